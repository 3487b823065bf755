"""The studies of force and of shape, in small: what they find is better than guessing."""

import numpy as np
import pytest

from padforge.design import InputError, Morphology
from padforge.design.indentation import Indenter
from padforge.sense.studies.indentation import (
    COUNTS,
    FOOTPRINTS,
    SETS,
    Learning,
    circumradius,
    force_study,
    readings,
    shape_study,
)
from padforge.sense.studies.study import run

PADS = {"square": Morphology.straight(2), "random": Morphology.random(2, 2, 0)}


@pytest.fixture(scope="module")
def force(tmp_path_factory: pytest.TempPathFactory) -> dict:
    learning = Learning(presses=300, test=120, hidden=12, epochs=25)
    return run(force_study(PADS, noise_counts=(1.0, 30.0), learning=learning), tmp_path_factory.mktemp("force"))


@pytest.mark.slow
def test_depth_and_force_are_found_better_than_guessed_and_noise_costs_accuracy(force: dict) -> None:
    for row in force["rows"]:
        assert 0 < row["depth_mm"] < 0.7 * row["depth_guessed_mm"]
        assert 0 < row["force_percent"] < 0.7 * row["force_guessed_percent"]
        assert row["depth_mm"] == pytest.approx(11.25 * row["depth_grid"])
        assert row["place_mm"] < 11.25 * 0.38  # the middle of the pad is that far off on average
        assert row["place_one_depth_mm"] < row["place_mm"]
    for quiet, loud in zip(force["rows"][::2], force["rows"][1::2], strict=True):
        assert quiet["pad"] == loud["pad"]
        assert quiet["depth_mm"] < loud["depth_mm"]
        assert quiet["place_one_depth_mm"] < loud["place_one_depth_mm"]
    assert len({tuple(row) for row in force["rows"]}) == 1
    expected = [(label, noise) for label in PADS for noise in (1.0, 30.0)]
    assert [(row["pad"], row["noise_counts"]) for row in force["rows"]] == expected
    curve, row, press = force["curves"][0], force["rows"][0], Indenter()
    made, found = (press.force_n(np.array(curve[key]) / 11.25, 11.25) for key in ("pressed_mm", "predicted_mm"))
    assert np.abs(found - made).mean() == pytest.approx(row["force_n"], rel=1e-3)
    assert len(curve["place_mm"]) == len(curve["middles_mm"])


def test_readings_are_whole_counts_footprints_have_one_area_and_depths_are_checked() -> None:
    signals = np.array([[0.0, 0.5, 0.0], [0.25, 1.0, 0.0], [0.5, 2.0, 0.0]])
    read = readings(signals, np.array([0.5, 1.0, 0.0]), 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(read, [[0, 2048, 0], [2048, COUNTS, 0], [COUNTS, COUNTS, 0]])
    noisy = readings(np.full((4000, 1), 0.5), np.ones(1), 4.0, np.random.default_rng(0))
    assert noisy.std() == pytest.approx(4, rel=0.1)
    for sides in FOOTPRINTS.values():
        radius = circumradius(sides)
        area = np.pi * radius**2 if sides is None else sides / 2 * radius**2 * np.sin(2 * np.pi / sides)
        assert area == pytest.approx(np.pi)
    with pytest.raises(InputError, match=r"depth is 0\.9, allowed is 0 to the sphere's radius"):
        force_study(PADS, depths=(0.1, 0.9))


@pytest.fixture(scope="module")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> dict:
    return run(shape_study(PADS, presses=500, test=200, hidden=12, epochs=25), tmp_path_factory.mktemp("shape"))


@pytest.mark.slow
def test_shapes_are_named_better_than_by_chance(shapes: dict) -> None:
    assert [(row["pad"], row["shapes"]) for row in shapes["rows"]] == [(label, of) for label in PADS for of in SETS]
    assert len({tuple(row) for row in shapes["rows"]}) == 1
    for row, each in zip(shapes["rows"], shapes["confusions"], strict=True):
        counts = np.array(each["counts"])
        assert counts.sum() == 200
        assert row["accuracy_percent"] == pytest.approx(100 * np.trace(counts) / 200)
        assert row["accuracy_percent"] > row["guessed_percent"] + 5
        assert row["worst_percent"] == pytest.approx((100 * np.diag(counts) / counts.sum(axis=1)).min())
        assert row["worst"] in SETS[row["shapes"]]
        assert 0 < row["place_mm"] < 11.25 * 0.38
        assert 0 < row["place_shape_known_mm"] < 11.25 * 0.38
