"""The rules of the house: rooms and files small enough to look over, tests that mirror rooms, nothing private shared.

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

MOST_LINES, MOST_FUNCTION_LINES, MOST_PARAMETERS, MOST_ENTRIES = 300, 60, 8, 9
MORE_ENTRIES = {"sense": 10, "tests/sense": 10}
SOURCES = {".py", ".pyi", ".js", ".css", ".html", ".j2", ".ino", ".h"}
UNCOUNTED = {"__init__.py", "__init__.pyi", "py.typed"}

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


def long_files() -> Iterator[str]:
    for path in sources():
        lines = (ROOT / path).read_text(encoding="utf-8").count("\n")
        if lines > MOST_LINES:
            yield f"{path}: {lines} lines, allowed are {MOST_LINES}"


def long_functions() -> Iterator[str]:
    for path in sources(suffixes={".py"}):
        for node in ast.walk(parsed(path)):
            if isinstance(node, Function):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > MOST_FUNCTION_LINES:
                    yield f"{path}: {node.name} has {lines} lines, allowed are {MOST_FUNCTION_LINES}"


def public(scope: ast.Module | ast.ClassDef) -> Iterator[Function]:
    """Functions and methods that others may call."""
    for node in scope.body:
        name = getattr(node, "name", "_")
        if isinstance(node, Function) and (name == "__init__" or not name.startswith("_")):
            yield node
        elif isinstance(node, ast.ClassDef) and not name.startswith("_"):
            yield from public(node)


def many_parameters() -> Iterator[str]:
    """Beside compiled kernels, which take no objects, and commands, which take what people may say."""
    for path in sources(*CODE, suffixes={".py"}):
        for function in public(parsed(path)):
            decorators = [ast.unparse(each).partition("(")[0] for each in function.decorator_list]
            if any(each.endswith(("njit", "command", "group")) for each in decorators):
                continue
            given = function.args
            names = [each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
            count = len(names) - (names[:1] in (["self"], ["cls"]))
            if count > MOST_PARAMETERS:
                yield f"{path}: {function.name} has {count} parameters, allowed are {MOST_PARAMETERS}"


def full_folders() -> Iterator[str]:
    for folder in (path for path in paths() if (ROOT / path).is_dir()):
        entries = [path.name for path in paths() if path.parent == folder and path.name not in UNCOUNTED]
        most = MORE_ENTRIES.get(folder.as_posix(), MOST_ENTRIES)
        if len(entries) > most:
            yield f"{folder}: {len(entries)} entries, allowed are {most}: {', '.join(entries)}"


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


@pytest.mark.parametrize(
    "broken", [long_files, long_functions, many_parameters, full_folders, borrowed_privates, rooms_without_code]
)
def test_the_house_keeps_its_rules(broken: Callable[[], Iterator[str]]) -> None:
    found = sorted(broken())
    assert not found, "\n".join(["", *found])


def test_the_house_is_looked_at() -> None:
    """Nothing passes because nothing was found."""
    assert {path.parts[0] for path in sources()} == set(HOUSE)
    assert len(list(sources(suffixes={".py"}))) > 200
    assert sum(1 for path in sources(*CODE, suffixes={".py"}) for _ in public(parsed(path))) > 500
