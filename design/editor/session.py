"""Edit one pad in a browser: apply the edits that a page posts, publish its view, and save the morphology."""

import json
import os
import secrets
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from padforge.design.common.files import check_replaceable, find_dependents, provenance
from padforge.design.common.validation import InputError, check_float, check_int, short_repr
from padforge.design.morphology import MAX_COORDINATE, Morphology
from padforge.design.paths.fitting import remove_spare_knots

from .edits import PathEvaluator, Paths, insert_knot, move_knot, replace_path, straight_paths

MAX_STEPS = 1000
"""Edits that can be undone."""
MAX_GESTURE = 40
"""Characters of the name of a gesture."""


class EditHistory:
    """The paths being edited, with undo and redo."""

    def __init__(self, paths: Paths) -> None:
        self._states, self._index, self._saved, self._gesture = [paths], 0, paths, ""

    @property
    def paths(self) -> Paths:
        """The current paths."""
        return self._states[self._index]

    def do(self, paths: Paths, gesture: str = "") -> None:
        """Replace the paths; edits of one gesture, such as a drag, are undone together.

        Args:
            paths: the new paths.
            gesture: name of the gesture, if the edit belongs to one.
        """
        if not gesture or gesture != self._gesture:
            self._index += 1
        self._states[self._index :] = [paths]
        del self._states[: -MAX_STEPS - 1]
        self._index, self._gesture = len(self._states) - 1, gesture

    def undo(self) -> None:
        """Undo the last step, if there is one."""
        self._index, self._gesture = max(self._index - 1, 0), ""

    def redo(self) -> None:
        """Redo the step that was undone last, if there is one."""
        self._index, self._gesture = min(self._index + 1, len(self._states) - 1), ""

    def mark_saved(self) -> None:
        """Note that the current paths are saved."""
        self._saved = self.paths

    @property
    def unsaved(self) -> bool:
        """Whether the paths differ from those saved last."""
        return self.paths is not self._saved

    @property
    def can_undo(self) -> bool:
        """Whether there is a step to undo."""
        return self._index > 0

    @property
    def can_redo(self) -> bool:
        """Whether there is a step to redo."""
        return self._index < len(self._states) - 1


