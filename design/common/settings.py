import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from .errors import InputError, instance, mapping, shown
from .errors import path as as_path
from .files import read_bytes

MOST_BYTES = 2**18
"""Longer settings are none that anybody wrote, and would take long to be refused."""

MOST_DOTS = 200
"""In a line: keys of very many parts take the reader of TOML time that grows with their square."""

SECTIONS = ("pad", "contact", "search", "rules", "mould", "printer", "rig", "localizer")
"""Every section a `pad.toml` may have, whichever package owns it."""


class Section(BaseModel):
    """One table of `pad.toml`: immutable, no unknown keys, no NaN; a field's description is its comment."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise _finding(error, type(self), f"[{type(self).__name__.lower()}]") from error

    __init__.__pydantic_base_init__ = True  # pyright: ignore[reportFunctionMemberAccess]  else tables within go there too


AnySection = TypeVar("AnySection", bound=Section)


class Spec:
    """The content of a `pad.toml`: `spec.section(Pad)` is that section, validated, with defaults filled in."""

    def __init__(self, tables: Mapping[str, Mapping[str, Any]], source: str = "built-in defaults") -> None:
        mapping("tables", tables)
        unknown = [name for name in tables if name not in SECTIONS]
        if unknown:
            raise InputError(f"{source}: unknown section [{unknown[0]}], allowed are {', '.join(SECTIONS)}")
        for name, table in tables.items():
            if not isinstance(table, Mapping):
                raise InputError(f"{source}: {name} is {shown(table)}, expected a section [{name}]")
            mapping(f"{source}: [{name}]", table)
        self.source = source
        self._tables = tables

    @classmethod
    def load(cls, path: Path | None) -> "Spec":
        """Read a TOML file; None stands for the defaults.

        Raises:
            InputError: the file is missing, is no TOML, or has an unknown section.
        """
        if path is None:
            return cls({})
        path = as_path("path", path)
        content = read_bytes(path, MOST_BYTES)
        if any(line.count(b".") > MOST_DOTS for line in content.splitlines()):
            raise InputError(f"{path}: not a settings file (a line has more than {MOST_DOTS} dots)")
        try:
            tables = tomllib.loads(content.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:  # tables within tables without end
            raise InputError(f"{path}: not a TOML file ({error})") from error
        return cls(tables, str(path))

    def section(self, model: type[AnySection], **overrides: Any) -> AnySection:
        """The section `model` stands for; `overrides` that are not None win over the file.

        Raises:
            InputError: an unknown key or a value out of range, naming the key, the value and what is allowed.
        """
        if not (isinstance(model, type) and issubclass(model, Section)):
            raise InputError(f"model is {shown(model)}, expected a section such as Pad")
        name = model.__name__.lower()
        given = {key: value for key, value in overrides.items() if value is not None}
        return validated(model, {**self._tables.get(name, {}), **given}, f"{self.source}: [{name}]")


def section(name: str, value: AnySection | None, model: type[AnySection]) -> AnySection:
    """The argument `name` of a public function: a section, or its defaults for None."""
    return model() if value is None else instance(name, value, model)


def validated(model: type[AnySection], values: Mapping[str, Any], where: str) -> AnySection:
    """`model(**values)`, with pydantic's findings as one InputError line that begins with `where`."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise _finding(error, model, where) from error


def _finding(error: ValidationError, model: type[Section], where: str) -> InputError:
    """The first of pydantic's findings on a `model` as one line that begins with `where`."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"] if str(part) in model.model_fields or isinstance(part, int))
    if first["type"] == "extra_forbidden":
        allowed = f", allowed are {', '.join(model.model_fields)}" if len(first["loc"]) == 1 else ""
        return InputError(f"{where} {'.'.join(map(str, first['loc']))}: no such key{allowed}")
    return InputError(f"{where} {key}: got {shown(first['input'])}, {first['msg'].lower()}")


def commented_toml(models: Mapping[str, type[Section]]) -> str:
    """A `pad.toml` that states every default, with each field's description as its comment."""
    lines = ["# padforge settings. Every key is optional; what stands here is the default."]
    for name, model in models.items():
        lines += ["", f"[{name}]"]
        defaults = model().model_dump()
        for key, field in model.model_fields.items():
            lines.append(f"{key} = {_toml_value(defaults[key])}".ljust(36) + f"# {field.description}")
    return "\n".join(lines) + "\n"


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    return repr(value)
