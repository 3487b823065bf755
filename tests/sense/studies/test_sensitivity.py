"""The study of sensitivity to the object, in small."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge import InputError
from padforge.design import Contact, Morphology
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense.studies import sensitivity
from padforge.sense.studies.sensitivity import sensitivity_study
from padforge.sense.studies.study import run

PADS = {"square": Morphology.straight(3)}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("SIDE", 12), ("TEST", 150), ("MEMBERS", 2), ("HIDDEN", 10), ("RADII", (0.6, 1.0))):
        monkeypatch.setattr(sensitivity, name, value)


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


def test_depths_beyond_the_thickness_are_left_out() -> None:
    deep, shallow = (sensitivity_study(PADS, contact=Contact(depth_mm=depth_mm)) for depth_mm in (5.0, 3.0))
    assert deep.settings["depth_mm"] == [2.5, 5.0]
    assert shallow.settings["depth_mm"] == [1.5, 3.0, 4.5]
    assert len(shallow.tasks) == 9


def test_tools_and_depths_are_half_and_one_and_a_half_times_those_of_the_contact() -> None:
    settings = sensitivity_study(PADS, contact=Contact(tool_radius_mm=4.0, depth_mm=2.0)).settings
    assert (settings["tool_radius_mm"], settings["depth_mm"]) == ([2, 4, 6], [1, 2, 3])


def test_profile_has_no_size_to_vary() -> None:
    with pytest.raises(InputError, match=r"\[contact\] model is profile, allowed are layer and shape"):
        sensitivity_study(PADS, contact=Contact(model="profile"))


@pytest.mark.slow
def test_study_finds_that_larger_objects_are_localized_better(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("SIDE", 16), ("TEST", 200), ("HIDDEN", 12)):
        monkeypatch.setattr(sensitivity, name, value)
    document = run(sensitivity_study(PADS, contact=PUBLISHED_CONTACT), tmp_path)
    assert len(document["rows"]) == 16
    keys = "trained_radius", "trained_sides", "radius", "sides"
    means = {tuple(row[key] for key in keys): row["mean"] for row in document["rows"]}
    assert means[1.0, 30, 1.0, 30] < 0.5 * means[0.6, 30, 0.6, 30]
    assert means[1.0, 30, 0.6, 30] > 1.5 * means[0.6, 30, 0.6, 30]


def test_sensitivity_study_compares_radii_over_depths_and_depths_over_radii() -> None:
    """Networks err by 1, 2 or 3 units for the radii, twice as much at the second depth, and by 60 for other objects."""
    study = sensitivity_study(PADS)
    sizes, others = study.settings["tool_radius_mm"], study.settings["depth_mm"]
    trained = np.outer([1.0, 2.0], np.arange(1.0, len(sizes) + 1)).ravel()
    assert (len(study.tasks), len(others)) == (len(trained), 2)
    states = []
    for number, error in enumerate(trained):
        errors = np.full((2, len(trained)), 60.0)
        errors[:, number] = error - 0.5, error + 0.5
        states.append({"errors": errors})
    result = study.conclude(states)
    unit_mm = PADS["square"].unit_mm
    row = result.rows[len(trained) + 1]
    names = ("trained_tool_radius_mm", "trained_depth_mm", "tool_radius_mm", "depth_mm", "mean", "std", "mean_mm")
    assert [row[name] for name in names] == pytest.approx([sizes[1], others[0]] * 2 + [2.0, 0.5, 2 * unit_mm])


def test_figure_has_errors_by_size_and_a_matrix_of_trained_by_tested_objects() -> None:
    """Of sizes 2 and 4 mm, 1 and 3 mm deep: in the curves every object is tested with itself."""
    objects = [(size, depth) for depth in (1.0, 3.0) for size in (2.0, 4.0)]
    matrix = np.arange(1.0, 17).reshape(4, 4)
    rows = [
        {"pad": "a", "trained_tool_radius_mm": trained[0], "trained_depth_mm": trained[1]}
        | {"tool_radius_mm": tested[0], "depth_mm": tested[1], "mean_mm": float(matrix[i, j])}
        for i, trained in enumerate(objects)
        for j, tested in enumerate(objects)
    ]
    settings = {"pads": {"a": {}}, "contact": Contact().model_dump(mode="json")}
    settings |= {"tool_radius_mm": [2.0, 4.0], "depth_mm": [1.0, 3.0]}
    figure: Any = sensitivity_study(PADS).draw({"rows": rows, "settings": settings})
    by_size, errors = figure.axes
    assert [line.get_xydata().tolist() for line in by_size.lines] == [[[2, 1], [4, 6]], [[2, 11], [4, 16]]]
    assert errors.images[0].get_array().tolist() == matrix.tolist()
    numbers = {text.get_position(): text.get_text() for text in errors.texts}
    assert (numbers[1, 0], numbers[0, 1]) == ("2.00", "5.00")  # the column is what is tested with
