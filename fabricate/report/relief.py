"""Heights seen from above as arrays of pixels: of a plan's mould, of any mesh, and the light that falls on them.

Arrays have their top row first. Lengths are mm.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from padforge.design.morphology import Array
from padforge.fabricate.mould.assembly import mould_body
from padforge.fabricate.mould.plan import Plan, polygon_rings

Ints = NDArray[np.intp]

FLOOR, WALL, NUMBER, RIDGE = 0, 1, 2, 3
"""What a pixel of a mould shows; `RIDGE` + level for the ridges of a level."""
_AT_ONCE = 2_000_000
"""Pixels of triangles worked on together: bounds memory at about 200 MB, however large the mesh."""
_EDGE = 1e-6
"""Pixels by which a triangle reaches over its edges: no pixel between two neighbours is lost to rounding."""
_SMALLEST_MM = 1e-6
"""What is smaller is drawn as a dot of this size."""
_STEPS = 8
"""Steps of shade on either side: enough for the eye, and small files."""


def mould_relief(plan: Plan, wide: int, tall: int) -> tuple[Array, Ints]:
    """Heights (tall, wide) above the tray's floor, and what each pixel shows, over the tray."""
    mould, pixels = plan.settings.mould, (wide, tall)
    walls = _walls(plan, pixels)
    walls[_inside(plan.pillars, plan.tray.bounds, pixels)] = plan.silicone_mm
    heights = walls.copy()
    for prism in mould_body(plan).adds:
        inside = _inside(prism.area, plan.tray.bounds, pixels)
        heights[inside] = np.maximum(heights[inside], prism.top_mm - mould.floor_mm)
    shown = np.where(walls > 0, WALL, FLOOR)
    standing = (heights > walls) & (heights <= plan.silicone_mm)
    shown[standing] = NUMBER
    for level, height in enumerate(plan.heights_mm):  # what a taller ridge covers, it shows
        base = plan.outline(level, height) if plan.settings.ridge_slope else plan.ridges[level]
        shown[standing & _inside(base, plan.tray.bounds, pixels)] = RIDGE + level
    return heights, shown


def mesh_relief(vertices: Array, triangles: Ints, pixels: int) -> tuple[Array, tuple[float, float, float, float]]:
    """The upper surface of a mesh of any kind, closed or not.

    Args:
        vertices: (n, 3) mm. triangles: (m, 3) vertex numbers.
        pixels: along the longer side.

    Returns:
        Heights at the pixels' middles in the frame of the mesh, -inf where there is none; and what they cover:
        left, right, low, high.
    """
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    scale = pixels / max(float((high - low).max()), _SMALLEST_MM)
    columns, rows = np.maximum(2, np.ceil((high - low) * scale - _EDGE)).astype(int).tolist()  # 2 have a slope
    corners = np.column_stack([(vertices[:, :2] - low) * scale - 0.5, vertices[:, 2]])[triangles]
    heights = np.full(rows * columns, -np.inf)
    for part in _portions(corners):
        row, column, height = _pixels_of(part, rows, columns)
        np.maximum.at(heights, row * columns + column, height)
    right, top = (low + np.array([columns, rows]) / scale).tolist()
    return heights.reshape(rows, columns)[::-1], (float(low[0]), right, float(low[1]), top)


def lit(colours: Array, heights_mm: Array) -> Array:
    """Colours (r, c, 3), 0..1, with light from the upper left on heights (r, c); flat places keep theirs."""
    from scipy.ndimage import uniform_filter

    # the root tells low steps from high ones without the high ones drowning their own colour
    eased = uniform_filter(np.sqrt(heights_mm - heights_mm.min(), dtype=np.float32), 3, mode="nearest")
    down, across = np.gradient(eased)
    slope = np.rint(_STEPS * np.clip(down + across, -1, 1)) / _STEPS
    sloping = slope != 0
    chosen, tilt = colours[sloping], slope[sloping, None]
    out = colours.copy()
    out[sloping] = chosen + np.where(tilt > 0, 0.6 * tilt * (1 - chosen), 0.5 * tilt * chosen)
    return out


