"""The studies of force and of shape, in small: estimates are better than guesses."""

from pathlib import Path

import numpy as np
import pytest

from padforge.design import Contact, Morphology, contact
from padforge.sense.studies import indentation
from padforge.sense.studies.indentation import FOOTPRINTS, SETS, circumradius, force_study, shape_study, tool_contacts
from padforge.sense.studies.study import Sizes, run

PAD = {"random": Morphology.random(2, 2, 0)}
UNIT_MM = 11.25
MIDDLE_ERROR_MM = UNIT_MM * 0.38
"""Mean distance of presses from the middle of the pad."""


@pytest.mark.slow
def test_force_study_estimates_depth_and_force_better_than_guessing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(indentation, "FORCE_NOISES", (1.0, 100.0))
    monkeypatch.setattr(contact, "DEPTH_STEPS", 4)
    force = run(force_study(PAD, sizes=Sizes(300, 120, hidden=12, epochs=25)), tmp_path)
    expected = [(label, noise) for label in PAD for noise in (1.0, 100.0)]
    assert [(row["pad"], row["noise_counts"]) for row in force["rows"]] == expected
    for row in force["rows"]:
        assert 0 < row["depth_mm"] < 0.7 * row["depth_guessed_mm"]
        assert 0 < row["force_percent"] < 0.7 * row["force_guessed_percent"]
        assert row["position_one_depth_mm"] < row["position_mm"] < MIDDLE_ERROR_MM
    for quiet, noisy in zip(force["rows"][::2], force["rows"][1::2], strict=True):
        assert quiet["depth_mm"] < noisy["depth_mm"]
        assert quiet["position_one_depth_mm"] < noisy["position_one_depth_mm"]


def test_tools_have_one_size_and_the_layer_of_the_contact_and_polygons_one_area() -> None:
    tools = tool_contacts(Contact(tool_radius_mm=6.0, thickness_mm=8.0))
    assert [contact.tool for contact in tools.values()] == list(tools) == ["dome", "ball", "flat", "finger"]
    assert {contact.thickness_mm for contact in tools.values()} == {8.0}
    assert [tools[name].tool_radius_mm for name in ("dome", "ball", "finger")] == [6.0] * 3
    assert 3.0 < tools["flat"].tool_radius_mm < 6.0
    for sides in FOOTPRINTS.values():
        radius = circumradius(sides)
        area = np.pi * radius**2 if sides is None else sides / 2 * radius**2 * np.sin(2 * np.pi / sides)
        assert area == pytest.approx(np.pi)


@pytest.mark.slow
def test_shape_study_classifies_better_than_chance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contact, "DEPTH_STEPS", 4)
    shapes = run(shape_study(PAD, sizes=Sizes(300, 120, hidden=12, epochs=25)), tmp_path)
    assert [(row["pad"], row["shapes"]) for row in shapes["rows"]] == [(label, kind) for label in PAD for kind in SETS]
    for row in shapes["rows"]:
        assert row["accuracy_percent"] > row["majority_percent"] + 5
        assert 0 < row["position_mm"] < MIDDLE_ERROR_MM
        assert 0 < row["position_shape_known_mm"] < MIDDLE_ERROR_MM
