"""Filters of readings: total variation denoising, exact, and the running median.

Total variation denoising keeps the steps that presses make and flattens what lies between. A missing reading is NaN:
it has no weight and takes the level of its neighbours. Channels are filtered independently. The published filter is
the robust one with lam = 4, or a median of 15 (T. G. Thuruthel, J. Hughes, F. Iida, IEEE Sensors J. 2020).
"""

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.validation import InputError, check_float, check_int, short_repr
from padforge.sense.arrays import Array, check_numbers
from padforge.sense.signals import filter_kernels

Fidelity = Literal["robust", "squares"]

_FORWARD_PASSES = {"robust": filter_kernels.forward_pass_l1, "squares": filter_kernels.forward_pass_l2}


def total_variation(readings: ArrayLike, lam: float, fidelity: Fidelity = "robust") -> Array:
    """Minimise fidelity + lam * sum |x_{i+1} - x_i| exactly (total variation denoising, fused lasso).

    The fidelity "robust" is sum |y_i - x_i|: outliers do not count by their distance, and lam counts readings, whatever
    the unit of y: a bump of fewer than 2 lam readings is removed. "squares" is 1/2 sum (y_i - x_i)^2: lam has the unit
    of y, and a bump of n readings is lowered by 2 lam / n. The robust minimiser is often not unique: from the last
    reading backwards, the middle of all possible values is taken. Cost: O(R min(R, lam)) for "robust", else O(R).

    Args:
        readings: any real type, NaN where missing (x then has the value of the next reading, else of the last; a
            channel without any stays NaN); shape (R,) or (R, C).
        lam: weight of the variation, above 0.
        fidelity: "robust" or "squares".

    Returns:
        The minimiser, float64 of the shape of `readings`.

    Raises:
        InputError: `readings` are not numbers of such a shape, or infinite; `lam` or `fidelity` are not as above.
    """
    if fidelity not in _FORWARD_PASSES:
        raise InputError(f"fidelity is {short_repr(fidelity)}, allowed is {' or '.join(_FORWARD_PASSES)}")
    weight = check_float("lam", lam, 0.0, np.inf)
    if not weight:
        raise InputError(f"lam is {lam!r}, allowed is a number above 0")

    def denoise(channel: Array, out: Array) -> None:
        low, high = np.empty((2, len(channel)))
        latest = _FORWARD_PASSES[fidelity](channel, weight, low, high)
        filter_kernels.backward_pass(low, high, latest, out)

    return _filter_channels(readings, denoise)


def running_median(readings: ArrayLike, width: int, causal: bool = False) -> Array:
    """Compute the median of the readings around each; windows shrink at the ends. O(R width).

    NaN are ignored. The median of an even number of readings is the mean of the two in the middle; that of none is NaN.

    Args:
        readings: any real type; shape (R,) or (R, C).
        width: readings in a window, odd.
        causal: the window ends at the reading, instead of having it in its middle.

    Returns:
        The medians, float64 of the shape of `readings`.

    Raises:
        InputError: readings as in `total_variation`, or a width that is no odd whole number above 0.
    """
    if check_int("width", width, 1, 2**31 - 1) % 2 != 1:  # no recording is longer
        raise InputError(f"width is {width!r}, allowed is an odd whole number above 0")
    window = (width - 1, 0) if causal else (width // 2, width // 2)

    def take_medians(channel: Array, out: Array) -> None:
        before, after = (min(side, len(channel)) for side in window)
        filter_kernels.running_median(channel, before, after, out)

    return _filter_channels(readings, take_medians)


def _filter_channels(readings: ArrayLike, apply: Callable[[Array, Array], None]) -> Array:
    """Apply a filter, which writes a channel (R,) into another array, to every channel."""
    array = check_numbers(readings, np.float64, "readings")
    if array.ndim not in (1, 2):
        raise InputError(f"readings have shape {array.shape}, expected (R,) or (R, C)")
    if np.isinf(array).any():
        raise InputError(f"readings hold infinity (first at {np.argwhere(np.isinf(array))[0].tolist()})")
    channels = np.ascontiguousarray(np.atleast_2d(array.T))
    out = np.empty_like(channels)
    for channel, filtered in zip(channels, out, strict=True):
        apply(channel, filtered)
    return np.ascontiguousarray(out.T).reshape(array.shape)
