"""Pads of any rectangle, from the recording of presses to the places found: in mm, and never in a hole."""

import json
from pathlib import Path

import numpy as np
import pytest

from design import InputError, Morphology
from design.common.settings import validated
from design.settings import PadSettings
from sense import Localizer, Recording, calibrate, evaluate, locate
from sense.live.sources import simulated
from sense.recordings.press_plan import PressPlan, planned, told_pad
from sense.recordings.simulation.published_protocol import simulate
from sense.settings import LocalizerSettings, RigSettings

HOLE = ((2.0, -6.0), (9.0, -6.0), (9.0, 6.0), (2.0, 6.0))
SIZE = PadSettings(horizontals=3, verticals=2, pitch_mm=(8.0, 15.0), keep_out_mm=(HOLE,))
PAD = Morphology.random(SIZE.layout, knots=3, seed=2)
QUICK = LocalizerSettings(members=1, hidden=48, layers=2, epochs=50, batch=64, lost=1)


def in_the_hole(places_mm: np.ndarray) -> np.ndarray:
    low, high = np.array(HOLE).min(axis=0), np.array(HOLE).max(axis=0)
    return ((places_mm > low) & (places_mm < high)).all(axis=1)


def made(size: PadSettings = SIZE, **settings: object) -> PressPlan:
    rig = validated(RigSettings, settings, "rig")
    return planned(Morphology.straight(size.layout), rig, np.random.default_rng(0), size)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """400 presses, as they are read back."""
    path = tmp_path_factory.mktemp("rectangle") / "recording"
    simulate(PAD, RigSettings(presses=400, seed=1), size=SIZE).save(path, {})
    return Recording.open(path)


@pytest.fixture(scope="module")
def calibrated(recording: Recording) -> tuple[Localizer, dict]:
    return calibrate(recording, QUICK)


@pytest.mark.parametrize("kind", ["uniform", "grid", "boustrophedon", "adaptive"])
def test_plans_fill_the_rectangle_and_keep_out_of_holes(kind: str) -> None:
    plan = made(presses=300, plan=kind)
    assert len(plan) == 300
    assert not in_the_hole(plan.places_mm).any()
    # half a pitch beyond the outermost of 2 verticals, 8 mm apart, and of 3 horizontals, 15 mm apart
    np.testing.assert_allclose(np.abs(plan.places_mm).max(axis=0), [8.0, 22.5], rtol=0.05)
    assert in_the_hole(made(SIZE.model_copy(update={"keep_out_mm": ()}), presses=300, plan=kind).places_mm).any()


@pytest.mark.parametrize("presses", [1, 2, 7, 60, 1500])
@pytest.mark.parametrize("counts", [(3, 6), (1, 9), (9, 1), (5, 4)])
def test_places_of_a_grid_are_as_far_apart_along_both_axes(counts: tuple[int, int], presses: int) -> None:
    size = PadSettings(horizontals=counts[0], verticals=counts[1], pitch_mm=(8.0, 15.0))
    places = made(size, presses=presses, plan="grid").places_mm
    assert len(places) == len(np.unique(places, axis=0)) == presses
    steps = [np.diff(np.unique(places[:, axis])) for axis in range(2)]
    if min(map(len, steps)) >= 8:
        assert steps[0].mean() == pytest.approx(steps[1].mean(), rel=0.1)


def test_a_hole_is_not_pressed_because_a_file_says_so(tmp_path: Path) -> None:
    (tmp_path / "plan.csv").write_text("x_mm,y_mm\n-3,2\n4,1\n")
    with pytest.raises(InputError, match=r"plan\.csv: press 2, at \(4, 1\) mm, lies in a keep-out"):
        made(plan=str(tmp_path / "plan.csv"))
    everything = ((-20.0, -40.0), (20.0, -40.0), (20.0, 40.0), (-20.0, 40.0))
    with pytest.raises(InputError, match=r"keep_out_mm leaves 0\.0% of what is pressed"):
        made(SIZE.model_copy(update={"keep_out_mm": (everything,)}))


def test_a_recording_says_which_pad_it_is_of(recording: Recording, tmp_path: Path) -> None:
    assert Morphology.of_document(recording.source["morphology"]) == PAD
    assert recording.source["keep_out_mm"] == [[list(corner) for corner in HOLE]]
    assert not in_the_hole(recording.presses_mm).any()
    recording.save(tmp_path / "recording", {})
    assert simulated(tmp_path).connect()["channels"] == 5
    square = Morphology.straight(2)
    assert json.dumps(told_pad(square)) == json.dumps({"pitch_mm": 11.25, "knots": square.knots.tolist()})


def test_places_are_found_in_mm(recording: Recording, calibrated: tuple[Localizer, dict]) -> None:
    localizer, document = calibrated
    found = locate(localizer, recording)
    off = np.linalg.norm(found.places_mm - recording.presses_mm, axis=1)
    assert off.mean() < 3.0  # of a pad of 24 by 60 mm
    test = np.array(document["test"]["pressed_mm"]) - document["test"]["found_mm"]
    assert document["errors"][0]["mean_mm"] == pytest.approx(np.linalg.norm(test, axis=1).mean(), rel=1e-6)
    rows = evaluate(localizer, recording, levels=(0, 1))["errors"]
    assert [row["lost"] for row in rows] == [0, 1]
    within = [np.mean(off <= radius) for radius in (found.r50_mm, found.r90_mm)]
    assert within == pytest.approx([0.5, 0.9], abs=0.2)


@pytest.mark.parametrize("counts", [(0, 3), (3, 0), (1, 0)])
def test_a_strip_finds_what_its_fibres_tell(counts: tuple[int, int]) -> None:
    """Straight parallel fibres tell nothing of the place along them; across, they tell it where two are felt."""
    size = PadSettings(horizontals=counts[0], verticals=counts[1], pitch_mm=(8.0, 8.0))
    recording = simulate(Morphology.straight(size.layout), RigSettings(presses=300, seed=1), size=size)
    localizer, document = calibrate(recording, QUICK)
    off = np.abs(locate(localizer, recording).places_mm - recording.presses_mm).mean(axis=0) / 4.0
    along, across = off if counts[0] else off[::-1]
    assert along > 0.15  # 4 mm are pressed, whose middle is off by a quarter of them
    assert sum(counts) == 1 or across < 0.25
    # nothing is left to locate by where all fibres are lost
    assert [row["lost"] for row in document["errors"]] == ([0, 1] if sum(counts) > 1 else [0])
