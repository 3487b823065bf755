"""Press plans: ordered positions and depths of the presses of a real or simulated probe."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.settings import or_default
from padforge.common.validation import InputError, naming_file
from padforge.design.morphology import Morphology
from padforge.design.paths.keep_outs import is_outside, keep_outs
from padforge.design.settings import Contact, PadSettings
from padforge.sense.arrays import MAX_MM, Array, Indices, Mask, check_magnitude, check_numbers
from padforge.sense.recording.tables import read_table
from padforge.sense.settings import RigSettings

COLUMNS = ("x_mm", "y_mm", "depth_mm")
MIN_PRESSABLE = 0.01  # minimum fraction of the sensed area outside of keep-outs
PositionTest = Callable[[Array], Mask]  # returns which positions (Q, 2), mm, may be pressed; shape (Q,)


@dataclass(frozen=True)
class PressPlan:
    """Presses to be made."""

    positions_mm: Array  # from the pad's centre; shape (Q, 2)
    depths_mm: Array  # below the pad's surface, > 0; shape (Q,)

    def __post_init__(self) -> None:
        positions = check_numbers(self.positions_mm, np.float64, "positions of the plan")
        depths = check_numbers(self.depths_mm, np.float64, "depths of the plan")
        if positions.ndim != 2 or positions.shape[1] != 2 or len(positions) == 0 or depths.shape != (len(positions),):
            raise InputError(
                f"plan: positions have shape {positions.shape} and depths {depths.shape}, "
                "expected (Q, 2) and (Q,), Q > 0"
            )
        check_magnitude("positions of the plan", positions, MAX_MM, "mm")
        check_magnitude("depths of the plan", depths[:, None], MAX_MM, "mm")
        if (depths <= 0).any():
            press = int(np.argmax(depths <= 0))
            raise InputError(f"plan: press {press} has depth {depths[press]:g} mm, allowed is more than 0")
        object.__setattr__(self, "positions_mm", positions)
        object.__setattr__(self, "depths_mm", depths)

    def __len__(self) -> int:
        return len(self.positions_mm)

    def to_rows(self) -> list[list[float]]:
        """Return the plan as JSON: [x_mm, y_mm, depth_mm] for each press."""
        return np.column_stack([self.positions_mm, self.depths_mm]).tolist()

    @classmethod
    def from_rows(cls, rows: ArrayLike) -> "PressPlan":
        """Return the plan of rows (Q, 3), see `to_rows`."""
        table = check_numbers(rows, np.float64, "plan")
        if table.ndim != 2 or table.shape[1] != 3:
            raise InputError(f"plan has shape {table.shape}, expected (Q, 3): {', '.join(COLUMNS)}")
        return cls(table[:, :2], table[:, 2])


def fit_pad_settings(pad: Morphology, pad_settings: PadSettings | None = None) -> PadSettings:
    """Return `[pad]`, or the default, for the layout of a pad; InputError if keep-outs leave too little to press."""
    pad_settings = or_default("pad_settings", pad_settings, PadSettings).for_layout(pad.layout)
    if pad_settings.keep_out_mm:
        import shapely

        (left, low), (right, high) = pad_settings.sensed
        sensed = shapely.box(left, low, right, high)
        share = sensed.difference(shapely.union_all(keep_outs(pad_settings))).area / sensed.area
        if share < MIN_PRESSABLE:
            raise InputError(
                f"[pad] keep_out_mm leaves {share:.1%} of what is pressed, allowed is {MIN_PRESSABLE:.0%} or more"
            )
    return pad_settings


def pad_source(pad: Morphology) -> dict[str, Any]:
    """Return a pad as it is stored in the source of a recording; `Morphology.from_dict` reads it."""
    document = pad.to_dict()
    return {key: document[key] for key in ("fibres", "pitch_mm", "knots")}


def pressable_test(pad: Morphology, pad_settings: PadSettings) -> PositionTest:
    """Return the test for positions on the plan of a pad outside of its keep-outs."""
    return lambda positions_mm: is_outside(pad.to_grid(positions_mm), pad_settings)


def planned_depths_mm(rig: RigSettings) -> Array:
    """Return the depths (n,), mm, of the presses of `[rig]`, or of its plan file."""
    file = rig.plan_file
    return np.array(rig.press_depths_mm) if file is None else read_plan(file, rig.press_depths_mm).depths_mm


def check_depths(depths_mm: Array, thickness_mm: float, pad: str) -> None:
    """Raise InputError if one of the depths (n,) reaches the thickness of the pad; `pad` is its source, in words."""
    if (deepest := float(depths_mm.max())) >= thickness_mm:
        raise InputError(f"[rig] presses {deepest:g} mm deep, allowed is less than {thickness_mm:g} mm, by {pad}")


def deepest_contact(contact: Contact, depths_mm: Array) -> Contact:
    """Return a layer contact with the maximum of some depths (n,), which are less than its thickness."""
    return contact.model_copy(update={"depth_mm": float(depths_mm.max())})


def describe_other_depth(depths_mm: Array, contact: Contact) -> str:
    """Return a notice if no press has the depth of the contact that the pad is designed for, otherwise ""."""
    if contact.model != "layer" or contact.depth_mm in depths_mm:
        return ""
    low, high = f"{depths_mm.min():g}", f"{depths_mm.max():g}"
    depths = low if low == high else f"{low} to {high}"
    return f"[rig] presses {depths} mm deep, the pad is designed for presses of {contact.depth_mm:g} mm"


def make_plan(
    pad: Morphology, rig: RigSettings, rng: np.random.Generator, pad_settings: PadSettings | None = None
) -> PressPlan:
    """Return the plan of `[rig]` for the sensed area of a pad, see `fit_pad_settings` and `make_plan_in`."""
    pad_settings = fit_pad_settings(pad, pad_settings)
    return make_plan_in(pad.to_mm(pad_settings.sensed), rig, rng, pressable_test(pad, pad_settings))


def make_plan_in(
    corners_mm: Array, rig: RigSettings, rng: np.random.Generator, is_pressable: PositionTest
) -> PressPlan:
    """Return the plan of `[rig]`: that of its file, or `presses` positions between two corners (2, 2), low and high.

    A grid has about equal steps along both axes, and as many rows as contain `presses` pressable positions; a
    serpentine plan alternates the direction of its rows. Depths alternate along a row, and each row starts with the
    next depth, since columns of equal depth would correlate depth with position. An adaptive plan is uniform until a
    localizer moves its presses.
    """
    if rig.plan_file is not None:
        return check_pressable(read_plan(rig.plan_file, rig.press_depths_mm), rig.plan_file, is_pressable)
    depths = np.array(rig.press_depths_mm)
    if rig.plan in ("grid", "serpentine"):
        n_grid = rig.presses
        while True:
            positions, turns = _grid(corners_mm, n_grid, serpentine=rig.plan == "serpentine")
            valid = is_pressable(positions)
            if valid.sum() >= rig.presses:
                break
            n_grid = max(n_grid + 1, int(n_grid * rig.presses / max(valid.sum(), 1)))
        positions, turns = positions[valid][: rig.presses], turns[valid][: rig.presses]
    else:
        positions, turns = sample_uniform(corners_mm, rig.presses, rng, is_pressable), np.arange(rig.presses)
    return PressPlan(positions, depths[turns % len(depths)])


def sample_uniform(corners_mm: Array, count: int, rng: np.random.Generator, is_pressable: PositionTest) -> Array:
    """Draw (count, 2) pressable positions, mm, uniformly between two corners (2, 2), low and high."""
    low, high = corners_mm
    positions = rng.uniform(low, high, (count, 2))
    while not (valid := is_pressable(positions)).all():
        positions = np.vstack([positions[valid], rng.uniform(low, high, (int((~valid).sum()), 2))])
    return positions


def _grid(corners_mm: Array, count: int, serpentine: bool) -> tuple[Array, Indices]:
    """Return at least `count` positions (Q, 2) of a grid, row by row, and the index (Q,) of the depth of each."""
    low, high = corners_mm
    width, height = (high - low).tolist()
    if width == height:
        n_columns = n_rows = int(np.ceil(np.sqrt(count)))
    else:  # equal steps 1 / per_mm along both axes, from (1 + per_mm width) (1 + per_mm height) = count
        per_mm = 2 * (count - 1) / (width + height + np.sqrt((width + height) ** 2 + 4 * width * height * (count - 1)))
        n_rows = round(1 + per_mm * height)
        n_columns = -(-count // n_rows)
    x = np.linspace(low[0], high[0], n_columns) if n_columns > 1 else corners_mm[:, 0].mean(keepdims=True)
    y = np.linspace(low[1], high[1], n_rows) if n_rows > 1 else corners_mm[:, 1].mean(keepdims=True)
    columns = np.tile(np.arange(n_columns), (n_rows, 1))
    if serpentine:
        columns[1::2] = columns[1::2, ::-1]
    positions = np.column_stack([x[columns.ravel()], np.repeat(y, n_columns)])
    return positions, (columns + np.arange(n_rows)[:, None]).ravel()


def check_pressable(plan: PressPlan, path: Path, is_pressable: PositionTest) -> PressPlan:
    """Return a plan from a file; raise InputError if it presses a keep-out."""
    valid = is_pressable(plan.positions_mm)
    if not valid.all():
        press = int(np.argmin(valid))
        x, y = plan.positions_mm[press]
        raise InputError(
            f"{path}: press {press}, at ({x:g}, {y:g}) mm, lies in a keep-out, allowed are positions outside of "
            "those of [pad] keep_out_mm"
        )
    return plan


def read_plan(path: Path, depths_mm: Sequence[float]) -> PressPlan:
    """Read a plan from a CSV file of x_mm, y_mm and depth_mm; without the latter, presses take `depths_mm` in turn."""
    table = read_table(path)
    if tuple(table.names) not in (COLUMNS, COLUMNS[:2]):
        raise InputError(f"{path}: header is {','.join(table.names)[:60]!r}, expected x_mm,y_mm or x_mm,y_mm,depth_mm")
    values = table.read_columns(range(len(table.names)))
    depths = np.resize(depths_mm, (len(values), 1))
    with naming_file(path):
        return PressPlan.from_rows(np.column_stack([values, depths])[:, :3])