class EditSession:
    """A pad being edited; thread-safe.

    Attributes:
        out: the file to save to; the next free name if another program wrote to it after the session began, or other
            files were made from the pad saved there.
    """

    def __init__(
        self,
        evaluator: PathEvaluator,
        source: Path | None,
        out: Path,
        publish: Callable[[dict[str, Any]], None],
        force: bool = False,
    ) -> None:
        """Load the pad to edit.

        Args:
            evaluator: evaluates the edited paths.
            source: file of a morphology; straight fibres if None.
            out: file to save to.
            publish: sends a view to all pages.
            force: whether to replace a pad from which other files beside it were made.

        Raises:
            InputError: an unreadable pad, or other files were made from the pad at `out`.
        """
        self.out, self._out_is_ours, self._force = out, out.exists(), force
        self._evaluator, self._publish = evaluator, publish
        self._provenance = provenance("padforge design edit", None, [] if source is None else [source])
        self._provenance["settings"] = {"pad": evaluator.pad_settings.model_dump(mode="json")}
        check_replaceable(out, self._provenance, force=force)
        layout = evaluator.pad_settings.layout
        paths = straight_paths(layout) if source is None else remove_spare_knots(Morphology.load(source).knots, layout)
        self._history = EditHistory(tuple(paths))
        self._lock, self._number, self._id = Lock(), 0, secrets.token_hex(8)
        self._title = f"{source or 'straight fibres'}, {layout}"
        self._saved_message = "" if source is None else f"as in {source}"
        self._view: dict[str, Any] = {"ready": False, "title": self._title, "ended": ""}

    def begin(self) -> None:
        """Publish the first view, which takes long if kernels must be compiled."""
        self._publish(self._view)
        with self._lock:
            self._update((0, 1))

    def end(self) -> None:
        """Tell all pages that the session has ended."""
        with self._lock:
            self._publish(self._view | {"ended": "ended in the terminal"})

    @property
    def unsaved(self) -> bool:
        """Whether there are edits that are not saved."""
        return self._history.unsaved

    def edit(self, body: bytes) -> Mapping[str, Any]:
        """Apply an edit, such as {"do": "move", "fibre": 1, "knot": 2, "x_mm": 3.0, "y_mm": 4.0, "gesture": "a"}.

        "add" takes a fibre and optionally a position, "remove" a fibre and a knot, "undo" and "redo" nothing. Fibres
        and inner knots count from 1. Edits of one gesture are undone together.

        Args:
            body: the edit as JSON.

        Returns:
            The new view.

        Raises:
            InputError: an invalid edit, which changes nothing.
        """
        edit = _parse_object(body)
        with self._lock:
            history, layout, selected = self._history, self._evaluator.pad_settings.layout, (0, 1)
            match edit.get("do"):
                case "move":
                    fibre, knot = selected = self._knot(edit)
                    gesture = edit.get("gesture", "")
                    if not isinstance(gesture, str) or len(gesture) > MAX_GESTURE:
                        raise InputError(f"gesture is {short_repr(gesture)}, expected up to {MAX_GESTURE} characters")
                    history.do(move_knot(history.paths, layout, fibre, knot, self._position(edit)), gesture)
                case "add":
                    fibre = self._fibre(edit)
                    position = self._position(edit) if "x_mm" in edit else None
                    paths, knot = insert_knot(history.paths, layout, fibre, position)
                    history.do(paths)
                    selected = fibre, knot
                case "remove":
                    fibre, knot = self._knot(edit)
                    history.do(replace_path(history.paths, fibre, np.delete(history.paths[fibre], knot, axis=0)))
                    selected = fibre, max(knot - 1, 1)
                case "undo":
                    history.undo()
                case "redo":
                    history.redo()
                case other:
                    raise InputError(f"do is {short_repr(other)}, allowed are move, add, remove, undo and redo")
            return self._update(selected)

    def save(self, body: bytes) -> Mapping[str, Any]:
        """Write the pad to `out`, atomically.

        Args:
            body: ignored.

        Returns:
            The new view.

        Raises:
            InputError: the file cannot be written.
        """
        with self._lock:
            replaces = self._out_is_ours and (self._force or not self.unsaved or not find_dependents(self.out))
            if self.out.is_file() and not replaces:
                self.out = free_name(self.out)
            pad = self._evaluator.to_morphology(self._history.paths)
            Morphology.from_layout(pad.knots, pad.layout, self._provenance).save(self.out)
            self._out_is_ours = True
            self._history.mark_saved()
            self._saved_message = f"saved to {self.out}"
            return self._update((0, 1))

    def _update(self, selected: tuple[int, int]) -> dict[str, Any]:
        """Publish and return a new view, with the fibre and the knot to select."""
        self._number += 1
        self._view = {
            **self._evaluator.constants,
            **self._evaluator.evaluate(self._history.paths),
            "ready": True,
            "title": self._title,
            "session": self._id,
            "number": self._number,
            "selected": selected,
            "can_undo": self._history.can_undo,
            "can_redo": self._history.can_redo,
            "unsaved": self.unsaved,
            "out": str(self.out),
            "message": "" if self.unsaved else self._saved_message,
            "ended": "",
        }
        self._publish(self._view)
        return self._view

    def _fibre(self, edit: Mapping[str, Any]) -> int:
        return check_int("fibre", edit.get("fibre"), 1, len(self._history.paths)) - 1

    def _knot(self, edit: Mapping[str, Any]) -> tuple[int, int]:
        fibre = self._fibre(edit)
        inner = len(self._history.paths[fibre]) - 2
        if not inner:
            raise InputError(f"fibre {fibre + 1} has no inner knot")
        return fibre, check_int("knot", edit.get("knot"), 1, inner)

    def _position(self, edit: Mapping[str, Any]) -> list[float]:
        """Return the position of an edit, grid units from the lower left corner of the pad."""
        layout = self._evaluator.pad_settings.layout
        position_mm = (check_float(name, edit.get(name), -MAX_COORDINATE, MAX_COORDINATE) for name in ("x_mm", "y_mm"))
        return [value / layout.unit_mm + extent / 2 for value, extent in zip(position_mm, layout.extent, strict=True)]


def free_name(path: Path) -> Path:
    """Return the first of NAME.json, NAME-2.json, NAME-3.json, ... that does not exist."""
    names = (path.with_stem(f"{path.stem}{f'-{number}' * (number > 1)}") for number in count(1))
    return next(name for name in names if not os.path.lexists(name))


def _parse_object(body: bytes) -> Mapping[str, Any]:
    try:
        document = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise InputError("the request is not JSON") from error
    if not isinstance(document, dict):
        raise InputError(f"the request is {short_repr(document)}, expected an object")
    return document
