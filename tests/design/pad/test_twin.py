"""Twins: what their files keep, what they refuse, and what their fibres answer as laid."""

import json
from dataclasses import replace

import numpy as np
import pytest

from design import InputError, Morphology, Twin
from design.pad.contact import relative_stretch
from design.pad.courses.curves import flatten
from design.pad.twin import Frame, TwinChannel, TwinReadings

PAD = Morphology.random(2, knots=3, seed=5)
DISTANCE = np.linspace(0, 1.6, 9)
WEIGHT = np.append(np.exp(-0.5 * (DISTANCE[:-1] / 0.5) ** 2) - 0.05 * (DISTANCE[:-1] > 1.2), 0.0)
PLACES = np.random.default_rng(0).uniform(-11, 11, (30, 2))


@pytest.fixture
def twin() -> Twin:
    """A pad that lies as planned, its last fibre read by no channel, its second channel by no fibre."""
    read = (2, None, 0, 1)
    channels = tuple(TwinChannel(c, fibre, -0.05 * (fibre is not None), 0.002, 0.9) for c, fibre in enumerate(read))
    laid = (*(PAD.to_mm(line) for line in flatten(PAD, 1e-4)[:3]), None)
    frame = Frame(True, 5.0, (2.0, -1.0), 0.95)
    return Twin(PAD, channels, frame, DISTANCE * PAD.pitch_mm, WEIGHT, laid, 0.015, (20.0, 22.0), 900)


def test_a_file_brings_a_twin_back(twin, tmp_path):
    uneven = tuple(None if line is None else np.linspace(0.8, 1.2, len(line) - 1) for line in twin.laid_mm)
    whole = replace(twin, sensitivity=uneven, angle_weight=0.1 * WEIGHT, provenance={"command": "test"})
    for each in (twin, whole):
        each.save(tmp_path / "twin.json")
        back = Twin.load(tmp_path / "twin.json")
        assert (back.channels, back.frame, back.noise, back.sensed_mm, back.presses) == (
            each.channels,
            each.frame,
            each.noise,
            each.sensed_mm,
            each.presses,
        )
        assert back.contact() == each.contact()
        assert back.laid_stretch(PLACES) == pytest.approx(each.laid_stretch(PLACES), abs=1e-3)
    assert json.loads((tmp_path / "twin.json").read_text())["format"] == "padforge-twin/2"


def test_fibres_that_lie_as_planned_answer_as_the_contact_model_has_it(twin):
    exact = relative_stretch(PAD, PAD.to_grid(twin.frame.to_plan(PLACES)), twin.contact())
    assert twin.laid_stretch(PLACES)[:, :3] == pytest.approx(exact[:, :3], abs=1e-3)
    assert not twin.laid_stretch(PLACES)[:, 3].any()


def test_a_piece_that_counts_twice_answers_twice(twin):
    double = replace(twin, sensitivity=tuple(None if x is None else np.full(len(x) - 1, 2.0) for x in twin.laid_mm))
    assert double.laid_stretch(PLACES) == pytest.approx(2 * twin.laid_stretch(PLACES))


def test_the_angle_adds_under_the_fibre_and_takes_beside_it(twin):
    straight = np.column_stack([np.linspace(-20, 20, 400), np.zeros(400)])
    plain = replace(twin, laid_mm=(straight, None, None, None), frame=Frame())
    angled = replace(plain, angle_weight=0.5 * WEIGHT)
    over, beside = np.array([[0.0, 0.0], [0.0, 12.0]])
    assert angled.laid_stretch([over])[0, 0] > plain.laid_stretch([over])[0, 0]
    assert angled.laid_stretch([beside])[0, 0] < plain.laid_stretch([beside])[0, 0]


def test_a_frame_mirrors_turns_scales_and_shifts():
    assert Frame(True, 90.0, (1.0, 2.0), 2.0).to_plan(np.array([[3.0, 0.5]])) == pytest.approx(np.array([[0.0, -4.0]]))


