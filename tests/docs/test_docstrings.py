"""Docstrings as mkdocstrings reads them: complete for what a package exports, and never half complete elsewhere."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe
import pytest

ROOT = Path(__file__).parents[2]
EXPORTS = ["padforge.design"]


def public_functions(parent: Any) -> Iterator[Any]:
    """Functions and methods below `parent` whose names, and whose classes' names, are public."""
    for name, member in parent.members.items():
        if member.is_alias or (name.startswith("_") and name != "__init__"):
            continue
        if member.is_function and "overload" not in member.labels:
            yield member
        elif member.is_module or member.is_class:
            yield from public_functions(member)


def stated_parameters(function: Any) -> set[str] | None:
    """Names in the section of parameters of a function, or of the class that it constructs; None without a section."""
    owners = [function, *([function.parent] if function.name == "__init__" else [])]
    sections = [section for owner in owners if owner.docstring for section in owner.docstring.parsed]
    found = [section.value for section in sections if section.kind is griffe.DocstringSectionKind.parameters]
    return {item.name.lstrip("*") for items in found for item in items} if found else None


def parameters(function: Any) -> set[str]:
    return {parameter.name for parameter in function.parameters} - {"self", "cls"}


@pytest.mark.parametrize("package", EXPORTS)
def test_docstrings_of_exported_functions_state_every_parameter(package: str) -> None:
    loaded = griffe.load(package, search_paths=[ROOT / "typings"], docstring_parser="google")
    exported = [
        member.final_target for member in loaded.members.values() if member.is_alias and member.is_imported is not None
    ]
    assert exported
    missing = [
        f"{function.path}: {sorted(parameters(function) - (stated_parameters(function) or set()))}"
        for member in exported
        if member.path.startswith("padforge")
        for function in ([member] if member.is_function else public_functions(member))
        if parameters(function) - (stated_parameters(function) or set())
    ]
    assert not missing, "\n".join(missing)
