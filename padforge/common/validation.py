"""Errors reported to users in one line without a traceback, and checks of arguments."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral, Real
from pathlib import Path
from reprlib import repr as shortened
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

MAX_LISTED = 12  # maximum number of names in a message
MAX_VALUES = 2**28  # size limit of arrays that public functions accept or create: 2 GiB of float64

Kind = TypeVar("Kind")


def printable(text: str) -> str:
    """Escape the characters of a line that are not printable: text from a file could contain control sequences."""
    return "".join(char if char.isprintable() else ascii(char)[1:-1] for char in text)


class InputError(ValueError):
    """An error of the user: a file, setting or argument that cannot be used, in one line that says what is allowed."""

    exit_code = 2  # of the command line, which prints the message without a traceback

    def __init__(self, message: object = "") -> None:
        super().__init__(" ".join(str(message).splitlines()))  # names of files and keys may contain line ends


@contextmanager
def naming_file(path: Path | str) -> Iterator[None]:
    """Put the name of a file, or of another source, before the message of an InputError."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


class Fault(Exception):  # noqa: N818  not an error of the program
    """A fault outside the program that needs the user's attention, such as a robot that was stopped."""

    exit_code = 1  # of the command line


# Distributions by their module, if the names differ.
_DISTRIBUTIONS = {"OCP": "build123d", "PIL": "pillow", "markdown_it": "markdown-it-py", "serial": "pyserial"}
_DISTRIBUTIONS |= {"foxglove": "foxglove-sdk", "rerun": "rerun-sdk"}
_DISTRIBUTIONS |= dict.fromkeys(("rtde_control", "rtde_receive"), "ur-rtde")


def missing_extra(error: ModuleNotFoundError, wanted: str = "") -> str | None:
    """Return advice in one line on how to install a missing library; None if it belongs to no extra of padforge.

    `wanted` are the extras, separated by commas, that the command needs in any case.
    """
    from importlib.metadata import PackageNotFoundError, requires

    module = (error.name or "").partition(".")[0]
    library = _DISTRIBUTIONS.get(module, module)
    requirement = re.compile(r"""([\w-]+).*extra == ['"](?!(?:all|test)\b)([\w-]+)""")
    try:
        matches = [match for line in requires("padforge") or () if (match := requirement.match(line))]
    except PackageNotFoundError:
        return None
    sizes = Counter(match[2] for match in matches)
    extras = [match[2] for match in matches if match[1] == library]
    if not extras:
        return None
    extra = wanted if {*wanted.split(",")} & {*extras} else min(extras, key=sizes.__getitem__)
    return f"this needs {library}, which is not installed: pip install 'padforge[{extra}]'"


def short_repr(value: object) -> str:
    """Return the representation of a value of any type and size, shortened to one line."""
    return " ".join(shortened(value).split())


def join_names(names: Sequence[str]) -> str:
    """Join the first names by commas, for a message."""
    more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
    return (", ".join(short_repr(name) for name in names[:MAX_LISTED]) or "nothing") + more


def check_type(name: str, value: object, kind: type[Kind]) -> Kind:
    """Return `value` if it is a `kind`, otherwise raise InputError."""
    if not isinstance(value, kind):
        raise InputError(f"{name} is {short_repr(value)}, expected a {kind.__name__}")
    return value


def check_int(name: str, value: object, minimum: int, maximum: int) -> int:
    """Return a whole number within [minimum, maximum] as an int, otherwise raise InputError."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not minimum <= int(value) <= maximum:
        raise InputError(f"{name} is {short_repr(value)}, allowed is a whole number from {minimum} to {maximum}")
    return int(value)


def check_float(name: str, value: object, minimum: float, maximum: float) -> float:
    """Return a number within [minimum, maximum] as a float, otherwise raise InputError."""
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    if not minimum <= number <= maximum:
        raise InputError(f"{name} is {short_repr(value)}, allowed is {minimum:g} to {maximum:g}")
    return number


def check_array(name: str, values: "ArrayLike", max_abs: float = math.inf) -> "NDArray[np.float64]":
    """Return finite real numbers of any shape, at most `max_abs`, as float64, otherwise raise InputError."""
    import numpy as np

    try:
        array = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} are {short_repr(values)}, expected numbers in rows of equal length") from error
    if array.dtype.kind not in "fiu" and array.size:
        raise InputError(f"{name} are {array.dtype} values, expected real numbers")
    if array.size > MAX_VALUES:
        raise InputError(f"{name} are {array.size} numbers, allowed are {MAX_VALUES}")
    numbers = array.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise InputError(f"{name} hold NaN or infinity, expected finite numbers")
    if numbers.size and np.abs(numbers).max() > max_abs:
        raise InputError(f"{name} hold {np.abs(numbers).max():g}, allowed is {-max_abs:g} to {max_abs:g}")
    return numbers


def check_path(name: str, value: object) -> Path:
    """Return a string or path as a Path, otherwise raise InputError."""
    if not isinstance(value, str | Path) or value == "":
        raise InputError(f"{name} is {short_repr(value)}, expected a path")
    return Path(value)


def check_mapping(name: str, value: object) -> Mapping[str, Any]:
    """Return a mapping with string keys, such as a JSON object, otherwise raise InputError."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{name} is {short_repr(value)}, expected a table")
    return value
