"""The note on kernels that are compiled: not where it is short or they are read from disk."""

import logging
import time
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

from padforge.design.common import compilation

KERNELS = """
from numba import njit

@njit(cache=True)
def inner(x):
    return x + 1

@njit(cache=True)
def outer(x):
    return inner(x) * 2
"""


def loaded(path: Path) -> ModuleType:
    """Load the module anew, as a new process does."""
    spec = spec_from_file_location("kernels_of_a_test", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_compilation_is_announced_unless_it_is_short_or_cached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "kernels.py"
    path.write_text(KERNELS)
    caplog.set_level(logging.INFO, "padforge")

    def notes(value: float) -> list[str]:
        """Messages while the kernels run on a number, in a process that has not announced yet."""
        caplog.clear()
        compilation.announce_compilation.cache_clear()
        compilation.announce_compilation()
        assert loaded(path).outer(value) == 2 * (value + 1)
        time.sleep(0.05)
        return [record.message.split(",")[0] for record in caplog.records]

    assert notes(1) == []  # compiled in less than the patience
    monkeypatch.setattr(compilation, "PATIENCE_S", 0.0)
    assert notes(1) == []  # read from disk
    assert set(notes(1.5)) == {"compiling kernels"}  # another type is compiled
