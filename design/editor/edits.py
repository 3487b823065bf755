"""Edit the paths of fibres knot by knot, and evaluate them: broken rules and the ambiguity of presses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.ambiguity import AMBIGUITY_NOISE, ambiguity_map, free_presses
from padforge.design.objectives.rules import check_rules
from padforge.design.paths.curves import beziers
from padforge.design.paths.fitting import add_spare_knots
from padforge.design.settings import Contact, Layout, PadSettings, RulesSettings, SearchSettings

MIN_DISTANCE = 1e-3
"""Smallest distance of two knots along a fibre, grid units."""
MAX_KNOTS = 64
"""Inner knots of a fibre, as for [search] knots."""
STRAIGHT_KNOTS = 5
"""Inner knots of a straight fibre, as handles for editing."""

Paths = tuple[Array, ...]
"""Knots of every fibre, shape (n, 2), grid units."""


def straight_paths(layout: Layout) -> Paths:
    """Return straight fibres with STRAIGHT_KNOTS inner knots."""
    share = np.linspace(0, 1, STRAIGHT_KNOTS + 2)[:, None]
    return tuple(line[0] + share * (line[-1] - line[0]) for line in Morphology.straight(layout).knots)


def replace_path(paths: Paths, fibre: int, path: Array) -> Paths:
    """Return the paths with another one for a fibre."""
    return (*paths[:fibre], path, *paths[fibre + 1 :])


def move_knot(paths: Paths, layout: Layout, fibre: int, knot: int, position: Sequence[float]) -> Paths:
    """Move an inner knot to a position, clipped to the pad and to the range between its neighbours.

    Args:
        paths: paths of all fibres.
        layout: layout of the pad.
        fibre: index of the fibre.
        knot: index of the knot.
        position: x and y, grid units.
    """
    path, axis = paths[fibre].copy(), layout.family(fibre)
    low, high = path[knot - 1, axis] + MIN_DISTANCE, path[knot + 1, axis] - MIN_DISTANCE
    if low <= high:  # else there is no room between its neighbours
        path[knot, axis] = np.clip(position[axis], low, high)
    path[knot, 1 - axis] = np.clip(position[1 - axis], 0, layout.extent[1 - axis])
    return replace_path(paths, fibre, path)


def insert_knot(paths: Paths, layout: Layout, fibre: int, position: Sequence[float] | None) -> tuple[Paths, int]:
    """Insert a knot on the curve of a fibre, so that its shape hardly changes.

    Args:
        paths: paths of all fibres.
        layout: layout of the pad.
        fibre: index of the fibre.
        position: x and y near which to insert it, grid units; the middle of the longest span if None.

    Returns:
        The paths, and the index of the new knot.

    Raises:
        InputError: the fibre has MAX_KNOTS already, or there is no room between its knots.
    """
    from scipy.interpolate import PchipInterpolator

    path, axis = paths[fibre], layout.family(fibre)
    along, across = path[:, axis], path[:, 1 - axis]
    if len(path) >= MAX_KNOTS + 2:
        raise InputError(f"fibre {fibre + 1} has {MAX_KNOTS} knots, which is the maximum")
    longest = int(np.argmax(np.diff(along)))
    target = float(along[longest : longest + 2].mean() if position is None else position[axis])
    knot = int(np.clip(np.searchsorted(along, target), 1, len(path) - 1))
    low, high = along[knot - 1] + MIN_DISTANCE, along[knot] - MIN_DISTANCE
    if low > high:
        raise InputError(f"fibre {fibre + 1} has no room for a knot there")
    target = float(np.clip(target, low, high))
    inserted = np.empty(2)
    inserted[axis], inserted[1 - axis] = target, PchipInterpolator(along, across)(target)
    return replace_path(paths, fibre, np.insert(path, knot, inserted, axis=0)), knot


@dataclass(frozen=True)
class PathEvaluator:
    """Evaluates edited paths by the settings of a pad.

    Attributes:
        pad_settings: the pad, whose layout all paths have.
        rules: design rules to check.
        contact: contact of the presses.
        search: number of failed fibres.
    """

    pad_settings: PadSettings
    rules: RulesSettings
    contact: Contact
    search: SearchSettings

    def to_morphology(self, paths: Paths) -> Morphology:
        """Return the pad of these paths, with as many knots on every fibre as on the one with most."""
        layout = self.pad_settings.layout
        return Morphology.from_layout(add_spare_knots(paths, layout), layout)

    def evaluate(self, paths: Paths) -> dict[str, Any]:
        """Return knots, curves, broken rules and ambiguities of the paths as JSON, mm from the centre of the pad."""
        pad = self.to_morphology(paths)
        ambiguity_mm = self._ambiguity_mm(pad)
        spans_mm = pad.to_mm(beziers(pad)).round(4).tolist()
        return {
            "fibres": [
                {"family": pad.layout.family(n), "knots": pad.to_mm(path).round(4).tolist(), "spans": spans_mm[n]}
                for n, path in enumerate(paths)
            ],
            "rules": [
                {"text": str(rule), "fibres": rule.fibres, "place_mm": rule.place_mm and list(rule.place_mm)}
                for rule in check_rules(pad, self.rules, self.pad_settings)
            ],
            "ambiguity_map_mm": np.round(ambiguity_mm, 4).tolist(),
            "ambiguity_mm": ambiguity_mm.mean(axis=1).tolist(),
        }

    @cached_property
    def constants(self) -> dict[str, Any]:
        """What does not depend on the paths, as JSON: the pad, its pressed positions, and straight fibres beside it."""
        layout = self.pad_settings.layout
        straight = Morphology.straight(layout)
        low, high = (straight.to_mm(corner) for corner in self.pad_settings.sensed)
        positions_mm = straight.to_mm(self._presses)
        return {
            "middle_mm": [0, 0],
            "half_mm": [side / 2 for side in layout.size_mm],
            "unit_mm": layout.unit_mm,
            "mirrored": False,
            "deep_family": int(self.pad_settings.deep_family == "vertical"),
            "sensed_mm": [*low.tolist(), *high.tolist()],
            "keep_out_mm": self.pad_settings.keep_out_mm,
            "positions_mm": positions_mm.round(3).tolist(),
            "cell_mm": [_lattice_step(column) for column in positions_mm.T],
            "straight_mm": self._ambiguity_mm(straight).mean(axis=1).tolist(),
        }

    @cached_property
    def _presses(self) -> Array:
        return free_presses(self.pad_settings)

    def _ambiguity_mm(self, pad: Morphology) -> Array:
        noise = AMBIGUITY_NOISE
        return pad.unit_mm * ambiguity_map(pad, self._presses, self.contact, self.search.max_failures, noise)


def _lattice_step(values: Array) -> float:
    """Return the distance of neighbouring rows or columns of a lattice; 1 if there is only one."""
    steps = np.diff(np.unique(values.round(6)))
    return float(steps.min()) if len(steps) else 1.0
