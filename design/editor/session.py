"""One pad being drawn: what a page posts goes in, what it shows comes out, and a morphology is saved."""

import json
import os
import secrets
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from threading import Lock
from typing import Any

from padforge.design.common.files import check_replaceable, find_dependents, provenance
from padforge.design.common.validation import InputError, check_float, check_int, short_repr
from padforge.design.editor.edits import Answers, Courses, moved, straight_courses, with_knot, without_knot
from padforge.design.morphology import MAX_COORDINATE, Morphology
from padforge.design.paths.fitting import remove_spare_knots

MOST_STEPS = 1000
"""That are remembered."""


class EditHistory:
    """The courses as they are, and as they were before.

    Attributes:
        now: the courses.
    """

    def __init__(self, begin: Courses) -> None:
        self.now = begin
        self._before: list[Courses] = []
        self._after: list[Courses] = []
        self._saved = begin
        self._gesture = ""

    def do(self, courses: Courses, gesture: str = "") -> None:
        """These are the courses from now on; what belongs to one gesture, such as a drag, is one step."""
        if not gesture or gesture != self._gesture:
            self._before = [*self._before, self.now][-MOST_STEPS:]
        self.now, self._after, self._gesture = courses, [], gesture

    def undo(self) -> None:
        """Take the last step back, if there is one."""
        if self._before:
            self._after.append(self.now)
            self.now, self._gesture = self._before.pop(), ""

    def redo(self) -> None:
        """Take the step again that was taken back last, if there is one."""
        if self._after:
            self._before.append(self.now)
            self.now, self._gesture = self._after.pop(), ""

    def keep(self, courses: Courses) -> None:
        """These were saved."""
        self._saved = courses

    @property
    def unsaved(self) -> bool:
        """Whether something has changed since it was saved, or begun."""
        return self.now is not self._saved

    @property
    def steps(self) -> tuple[int, int]:
        """How many can be taken back, and taken again."""
        return len(self._before), len(self._after)


_LONGEST_GESTURE = 40


