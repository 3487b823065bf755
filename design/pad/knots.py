"""Knots: the points that fibres run through, as plain arrays (..., H + V, N+2, 2) in grid units.

Where no layout is told, arrays are those of a square pad of one pitch: as many horizontals as verticals, a unit apart.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from padforge.design.common.errors import InputError, reals
from padforge.design.pad.kernels.press import Ends
from padforge.design.settings import Layout

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAST_SPAN = 1e-12
"""Least distance of knots along a fibre's travel axis, grid units: slopes stay numbers that can be squared."""
FARTHEST = 1e6
"""Greatest coordinate of a place, by amount, in grid units or mm."""
MARGIN = 1e-3
"""Least distance of a free knot to the pad's edge, grid units, as in the published optimiser."""


def layout_of(fibres: int, layout: Layout | None = None) -> Layout:
    """The layout of so many fibres: that told, or where none is that of a square pad of one pitch.

    Raises:
        InputError: fibres of another number than those of the layout, or none, or not of two equal families.
    """
    if layout is None:
        if fibres % 2 or not fibres:
            raise InputError(f"these are {fibres} fibres, expected 2 M: as many horizontals as verticals")
        return Layout.of(fibres // 2)
    if fibres != layout.fibres:
        raise InputError(f"these are {fibres} fibres, expected {layout}")
    return layout


def kernel_ends(layout: Layout) -> Ends:
    """Where its fibres end, as kernels take it."""
    return Ends(*layout.counts, *layout.spacing[::-1])


def assemble(inner: Array, layout: Layout | None = None) -> Array:
    """Whole fibres from free knots: sort along the travel axis, keep knots apart, add the fixed ends.

    Args:
        inner: (..., F, N, 2) knots in any order, grid units on the pad.
        layout: of the F fibres; a square one if None.

    Returns:
        (..., F, N+2, 2) knots that satisfy `Morphology`. Knots at the same travel coordinate are moved apart by
        the least step that keeps the curve a graph (1e-9 grid units, far below any printer).
    """
    layout = layout_of(inner.shape[-3], layout)
    knots = np.empty((*inner.shape[:-2], inner.shape[-2] + 2, 2))
    for travel, rows in enumerate(layout.families):
        cross = 1 - travel
        fibres = inner[..., rows, :, :]
        rank = np.argsort(fibres[..., travel], axis=-1, kind="stable")[..., None]
        knots[..., rows, 1:-1, :] = np.take_along_axis(fibres, rank, axis=-2)
        knots[..., rows, 0, travel], knots[..., rows, -1, travel] = 0, layout.extent[travel]
        knots[..., rows, 0, cross] = knots[..., rows, -1, cross] = layout.levels[rows]
        _separate(knots[..., rows, :, travel])
    return knots


def _separate(travel: Array, step: float = 1e-9) -> None:
    """Move ascending coordinates (..., N+2) apart in place, the first and last staying where they are."""
    if (np.diff(travel, axis=-1) >= step).all():
        return
    for k in range(1, travel.shape[-1] - 1):
        travel[..., k] = np.maximum(travel[..., k], travel[..., k - 1] + step)
    for k in range(travel.shape[-1] - 2, 0, -1):
        travel[..., k] = np.minimum(travel[..., k], travel[..., k + 1] - step)


def of_parameters(parameters: ArrayLike) -> Array:
    """Knots (2M, N+2, 2) of the published parameter matrix `para`, (N, 4M): x of horizontals, their y, x of verticals,
    their y.

    Raises:
        InputError: a matrix of another shape, or not of finite numbers.
    """
    para = reals("parameters", parameters)
    if para.size == 0 or para.ndim != 2 or para.shape[1] == 0 or para.shape[1] % 4:
        raise InputError(f"parameters have shape {para.shape}, expected (N, 4 M)")
    columns = para.T.reshape(2, 2, -1, len(para))  # family, coordinate, fibre, knot
    return assemble(columns.transpose(0, 2, 3, 1).reshape(-1, len(para), 2))


def axes(knots: Array, horizontals: int) -> tuple[Array, Array]:
    """Travel and cross coordinates (P, F, n) of knots (P, F, n, 2), of which so many, from the first, run along x."""
    travel, cross = (
        np.concatenate([knots[:, :horizontals, :, axis], knots[:, horizontals:, :, 1 - axis]], axis=1)
        for axis in (0, 1)
    )
    return travel, cross
