"""The rules of the house: tests mirror rooms, and nothing private is shared.

Each test names all that breaks its rule. Which way imports may point is import-linter's to say, in pyproject.toml.
"""

import ast
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("design", "fabricate", "sense")
CODE = (*PACKAGES, "padforge")
HOUSE = (*CODE, "tests")

SOURCES = {".py", ".pyi", ".js", ".css", ".html", ".j2", ".ino", ".h"}

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def paths() -> list[Path]:
    """Files and folders of the house, relative to its root, without what Python and tools leave behind."""
    roots = [ROOT / name for name in HOUSE]
    found = [path for root in roots for path in (root, *root.rglob("*"))]
    kept = [path.relative_to(ROOT) for path in found if not path.is_dir() or any(path.rglob("*.*"))]
    return sorted(path for path in kept if not any(part.startswith((".", "__pycache__")) for part in path.parts))


def sources(*within: str, suffixes: set[str] = SOURCES) -> Iterator[Path]:
    return (path for path in paths() if path.suffix in suffixes and path.parts[0] in (within or HOUSE))


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse((ROOT / path).read_text(encoding="utf-8"))


def public(scope: ast.Module | ast.ClassDef) -> Iterator[Function]:
    """Functions and methods that others may call."""
    for node in scope.body:
        name = getattr(node, "name", "_")
        if isinstance(node, Function) and (name == "__init__" or not name.startswith("_")):
            yield node
        elif isinstance(node, ast.ClassDef) and not name.startswith("_"):
            yield from public(node)


def private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def borrowed_privates() -> Iterator[str]:
    """Private names that a module has from another one, imported or looked up in it."""
    for path in sources(*CODE, suffixes={".py", ".pyi"}):
        modules = set()
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").split(".")[0] in PACKAGES):
                yield from (
                    f"{path}: imports {each.name} of {node.module}" for each in node.names if private(each.name)
                )
                modules |= {each.asname or each.name for each in node.names if each.name.islower()}
        for node in ast.walk(parsed(path)):
            match node:
                case ast.Attribute(ast.Name(module), name) if module in modules and private(name):
                    yield f"{path}: uses {module}.{name}"


def rooms_without_code() -> Iterator[str]:
    """Folders of tests, stress tests too, that are no rooms of the package they test."""
    for path in sources("tests", suffixes={".py"}):
        inner = path.parent.parts[2 if path.parts[1] == "stress" else 1 :]
        if path.name.startswith("test_") and inner[:1] and inner[0] in PACKAGES and not ROOT.joinpath(*inner).is_dir():
            yield f"{path}: there is no {'/'.join(inner)}"


@pytest.mark.parametrize("broken", [borrowed_privates, rooms_without_code])
def test_the_house_keeps_its_rules(broken: Callable[[], Iterator[str]]) -> None:
    found = sorted(broken())
    assert not found, "\n".join(["", *found])


def test_the_house_is_looked_at() -> None:
    """Nothing passes because nothing was found."""
    assert {path.parts[0] for path in sources()} == set(HOUSE)
    assert len(list(sources(suffixes={".py"}))) > 200
    assert sum(1 for path in sources(*CODE, suffixes={".py"}) for _ in public(parsed(path))) > 500
