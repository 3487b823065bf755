"""Arrays that a recording consists of: their types, their limits, which no pad or clock exceeds, and checks."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.common.validation import MAX_VALUES, InputError, short_repr

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_FIBRES = 512
MAX_VOLTS = 1e3  # largest absolute reading, V
MAX_MM = 1e5  # largest absolute position, mm
MAX_S = 1e10  # largest absolute time, s; seconds since 1970 are 2e9
MAX_N = 1e5  # largest absolute force, N
MIN_RATE_HZ = 1e-3
MAX_RATE_HZ = 1e6
MAX_BYTES = 2**33  # size of the largest file of a recording
MAX_INDEX = 2**53  # largest index that float64 holds exactly
MIN_SCALE_V = 1e-9  # minimum standard deviation, V, by which an input is divided; an input that varies less is constant


def masked_mean(values: Array, mask: Mask) -> Array:
    """Return the means over the first axis of the values in a mask; 0 where it has none."""
    return np.where(mask, values, 0.0).sum(axis=0) / np.maximum(mask.sum(axis=0), 1)


def press_bounds(down_command: Any, up_command: Any, n_readings: Any, xp: Any = np) -> tuple[Any, Any]:
    """Return the first reading (Q,) after the previous press, and the first of the next one or the end of the readings.

    All arrays are of the module `xp`, numpy or torch.
    """
    previous_end = xp.concat([xp.zeros_like(up_command[:1]), up_command[:-1]])
    return previous_end, xp.concat([down_command[1:], xp.atleast_1d(n_readings)])


def check_numbers(values: ArrayLike, kind: type[np.generic], name: str, copy: bool = True) -> NDArray[Any]:
    """Convert values to an array of float64 or int64; raise InputError if they are anything else, or too many."""
    allowed = "real numbers" if kind is np.float64 else f"whole numbers up to {MAX_INDEX}"
    try:
        array = np.asarray(values)
    except Exception as error:  # numpy passes on whatever an object raises that poses as an array
        raise InputError(f"{name} are {short_repr(values)}, expected an array of {allowed} ({error})") from error
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} are {short_repr(values)} ({array.dtype}), expected an array of {allowed}")
    if array.size > MAX_VALUES:
        raise InputError(f"{name} are {array.size} numbers, allowed are {MAX_VALUES}")
    with np.errstate(over="ignore"):  # longer floats become infinity
        array = array.astype(np.float64, copy=copy) if array.dtype.kind == "f" else array
    if kind is np.int64 and not ((array >= -MAX_INDEX) & (array <= MAX_INDEX) & (array == np.trunc(array))).all():
        raise InputError(f"{name} are {short_repr(values)}, expected an array of {allowed}")
    return array.astype(kind, copy=copy)


def check_magnitude(name: str, values: Array, limit: float, unit: str, missing: bool = False) -> None:
    """Raise InputError if a value (N, M) is not finite, or beyond the limit; NaN is allowed if `missing`."""
    valid = ~np.isinf(values) if missing else np.isfinite(values)
    if not valid.all():
        row = int(np.argmin(valid.all(axis=1)))
        kind = "infinity" if missing else "NaN or infinity"
        raise InputError(f"{name} hold {kind} (first in row {row}), expected finite numbers")
    beyond = (values > limit) | (values < -limit)  # no abs(), which would copy gigabytes
    if beyond.any():
        row = int(np.argmax(beyond.any(axis=1)))
        raise InputError(
            f"{name} hold {values[beyond][0]:g} {unit} (first in row {row}), allowed is {-limit:g} to {limit:g} {unit}"
        )


def check_stream(times_s: ArrayLike, readings: ArrayLike, fibres: int | None = None) -> tuple[Array, Array]:
    """Check readings (n, C), V, NaN where missing, and their times (n,), s, and convert them to float64.

    Raises:
        InputError: not `fibres` channels (None allows any), shapes that do not fit together, values beyond the limits,
            or times that do not ascend.
    """
    times = check_numbers(times_s, np.float64, "times", copy=False)
    rows = check_numbers(readings, np.float64, "readings", copy=False)
    if times.ndim != 1 or rows.ndim != 2 or len(rows) != len(times) or rows.shape[1] != (fibres or rows.shape[1]):
        raise InputError(
            f"times have shape {times.shape} and readings {rows.shape}, expected (n,) and (n, {fibres or 'C'})"
        )
    if not 1 <= rows.shape[1] <= MAX_FIBRES:
        raise InputError(f"readings are of {rows.shape[1]} fibres, allowed is 1 to {MAX_FIBRES}")
    check_magnitude("readings", rows, MAX_VOLTS, "V", missing=True)
    check_magnitude("times", times[:, None], MAX_S, "s")
    is_later = np.diff(times) > 0
    if not is_later.all():
        row = int(np.argmin(is_later)) + 1
        raise InputError(f"times do not ascend at reading {row}, expected every reading later than the one before")
    return times, rows
