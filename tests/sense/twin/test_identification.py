"""Identification of pads whose truth is known, what is doubted, and recordings that do not suffice."""

from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from padforge import InputError
from padforge.benchmarks import twin as bench
from padforge.benchmarks.twin import printed_pad
from padforge.design import Morphology
from padforge.design.settings import Contact, PadSettings
from padforge.design.twin import Twin
from padforge.sense import RigSettings, identify
from padforge.sense.arrays import Array
from padforge.sense.recording.recording import Recording
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.twin.as_built import OFFSET, AsBuiltPad, PadPlan, channel_indices
from padforge.sense.twin.doubts import find_doubts
from padforge.sense.twin.identification import Identification, identify_pad
from padforge.sense.twin.wiring import Wiring, images
from tests.helpers.golden import Golden
from tests.helpers.presses import changed
from tests.helpers.rigs import ideal_rig
from tests.sense.conftest import few_candidates, identify_simulated

from .conftest import PLAN, few_compared


@pytest.fixture(scope="module")
def recording(printed: Twin) -> Recording:
    return simulate(printed, ideal_rig(presses=300, seed=3))


@pytest.fixture(scope="module")
@few_candidates()
@few_compared()
def result(recording: Recording) -> Identification:
    return identify_pad(recording, PLAN, seed=1)


def test_identify_recovers_the_printed_pad(printed: Twin, result: Identification) -> None:
    """Its wiring, pose and sensitivity profile."""
    twin = result.twin
    assert [channel.fibre for channel in twin.channels] == [channel.fibre for channel in printed.channels]
    assert twin.frame.mirrored
    assert twin.frame.turn_deg == pytest.approx(printed.frame.turn_deg, abs=4)
    assert twin.frame.shift_mm == pytest.approx(printed.frame.shift_mm, abs=1.0)
    estimated, true = twin.contact().sensitivity_profile, printed.contact().sensitivity_profile
    distance_mm = np.linspace(0, 13.5, 7)
    expected = pytest.approx(np.interp(distance_mm, *np.array(true).T), abs=0.15)
    assert np.interp(distance_mm, *np.array(estimated).T) == expected
    assert result.explained.mean() > 0.95
    assert result.explained.mean() > result.explained_on_plan
    assert not result.alternatives
    for channel, true in zip(result.twin.channels, printed.channels, strict=True):
        if true.fibre is not None:
            assert channel.gain_v == pytest.approx(true.gain_v, rel=0.25)
            # 255 presses tell it within 9 %, and the fitted pad takes up some 5 % of it; drift within a press is added
            assert 0.8 * true.noise_v < channel.noise_v < 3 * true.noise_v


def test_twin_responds_as_the_fitted_pad(result: Identification) -> None:
    twin, positions_mm = result.twin, result.held_out.positions_mm
    stretch = twin.as_built_stretch(positions_mm)
    volts = np.column_stack([twin.channels[c].gain_v * stretch[:, twin.channels[c].fibre] for c in result.live])
    fitted = result.fit.pad.predict(positions_mm) - result.fit.pad.channel_values[:, 1]
    assert volts == pytest.approx(fitted, abs=0.05 * np.abs(fitted).max())


@pytest.mark.slow
@few_candidates()
@few_compared(N_CONTACT=120)
def test_identify_measures_the_contact_of_a_pad_that_lies_as_planned() -> None:
    recording = simulate(PLAN, ideal_rig(presses=200, depth_mm=4.0, seed=2), Contact(depth_mm=4.0))
    result = identify_pad(recording, PLAN, seed=1)
    assert result.fit.pad.fibres == (0, 1, 2, 3)
    assert result.contact is not None
    assert result.contact.stated.depth_mm == 4.0
    best = result.contact.best
    assert best.scale == pytest.approx(1, rel=0.1)
    assert (best.squeeze, best.stretch) == pytest.approx((1, 1), rel=0.2)
    assert result.contact.on_plan.explained > result.contact.gaussian_on_plan.explained


@pytest.mark.slow
@few_candidates()
@few_compared()
def test_identify_reports_alternatives_of_a_symmetric_pad_and_is_reproducible_without_a_layer() -> None:
    pad = Morphology.straight(2)
    printed = printed_pad(pad, np.random.default_rng(0), lateral_offset_mm=0.2, n_dead=0)
    recording = simulate(printed, RigSettings(presses=150, seed=1))  # of seed 0 it is just not as good
    # no layer, and a layer that is thinner than presses are deep
    contacts = Contact(model="profile"), Contact(thickness_mm=4.0, depth_mm=3.0)
    result, again = (identify_pad(recording, pad, contact, seed=1) for contact in contacts)
    assert result.contact is again.contact is None
    assert np.array_equal(again.fit.pad.values, result.fit.pad.values)
    assert result.alternatives
    assert abs(result.fit.pad.transform.turn_deg) < 20  # of all that are as good, the one rotated least


@pytest.mark.slow
@few_candidates()
@few_compared()
def test_identify_gives_no_fibre_to_channels_without_readings(recording: Recording, printed: Twin) -> None:
    live = next(channel.channel for channel in printed.channels if channel.fibre is not None)
    twin = identify(changed(recording, "readings", np.s_[:, live], np.nan), PLAN)
    assert twin.channels[live].fibre is None
    others, expected = ([c.fibre for c in pad.channels if c.channel != live] for pad in (twin, printed))
    assert others == expected


