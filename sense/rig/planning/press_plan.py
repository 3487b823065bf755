"""Press plans as data: where, how deep and how long the probe presses, in the order it does."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from design.common.errors import InputError
from design.pad.morphology import Morphology
from design.settings import Sensed, sensed_rectangle
from sense.recordings.csv_table import read_csv
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
    """The plan that `[rig]` asks for: `presses` places over what is pressed of the pad, as `sensed_mm` of `[pad]` says.

    A grid has as many rows as columns and at least `presses` places, of which the first are taken; boustrophedon runs
    forth and back along its rows. Depths are taken in turn. An adaptive plan is uniform until a localizer steers it.
    """
    low, high = pad.to_mm(sensed_rectangle(pad.grid, pad.pitch_mm, sensed_mm))
    if rig.plan in ("grid", "boustrophedon"):
        side = int(np.ceil(np.sqrt(rig.presses)))
        x, y = np.linspace(low, high, side).T if side > 1 else np.zeros((2, 1))
        rows = np.tile(x, (side, 1))
        if rig.plan == "boustrophedon":
            rows[1::2] = rows[1::2, ::-1]
        places = np.column_stack([rows.ravel(), np.repeat(y, side)])[: rig.presses]
    else:
        places = rng.uniform(low, high, (rig.presses, 2))
    depths = np.resize(rig.depths_mm or (rig.depth_mm,), len(places))
    return PressPlan(places, depths)


def read_plan(path: Path, depth_mm: float) -> PressPlan:
    """A plan from a CSV with the columns x_mm, y_mm and, where it is not `depth_mm` throughout, depth_mm.

    Raises:
        InputError: the file is no such CSV; the message names the line.
    """
    names, lines = read_csv(path)
    if tuple(names) not in (COLUMNS, COLUMNS[:2]):
        raise InputError(f"{path}: header is {','.join(names)[:60]!r}, expected x_mm,y_mm or x_mm,y_mm,depth_mm")
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=2):
        if not line:
            continue
        try:
            values = [float(cell) for cell in line]
        except ValueError as error:
            raise InputError(f"{path}: line {number} holds no numbers ({error})") from error
        if len(values) != len(names):
            raise InputError(f"{path}: line {number} has {len(values)} values, expected {len(names)}")
        rows.append([*values, depth_mm][:3])
    return _named(path, rows)


def _named(path: Path, rows: list[list[float]]) -> PressPlan:
    try:
        return PressPlan.of(np.array(rows, dtype=np.float64).reshape(-1, 3))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
