import json

import numpy as np

from design import Morphology
from sense.live.by_hand.view import COLUMNS, ROWS, pad_view, view_lines

VIEW = {
    "said": "press x 5, y 5 mm",
    "told": "counted: x 0, y 0 mm",
    "phase": "press",
    "progress": 0.5,
    "target": (16.875, 16.875),
    "refused": None,
    "presses": [{"x_mm": 0.0, "y_mm": 0.0}, {"x_mm": -16.875, "y_mm": 16.875}],
    "done": 2,
    "of": 7,
}


def test_the_pad_is_shown_as_it_is_planned() -> None:
    pad = Morphology.random(2, knots=3, seed=1)
    view = json.loads(json.dumps(pad_view(pad, "out/hand")))
    assert view["half_mm"] == [side / 2 for side in pad.layout.size_mm]
    assert len(view["courses"]) == 4
    ends = np.array([[course[0], course[-1]] for course in view["courses"]])
    np.testing.assert_allclose(ends, pad.to_mm(pad.knots[:, [0, -1]]), atol=0.051)


def test_a_terminal_shows_the_place_where_it_is() -> None:
    lines = view_lines(pad_view(Morphology.straight(2), "hand") | VIEW)
    assert lines[0] == "PRESS X 5, Y 5 MM"
    assert lines[1].count("#") == lines[1].count(".") == 15
    rows = lines[3 : 3 + ROWS]
    assert {len(row) for row in rows} == {COLUMNS + 2}
    assert (rows[0][COLUMNS], rows[0][1]) == ("O", ".")  # up is up, right is right
    assert "".join(rows).count("O") == 1
    assert rows[ROWS // 2][1 + COLUMNS // 2] == "."
    assert "2 of 7 presses" in lines[-2]
    assert "q: end" in lines[-1]


def test_with_its_tracks_up_the_pad_is_shown_as_it_lies() -> None:
    """Places stay those of the plan; what is to the right there is to the left of whoever looks at the pad."""
    pad = Morphology.straight(2)
    plain, lying = (view_lines(pad_view(pad, "hand", mirrored) | VIEW) for mirrored in (False, True))
    assert [row[::-1] for row in lying[3 : 3 + ROWS]] == plain[3 : 3 + ROWS]
    assert lying[0] == plain[0]
    assert pad_view(pad, "hand", True)["courses"] == pad_view(pad, "hand")["courses"]


def test_a_map_of_a_rectangle_is_as_wide_and_high_as_the_pad() -> None:
    pad = Morphology.straight((1, 5), 8.0)  # 48 mm wide and 16 mm high
    lines = view_lines(pad_view(pad, "hand") | VIEW | {"target": (24.0, 8.0), "refused": (-24.0, -8.0)})
    edges = [row for row, line in enumerate(lines) if line.startswith("+")]
    assert (len(lines[edges[0]]), edges[1] - edges[0] - 1) == (COLUMNS + 2, ROWS // 3)
    assert (lines[edges[0] + 1][COLUMNS], lines[edges[1] - 1][1]) == ("O", "x")
