"""What a recording may hold: beyond these limits lies no pad, probe or clock, but a file of another kind."""

from reprlib import repr as shortened
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from design.errors import InputError

MAX_FIBRES = 512
MAX_VOLTS, MAX_MM, MAX_S = 1e3, 1e5, 1e10
"""Greatest reading, place and time, by amount (seconds since 1970 are 2e9)."""
MIN_RATE_HZ, MAX_RATE_HZ = 1e-3, 1e6
MAX_VALUES = 2**30
"""Greatest number of values in an array of a file: 8 GiB of them."""
MAX_INDEX = 2**53
"""Greatest index that float64 holds exactly."""


def numbers(values: ArrayLike, kind: type[np.generic], name: str) -> NDArray[Any]:
    """A copy of `values` as an array of float64, or of int64 where all are whole numbers.

    Raises:
        InputError: anything else.
    """
    what = "real numbers" if kind is np.float64 else f"whole numbers up to {MAX_INDEX}"
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(f"{name} are {shortened(values)}, expected an array of {what} ({error})") from error
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} are {shortened(values)} ({array.dtype}), expected an array of {what}")
    if kind is np.int64 and not ((np.abs(array) <= MAX_INDEX) & (array == np.trunc(array))).all():
        raise InputError(f"{name} are {shortened(values)}, expected an array of {what}")
    return array.astype(kind)


def refuse_beyond(name: str, values: NDArray[np.float64], limit: float, unit: str, missing: bool = False) -> None:
    """Raise InputError if an entry of (N, M) values is not finite, or beyond `limit`; NaN is allowed if `missing`."""
    sound = ~np.isinf(values) if missing else np.isfinite(values)
    if not sound.all():
        row = int(np.argmin(sound.all(axis=1)))
        kind = "infinity" if missing else "NaN or infinity"
        raise InputError(f"{name} hold {kind} (first in row {row}), expected finite numbers")
    beyond = np.abs(values) > limit
    if beyond.any():
        row = int(np.argmax(beyond.any(axis=1)))
        raise InputError(
            f"{name} hold {values[beyond][0]:g} {unit} (first in row {row}), allowed is {-limit:g} to {limit:g} {unit}"
        )
