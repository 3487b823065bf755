"""The studies of force and of shape, in small: estimates are better than guesses."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from padforge import InputError
from padforge.design import Contact, Morphology, contact, press_forces_n
from padforge.sense.studies import indentation
from padforge.sense.studies.indentation import FOOTPRINTS, SETS, circumradius, force_study, shape_study, tool_contacts
from padforge.sense.studies.study import Sizes, Study, run

PADS = {"square": Morphology.straight(2), "random": Morphology.random(2, 2, 0)}
UNIT_MM = 11.25
MIDDLE_ERROR_MM = UNIT_MM * 0.38
"""Mean distance of presses from the middle of the pad."""


@pytest.mark.slow
def test_force_study_estimates_depth_and_force_better_than_guessing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(indentation, "FORCE_NOISES", (1.0, 100.0))
    monkeypatch.setattr(contact, "DEPTH_STEPS", 6)
    force = run(force_study(PADS, sizes=Sizes(300, 120, hidden=12, epochs=25)), tmp_path)
    expected = [(label, noise) for label in PADS for noise in (1.0, 100.0)]
    assert [(row["pad"], row["noise_counts"]) for row in force["rows"]] == expected
    for row in force["rows"]:
        assert 0 < row["depth_mm"] < 0.7 * row["depth_guessed_mm"]
        assert 0 < row["force_percent"] < 0.7 * row["force_guessed_percent"]
        assert row["position_one_depth_mm"] < row["position_mm"] < MIDDLE_ERROR_MM
    for quiet, noisy in zip(force["rows"][::2], force["rows"][1::2], strict=True):
        assert quiet["depth_mm"] < noisy["depth_mm"]
        assert quiet["position_one_depth_mm"] < noisy["position_one_depth_mm"]


def test_tools_have_one_size_and_the_layer_of_the_contact() -> None:
    tools = tool_contacts(Contact(tool_radius_mm=6.0, thickness_mm=8.0))
    assert [contact.tool for contact in tools.values()] == list(tools) == ["dome", "ball", "flat", "finger"]
    assert {contact.thickness_mm for contact in tools.values()} == {8.0}
    assert [tools[name].tool_radius_mm for name in ("dome", "ball", "finger")] == [6.0] * 3
    assert 3.0 < tools["flat"].tool_radius_mm < 6.0


@pytest.mark.parametrize("study", [force_study, shape_study])
def test_contact_without_depth_is_refused(study: Callable[..., Study]) -> None:
    with pytest.raises(InputError, match=r"\[contact\] model is shape, allowed is layer"):
        study(PADS, contact=Contact(radius=0.6))


@pytest.mark.parametrize("sides", FOOTPRINTS.values())
def test_circumradius_gives_polygons_of_one_area(sides: int | None) -> None:
    radius = circumradius(sides)
    area = np.pi * radius**2 if sides is None else sides / 2 * radius**2 * np.sin(2 * np.pi / sides)
    assert area == pytest.approx(np.pi)


@pytest.mark.slow
def test_shape_study_classifies_better_than_chance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact, "DEPTH_STEPS", 6)
    shapes = run(shape_study(PADS, sizes=Sizes(500, 200, hidden=12, epochs=25)), tmp_path)
    assert [(row["pad"], row["shapes"]) for row in shapes["rows"]] == [(label, kind) for label in PADS for kind in SETS]
    for row in shapes["rows"]:
        assert row["accuracy_percent"] > row["majority_percent"] + 5
        assert 0 < row["position_mm"] < MIDDLE_ERROR_MM
        assert 0 < row["position_shape_known_mm"] < MIDDLE_ERROR_MM


def test_force_study_errs_by_the_whole_range_where_the_deepest_presses_pass_for_the_lightest() -> None:
    """Half of the presses are deepest, half lightest, each predicted as the other, and 3 and 4 units off in x and y."""
    study = force_study({"square": PADS["square"]})
    low, high = study.settings["depths_mm"]
    depth = np.tile([low, high], 4)
    pressed = np.column_stack([np.ones((8, 2)), depth])
    predicted = pressed + np.array([3.0, 4.0, 0.0])
    predicted[:, 2] = depth[::-1]
    known = {"pressed": pressed[:, :2], "predicted": pressed[:, :2] + np.array([0.0, 1.0])}
    one = {"pressed": pressed, "predicted": pressed + np.array([2.0, 0.0, 0.0])}
    noises = study.settings["noise_counts"]
    result = study.conclude([{"pressed": pressed, "predicted": predicted}, known, one] * len(noises))
    assert [row["noise_counts"] for row in result.rows] == noises
    row, unit_mm = result.rows[0], PADS["square"].unit_mm
    names = ("position_mm", "position_depth_known_mm", "position_one_depth_mm")
    assert [row[name] for name in names] == pytest.approx([5 * unit_mm, unit_mm, 2 * unit_mm])
    assert row["depth_mm"] == pytest.approx(high - low)
    assert row["depth_guessed_mm"] == pytest.approx((high - low) / 2)
    lightest_n, deepest_n = press_forces_n(np.array([low, high])).tolist()
    assert (row["force_n"], row["force_percent"]) == pytest.approx((deepest_n - lightest_n, 100))
    assert row["force_guessed_percent"] == pytest.approx(50)  # the middle depth is between both, wherever its force
    curve = result.extra["curves"][0]
    assert np.diff(curve["bin_depth_mm"]) == pytest.approx((high - low) / indentation.BINS)
    assert [each is not None for each in curve["bin_position_mm"]] == [True, *[False] * (indentation.BINS - 2), True]
    assert curve["bin_position_mm"][0] == pytest.approx(5 * unit_mm)


def test_shape_study_names_the_shape_that_is_recognized_least() -> None:
    """Of each kind the second shape is recognized once in 4 presses, the others always; errors: 0.5 and 0.25 units."""
    study = shape_study({"square": PADS["square"]})
    states = []
    for shapes in SETS.values():
        counts = 4 * np.eye(len(shapes), dtype=int)
        counts[1, :2] = 3, 1
        states += [{"confusions": counts}, {"unknown": np.array(0.5), "known": np.array(0.25)}]
    result = study.conclude(states)
    assert [row["shapes"] for row in result.rows] == list(SETS)
    for row, shapes in zip(result.rows, SETS.values(), strict=True):
        assert (row["worst"], row["worst_percent"]) == (shapes[1], 25)
        assert row["accuracy_percent"] == pytest.approx(100 * (4 * len(shapes) - 3) / (4 * len(shapes)))
        positions_mm = row["position_mm"], row["position_shape_known_mm"]
        assert positions_mm == pytest.approx((0.5 * UNIT_MM, 0.25 * UNIT_MM))
