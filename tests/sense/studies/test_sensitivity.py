"""The study of sensitivity to the object, in small."""

from pathlib import Path

import pytest

from padforge.design import Contact, Morphology
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense.studies import sensitivity
from padforge.sense.studies.sensitivity import sensitivity_study
from padforge.sense.studies.study import run
from tests.helpers.constants import with_constants

PADS = {"square": Morphology.straight(3)}

small = with_constants((sensitivity, {"SIDE": 12, "TEST": 150, "MEMBERS": 2, "HIDDEN": 10, "RADII": (0.6, 1.0)}))


def test_tool_and_depth_of_half_size_err_more_between_fibres(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the paper's own probe of half the size did: 6.3 and 6.8 mm instead of about 2."""
    monkeypatch.setattr(sensitivity, "FACTORS", (0.5, 1.0))
    document = run(sensitivity_study(PADS), tmp_path)
    keys = "trained_tool_radius_mm", "trained_depth_mm", "tool_radius_mm", "depth_mm"
    means_mm = {tuple(row[key] for key in keys): row["mean_mm"] for row in document["rows"]}
    assert len(means_mm) == 16
    half, stated = (4.2, 2.5), (8.4, 5.0)
    assert means_mm[half + half] > 2 * means_mm[stated + stated]
    assert means_mm[stated + half] > means_mm[half + half]
    assert means_mm[stated + stated] < means_mm[4.2, 5.0, 4.2, 5.0] < means_mm[half + half]
    assert "Errors are in mm." in document["text"][0]


def test_tools_and_depths_are_half_and_one_and_a_half_times_those_of_the_contact() -> None:
    """Without depths beyond the thickness."""
    settings = sensitivity_study(PADS, contact=Contact(tool_radius_mm=4.0, depth_mm=2.0)).settings
    assert (settings["tool_radius_mm"], settings["depth_mm"]) == ([2, 4, 6], [1, 2, 3])
    deep, shallow = (sensitivity_study(PADS, contact=Contact(depth_mm=depth_mm)) for depth_mm in (5.0, 3.0))
    assert deep.settings["depth_mm"] == [2.5, 5.0]
    assert shallow.settings["depth_mm"] == [1.5, 3.0, 4.5]
    assert len(shallow.tasks) == 9


def test_study_finds_that_larger_objects_are_localized_better(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("SIDE", 16), ("TEST", 200), ("HIDDEN", 12)):
        monkeypatch.setattr(sensitivity, name, value)
    document = run(sensitivity_study(PADS, contact=PUBLISHED_CONTACT), tmp_path)
    assert len(document["rows"]) == 16
    keys = "trained_radius", "trained_sides", "radius", "sides"
    means = {tuple(row[key] for key in keys): row["mean"] for row in document["rows"]}
    assert means[1.0, 30, 1.0, 30] < 0.5 * means[0.6, 30, 0.6, 30]
    assert means[1.0, 30, 0.6, 30] > 1.5 * means[0.6, 30, 0.6, 30]
