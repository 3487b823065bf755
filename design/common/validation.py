"""The exceptions a user meets: each is one line, without a traceback."""

import math
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from numbers import Integral, Real
from pathlib import Path
from reprlib import repr as shortened
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray


class InputError(ValueError):
    """The user's own mistake: a file, setting or argument that cannot be used.

    The message is one line that names the thing, the value got and what is
    allowed. The command line prints it without a traceback and exits 2.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(" ".join(str(message).splitlines()))  # names of files and keys may hold line ends


class Fault(Exception):  # noqa: N818  of things outside the program, not an error of it
    """Something outside went wrong that the user has to look at, such as a robot that was stopped.

    Attributes:
        exit_code: what the command line ends with.
    """

    exit_code = 1


def missing_extra(error: ModuleNotFoundError, wanted: str = "") -> str | None:
    """What makes up for a library that is missing, on one line; None if no extra of padforge brings it.

    What extras bring is read from what is installed of padforge itself, so that it is said in one place.

    Args:
        wanted: extras, with commas between them, that whatever was tried needs in any case.
    """
    from importlib.metadata import PackageNotFoundError, requires

    module = (error.name or "").partition(".")[0]
    library = _LIBRARIES.get(module, module)
    try:
        needs = requires("padforge") or ()
    except PackageNotFoundError:
        return None
    by = [re.search(r"""extra == ['"]([\w-]+)""", need) for need in needs if re.match(rf"{library}\b(?![-\w])", need)]
    extras = [found[1] for found in by if found and found[1] not in ("all", "test", "figures")]
    if not extras:
        return None
    extra = wanted if {*wanted.split(",")} & {*extras} else extras[0]
    return f"this needs {library}, which is not installed: pip install 'padforge[{extra}]'"


_LIBRARIES = {
    **{"OCP": "build123d", "PIL": "pillow", "markdown_it": "markdown-it-py", "serial": "pyserial"},
    **dict.fromkeys(("rtde_control", "rtde_receive"), "ur-rtde"),
}
"""Libraries by the module they bring, where the names differ."""

MAX_VALUES = 2**28
"""Most numbers an array may hold that a public function is given or makes: 2 GiB of them."""
MAX_PATH = 4096
"""Most characters of a path: no system takes more."""

Kind = TypeVar("Kind")


def short_repr(value: object) -> str:
    """A value of any type and size in a few words on one line."""
    try:
        return " ".join(shortened(value).split())
    except Exception:  # a whole number of too many digits, or somebody's own __repr__
        return f"a {type(value).__name__}"


def check_type(name: str, value: object, kind: type[Kind]) -> Kind:
    """`value`, which must be a `kind`."""
    if not isinstance(value, kind):
        raise InputError(f"{name} is {short_repr(value)}, expected a {kind.__name__}")
    return value


def check_int(name: str, value: object, least: int, most: int) -> int:
    """A whole number within `least`..`most`, as an int."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not least <= int(value) <= most:
        raise InputError(f"{name} is {short_repr(value)}, allowed is a whole number from {least} to {most}")
    return int(value)


def check_float(name: str, value: object, least: float, most: float) -> float:
    """A number within `least`..`most`, as a float."""
    number = math.nan
    if isinstance(value, Real) and not isinstance(value, bool):
        with suppress(OverflowError):
            number = float(value)
    if not least <= number <= most:
        raise InputError(f"{name} is {short_repr(value)}, allowed is {least:g} to {most:g}")
    return number


def check_array(name: str, values: "ArrayLike", most: float = math.inf) -> "NDArray[np.float64]":
    """Finite numbers of any shape, none beyond -most..most, as an array of float64.

    Raises:
        InputError: rows of different length, anything but real numbers, or more than MOST_VALUES of them.
    """
    import numpy as np

    try:
        found = np.asarray(values)
    except Exception as error:  # numpy lets pass whatever an object raises that poses as an array
        raise InputError(f"{name} are {short_repr(values)}, expected numbers in rows of one length") from error
    if found.dtype.kind not in "fiu" and found.size:
        raise InputError(f"{name} are {found.dtype} values, expected real numbers")
    if found.size > MAX_VALUES:
        raise InputError(f"{name} are {found.size} numbers, allowed are {MAX_VALUES}")
    with np.errstate(over="ignore"):  # of longer floats, which become infinity
        numbers = found.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise InputError(f"{name} hold NaN or infinity, expected finite numbers")
    if numbers.size and np.abs(numbers).max() > most:
        raise InputError(f"{name} hold {np.abs(numbers).max():g}, allowed is {-most:g} to {most:g}")
    return numbers


def check_path(name: str, value: object) -> Path:
    """A path, given as one or as text."""
    text = os.fspath(value) if isinstance(value, str | Path) else ""
    if not text or "\0" in text or len(text) > MAX_PATH:
        raise InputError(f"{name} is {short_repr(value)}, expected a path")
    return Path(text)


def check_mapping(name: str, value: object) -> Mapping[str, Any]:
    """A table of text keys, such as JSON's objects are."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{name} is {short_repr(value)}, expected a table")
    return value
