from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from design import Contact, Morphology
from design.common.errors import InputError
from design.settings import PadSettings
from sense.live.by_hand.targets import ROUND, in_rounds, still_to_make, targets_of
from sense.rig.planning.setup import Setup
from sense.settings import RigSettings


def setup(**settings: object) -> Setup:
    return Setup(Morphology.straight(4), Contact(), RigSettings(**settings), Path("out"), "test")  # type: ignore[arg-type]


def test_uniform_places_are_gone_through_by_short_ways_all_over_the_pad() -> None:
    places = targets_of(setup(presses=4 * ROUND, seed=3))
    assert np.array_equal(places, np.rint(places))
    ways = np.linalg.norm(np.diff(places, axis=0), axis=1)
    shuffled = np.random.default_rng(1).permutation(places)
    assert ways.mean() < 0.5 * np.linalg.norm(np.diff(shuffled, axis=0), axis=1).mean()
    for first in range(0, len(places), ROUND):
        assert (np.ptp(places[first : first + ROUND], axis=0) > 0.6 * 45).all()


def test_rounds_leave_nothing_out() -> None:
    places = np.random.default_rng(2).integers(-5, 5, (2 * ROUND + 7, 2)).astype(float)
    ordered = in_rounds(places)
    for first in range(0, len(places), ROUND):
        part = slice(first, first + ROUND)
        assert sorted(map(tuple, ordered[part])) == sorted(map(tuple, places[part]))


def test_a_plan_with_an_order_keeps_it(tmp_path: Path) -> None:
    grid = targets_of(setup(presses=9, plan="boustrophedon"))
    assert (np.diff(grid[:3, 0]) > 0).all()
    assert (np.diff(grid[3:6, 0]) < 0).all()
    (tmp_path / "places.csv").write_text("x_mm,y_mm\n3.25,-1\n0,2\n3.25,-1\n")
    assert targets_of(setup(plan=str(tmp_path / "places.csv"))).tolist() == [[3.25, -1], [0, 2], [3.25, -1]]
    with pytest.raises(InputError, match=r"\[rig\] plan is adaptive, by hand allowed are"):
        targets_of(setup(plan="adaptive"))


def test_what_is_still_to_make_is_counted_place_by_place() -> None:
    targets = np.array([[1.0, 1], [2, 2], [1, 1], [3, 3]])
    assert still_to_make(targets, np.array([[1.0, 1], [np.nan, np.nan], [3, 3]])).tolist() == [[2, 2], [1, 1]]
    assert still_to_make(targets, targets).shape == (0, 2)


def test_whole_millimetres_do_not_lie_in_a_hole() -> None:
    hole = ((-4.6, -20.0), (4.6, -20.0), (4.6, 20.0), (-4.6, 20.0))
    places = targets_of(replace(setup(presses=400), size=PadSettings(keep_out_mm=(hole,))))
    assert len(places) == 400
    assert not ((np.abs(places) < [4.6, 20.0]).all(axis=1)).any()
    assert (places == np.rint(places)).mean() > 0.9
