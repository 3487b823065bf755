"""Knots: the points that fibres run through, as plain arrays (..., 2M, N+2, 2) in grid units."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from design.common.errors import InputError, reals

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LEAST_SPAN = 1e-12
"""Least distance of knots along a fibre's travel axis, grid units: slopes stay numbers that can be squared."""
FARTHEST = 1e6
"""Greatest coordinate of a place, by amount, in grid units or mm."""
MARGIN = 1e-3
"""Least distance of a free knot to the pad's edge, grid units, as in the published optimiser."""


def assemble(inner: Array) -> Array:
    """Whole fibres from free knots: sort along the travel axis, keep knots apart, add the fixed ends.

    Args:
        inner: (..., 2M, N, 2) knots in any order, grid units within 0..M+1.

    Returns:
        (..., 2M, N+2, 2) knots that satisfy `Morphology`. Knots at the same travel coordinate are moved apart by
        the least step that keeps the curve a graph (1e-9 grid units, far below any printer).
    """
    grid = inner.shape[-3] // 2
    knots = np.empty((*inner.shape[:-2], inner.shape[-2] + 2, 2))
    order = np.arange(1, grid + 1)
    for family, (travel, cross) in enumerate(((0, 1), (1, 0))):
        rows = slice(family * grid, (family + 1) * grid)
        fibres = inner[..., rows, :, :]
        rank = np.argsort(fibres[..., travel], axis=-1, kind="stable")[..., None]
        knots[..., rows, 1:-1, :] = np.take_along_axis(fibres, rank, axis=-2)
        knots[..., rows, 0, travel], knots[..., rows, -1, travel] = 0, grid + 1
        knots[..., rows, 0, cross] = knots[..., rows, -1, cross] = order
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


def axes(knots: Array) -> tuple[Array, Array]:
    """Travel and cross coordinates (P, 2M, n) of knots (P, 2M, n, 2)."""
    grid = knots.shape[1] // 2
    travel, cross = (
        np.concatenate([knots[:, :grid, :, axis], knots[:, grid:, :, 1 - axis]], axis=1) for axis in (0, 1)
    )
    return travel, cross