def test_identify_rejects_recordings_that_do_not_suffice(recording: Recording) -> None:
    plan = Morphology.straight((1, 3), (8.0, 12.0))
    size = PadSettings(**plan.layout.settings, sensed_mm=(10.0, 11.0))
    narrow = simulate(plan, RigSettings(presses=80), pad_settings=size)
    few = {"presses_mm": np.where(np.arange(300)[:, None] < 59, recording.presses_mm, np.nan)}
    noise = {"readings": np.random.default_rng(0).normal(2.0, 0.002, recording.readings.shape)}
    for unfit, pad, message in (
        (replace(recording, **few), PLAN, "59 presses of known position"),
        (replace(recording, **noise), PLAN, "no channel of the recording responds"),
        (recording, Morphology.straight(1, pitch_mm=20.0), "3 channels .* to presses, the pad has 2 fibres"),
        (narrow, plan, "allowed from 12 x 6 mm on"),  # over half of a rectangle each way
    ):
        with pytest.raises(InputError, match=message):
            identify(unfit, pad)


@pytest.mark.slow
@few_candidates()
@few_compared()
def test_identify_recognizes_a_rectangle_turned_by_a_quarter() -> None:
    plan = Morphology.random((1, 2), 3, 3, (8.0, 12.0))
    printed = printed_pad(plan, np.random.default_rng(1), lateral_offset_mm=0.2, n_dead=0)
    turned = replace(printed, frame=replace(printed.frame, turn_deg=93.0))
    twin = identify(simulate(turned, RigSettings(presses=150, seed=3)), plan, seed=1)
    assert [channel.fibre for channel in twin.channels] == [channel.fibre for channel in turned.channels]
    assert twin.frame.mirrored
    assert twin.frame.turn_deg == pytest.approx(93.0, abs=5)
    assert twin.frame.shift_mm == pytest.approx(turned.frame.shift_mm, abs=1.5)


@pytest.mark.slow
@few_candidates()
@few_compared()
@patch.multiple(bench, PRESSES=(150,), GRID=2, KNOTS=3, WORLDS={"small": ("gaussian", 0.5, 1)})
def test_twin_predicts_better_than_baselines(taken: Any) -> None:
    for cached in (bench.printed, bench.recorded):
        cached.cache_clear()
    results = {key[1]: row for key, row in taken(bench.BENCH).items()}
    for cached in (bench.printed, bench.recorded):
        cached.cache_clear()
    assert list(results) == ["twin", "plan", "place"]
    assert results["twin"]["right"] == 1.0
    assert results["twin"]["error"] < min(results["place"]["error"], results["plan"]["error"])


def test_doubts_are_told_whole(identification: Identification, golden: Golden) -> None:
    """Of a pad that lies as planned nothing; nor of straight fibres that images plan where they are."""
    pad, plan = identification.fit.pad, Morphology.straight(2)
    straight = replace(pad, plan=PadPlan.from_morphology(plan))
    lain = Wiring(straight.transform, 0.5, pad.fibres, 0.9)
    turned, swapped = images(lain, plan.layout), [replace(lain, fibres=(0, 1, 3, 2))]
    offsets = [channel_indices(channel)[OFFSET] for channel in range(4)]

    def moved(places: Any, by: float, pad: AsBuiltPad = pad, **others: object) -> Identification:
        values = pad.values.copy()
        values[places] += by
        return replace(identification, fit=replace(identification.fit, pad=replace(pad, values=values)), **others)

    def explaining(explained: Array) -> Identification:
        return replace(identification, explained=explained)

    cases = {
        "as planned": identification,
        "one channel is explained badly": explaining(identification.explained - 0.7 * (np.arange(4) == 2)),
        "all channels are": explaining(identification.explained - 0.2),
        "a smooth function explains a little more": explaining(identification.explained_smooth - 0.02),
        "a fibre 6.75 mm along x and y from its plan": moved(offsets[1], 0.6),
        "a quarter turn": moved(0, np.pi / 2),
        "askew": moved(0, np.radians(-101)),
        "shrunk": moved(3, -0.3),
        "straight fibres, images that fit": moved(0, 0.0, straight, alternatives=turned),
        "straight fibres, two of them swapped": moved(0, 0.0, straight, alternatives=swapped),
        "straight fibres 1.7 mm beside their plan": moved(np.concatenate(offsets), 0.15, straight, alternatives=turned),
        "winding fibres, images that fit": replace(identification, alternatives=turned),
    }
    lines = ["\n    ".join([f"{name}:", *find_doubts(result)]) for name, result in cases.items()]
    golden("sense/identification/doubts.txt", "\n".join(lines), rtol=2e-2)


@pytest.mark.slow
@few_candidates()
@few_compared()
def test_another_pad_is_doubted_and_the_recorded_one_is_not() -> None:
    rig = RigSettings(presses=160, seed=1)
    built = Morphology.random(2, knots=3, seed=1)
    right, wrong = (identify_simulated(built, told, rig) for told in (built, Morphology.random(2, knots=4, seed=11)))
    assert find_doubts(right) == []
    assert right.fit.pad.fibres == (0, 1, 2, 3)
    assert any("is it the recording of this pad?" in doubt for doubt in find_doubts(wrong))
