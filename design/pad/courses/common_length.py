"""How far lines run along each other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from padforge.design.pad.kernels.near_intervals import near_intervals
from padforge.design.pad.knots import Array

_TOUCHING = 1e-6
"""Share of the width by which two intervals of one line may be apart and still be one stretch: rounding."""


@dataclass(frozen=True)
class CommonStretches:
    """Stretches of lines in which all of each is near another line, ordered by line, other line and place.

    Attributes:
        line: (n,) index of each one's line.
        other: (n,) index of the line that it is near.
        begin: (n,) arc at which it begins, from the start of its line.
        end: (n,) arc at which it ends.
    """

    line: NDArray[np.int_]
    other: NDArray[np.int_]
    begin: Array
    end: Array

    @property
    def length(self) -> Array:
        """(n,) length of each along its line."""
        return self.end - self.begin


def common_stretches(lines: Sequence[Array], others: Sequence[Array], width: float) -> CommonStretches:
    """Return every stretch of `lines` that is nearer than `width` to one of `others`.

    Two straight lines that cross at an angle a have a stretch of 2 width / sin(a) in common.

    Args:
        lines: polylines (n, 2), one or more.
        others: polylines (n, 2), one or more, in the same unit.
        width: distance below which two lines count as running along each other.
    """
    near = near_intervals(*_joined(lines), *_joined(others), width)
    pair = near[:, 0].astype(int) * len(others) + near[:, 1].astype(int)
    # pairs laid out one after another on one axis: intervals that follow on each other are one stretch
    offset = pair * (near[:, 3].max(initial=0.0) + 2 * width)
    order = np.lexsort((near[:, 2], pair))
    pair, offset, begin, end = pair[order], offset[order], near[order, 2], near[order, 3]
    until = np.maximum.accumulate(end + offset)
    new = np.ones(len(pair), bool)
    new[1:] = begin[1:] + offset[1:] > until[:-1] + _TOUCHING * width
    first = np.flatnonzero(new)
    last = np.append(first, len(pair))[1:] - 1
    line, other = np.divmod(pair[first], len(others))
    return CommonStretches(line, other, begin[first], until[last] - offset[last])


def _joined(lines: Sequence[Array]) -> tuple[Array, NDArray[np.int_]]:
    """All points of lines, one line after the other, and where each line's begin, and how many points there are."""
    return np.ascontiguousarray(np.concatenate(lines)), np.cumsum([0, *map(len, lines)])
