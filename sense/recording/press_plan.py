"""Press plans as data: where and how deep a probe presses, real or simulated, in the order it does."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.settings import or_default
from padforge.design.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.paths.keep_outs import is_outside, keep_outs
from padforge.design.settings import PadSettings
from padforge.sense.arrays import MAX_MM, Array, Indices, Mask, check_magnitude, check_numbers
from padforge.sense.recording.csv_table import CsvTable
from padforge.sense.settings import RigSettings

COLUMNS = ("x_mm", "y_mm", "depth_mm")
LEAST_FREE = 0.01
"""Least share of what is pressed that keep-outs must leave."""

Free = Callable[[Array], Mask]
"""Says of places (Q, 2) in mm which of them (Q,) may be pressed: those in no hole."""


@dataclass(frozen=True)
class PressPlan:
    """Presses to be made.

    Attributes:
        positions_mm: (Q, 2) from the pad's centre.
        depths_mm: (Q,) from the pad's surface, > 0.

    Raises:
        InputError: shapes that do not fit together, no press, or values that are not finite or beyond all pads.
    """

    positions_mm: Array
    depths_mm: Array

    def __post_init__(self) -> None:
        places = check_numbers(self.positions_mm, np.float64, "places of the plan")
        depths = check_numbers(self.depths_mm, np.float64, "depths of the plan")
        if places.ndim != 2 or places.shape[1] != 2 or len(places) == 0 or depths.shape != (len(places),):
            raise InputError(
                f"plan: places have shape {places.shape} and depths {depths.shape}, expected (Q, 2) and (Q,), Q > 0"
            )
        check_magnitude("places of the plan", places, MAX_MM, "mm")
        check_magnitude("depths of the plan", depths[:, None], MAX_MM, "mm")
        if (depths <= 0).any():
            press = int(np.argmax(depths <= 0))
            raise InputError(f"plan: press {press} has depth {depths[press]:g} mm, allowed is more than 0")
        object.__setattr__(self, "positions_mm", places)
        object.__setattr__(self, "depths_mm", depths)

    def __len__(self) -> int:
        return len(self.positions_mm)

    def document(self) -> list[list[float]]:
        """The plan as JSON: one [x_mm, y_mm, depth_mm] a press."""
        return np.column_stack([self.positions_mm, self.depths_mm]).tolist()

    @classmethod
    def of(cls, rows: ArrayLike) -> "PressPlan":
        """The plan of rows (Q, 3) as `document` gives them."""
        table = check_numbers(rows, np.float64, "plan")
        if table.ndim != 2 or table.shape[1] != 3:
            raise InputError(f"plan has shape {table.shape}, expected (Q, 3): {', '.join(COLUMNS)}")
        return cls(table[:, :2], table[:, 2])


def size_of(pad: Morphology, size: PadSettings | None = None) -> PadSettings:
    """What is pressed of a pad, and what is not, by `[pad]`; the default where None.

    Raises:
        InputError: presses beyond this pad, or keep-outs that leave less than LEAST_FREE of what is pressed.
    """
    size = or_default("size", size, PadSettings).for_layout(pad.layout)
    if size.keep_out_mm:
        import shapely

        (left, low), (right, high) = size.sensed
        pressed = shapely.box(left, low, right, high)
        share = pressed.difference(shapely.union_all(keep_outs(size))).area / pressed.area
        if share < LEAST_FREE:
            raise InputError(f"[pad] keep_out_mm leaves {share:.1%} of what is pressed, allowed is {LEAST_FREE:.0%}")
    return size


def told_pad(pad: Morphology) -> dict[str, Any]:
    """What a recording says of its pad, which `Morphology.from_dict` reads."""
    document = pad.to_dict()
    kept = ("pitch_mm", "knots") if pad.layout.is_square else ("format", "fibres", "pitch_mm", "knots")
    return {key: document[key] for key in kept}


def free_of(pad: Morphology, size: PadSettings) -> Free:
    """Which places on the plan of a pad lie in no keep-out of `size`."""
    return lambda positions_mm: is_outside(pad.to_grid(positions_mm), size)


def planned(pad: Morphology, rig: RigSettings, rng: np.random.Generator, size: PadSettings | None = None) -> PressPlan:
    """The plan that `[rig]` asks for over what is pressed of a pad, see `size_of` and `planned_in`."""
    size = size_of(pad, size)
    return planned_in(pad.to_mm(size.sensed), rig, rng, free_of(pad, size))


def planned_in(corners_mm: Array, rig: RigSettings, rng: np.random.Generator, free: Free) -> PressPlan:
    """The plan that `[rig]` asks for: that of a file, or `presses` places between two corners (2, 2), low and high.

    A grid has so many rows and columns that neighbours are about as far apart either way (as many of both over a
    square), and at least `presses` places that are free, of which the first are taken; serpentine runs forth and
    back along its rows. Depths are taken in turn along a row, and each row begins one further on: columns of one depth
    would tie depth to place. An adaptive plan is uniform until a localizer steers it.

    Raises:
        InputError: as `read_plan`, or a place of a file that is not free.
    """
    if rig.plan_file is not None:
        return all_free(read_plan(rig.plan_file, rig.depth_mm), rig.plan_file, free)
    depths = np.array(rig.depths_mm or (rig.depth_mm,))
    if rig.plan in ("grid", "serpentine"):
        asked = rig.presses
        while True:
            places, turns = _rows(corners_mm, asked, forth_and_back=rig.plan == "serpentine")
            there = free(places)
            if there.sum() >= rig.presses:
                break
            asked = max(asked + 1, int(asked * rig.presses / max(there.sum(), 1)))
        places, turns = places[there][: rig.presses], turns[there][: rig.presses]
    else:
        places, turns = uniform(corners_mm, rig.presses, rng, free), np.arange(rig.presses, dtype=np.int64)
    return PressPlan(places, depths[turns % len(depths)])


def uniform(corners_mm: Array, count: int, rng: np.random.Generator, free: Free) -> Array:
    """(count, 2) places, mm, drawn uniformly over what is free between two corners (2, 2), low and high."""
    low, high = corners_mm
    places = rng.uniform(low, high, (count, 2))
    while not (there := free(places)).all():
        places = np.vstack([places[there], rng.uniform(low, high, (int((~there).sum()), 2))])
    return places


def _rows(corners_mm: Array, asked: int, forth_and_back: bool) -> tuple[Array, Indices]:
    """At least so many places (Q, 2) in rows between two corners, and for each the depth whose turn it is (Q,)."""
    low, high = corners_mm
    width, height = (high - low).tolist()
    across, up = _counts(width, height, asked)
    x = np.linspace(low[0], high[0], across) if across > 1 else corners_mm[:, 0].mean(keepdims=True)
    y = np.linspace(low[1], high[1], up) if up > 1 else corners_mm[:, 1].mean(keepdims=True)
    columns = np.tile(np.arange(across), (up, 1))
    if forth_and_back:
        columns[1::2] = columns[1::2, ::-1]
    places = np.column_stack([x[columns.ravel()], np.repeat(y, across)])
    return places, (columns + np.arange(up)[:, None]).ravel()


def _counts(width: float, height: float, asked: int) -> tuple[int, int]:
    """Columns and rows of at least so many places."""
    if width == height:
        side = int(np.ceil(np.sqrt(asked)))
        return side, side
    # (1 + width / step) (1 + height / step) = asked
    per_mm = 2 * (asked - 1) / (width + height + np.sqrt((width + height) ** 2 + 4 * width * height * (asked - 1)))
    rows = round(1 + per_mm * height)
    return -(-asked // rows), rows


def all_free(plan: PressPlan, path: Path, free: Free) -> PressPlan:
    """The plan that was read from `path`; InputError where it presses what is not free."""
    there = free(plan.positions_mm)
    if not there.all():
        press = int(np.argmin(there))
        x, y = plan.positions_mm[press]
        raise InputError(
            f"{path}: press {press + 1}, at ({x:g}, {y:g}) mm, lies in a keep-out, allowed are places outside of those "
            "of [pad] keep_out_mm"
        )
    return plan


def read_plan(path: Path, depth_mm: float) -> PressPlan:
    """A plan from a CSV with the columns x_mm, y_mm and, where it is not `depth_mm` throughout, depth_mm.

    Raises:
        InputError: the file is no such CSV; the message names the line.
    """
    table = CsvTable(path, gaps=True)
    if tuple(table.names) not in (COLUMNS, COLUMNS[:2]):
        raise InputError(f"{path}: header is {','.join(table.names)[:60]!r}, expected x_mm,y_mm or x_mm,y_mm,depth_mm")
    values = table.columns(range(len(table.names)))
    depths = np.full((len(values), 1), depth_mm)
    try:
        return PressPlan.of(np.column_stack([values, depths])[:, :3])
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
