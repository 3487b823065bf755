"""The note on kernels that are compiled: not where it is short or they are read from disk."""

import ast
import logging
import re
import shutil
import time
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest
from numba.core import event as events

import padforge
from padforge.design.common import compilation
from tests.helpers.kernels import PACKAGES

KERNELS = """
from padforge.design.common.compilation import inner_kernel, kernel

@inner_kernel
def inner(x):
    return x + 1

@kernel
def outer(x):
    return inner(x) * 2
"""

COMPILED = ("kernel", "inner_kernel", "inline_kernel", "njit")


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
        with events.install_listener("numba:compile", compilation.Compilations()):
            assert loaded(path).outer(value) == 2 * (value + 1)
            time.sleep(0.05)
        return [record.message.split(",")[0] for record in caplog.records]

    assert notes(1) == []  # compiled in less than the patience
    monkeypatch.setattr(compilation, "PATIENCE_S", 0.0)
    assert notes(1) == []  # read from disk
    assert set(notes(1.5)) == {"compiling kernels"}  # another type is compiled


def test_clear_stale_kernels_deletes_when_a_source_changes(tmp_path: Path) -> None:
    package = tmp_path / "kernels"
    (package / "room").mkdir(parents=True)
    for name in ("inner.py", "outer.py", "room/outer.py"):
        (package / name).write_text("x = 1")
    kept = [folder / "__pycache__" / "outer.py311.1.nbc" for folder in (package, package / "room")]
    compilation.clear_stale_kernels(package)
    for path in kept:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    compilation.clear_stale_kernels(package)
    assert all(path.exists() for path in kept)
    (package / "inner.py").write_text("x = 2")
    compilation.clear_stale_kernels(package)
    assert not any(path.exists() for path in kept)
    shutil.rmtree(package / "__pycache__")
    (package / "__pycache__").touch()  # a folder that cannot be written
    compilation.clear_stale_kernels(package)
    assert (package / "__pycache__").is_file()


def test_inner_kernels_are_called_by_kernels_alone() -> None:
    """Whichever name they are imported by: Python would crash."""
    folders = [Path(folder) / package for folder in padforge.__path__ for package in PACKAGES]
    sources, tests = (
        [path.read_text(encoding="utf-8") for folder in where for path in folder.rglob("*.py")]
        for where in (folders, [Path(__file__).parents[2]])
    )

    inner = {
        name for source in sources for name in re.findall(r"^@in(?:ner|line)_kernel.*\ndef (\w+)", source, re.MULTILINE)
    }
    assert {"piece_of", "select_frame"} <= inner
    named = re.compile(rf"\b({'|'.join(inner)})\b")

    def look_at(node: ast.AST) -> None:
        """Assert of a node and all below it, but for what is compiled."""
        decorators = node.decorator_list if isinstance(node, ast.FunctionDef) else []
        if any(ast.unparse(decorator).split("(")[0] in COMPILED for decorator in decorators):
            return
        assert not (isinstance(node, ast.alias) and node.name in inner and node.asname)
        assert getattr(node, "attr", getattr(node, "id", "")) not in inner
        for child in ast.iter_child_nodes(node):
            look_at(child)

    for source in filter(named.search, sources + tests):
        look_at(ast.parse(source))
