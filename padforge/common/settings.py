"""Reading, validation and writing of `pad.toml`; each package defines the models of its sections."""

import json
import sys
import tomllib
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from pydantic import BaseModel, BeforeValidator, ConfigDict, PlainSerializer, ValidationError, model_validator

from padforge.common.files import read_bytes
from padforge.common.validation import InputError, check_mapping, check_path, check_type, short_repr

if TYPE_CHECKING:
    from pydantic import GetJsonSchemaHandler
    from pydantic_core import CoreSchema


class Settings(BaseModel):
    """A table of `pad.toml`: immutable, without unknown keys and NaN; descriptions of fields become comments."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise _to_input_error(error, type(self), values, f"[{self.section()}]") from error

    @model_validator(mode="before")
    @classmethod
    def _without_numpy(cls, values: object) -> object:
        return to_builtins(values)

    @classmethod
    def section(cls) -> str:
        """Return the name of the table: that of the model, without `Settings`."""
        return cls.__name__.removesuffix("Settings").lower()

    # Makes pydantic validate nested tables without this __init__, so that its errors have the full path of a key.
    __init__.__pydantic_base_init__ = True  # pyright: ignore[reportFunctionMemberAccess]


AnySettings = TypeVar("AnySettings", bound=Settings)


def to_builtins(value: Any) -> object:
    """Convert NumPy scalars and arrays to Python numbers and lists."""
    numpy = sys.modules.get("numpy")  # a caller with such values has imported it
    if numpy and isinstance(value, numpy.generic | numpy.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        items = map(to_builtins, value)
        return list(items) if isinstance(value, list) else tuple(items)
    if isinstance(value, Mapping):
        return {key: to_builtins(item) for key, item in value.items()}
    return value


def as_tuple(value: object) -> object:
    """Convert a list, as read from a file, to the tuple of a frozen model; return other values unchanged."""
    return tuple(value) if isinstance(value, list) else value


@dataclass(frozen=True)
class _NullWord:
    """Annotation that replaces null in the JSON Schema of a key by a word."""

    word: str

    def __get_pydantic_json_schema__(self, schema: "CoreSchema", handler: "GetJsonSchemaHandler") -> dict[str, Any]:
        """Return the JSON Schema of the key with the word in place of null."""
        options = handler(schema)["anyOf"]
        return {"anyOf": [{"const": self.word} if option == {"type": "null"} else option for option in options]}


def null_as(word: str) -> tuple[BeforeValidator, PlainSerializer, _NullWord]:
    """Return annotations of a key whose None is `word` in files: `Annotated[float | None, *null_as("any")]`."""

    def read(value: object) -> object:
        return None if isinstance(value, str) and value == word else value

    return BeforeValidator(read), PlainSerializer(lambda value: word if value is None else value), _NullWord(word)


class Spec:
    """The contents of a `pad.toml`; `spec.section(PadSettings)` returns a validated section with its defaults."""

    def __init__(
        self,
        tables: Mapping[str, Mapping[str, Any]],
        source: str = "built-in defaults",
        sections: Collection[str] | None = None,
    ) -> None:
        """Check that `tables` has only the allowed `sections`, any if None; `section` validates their contents.

        Errors name the `source`.
        """
        allowed = check_mapping("tables", tables) if sections is None else sections
        if unknown := [name for name in tables if name not in allowed]:
            raise InputError(f"{source}: unknown section [{unknown[0]}], allowed are {', '.join(allowed)}")
        for name, table in tables.items():
            check_mapping(f"{source}: [{name}]", table)
        self.source, self._tables = source, tables

    @classmethod
    def load(cls, path: Path | None, sections: Collection[str] | None = None) -> "Spec":
        """Read a TOML file with the allowed `sections`, any if None; a `path` of None stands for the defaults."""
        if path is None:
            return cls({})
        path = check_path("path", path)
        content = read_bytes(path)
        try:
            tables = tomllib.loads(content.decode("utf-8-sig"))
        except ValueError as error:
            raise InputError(f"{path}: not a TOML file ({error})") from error
        return cls(tables, str(path), sections)

    def section(self, model: type[AnySettings], **overrides: Any) -> AnySettings:
        """Return the validated section of a model; raise InputError if a key is unknown or a value out of range.

        Overrides that are not None replace values of the file; errors in them do not name the file.
        """
        changes = {key: value for key, value in overrides.items() if value is not None}
        return validate(model, {**self.stated(model), **changes}, f"{self.source}: [{model.section()}]", changes)

    def replaced(self, tables: Mapping[str, Mapping[str, Any]], source: str = "") -> "Spec":
        """Return a copy with other values, by section and key; errors name its `source`, by default that of `self`."""
        source = source or self.source
        Spec(tables, source)  # checks the tables
        names = {*self._tables, *tables}
        return Spec({name: {**self._tables.get(name, {}), **tables.get(name, {})} for name in names}, source)

    def stated(self, model: type[Settings] | str) -> Mapping[str, Any]:
        """Return the values of a section, given by its model or name, that the file states; they are not validated."""
        return self._tables.get(model if isinstance(model, str) else model.section(), {})


def or_default(
    name: str, value: AnySettings | None, model: type[AnySettings], default: AnySettings | None = None
) -> AnySettings:
    """Return an argument that is a section of the settings; if it is None, `default` or the defaults of the model."""
    return (default or model()) if value is None else check_type(name, value, model)


def validate(
    model: type[AnySettings], values: Mapping[str, Any], where: str, overrides: Collection[str] = ()
) -> AnySettings:
    """Return `model(**values)`; raise the first error of pydantic as an InputError.

    The message begins with `where`, or, if its key is in `overrides`, with the section.
    """
    try:
        return model.model_validate(dict(values))
    except ValidationError as error:
        raise _to_input_error(error, model, values, where, overrides) from error


def _to_input_error(
    error: ValidationError,
    model: type[Settings],
    values: Mapping[str, Any],
    where: str,
    overrides: Collection[str] = (),
) -> InputError:
    first = error.errors()[0]
    if first["loc"] and first["loc"][0] in overrides:
        where = f"[{model.section()}]"
    message = first["msg"].removeprefix("Value error, ")
    if not first["loc"]:  # the message of an error of the whole section has the keys
        return InputError(f"{where} {message}")
    key = _key_path(first["loc"], model, values)
    if first["type"] == "extra_forbidden":
        allowed = f", allowed are {', '.join(model.model_fields)}" if len(first["loc"]) == 1 else ""
        return InputError(f"{where} {key}: no such key{allowed}")
    message = message[:1].lower() + message[1:]  # units keep their capitals
    return InputError(f"{where} {key}: got {short_repr(first['input'])}, {message}")


def _key_path(loc: Sequence[str | int], model: type[Settings], values: object) -> str:
    """Return the path of an error in the values of a model, such as contacts[0].radius.

    Items of `loc` that are neither keys nor indices are names of types, which pydantic inserts.
    """
    path = ""
    for item in loc:
        if isinstance(item, int):
            path += f"[{item}]"
        elif item in model.model_fields or (isinstance(values, Mapping) and item in values):
            path += f".{item}"
        else:
            continue
        with suppress(LookupError, TypeError):  # this value is not a table or list
            values = cast("Any", values)[item]
    return path.removeprefix(".")


def commented_toml(models: Mapping[str, type[Settings]], preset: Mapping[str, Settings] | None = None) -> str:
    """Return a `pad.toml` with every key of `models`, by section, and the descriptions as comments."""
    head = "# padforge settings. Every key is optional; what stands here is the default"
    lines = [f"{head}, or of the preset." if preset else f"{head}."]
    lines += ["# Numbers are in the units of the comments."]
    for name, model in models.items():
        lines += ["", f"[{name}]"]
        values = ((preset or {}).get(name) or model()).model_dump()
        for key, field in model.model_fields.items():
            value = json.dumps(values[key], ensure_ascii=False)  # also valid TOML
            lines.append(f"{key} = {value} ".ljust(36) + f"# {field.description}")
    return "\n".join(lines) + "\n"


def settings_schema(models: Mapping[str, type[Settings]]) -> dict[str, Any]:
    """Return the JSON Schema of a `pad.toml`, with which editors complete and check it.

    It uses draft 7, the latest one that editors for TOML support, and does not express rules across keys.
    """
    from pydantic.json_schema import models_json_schema  # slow to import, and needed by one command only

    refs, schema = models_json_schema([(model, "validation") for model in models.values()])
    for model in models.values():
        table = schema["$defs"][refs[model, "validation"]["$ref"].rpartition("/")[2]]
        table["description"] = table["description"].partition("\n\n")[0]
        for key, default in model().model_dump(mode="json").items():
            described = {"description": model.model_fields[key].description, "default": default}
            table["properties"][key] = described | _as_in_files(table["properties"][key])
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "padforge settings",
        "type": "object",
        "additionalProperties": False,
        "properties": {name: refs[model, "validation"] for name, model in models.items()},
        **schema,
    }


def _as_in_files(schema: Any) -> Any:
    """Return the schema of a key, with tuples as in draft 7."""
    if isinstance(schema, list):
        return [_as_in_files(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    dropped, renamed = {"title", "description", "default"}, {"prefixItems": "items"}
    return {renamed.get(name, name): _as_in_files(item) for name, item in schema.items() if name not in dropped}
