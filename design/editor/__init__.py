"""Edit one pad in a browser: apply the edits that a page posts, publish its view, and save the morphology."""

import json
import os
import secrets
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import count
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from padforge.common.files import check_replaceable, find_dependents, provenance, sha256
from padforge.common.settings import Spec
from padforge.common.validation import InputError, check_float, check_int, short_repr
from padforge.design.morphology import MAX_COORDINATE, Array, Morphology
from padforge.design.objectives.ambiguity import AMBIGUITY_NOISE, ambiguity_map, free_presses
from padforge.design.objectives.rules import check_rules
from padforge.design.paths.curves import add_spare_knots, beziers, remove_spare_knots
from padforge.design.settings import PadSettings, RulesSettings, SearchSettings, read_contact

MIN_DISTANCE = 1e-3  # smallest distance of two knots along a fibre, grid units
MAX_KNOTS = 64  # inner knots of a fibre, as for [search] knots
STRAIGHT_KNOTS = 5  # inner knots of a straight fibre, as handles for editing
MAX_STEPS = 1000  # edits that can be undone

Paths = tuple[Array, ...]  # knots of every fibre, shape (n, 2), grid units


class _EditHistory:
    """The paths being edited, with undo and redo; edits of one gesture, such as a drag, are undone together."""

    def __init__(self, paths: Paths) -> None:
        self.states, self.index, self._gesture = [paths], 0, ""

    @property
    def paths(self) -> Paths:
        return self.states[self.index]

    def do(self, paths: Paths, gesture: str = "") -> None:
        """Replace the paths."""
        if not gesture or gesture != self._gesture:
            self.index += 1
        self.states[self.index :] = [paths]
        del self.states[: -MAX_STEPS - 1]
        self.index, self._gesture = len(self.states) - 1, gesture

    def step(self, by: int) -> None:
        """Undo (-1) or redo (1) a step, if there is one."""
        self.index, self._gesture = min(max(self.index + by, 0), len(self.states) - 1), ""


