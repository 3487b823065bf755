"""`pad.toml`: reading, validating and writing settings. Which sections there are is for those who own them to say."""

import math
import sys
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, ValidationError, model_validator

from padforge.design.common.files import read_bytes
from padforge.design.common.validation import InputError, check_mapping, check_type, short_repr
from padforge.design.common.validation import check_path as as_path

MAX_BYTES = 2**18
"""Longer settings are none that anybody wrote, and would take long to be refused."""
MAX_DOTS = 200
"""In a line: keys of very many parts take the reader of TOML time that grows with their square."""
MAX_DEPTH = 6
"""Of lists and tables in a table; no setting has more, and a list may hold itself."""
MAX_ITEMS = 2**17
"""Of an array; one of more is no setting, and a broadcast one may be larger than any memory once it is a list."""


class Settings(BaseModel):
    """One table of `pad.toml`: immutable, no unknown keys, no NaN; a field's description is its comment."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    MOVED: ClassVar[Mapping[str, str]] = {}
    """Keys that were in this table once, and where they are now."""

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise _finding(error, type(self), f"[{self.section()}]") from error

    @model_validator(mode="before")
    @classmethod
    def _without_numpy(cls, given: object) -> object:
        return to_builtins(given)

    @classmethod
    def section(cls) -> str:
        """The name of its table: the model's, without `Settings`."""
        return cls.__name__.removesuffix("Settings").lower()

    __init__.__pydantic_base_init__ = True  # pyright: ignore[reportFunctionMemberAccess]  else tables within go there too


AnySettings = TypeVar("AnySettings", bound=Settings)


def to_builtins(value: Any, depth: int = MAX_DEPTH) -> object:
    """Return a value with Python's numbers and lists in place of NumPy's scalars and arrays.

    Args:
        value: that of a key, or a whole table.
        depth: levels of lists and tables within which they are replaced.

    Returns:
        The value; an array of more than MAX_ITEMS as it is, which no model takes.
    """
    numpy = sys.modules.get("numpy")  # whoever has such values has loaded it, and nobody else waits for it
    if numpy and isinstance(value, numpy.generic | numpy.ndarray):
        # an axis of length 0 counts as 1: lists would be made for the others all the same
        return value if math.prod(max(length, 1) for length in value.shape) > MAX_ITEMS else value.tolist()
    if depth and isinstance(value, list | tuple):
        items = [to_builtins(item, depth - 1) for item in value]
        return items if isinstance(value, list) else tuple(items)
    if depth and isinstance(value, Mapping):
        return {key: to_builtins(item, depth - 1) for key, item in value.items()}
    return value


def as_tuple(value: object) -> object:
    """A list, as files have it, as the tuple that a frozen model holds; anything else as it is."""
    return tuple(value) if isinstance(value, list) else value


def null_as(word: str) -> tuple[BeforeValidator, PlainSerializer]:
    """For `Annotated[... | None, *none_as("unknown")]`: a key that is this word where the model holds None."""

    def read(value: object) -> object:
        return None if isinstance(value, str) and value == word else value

    return BeforeValidator(read), PlainSerializer(lambda value: word if value is None else value)