class EditSession:
    """A pad being drawn; several threads may ask at once.

    Attributes:
        out: the file it is saved to: the next free name beside it where another one came there after this began, or
            others were made from it since.
    """

    def __init__(
        self,
        answers: Answers,
        source: Path | None,
        out: Path,
        show: Callable[[dict[str, Any]], None],
        force: bool = False,
    ) -> None:
        """Begin with the pad of a file, or with straight fibres.

        Args:
            show: takes what pages show whenever that has changed.
            force: whether a pad is replaced that others beside it were made from.

        Raises:
            InputError: a pad that cannot be read, or others were made from the one at `out`.
        """
        self.out, self._ours, self._force = out, out.exists(), force
        self._answers, self._source, self._show = answers, source, show
        layout = answers.size.layout
        self._made_by = provenance("padforge design edit", None, [] if source is None else [source])
        self._made_by["settings"] = {"pad": answers.size.model_dump(mode="json")}
        check_replaceable(out, self._made_by, force=force)
        begin = (
            straight_courses(layout) if source is None else remove_spare_knots(Morphology.load(source).knots, layout)
        )
        self._history = EditHistory(tuple(begin))
        self._lock, self._number, self._name = Lock(), 0, secrets.token_hex(8)
        self._told = "" if source is None else f"as {source} has it"
        self._view: dict[str, Any] = {"ready": False, "title": self._title, "ended": ""}

    def begin(self) -> None:
        """Show the pad for the first time, which takes long where kernels are not compiled yet."""
        self._show(self._view)
        with self._lock:
            self._changed((0, 1))

    def edit(self, body: bytes) -> Mapping[str, Any]:
        """Do what a page asks for: {"do": "move", "fibre": 1, "knot": 2, "x_mm": .., "y_mm": .., "gesture": ".."}.

        "add" takes a fibre and perhaps a place, "remove" a fibre and a knot, "undo" and "redo" nothing. Fibres count
        from 1, inner knots as well. What belongs to one gesture is undone at once.

        Returns:
            What the page shows.

        Raises:
            InputError: no such thing can be done; nothing has changed then.
        """
        asked = _document(body)
        with self._lock:
            history = self._history
            at = (0, 1)
            match asked.get("do"):
                case "move":
                    fibre, knot = self._knot(asked)
                    at, gesture = (fibre, knot), asked.get("gesture", "")
                    if not isinstance(gesture, str) or len(gesture) > _LONGEST_GESTURE:
                        raise InputError(
                            f"gesture is {short_repr(gesture)}, expected up to {_LONGEST_GESTURE} characters"
                        )
                    place = self._place(asked)
                    history.do(moved(history.now, self._answers.size.layout, fibre, knot, place), gesture)
                case "add":
                    fibre = self._fibre(asked)
                    place = self._place(asked) if "x_mm" in asked else None
                    courses, knot = with_knot(history.now, self._answers.size.layout, fibre, place)
                    history.do(courses)
                    at = fibre, knot
                case "remove":
                    fibre, knot = self._knot(asked)
                    history.do(without_knot(history.now, fibre, knot))
                    at = fibre, max(knot - 1, 1)
                case "undo":
                    history.undo()
                case "redo":
                    history.redo()
                case other:
                    raise InputError(f"do is {short_repr(other)}, allowed are move, add, remove, undo and redo")
            return self._changed(at)

    def save(self, body: bytes) -> Mapping[str, Any]:
        """Write the pad to `out`, whole or not at all.

        Raises:
            InputError: it cannot be written.
        """
        with self._lock:
            courses = self._history.now
            kept = not self._ours or (self.unsaved and not self._force and find_dependents(self.out))
            if self.out.is_file() and kept:
                self.out = free_name(self.out)
            pad = self._answers.morphology(courses)
            Morphology.from_layout(pad.knots, pad.layout, self._made_by).save(self.out)
            self._ours = True
            self._history.keep(courses)
            self._told = f"saved to {self.out}"
            return self._changed((0, 1))

    def end(self) -> None:
        """Tell pages that nothing more comes."""
        with self._lock:
            self._show(self._view | {"ended": "ended in the terminal"})

    @property
    def unsaved(self) -> bool:
        """Whether something has changed since it was saved, or begun."""
        return self._history.unsaved

    @property
    def _title(self) -> str:
        return f"{self._source or 'straight fibres'}, {self._answers.size.layout}"

    def _changed(self, at: tuple[int, int]) -> dict[str, Any]:
        """What there is to show now, shown. The knot at `at` is the one to look at."""
        back, forth = self._history.steps
        self._number += 1
        self._view = {
            **self._answers.fixed,
            **self._answers.of(self._history.now),
            "ready": True,
            "title": self._title,
            "session": self._name,
            "number": self._number,
            "at": at,
            "can_undo": back > 0,
            "can_redo": forth > 0,
            "unsaved": self.unsaved,
            "out": str(self.out),
            "told": "" if self.unsaved else self._told,
            "ended": "",
        }
        self._show(self._view)
        return self._view

    def _fibre(self, asked: Mapping[str, Any]) -> int:
        return check_int("fibre", asked.get("fibre"), 1, len(self._history.now)) - 1

    def _knot(self, asked: Mapping[str, Any]) -> tuple[int, int]:
        fibre = self._fibre(asked)
        inner = len(self._history.now[fibre]) - 2
        if not inner:
            raise InputError(f"fibre {fibre + 1} has no knot but its ends")
        return fibre, check_int("knot", asked.get("knot"), 1, inner)

    def _place(self, asked: Mapping[str, Any]) -> list[float]:
        """Where something is asked for, grid units."""
        layout = self._answers.size.layout
        place_mm = (check_float(name, asked.get(name), -MAX_COORDINATE, MAX_COORDINATE) for name in ("x_mm", "y_mm"))
        return [at / layout.unit_mm + extent / 2 for at, extent in zip(place_mm, layout.extent, strict=True)]


def free_name(path: Path) -> Path:
    """The first of NAME.json, NAME-2.json, NAME-3.json, ... that no file has."""
    names = (path.with_stem(f"{path.stem}{f'-{number}' * (number > 1)}") for number in count(1))
    return next(each for each in names if not os.path.lexists(each))


def _document(body: bytes) -> Mapping[str, Any]:
    try:
        document = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise InputError("what was posted is no JSON") from error
    if not isinstance(document, dict):
        raise InputError(f"{short_repr(document)} was posted, expected an object")
    return document