class EditSession:
    """A pad being edited; thread-safe.

    Its file `out` becomes the next free name if another program wrote to it after the session began or last saved, or
    other files were made from the pad saved there.
    """

    def __init__(
        self, spec: Spec, source: Path | None, out: Path, publish: Callable[[dict[str, Any]], None], force: bool
    ) -> None:
        """Load the pad to edit, straight fibres without a `source`; `publish` sends a view to all pages."""
        self.out, self._force, self._publish = out, force, publish
        self._provenance = provenance("padforge design edit", None, [] if source is None else [source])
        pad = Morphology.straight(spec.section(PadSettings).layout) if source is None else Morphology.load(source)
        self._layout, self._pad_settings = pad.layout, spec.section(PadSettings, **pad.layout.settings)
        self._rules, self._contact = spec.section(RulesSettings), read_contact(spec)
        self._max_failures = spec.section(SearchSettings).max_failures
        self._provenance["settings"] = {"pad": self._pad_settings.model_dump(mode="json")}
        check_replaceable(out, self._provenance, force=force)
        self._replaceable_sha256 = sha256(out) if out.is_file() else ""  # of the file that a save may replace
        if source is None:
            share = np.linspace(0, 1, STRAIGHT_KNOTS + 2)[:, None]
            paths = tuple(line[0] + share * (line[-1] - line[0]) for line in pad.knots)
        else:
            paths = tuple(remove_spare_knots(pad.knots, pad.layout))
        self._history, self._saved = _EditHistory(paths), paths
        self._lock, self._number, self._id = Lock(), 0, secrets.token_hex(8)
        self._title = f"{source or 'straight fibres'}, {pad.layout}"
        self._saved_message = "" if source is None else f"as in {source}"
        self._view: dict[str, Any] = {"ready": False, "title": self._title, "ended": ""}

    def begin(self) -> None:
        """Publish the first view, which takes long if kernels must be compiled."""
        self._publish(self._view)
        with self._lock:
            self._update(0, 1)

    def end(self) -> None:
        """Tell all pages that the session has ended."""
        with self._lock:
            self._publish(self._view | {"ended": "ended in the terminal"})

    @property
    def unsaved(self) -> bool:
        """Whether there are edits that are not saved."""
        return self._history.paths is not self._saved

    def edit(self, body: bytes) -> Mapping[str, Any]:
        """Apply an edit, such as {"do": "move", "fibre": 1, "knot": 2, "x_mm": 3.0, "y_mm": 4.0, "gesture": "a"}.

        "add" takes a fibre and optionally a position, "remove" a fibre and a knot, "undo" and "redo" nothing. Fibres
        and inner knots count from 1. Edits of one gesture are undone together; an invalid one changes nothing. Returned
        is the new view.
        """
        edit = json.loads(body)
        with self._lock:
            history, gesture, kind = self._history, edit.get("gesture", ""), edit.get("do")
            if kind in ("undo", "redo"):
                history.step(-1 if kind == "undo" else 1)
                return self._update(0, 1)
            if kind not in ("move", "add", "remove"):
                raise InputError(f"do is {short_repr(kind)}, allowed are move, add, remove, undo and redo")
            fibre = check_int("fibre", edit.get("fibre"), 1, len(history.paths)) - 1
            path = history.paths[fibre]
            if kind == "add":
                path, selected = self._insert_knot(fibre, self._position(edit) if "x_mm" in edit else None)
            elif len(path) == 2:
                raise InputError(f"fibre {fibre + 1} has no inner knot")
            else:
                knot = selected = check_int("knot", edit.get("knot"), 1, len(path) - 2)
                if kind == "move":
                    path = self._move_knot(fibre, knot, self._position(edit))
                else:
                    path, selected = np.delete(path, knot, axis=0), max(knot - 1, 1)
            history.do((*history.paths[:fibre], path, *history.paths[fibre + 1 :]), gesture)
            return self._update(fibre, selected)

    def save(self, body: bytes) -> Mapping[str, Any]:
        """Write the pad to `out`, atomically, and return the new view; `body` is ignored."""
        with self._lock:
            if self.out.is_file():
                is_foreign = sha256(self.out) != self._replaceable_sha256
                if is_foreign or (self.unsaved and not self._force and find_dependents(self.out)):
                    self.out = free_name(self.out)
            self._to_morphology(self._provenance).save(self.out)
            self._replaceable_sha256, self._saved = sha256(self.out), self._history.paths
            self._saved_message = f"saved to {self.out}"
            return self._update(0, 1)

    def _position(self, edit: Mapping[str, Any]) -> list[float]:
        """Return the position of an edit, grid units from the lower left corner of the pad."""
        position_mm = (check_float(name, edit.get(name), -MAX_COORDINATE, MAX_COORDINATE) for name in ("x_mm", "y_mm"))
        layout = self._layout
        return [value / layout.unit_mm + extent / 2 for value, extent in zip(position_mm, layout.extent, strict=True)]

    def _move_knot(self, fibre: int, knot: int, position: Sequence[float]) -> Array:
        """Return a path with a knot at a position, clipped to the pad and to the range between its neighbours."""
        path, axis = self._history.paths[fibre].copy(), self._layout.family(fibre)
        low, high = path[knot - 1, axis] + MIN_DISTANCE, path[knot + 1, axis] - MIN_DISTANCE
        if low <= high:  # else there is no room between its neighbours
            path[knot, axis] = np.clip(position[axis], low, high)
        path[knot, 1 - axis] = np.clip(position[1 - axis], 0, self._layout.extent[1 - axis])
        return path

    def _insert_knot(self, fibre: int, position: Sequence[float] | None) -> tuple[Array, int]:
        """Return a path with a new knot on its curve, near a position or in its longest span, and its index."""
        from scipy.interpolate import PchipInterpolator

        path, axis = self._history.paths[fibre], self._layout.family(fibre)
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
        return np.insert(path, knot, inserted, axis=0), knot

    def _to_morphology(self, provenance: dict[str, Any] | None = None) -> Morphology:
        """Return the pad of the paths, with as many knots on every fibre as on the one with most."""
        return Morphology.from_layout(add_spare_knots(self._history.paths, self._layout), self._layout, provenance)

    def _update(self, fibre: int, knot: int) -> dict[str, Any]:
        """Publish and return a new view, mm from the centre of the pad, with the fibre and the knot to select."""
        pad, history = self._to_morphology(), self._history
        ambiguity_mm, spans_mm = self._ambiguity_mm(pad), pad.to_mm(beziers(pad)).round(4).tolist()
        self._number += 1
        self._view = {
            **self._constants,
            "fibres": [
                {"family": pad.layout.family(n), "knots": pad.to_mm(path).round(4).tolist(), "spans": spans_mm[n]}
                for n, path in enumerate(history.paths)
            ],
            "rules": [
                {"text": str(rule), "fibres": rule.fibres, "place_mm": rule.place_mm and list(rule.place_mm)}
                for rule in check_rules(pad, self._rules, self._pad_settings)
            ],
            "ambiguity_map_mm": np.round(ambiguity_mm, 4).tolist(),
            "ambiguity_mm": ambiguity_mm.mean(axis=1).tolist(),
            "number": self._number,
            "selected": (fibre, knot),
            "can_undo": history.index > 0,
            "can_redo": history.index < len(history.states) - 1,
            "unsaved": self.unsaved,
            "out": str(self.out),
            "message": "" if self.unsaved else self._saved_message,
        }
        self._publish(self._view)
        return self._view

    @cached_property
    def _constants(self) -> dict[str, Any]:
        """The part of a view that does not depend on the paths: the pad, the presses, and errors of straight fibres."""
        straight = Morphology.straight(self._layout)
        sensed_mm = straight.to_mm(np.array(self._pad_settings.sensed))
        positions_mm = straight.to_mm(self._presses)
        return {
            "ready": True,
            "title": self._title,
            "session": self._id,
            "ended": "",
            "centre_mm": [0, 0],
            "half_mm": [side / 2 for side in self._layout.size_mm],
            "unit_mm": self._layout.unit_mm,
            "deep_family": int(self._pad_settings.deep_family == "vertical"),
            "sensed_mm": sensed_mm.ravel().tolist(),
            "keep_out_mm": self._pad_settings.keep_out_corners_mm,
            "positions_mm": positions_mm.round(3).tolist(),
            "cell_mm": [_lattice_step(column) for column in positions_mm.T],
            "straight_mm": self._ambiguity_mm(straight).mean(axis=1).tolist(),
        }

    @cached_property
    def _presses(self) -> Array:
        return free_presses(self._pad_settings)

    def _ambiguity_mm(self, pad: Morphology) -> Array:
        return pad.unit_mm * ambiguity_map(pad, self._presses, self._contact, self._max_failures, AMBIGUITY_NOISE)


def free_name(path: Path) -> Path:
    """Return the first of NAME.json, NAME-2.json, ... that does not exist."""
    names = (path.with_stem(f"{path.stem}{f'-{number}' * (number > 1)}") for number in count(1))
    return next(name for name in names if not os.path.lexists(name))


def _lattice_step(values: Array) -> float:
    """Return the distance of neighbouring rows or columns of a lattice; 1 if there is only one."""
    steps = np.diff(np.unique(values.round(6)))
    return float(steps.min()) if len(steps) else 1.0