class Spec:
    """The content of a `pad.toml`: `spec.section(PadSettings)` is that section, validated, with defaults filled in.

    Args:
        tables: sections by name. source: what errors call them.
        sections: names that are allowed; any if None.
    """

    def __init__(
        self,
        tables: Mapping[str, Mapping[str, Any]],
        source: str = "built-in defaults",
        sections: Collection[str] | None = None,
    ) -> None:
        check_mapping("tables", tables)
        try:
            allowed = tables if sections is None else [*check_type("sections", sections, Collection)]
        except TypeError as error:  # an array of no dimension is a collection of nothing that could be gone through
            raise InputError(f"sections are {short_repr(sections)}, expected names") from error
        if not all(isinstance(name, str) for name in allowed):
            raise InputError(f"sections are {short_repr(sections)}, expected names")
        unknown = [name for name in tables if name not in allowed]
        if unknown:
            raise InputError(f"{source}: unknown section [{unknown[0]}], allowed are {', '.join(allowed)}")
        for name, table in tables.items():
            if not isinstance(table, Mapping):
                raise InputError(f"{source}: {name} is {short_repr(table)}, expected a section [{name}]")
            check_mapping(f"{source}: [{name}]", table)
        self.source = source
        self._tables = tables

    @classmethod
    def load(cls, path: Path | None, sections: Collection[str] | None = None) -> "Spec":
        """Read a TOML file with the `sections` allowed, or any; None stands for the defaults.

        Raises:
            InputError: the file is missing, is no TOML, or has an unknown section.
        """
        if path is None:
            return cls({})
        path = as_path("path", path)
        content = read_bytes(path, MAX_BYTES)
        if any(line.count(b".") > MAX_DOTS for line in content.splitlines()):
            raise InputError(f"{path}: not a settings file (a line has more than {MAX_DOTS} dots)")
        try:
            tables = tomllib.loads(content.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:  # tables within tables without end
            raise InputError(f"{path}: not a TOML file ({error})") from error
        return cls(tables, str(path), sections)

    def section(self, model: type[AnySettings], **overrides: Any) -> AnySettings:
        """The section `model` stands for; `overrides` that are not None win over the file.

        Raises:
            InputError: an unknown key or a value out of range, naming the key, the value and what is allowed.
        """
        given = {key: value for key, value in overrides.items() if value is not None}
        return validate(model, {**self.given(model), **given}, f"{self.source}: [{model.section()}]")

    def replaced(self, tables: Mapping[str, Mapping[str, Any]]) -> "Spec":
        """These settings, with the values in `tables`, by section, in place of their own."""
        Spec(tables, self.source)
        names = {*self._tables, *tables}
        return Spec({name: {**self._tables.get(name, {}), **tables.get(name, {})} for name in names}, self.source)

    def given(self, model: type[Settings]) -> Mapping[str, Any]:
        """What the file states of the section `model` stands for, as it stands there."""
        if not (isinstance(model, type) and issubclass(model, Settings)):
            raise InputError(f"model is {short_repr(model)}, expected a section such as Pad")
        return self._tables.get(model.section(), {})


def or_default(
    name: str, value: AnySettings | None, model: type[AnySettings], default: AnySettings | None = None
) -> AnySettings:
    """The argument `name` of a public function: a section, or for None `default`, the section's own if that is None."""
    return (default or model()) if value is None else check_type(name, value, model)


def validate(model: type[AnySettings], values: Mapping[str, Any], where: str) -> AnySettings:
    """`model(**values)`, with pydantic's findings as one InputError line that begins with `where`."""
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise _finding(error, model, where) from error


def _finding(error: ValidationError, model: type[Settings], where: str) -> InputError:
    """The first of pydantic's findings on a `model` as one line that begins with `where`."""
    first = error.errors()[0]
    if not first["loc"]:  # a finding on the whole section names the key itself
        return InputError(f"{where} {first['msg']}")
    key = ".".join(str(part) for part in first["loc"] if str(part) in model.model_fields or isinstance(part, int))
    if first["type"] == "extra_forbidden":
        if moved := model.MOVED.get(str(first["loc"][0])):
            return InputError(f"{where} {first['loc'][0]}: no such key, it is {moved} now")
        allowed = f", allowed are {', '.join(model.model_fields)}" if len(first["loc"]) == 1 else ""
        return InputError(f"{where} {'.'.join(map(str, first['loc']))}: no such key{allowed}")
    return InputError(f"{where} {key}: got {short_repr(first['input'])}, {first['msg'].lower()}")


def commented_toml(models: Mapping[str, type[Settings]], preset: Mapping[str, Settings] | None = None) -> str:
    """A `pad.toml` that states every default, or what a preset has in its place, with descriptions as comments."""
    head = "# padforge settings. Every key is optional; what stands here is the default"
    lines = [f"{head}, or of the preset." if preset else f"{head}."]
    for name, model in models.items():
        lines += ["", f"[{name}]"]
        stated = ((preset or {}).get(name) or model()).model_dump()
        for key, field in model.model_fields.items():
            lines.append(f"{key} = {_toml_value(stated[key])} ".ljust(36) + f"# {field.description}")
    return "\n".join(lines) + "\n"


def _toml_value(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    return repr(value)