def test_the_contact_of_a_twin_is_its_profile_in_mm(twin):
    contact = twin.contact()
    assert contact.reach == tuple(zip(twin.distance_mm, twin.weight, strict=True))
    assert contact.length == "euclidean"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"channels": (TwinChannel(0, 9, 0.1, 0.0, 0.9),)}, "a channel reads fibre 9"),
        ({"channels": tuple(TwinChannel(c, 0, 0.1, 0.0, 0.9) for c in (0, 1))}, "two channels read the same fibre"),
        ({"weight": WEIGHT[:-1]}, "weight of reach"),
        ({"weight": np.where(WEIGHT == 0, 0.1, WEIGHT)}, "the last weight must be 0"),
        ({"laid_mm": (None,)}, "laid_mm must have"),
        ({"sensitivity": (None, None, None, None)}, "sensitivity must have"),
        ({"noise": float("nan")}, "noise"),
        ({"sensed_mm": (20.0, 0.0)}, "sensed_mm"),
        ({"presses": 0}, "presses"),
    ],
)
def test_what_does_not_fit_together_is_refused(twin, change, said):
    with pytest.raises(InputError, match=said):
        replace(twin, **change)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda text: text[: len(text) // 2], "not"),
        (lambda text: text.replace("padforge-twin/2", "padforge-design/1"), "padforge-twin/2"),
        (lambda text: text.replace('"gain_v"', '"gain"', 1), "no valid twin"),
        (lambda text: text.replace('"knots"', '"nots"', 1), "no valid morphology"),
        (lambda text: text.replace('"scale": 0.95', '"scale": -1'), "scale"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(twin, tmp_path, damage, said):
    twin.save(tmp_path / "twin.json")
    text = damage((tmp_path / "twin.json").read_text())
    (tmp_path / "twin.json").write_text(text)
    with pytest.raises(InputError, match=said) as error:
        Twin.load(tmp_path / "twin.json")
    assert "twin.json" in str(error.value)
    assert "\n" not in str(error.value)


READINGS = TwinReadings(noise_mv=2.0, drift_mv=18.0, hysteresis=0.3, hysteresis_s=14.0, looks=8.0)


def test_how_readings_run_is_kept_and_may_be_missing(twin, tmp_path):
    for readings in (READINGS, None):
        replace(twin, readings=readings).save(tmp_path / "twin.json")
        assert Twin.load(tmp_path / "twin.json").readings == readings


@pytest.mark.parametrize(
    ("name", "value"), [("looks", 0.5), ("hysteresis", 1.0), ("drift_mv", -1), ("noise_mv", "much"), ("warmth", 3)]
)
def test_readings_that_cannot_be_are_one_line(twin, tmp_path, name, value):
    path = tmp_path / "twin.json"
    replace(twin, readings=READINGS).save(path)
    document = json.loads(path.read_text())
    document["readings"][name] = value
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"^{path}: .*{name}"):
        Twin.load(path)


def test_courses_that_are_far_longer_than_a_pad_are_refused(twin, tmp_path):
    """A file of some kilobytes would take gigabytes, and an hour for a few presses."""
    twin.save(tmp_path / "twin.json")
    document = json.loads((tmp_path / "twin.json").read_text())
    document["laid_mm"][0] = [[-9e3, -9e3], [9e3, 9e3]] * 40
    (tmp_path / "twin.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"twin\.json: laid_mm are 2.*e\+06 mm long in all, allowed are 1\.89e\+06"):
        Twin.load(tmp_path / "twin.json")


@pytest.mark.parametrize("places_mm", [[[]], [1.0, 2.0], [[1.0, 2.0, 3.0]], np.ones((2, 2, 2)), 3.0, [[np.nan, 0.0]]])
def test_places_that_are_none_are_refused_in_one_line(twin, places_mm):
    with pytest.raises(InputError, match="places_mm"):
        twin.laid_stretch(places_mm)
