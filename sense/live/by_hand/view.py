"""What of a session by hand is shown besides its own view: the pad as it is planned, and all of it as text."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from design import Morphology
from design.pad.courses.curves import flatten

from .session import WORDS

TOLERANCE = 0.02
"""Of the courses drawn, grid units."""
COLUMNS, ROWS = 49, 21
"""Of the map on a terminal, whose characters are about twice as high as wide."""
BAR = 30
"""Characters of the bar of a wait or a hold."""


def pad_view(pad: Morphology, title: str, mirrored: bool = False) -> dict[str, Any]:
    """The part of the view that stays, as JSON: frame, fibres' courses in mm, and what may be said.

    Places are those of the plan; of a pad that lies `mirrored`, with its tracks up, x runs to the left.
    """
    courses = [np.round(pad.to_mm(course), 1).tolist() for course in flatten(pad, TOLERANCE)]
    half_mm = pad.size_mm / 2
    return {
        "title": title,
        "middle_mm": [0.0, 0.0],
        "half_mm": half_mm,
        "mirrored": mirrored,
        "courses": courses,
        "words": WORDS,
        "ended": "",
    }


def view_lines(view: Mapping[str, Any]) -> list[str]:
    """All there is to show (`pad_view` and `HandSession.view`) as text; the pad as a map seen from above."""
    full = round(BAR * view["progress"])
    return [
        view["said"].upper(),
        f"[{'#' * full}{'.' * (BAR - full)}]",
        *_map(view),
        f"{view['done']} of {view['of']} presses   {view['told']}",
        "   ".join(f"{each['key']}: {each['text'].lower()}" for each in WORDS),
    ]


def _map(view: Mapping[str, Any]) -> list[str]:
    """The pad's edge, the places pressed last (.), one that did not count (x), and the next (O)."""
    rows = [[" "] * COLUMNS for _ in range(ROWS)]

    def put(place: tuple[float, float], mark: str) -> None:
        x, y = (np.clip((value / view["half_mm"] + 1) / 2, 0, 1) for value in place)
        right = 1 - x if view["mirrored"] else x
        rows[round((1 - y) * (ROWS - 1))][round(right * (COLUMNS - 1))] = mark

    for press in view["presses"]:
        put((press["x_mm"], press["y_mm"]), ".")
    for name, mark in (("refused", "x"), ("target", "O")):
        if view[name] is not None:
            put(view[name], mark)
    edge = f"+{'-' * COLUMNS}+"
    return [edge, *(f"|{''.join(row)}|" for row in rows), edge]
