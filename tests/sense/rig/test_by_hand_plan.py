"""Where a person is asked to press, how that is shown, and what of it a run directory keeps."""

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.design.common.validation import InputError
from padforge.design.settings import PadSettings
from padforge.sense.rig.by_hand import (
    COLUMNS,
    ROUND,
    ROWS,
    in_rounds,
    opened,
    pad_view,
    record_by_hand,
    still_to_make,
    targets_of,
    view_lines,
)
from padforge.sense.rig.config import RigConfig
from padforge.sense.rig.devices import RigFault
from padforge.sense.settings import RigSettings

BOARD = {"name": "board", "channels": 4, "rate_hz": 1000.0}
VIEW = {
    "said": "press x 5, y 5 mm",
    "told": "counted: x 0, y 0 mm",
    "phase": "press",
    "progress": 0.5,
    "done": 2,
    "of": 7,
}
VIEW |= {"target": (16.875, 16.875), "refused": None}
VIEW |= {"presses": [{"x_mm": 0.0, "y_mm": 0.0}, {"x_mm": -16.875, "y_mm": 16.875}]}


def setup_of(**settings: object) -> RigConfig:
    return RigConfig(Morphology.straight(4), Contact(), RigSettings(**settings), Path("out"), "test")  # type: ignore[arg-type]


def test_uniform_places_are_gone_through_by_short_ways_all_over_the_pad() -> None:
    places = targets_of(setup_of(presses=4 * ROUND, seed=3))
    assert np.array_equal(places, np.rint(places))
    ways = np.linalg.norm(np.diff(places, axis=0), axis=1)
    shuffled = np.random.default_rng(1).permutation(places)
    assert ways.mean() < 0.5 * np.linalg.norm(np.diff(shuffled, axis=0), axis=1).mean()
    for first in range(0, len(places), ROUND):
        assert (np.ptp(places[first : first + ROUND], axis=0) > 0.6 * 45).all()


def test_rounds_leave_nothing_out_and_what_is_made_is_counted_place_by_place() -> None:
    places = np.random.default_rng(2).integers(-5, 5, (2 * ROUND + 7, 2)).astype(float)
    ordered = in_rounds(places)
    for first in range(0, len(places), ROUND):
        part = slice(first, first + ROUND)
        assert sorted(map(tuple, ordered[part])) == sorted(map(tuple, places[part]))
    targets = np.array([[1.0, 1], [2, 2], [1, 1], [3, 3]])
    assert still_to_make(targets, np.array([[1.0, 1], [np.nan, np.nan], [3, 3]])).tolist() == [[2, 2], [1, 1]]
    assert still_to_make(targets, targets).shape == (0, 2)


def test_a_plan_with_an_order_keeps_it(tmp_path: Path) -> None:
    grid = targets_of(setup_of(presses=9, plan="boustrophedon"))
    assert (np.diff(grid[:3, 0]) > 0).all()
    assert (np.diff(grid[3:6, 0]) < 0).all()
    (tmp_path / "places.csv").write_text("x_mm,y_mm\n3.25,-1\n0,2\n3.25,-1\n")
    assert targets_of(setup_of(plan=str(tmp_path / "places.csv"))).tolist() == [[3.25, -1], [0, 2], [3.25, -1]]
    with pytest.raises(InputError, match=r"\[rig\] plan is adaptive, by hand allowed are"):
        targets_of(setup_of(plan="adaptive"))


def test_whole_millimetres_do_not_lie_in_a_hole() -> None:
    hole = ((-4.6, -20.0), (4.6, -20.0), (4.6, 20.0), (-4.6, 20.0))
    places = targets_of(replace(setup_of(presses=400), size=PadSettings(keep_out_mm=(hole,))))
    assert len(places) == 400
    assert not ((np.abs(places) < [4.6, 20.0]).all(axis=1)).any()
    assert (places == np.rint(places)).mean() > 0.9


def test_the_pad_is_shown_as_it_is_planned() -> None:
    pad = Morphology.random(2, knots=3, seed=1)
    view = json.loads(json.dumps(pad_view(pad, "hand")))
    assert pad_view(pad, "hand", mirrored=True)["courses"] == pad_view(pad, "hand")["courses"]
    assert view["half_mm"] == [side / 2 for side in pad.layout.size_mm]
    assert len(view["courses"]) == 4
    ends = np.array([[course[0], course[-1]] for course in view["courses"]])
    np.testing.assert_allclose(ends, pad.to_mm(pad.knots[:, [0, -1]]), atol=0.051)