def _walls(plan: Plan, pixels: tuple[int, int]) -> Array:
    """(tall, wide) height of the walls alone, which lean outwards from the outline of the floor."""
    low, high = np.reshape(plan.tray.bounds, (2, 2))
    x, y = (a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, pixels, strict=True))
    outside = np.full(pixels[::-1], np.inf)
    for hollow in (plan.cavity, *plan.exits):
        left, bottom, right, top = hollow.bounds
        across = np.maximum(left - x, x - right)
        up = np.maximum(bottom - y, y - top)[::-1]
        columns, rows = _near(across, plan.flare_mm), _near(up, plan.flare_mm)
        window = outside[rows, columns]
        np.minimum(window, np.maximum(up[rows, None], across[None, columns]), out=window)
    return plan.silicone_mm * np.clip(outside / max(plan.flare_mm, _SMALLEST_MM), 0, 1)


def _near(away: Array, reach_mm: float) -> slice:
    """The stretch of pixels no further away than `reach_mm`."""
    near = np.flatnonzero(away <= reach_mm)
    return slice(near[0], near[-1] + 1) if len(near) else slice(0)


def _inside(area: BaseGeometry, bounds: tuple[float, ...], pixels: tuple[int, int]) -> NDArray[np.bool_]:
    """(tall, wide) whether the pixel's middle lies in `area`, over the rectangle `bounds`."""
    (low, high), (wide, tall) = np.reshape(bounds, (2, 2)), pixels
    rings = [(ring - low) / (high - low) * pixels - 0.5 for polygon in polygon_rings(area) for ring in polygon]
    if not rings:
        return np.zeros((tall, wide), dtype=bool)
    starts, ends = np.concatenate(rings), np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    ends_at = np.ceil(np.stack([starts[:, 1], ends[:, 1]])).clip(0, tall).astype(np.intp)
    edge, row = _runs(ends_at.min(axis=0), ends_at.max(axis=0) - 1)
    (x, y), (to_x, to_y) = starts[edge].T, ends[edge].T
    column = np.ceil(x + (row - y) * (to_x - x) / (to_y - y)).clip(0, wide).astype(np.intp)
    passed = np.bincount(row * (wide + 1) + column, minlength=tall * (wide + 1)).reshape(tall, wide + 1)
    return (np.cumsum(passed[::-1, :-1], axis=1) % 2).astype(bool)


def _portions(corners: Array) -> Iterable[Array]:
    """Triangles (m, 3, 3) that are seen from above, a bounded number of pixels at a time."""
    first, second, third = np.moveaxis(corners[..., :2], 1, 0)
    a, b = second - first, third - first
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    seen = area > 0
    cost = area + np.ptp(corners[..., 1], axis=1) + 1
    portion = np.cumsum(cost[seen]) // _AT_ONCE
    return np.split(corners[seen], np.flatnonzero(np.diff(portion)) + 1)


def _pixels_of(corners: Array, rows: int, columns: int) -> tuple[Ints, Ints, Array]:
    """Row, column and height of every pixel whose middle lies in a triangle (m, 3, 3), row by row of each."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    triangle, row = _runs(*_between(low[:, 1], high[:, 1], rows))
    left, right = _crossed(corners[triangle, :, :2], row)
    line, column = _runs(*_between(left, right, columns))
    triangle, row = triangle[line], row[line]
    origin, a, b = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    tilt = -normal[:, :2] / normal[:, 2:]
    away = np.stack([column, row], axis=1) - origin[triangle, :2]
    height = origin[triangle, 2] + (tilt[triangle] * away).sum(axis=1)
    return row, column, np.clip(height, low[triangle, 2], high[triangle, 2])


def _between(start: Array, end: Array, count: int) -> tuple[Ints, Ints]:
    """First and last of the whole numbers 0..count-1 within start..end (n,); the last below the first for none."""
    first, last = np.ceil(start - _EDGE), np.floor(end + _EDGE)
    return np.clip(first, 0, count).astype(np.intp), np.clip(last, -1, count - 1).astype(np.intp)


def _runs(first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """Every whole number from first to last (n,), run after run, behind the number of its run."""
    lengths = np.maximum(0, last - first + 1)
    run = np.repeat(np.arange(len(lengths)), lengths)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(lengths) - lengths - first, lengths)


def _crossed(corners: Array, row: Ints) -> tuple[Array, Array]:
    """Left and right end of the line at height `row` (n,) within the triangles (n, 3, 2)."""
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for edge in range(3):
        (x, y), (to_x, to_y) = corners[:, edge].T, corners[:, (edge + 1) % 3].T
        rise = to_y - y
        share = np.divide(row - y, rise, out=np.full(len(row), np.nan), where=rise != 0)
        met = (share >= -_EDGE) & (share <= 1 + _EDGE)
        place = np.where(met, x + np.clip(share, 0, 1) * (to_x - x), np.nan)
        left, right = np.fmin(left, place), np.fmax(right, place)
    return left, right
