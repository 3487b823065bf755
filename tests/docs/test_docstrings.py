"""Docstrings as mkdocstrings reads them: complete for what is exported, never half complete elsewhere."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import griffe
import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
STAGES = ("design", "fabricate", "sense")


@cache
def package() -> Any:
    """All of padforge: griffe reads it whole if it is asked for a part of it."""
    return griffe.load(f"padforge.{STAGES[0]}", search_paths=[ROOT / "typings"], docstring_parser="google").package


def public_functions(parent: Any) -> Iterator[Any]:
    """Functions and methods below `parent` with public names; constructors of classes that define one."""
    for name, member in parent.members.items():
        if member.is_alias or (name.startswith("_") and name != "__init__"):
            continue
        if member.is_function:
            yield member
        elif member.is_module or member.is_class:
            yield from public_functions(member)


def parameters(function: Any) -> set[str]:
    return {parameter.name for parameter in function.parameters} - {"self", "cls"}


def stated_parameters(function: Any) -> set[str] | None:
    """Names that the docstring states, of a constructor also those of its class; None without such a section."""
    owners = [function, *([function.parent] if function.name == "__init__" else [])]
    sections = [section for owner in owners if owner.docstring for section in owner.docstring.parsed]
    kinds = griffe.DocstringSectionKind.parameters, griffe.DocstringSectionKind.attributes
    stated = [section.value for section in sections if section.kind in kinds]
    return {item.name.lstrip("*") for items in stated for item in items} if stated else None


def exported(name: str) -> Iterator[Any]:
    for node in ast.parse((ROOT / name / "__init__.pyi").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                member = package().members[name]
                for part in f"{node.module}.{alias.name}".split("."):
                    member = member.members[part]
                yield member


def test_docstrings_state_all_parameters_or_none_and_every_one_of_what_is_exported() -> None:
    missing = {
        function.path: parameters(function) - (stated_parameters(function) or set())
        for name in STAGES
        for member in exported(name)
        for function in ([member] if member.is_function else public_functions(member) if member.is_class else [])
        if not (function.name == "__init__" and ({"dataclass"} & member.labels or member.bases))
    }
    partial = {
        function.path: parameters(function) ^ stated
        for name in STAGES
        for function in public_functions(package().members[name])
        if (stated := stated_parameters(function)) is not None and function.name != "__init__"
    }
    for found, least in ((missing, 10), (partial, 0)):
        assert all(sum(path.startswith(f"padforge.{name}.") for path in found) > least for name in STAGES)
        assert {path: names for path, names in found.items() if names} == {}