def test_a_terminal_shows_the_place_where_it_is() -> None:
    pad = Morphology.straight(2)
    lines = view_lines(pad_view(pad, "hand") | VIEW)
    assert lines[0] == "PRESS X 5, Y 5 MM"
    assert lines[1].count("#") == lines[1].count(".") == 15
    rows = lines[3 : 3 + ROWS]
    assert {len(row) for row in rows} == {COLUMNS + 2}
    assert (rows[0][COLUMNS], rows[0][1]) == ("O", ".")  # up is up, right is right
    assert "".join(rows).count("O") == 1
    assert rows[ROWS // 2][1 + COLUMNS // 2] == "."
    assert "2 of 7 presses" in lines[-2]
    assert "q: end" in lines[-1]
    # With its tracks up, what is to the right on the plan is to the left of whoever looks; places stay as planned.
    lying = view_lines(pad_view(pad, "hand", mirrored=True) | VIEW)
    assert [row[::-1] for row in lying[3 : 3 + ROWS]] == rows
    assert lying[0] == lines[0]


def test_a_map_of_a_rectangle_is_as_wide_and_high_as_the_pad() -> None:
    pad = Morphology.straight((1, 5), 8.0)  # 48 mm wide and 16 mm high
    lines = view_lines(pad_view(pad, "hand") | VIEW | {"target": (24.0, 8.0), "refused": (-24.0, -8.0)})
    edges = [row for row, line in enumerate(lines) if line.startswith("+")]
    assert (len(lines[edges[0]]), edges[1] - edges[0] - 1) == (COLUMNS + 2, ROWS // 3)
    assert (lines[edges[0] + 1][COLUMNS], lines[edges[1] - 1][1]) == ("O", "x")


@pytest.fixture
def down_command(tmp_path: Path) -> RigConfig:
    """A recording whose first two presses are made, and one at an unknown place."""
    setup = RigConfig(Morphology.straight(2), Contact(), RigSettings(presses=5), tmp_path / "run", "test", [])
    recorder, targets, left = opened(setup, BOARD, resume=False)
    assert left is targets
    with recorder:
        recorder.append(np.arange(20.0), np.ones((20, 4)))
        for press, place in enumerate((targets[0], (np.nan, np.nan), targets[1])):
            recorder.begin(place, 2 + 5 * press)
            recorder.finish(5 + 5 * press)
    return setup


def test_what_is_missing_is_asked_for_of_the_plan_that_was_kept(down_command: RigConfig) -> None:
    source = json.loads((down_command.out / "start.json").read_text())["source"]
    assert (source["kind"], source["devices"]["board"]) == ("hand", BOARD)
    assert source["plan"]["columns"] == ["x_mm", "y_mm"]
    assert len(source["plan"]["presses"]) == 5
    recorder, targets, left = opened(down_command, BOARD, resume=True)
    with recorder:
        assert targets.tolist() == source["plan"]["presses"]
        np.testing.assert_array_equal(left, targets[2:])
        assert recorder.n_readings == 20


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "rig"}, "holds a recording of kind 'rig', not 'hand'"),
        ({"plan": {"presses": [[1, 2, 3]]}}, "its plan has shape"),
        ({"plan": {"presses": [["a", 1]]}}, "places of the plan"),
    ],
)
def test_another_recording_is_not_gone_on_with(down_command: RigConfig, change: dict, said: str) -> None:
    path = down_command.out / "start.json"
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"source": document["source"] | change}))
    with pytest.raises(InputError, match=said):
        opened(down_command, BOARD, resume=True)


def test_a_recording_killed_while_it_was_being_born_is_not_in_the_way(tmp_path: Path) -> None:
    board = Mock(connect=Mock(side_effect=RigFault("lost", "the board is gone")))
    setup = replace(setup_of(), out=tmp_path / "run")
    setup.out.mkdir()
    (setup.out / "journal.ndjson").touch()
    with pytest.raises(RigFault, match="the board is gone"):
        record_by_hand(setup, board, lambda view: None)
    (setup.out / "notes.txt").touch()
    with pytest.raises(InputError, match="never written over"):
        record_by_hand(setup, board, lambda view: None)
