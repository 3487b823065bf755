"""What of a session by hand is shown besides its own view: the pad as it is planned, and all of it as text."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from padforge.design import Morphology
from padforge.design.paths.curves import flatten

from padforge.sense.live.by_hand.session import WORDS

TOLERANCE = 0.02
"""Of the courses drawn, grid units."""
COLUMNS, ROWS = 49, 21
"""Of the map of a square pad on a terminal, whose characters are about twice as high as wide; of another one at most so
many."""
BAR = 30
"""Characters of the bar of a wait or a hold."""


def pad_view(pad: Morphology, title: str, mirrored: bool = False) -> dict[str, Any]:
    """The part of the view that stays, as JSON: frame, fibres' courses in mm, and what may be said.

    Places are those of the plan; of a pad that lies `mirrored`, with its tracks up, x runs to the left.
    """
    courses = [np.round(pad.to_mm(course), 1).tolist() for course in flatten(pad, TOLERANCE)]
    return {
        "title": title,
        "middle_mm": [0.0, 0.0],
        "half_mm": [side / 2 for side in pad.layout.size_mm],
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
    width, height = view["half_mm"]
    columns = max(round(COLUMNS * width / max(width, height)), 3)
    rows = [[" "] * columns for _ in range(max(round(ROWS * height / max(width, height)), 3))]

    def put(place: tuple[float, float], mark: str) -> None:
        x, y = np.clip((np.array(place) / (width, height) + 1) / 2, 0, 1).tolist()
        right = 1 - x if view["mirrored"] else x
        rows[round((1 - y) * (len(rows) - 1))][round(right * (columns - 1))] = mark

    for press in view["presses"]:
        put((press["x_mm"], press["y_mm"]), ".")
    for name, mark in (("refused", "x"), ("target", "O")):
        if view[name] is not None:
            put(view[name], mark)
    edge = f"+{'-' * columns}+"
    return [edge, *(f"|{''.join(row)}|" for row in rows), edge]
