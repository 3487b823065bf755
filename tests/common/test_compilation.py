import logging
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest
from numba.core import event as events

from padforge.common import compilation

KERNELS = """
from padforge.common.compilation import kernel

@kernel
def inner(x):
    return x + 1

@kernel
def outer(x):
    return inner(x) * 2
"""


def loaded(path: Path) -> ModuleType:
    spec = spec_from_file_location("kernels_of_a_test", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_compilation_is_announced_unless_it_is_short_or_cached(tmp_path, monkeypatch, caplog) -> None:
    path = tmp_path / "kernels.py"
    path.write_text(KERNELS)
    caplog.set_level(logging.INFO, "padforge")

    def notes(value: float) -> list[str]:
        """Messages while the kernels run on a number, in a process that has not announced yet."""
        caplog.clear()
        with events.install_listener("numba:compile", compilation.Compilations()):
            assert loaded(path).outer(value) == 2 * (value + 1)
            time.sleep(0.05)
        return [record.message.split(",")[0] for record in caplog.records]

    assert notes(1) == []  # compiled in less than the patience
    monkeypatch.setattr(compilation, "NOTICE_AFTER_S", 0.0)
    assert notes(1) == []  # read from disk
    assert set(notes(1.5)) == {"compiling kernels"}  # another type is compiled


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The root of other sources, which have a folder of compiled kernels of their own; no other folder is theirs."""
    root = tmp_path / "padforge"
    for folder in ("design", "common"):
        (root / folder).mkdir(parents=True)
    monkeypatch.setattr(compilation, "SOURCES", [root / "design"])
    monkeypatch.setattr(compilation, "__file__", str(root / "common/compilation.py"))
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    compilation.cache_folder.cache_clear()
    yield root
    compilation.cache_folder.cache_clear()


@pytest.mark.parametrize("is_chosen", [False, True])
def test_kernels_are_compiled_anew_when_what_they_call_has_changed(root, monkeypatch, is_chosen) -> None:
    """In the folder of the user's choice, too."""
    if is_chosen:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(root / "chosen"))
    inner, _, outer = KERNELS.rpartition("@kernel")
    (root / "design/kernels").mkdir()
    (root / "design/kernels/inner.py").write_text(inner)
    imports = inner.partition("@")[0] + "from inner_of_a_test import inner\n"
    (root / "design/outer.py").write_text(f"{imports}@kernel{outer}")

    def compute() -> tuple[int, int]:
        """Do what a new process does; returns the result, and how many kernels are compiled for it."""
        compilation.cache_folder.cache_clear()
        monkeypatch.setitem(sys.modules, "inner_of_a_test", loaded(root / "design/kernels/inner.py"))
        module = loaded(root / "design/outer.py")
        return module.outer(1), sum(module.outer.stats.cache_misses.values())

    assert [compute(), compute()] == [(4, 1), (4, 0)]
    (root / "design/kernels/inner.py").write_text(inner.replace("x + 1", "(x + 2)"))
    assert [compute(), compute()] == [(6, 1), (6, 0)]
    base = root / ("chosen" if is_chosen else "common/__pycache__")
    assert len({path.parents[1] for path in root.rglob("*.nbc")}) == len(list(base.iterdir())) == 2


def test_kernels_are_cached_where_the_user_can_write(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files take the place of folders that cannot be written, one after the other."""
    bases = [root / name for name in ("chosen", "common/__pycache__", "xdg", "home/.cache", "temporary")]
    variables = {"NUMBA_CACHE_DIR": "chosen", "XDG_CACHE_HOME": "xdg", "HOME": "home", "USERPROFILE": "home"}
    for variable, name in variables.items():
        monkeypatch.setenv(variable, str(root / name))
    bases[-1].mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(bases[-1]))
    for base in bases:
        compilation.cache_folder.cache_clear()
        folder = compilation.cache_folder()
        assert folder.parent == base
        shutil.rmtree(base)
        base.touch()


def test_few_caches_of_other_sources_stay(root: Path) -> None:
    base, mine = root / "common/__pycache__", "compilation.cpython-311.pyc"
    base.mkdir()
    (base / mine).touch()
    for number in range(6):
        (base / f"padforge-kernels-{number:016x}").mkdir()
        os.utime(base / f"padforge-kernels-{number:016x}", (number, number))
    latest = compilation.cache_folder().name
    numbers = range(7 - compilation.MAX_CACHES, 6)
    assert {path.name for path in base.iterdir()} == {mine, latest, *(f"padforge-kernels-{n:016x}" for n in numbers)}
