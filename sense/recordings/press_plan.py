"""Press plans as data: where and how deep a probe presses, real or simulated, in the order it does."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from design.common.errors import InputError
from design.pad.morphology import Morphology
from design.settings import Sensed, sensed_rectangle
from sense.recordings.formats.csv_table import CsvTable
from sense.recordings.processing.limits import MAX_MM, Array, as_numbers, refuse_beyond
from sense.settings import RigSettings

COLUMNS = ("x_mm", "y_mm", "depth_mm")


@dataclass(frozen=True)
class PressPlan:
    """Presses to be made.

    Attributes:
        places_mm: (Q, 2) from the pad's centre.
        depths_mm: (Q,) from the pad's surface, > 0.

    Raises:
        InputError: shapes that do not fit together, no press, or values that are not finite or beyond all pads.
    """

    places_mm: Array
    depths_mm: Array

    def __post_init__(self) -> None:
        places = as_numbers(self.places_mm, np.float64, "places of the plan")
        depths = as_numbers(self.depths_mm, np.float64, "depths of the plan")
        if places.ndim != 2 or places.shape[1] != 2 or len(places) == 0 or depths.shape != (len(places),):
            raise InputError(
                f"plan: places have shape {places.shape} and depths {depths.shape}, expected (Q, 2) and (Q,), Q > 0"
            )
        refuse_beyond("places of the plan", places, MAX_MM, "mm")
        refuse_beyond("depths of the plan", depths[:, None], MAX_MM, "mm")
        if (depths <= 0).any():
            press = int(np.argmax(depths <= 0))
            raise InputError(f"plan: press {press} has depth {depths[press]:g} mm, allowed is more than 0")
        object.__setattr__(self, "places_mm", places)
        object.__setattr__(self, "depths_mm", depths)

    def __len__(self) -> int:
        return len(self.places_mm)

    def document(self) -> list[list[float]]:
        """The plan as JSON: one [x_mm, y_mm, depth_mm] a press."""
        return np.column_stack([self.places_mm, self.depths_mm]).tolist()

    @classmethod
    def of(cls, rows: ArrayLike) -> "PressPlan":
        """The plan of rows (Q, 3) as `document` gives them."""
        table = as_numbers(rows, np.float64, "plan")
        if table.ndim != 2 or table.shape[1] != 3:
            raise InputError(f"plan has shape {table.shape}, expected (Q, 3): {', '.join(COLUMNS)}")
        return cls(table[:, :2], table[:, 2])


def planned(pad: Morphology, rig: RigSettings, rng: np.random.Generator, sensed_mm: Sensed = "beyond") -> PressPlan:
    """The plan that `[rig]` asks for over what is pressed of a pad, by `sensed_mm` of `[pad]`; see `planned_in`."""
    return planned_in(pad.to_mm(sensed_rectangle(pad.grid, pad.pitch_mm, sensed_mm)), rig, rng)


def planned_in(corners_mm: Array, rig: RigSettings, rng: np.random.Generator) -> PressPlan:
    """The plan that `[rig]` asks for: that of a file, or `presses` places between two corners (2, 2), low and high.

    A grid has as many rows as columns and at least `presses` places, of which the first are taken; boustrophedon runs
    forth and back along its rows. Depths are taken in turn along a row, and each row begins one further on: columns of
    one depth would tie depth to place. An adaptive plan is uniform until a localizer steers it.

    Raises:
        InputError: as `read_plan`.
    """
    if rig.plan_file is not None:
        return read_plan(rig.plan_file, rig.depth_mm)
    low, high = corners_mm
    depths = np.array(rig.depths_mm or (rig.depth_mm,))
    if rig.plan in ("grid", "boustrophedon"):
        side = int(np.ceil(np.sqrt(rig.presses)))
        x, y = np.linspace(low, high, side).T if side > 1 else np.zeros((2, 1))
        columns = np.tile(np.arange(side), (side, 1))
        if rig.plan == "boustrophedon":
            columns[1::2] = columns[1::2, ::-1]
        places = np.column_stack([x[columns.ravel()], np.repeat(y, side)])[: rig.presses]
        turns = (columns + np.arange(side)[:, None]).ravel()[: rig.presses]
    else:
        places, turns = rng.uniform(low, high, (rig.presses, 2)), np.arange(rig.presses)
    return PressPlan(places, depths[turns % len(depths)])


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
