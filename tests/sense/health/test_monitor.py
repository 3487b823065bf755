"""A healthy pad is left in peace, a bad fibre is named with what is wrong; and what health is learnt from."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.design.common.validation import InputError
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense import Recording, open_recording
from padforge.sense import settings as sense_settings
from padforge.sense.arrays import MIN_SCALE_V
from padforge.sense.health import health_model as learning
from padforge.sense.health.fault_detector import TEXTS, FaultDetector, FibreFault, examine, fault_lines
from padforge.sense.health.fault_likelihoods import HYPOTHESES
from padforge.sense.health.health_model import (
    COMMANDED,
    DETECTED,
    LEAST_PRESSES,
    HealthModel,
    checked_presses,
    dead_fibres,
    fit_health_model,
)
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.simulation.simulated_recording import simulate
from tests.sense.health.pads import BAD_FROM, LEARNT, PRESSES, faulty, later, learn, spoilt

FEW = 320
"""Presses that health is learnt from, but not enough to call a fibre weak."""


@pytest.mark.parametrize(
    ("fault", "kind", "within"),
    [
        *(("stuck", {"stuck"}, 20), ("open", {"open"}, 20), ("floating", {"open"}, 20), ("noisy", {"noisy"}, 20)),
        *(("swapped", {"swapped", "offset"}, 20), ("offset", {"offset"}, 20)),
        *(("drifting", {"drifting"}, 60), ("weak", {"weak"}, 60)),
    ],
)
def test_a_bad_fibre_is_named(pad: Recording, model: HealthModel, fault: str, kind: set[str], within: int) -> None:
    findings = later(model, spoilt(pad, fault), pad)
    first, bad_from = findings[0], BAD_FROM - LEARNT
    assert first.kind in kind
    # Where rests differ a swap shows as two offsets before the answers have told what it is.
    guilty = {1, 4} if fault == "swapped" else {1}
    named = [fibre for finding in findings for fibre in finding.fibres]
    assert bad_from <= first.press <= bad_from + within
    assert first.since <= first.press
    assert first.score >= 5
    # Named is named: no fibre is reported twice, and no sound one with it.
    assert sorted(named) == sorted(guilty)


@pytest.mark.parametrize(("beyond", "kind"), [(-1.01, "open"), (-0.99, "stuck"), (0.99, "stuck"), (1.01, "open")])
def test_one_value_farther_off_than_rests_is_open(pad: Recording, model: HealthModel, beyond: float, kind: str) -> None:
    low, high = model.rests[:, 1]
    readings = pad.readings.copy()
    readings[pad.down_command[BAD_FROM] :, 1] = (high if beyond > 0 else low) + beyond * (high - low)
    (finding,) = later(model, readings, pad)
    assert (finding.fibres, finding.kind) == ((1,), kind)


@pytest.mark.parametrize("after", [0, 3])
def test_a_healthy_pad_is_left_in_peace_where_the_last_release_was_not_recorded(model: HealthModel, after: int) -> None:
    """A simulated recording ends when the probe is sent up; others some readings later."""
    for seed in range(9, 12):
        rig = sense_settings.RigSettings(presses=31, seed=seed, drift_mv=10)
        pad = simulate(Morphology.random(3, knots=3, seed=5), rig, PUBLISHED_CONTACT)
        end = pad.up_command[29] + after
        assert (
            examine(model, pad.readings[:end], pad.times_s[:end], pad.down_command[:30], pad.up_command[:30]) == []
        ), seed


def test_presses_one_by_one_tell_the_same(pad: Recording, model: HealthModel) -> None:
    readings = spoilt(pad, "noisy")
    monitor = FaultDetector(model)
    findings: list[FibreFault] = []
    for press in range(LEARNT, PRESSES):
        first = pad.down_command[press] - 10
        last = pad.down_command[press + 1] if press + 1 < PRESSES else len(readings)
        findings += monitor.update(readings[first:last], 10, int(pad.up_command[press] - first))
    assert findings == later(model, readings, pad)
    assert monitor.lost == (1,)
    assert monitor.presses == PRESSES - LEARNT


def test_a_fibre_is_missing_after_twenty_presses_on_end(pad: Recording, model: HealthModel) -> None:
    def without(*presses: range) -> list[tuple[int, int, str]]:
        readings = pad.readings.copy()
        for each in presses:
            readings[pad.down_command[BAD_FROM + each.start] : pad.up_command[BAD_FROM + each.stop - 1], 2] = np.nan
        return [(finding.press, finding.since, finding.kind) for finding in later(model, readings, pad)]

    first = BAD_FROM - LEARNT
    assert without(range(19)) == []
    assert without(range(19), range(20, 39)) == []  # the press between begins the count anew
    assert without(range(20)) == [(first + 19, first, "missing")]
    assert without(range(45)) == [(first + 19, first, "missing")]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"readings": np.s_[:, :5]}, "readings are of 5 fibres, health was learnt from 6"),
        ({"times_s": np.s_[1:]}, "times have shape"),
        ({"up_command": np.s_[:-1]}, "presses have 760 begins and 759 ends"),
    ],
)
def test_another_recording_is_refused(pad: Recording, model: HealthModel, change: dict, message: str) -> None:
    parts = {
        name: getattr(pad, name)[change.get(name, ...)]
        for name in ("readings", "times_s", "down_command", "up_command")
    }
    with pytest.raises(InputError, match=message):
        examine(model, **parts)


def test_a_rate_or_a_press_that_does_not_fit_is_refused(pad: Recording, model: HealthModel) -> None:
    with pytest.raises(InputError, match="readings a second"):
        examine(model, pad.readings, 2 * pad.times_s, pad.down_command, pad.up_command)
    with pytest.raises(InputError, match=r"expected \(R, 6\)"):
        FaultDetector(model).update(pad.readings[:60, :5], 10, 30)
    for down_command, up_command in ((0, 30), (30, 30), (10, 61)):
        with pytest.raises(InputError, match="allowed is a whole number from"):
            FaultDetector(model).update(pad.readings[:60], down_command, up_command)
    readings, times_s = np.zeros((9, 2)), np.arange(9.0)
    checked_presses(readings, times_s, [1, 5], [5, 9])
    for wrong in (([0, 5], [4, 9]), ([1, 4], [5, 9]), ([1, 5], [1, 9]), ([1, 5], [2, 5]), ([1, 5], [5, 10])):
        with pytest.raises(InputError, match="each to end before the next begins"):
            checked_presses(readings, times_s, *wrong)


def test_a_healthy_pad_is_left_in_peace_and_every_hypothesis_has_a_part_of_false_alarms(pad, model) -> None:
    assert later(model, pad.readings, pad) == []
    for alarms in (1e-3, 1e-5):
        assert np.exp(-replace(model, false_alarms=alarms).threshold) == pytest.approx(alarms / len(HYPOTHESES))


@pytest.mark.parametrize("seed", range(5))
def test_pads_at_their_worst_are_examined(pad: Recording, model: HealthModel, seed: int) -> None:
    end = int(pad.down_command[60])
    readings = faulty(np.random.default_rng(seed), pad.readings[:end])
    for finding in examine(model, readings, pad.times_s[:end], pad.down_command[:60], pad.up_command[:60]):
        assert 0 <= finding.since <= finding.press < 60
        assert finding.score >= 5


def test_findings_are_told_in_one_line_each() -> None:
    findings = [FibreFault(30, 21, (1, 4), "swapped", 7.2), FibreFault(50, 41, (0,), "weak", 6.0)]
    told = fault_lines(findings, 6, dead=(5,))
    assert told == [
        "fibre 6 was dead in the recording that health was learnt from",
        "fibres 2 and 5 have changed places (swapped) since press 21, found at press 30; by chance once in 1e7 presses",
        "fibre 1 answers by about half (weak) since press 41, found at press 50; by chance once in 1e6 presses",
        "sound fibres: 3, 4",
    ]
    # Whatever a hypothesis is called, there are words for it.
    assert {name for name in HYPOTHESES if not name.startswith("offset")} <= set(TEXTS)


@pytest.mark.slow
def test_on_the_published_recording_faults_are_named_and_health_is_not(published: Path) -> None:
    pad = open_recording(published / "para5_long_first4500.mat")
    model = learn(pad.readings, pad, presses=1000)
    end = pad.down_command[1362]
    short = Recording(
        pad.readings[:end], pad.times_s[:end], pad.presses_mm[:1362], pad.down_command[:1362], pad.up_command[:1362]
    )
    assert later(model, short.readings, short, first=1000) == []
    for fault, within in (("stuck", 20), ("swapped", 20), ("offset", 20), ("weak", 60)):
        found = later(model, spoilt(short, fault, 1300), short, first=1280)[0]
        assert set(found.fibres) <= ({1, 4} if fault == "swapped" else {1})
        assert 20 <= found.press <= 20 + within


def test_dead_channels_are_left_out_and_a_single_fibre_still_tells_what_its_own_readings_do(pad: Recording) -> None:
    readings = pad.readings.copy()
    readings[:, 0] = 3.3
    readings[:, 3] = np.minimum(readings[:, 3], np.quantile(readings[:, 3], 0.2))
    model = learn(readings, pad)
    assert model.dead == (0, 3)
    assert FaultDetector(model).lost == (0, 3)
    assert later(model, readings, pad) == []
    assert later(model, spoilt(pad, "noisy", readings=readings), pad)[0].fibres == (1,)
    readings = pad.readings[:, 1:2].copy()
    model = learn(readings, pad)
    readings[pad.down_command[BAD_FROM] :] = readings[pad.down_command[BAD_FROM]]
    assert [finding.kind for finding in later(model, readings, pad)] == ["stuck"]


def test_fibres_that_read_one_value_or_stand_at_the_end_of_their_range_are_dead() -> None:
    """At the end for more than half of the time, which most fibres are not."""
    rng = np.random.default_rng(0)
    readings = 1.5 + 0.01 * rng.standard_normal((1000, 9))
    readings[:, 1] = 1.5
    readings[:510, 2] = readings[:, 2].max()
    readings[:490, 3] = readings[:, 3].max()
    readings[:510, 4] = readings[:, 4].min()
    readings[:510, 5] = np.nan
    readings[:490, 6] = np.nan
    for fibre, spread in ((7, 0.99), (8, 1.01)):
        readings[:, fibre] = 1.5 + spread * MIN_SCALE_V * rng.permutation(np.linspace(0, 1, 1000))
    assert dead_fibres(readings).tolist() == [1, 2, 4, 5, 7]


@pytest.mark.slow
def test_health_learnt_from_few_presses_calls_no_fibre_weak(pad: Recording) -> None:
    model = learn(pad.readings, pad, FEW)
    end = int(pad.down_command[FEW])
    assert not examine(model, pad.readings[:end], pad.times_s[:end], pad.down_command[:FEW], pad.up_command[:FEW])
    assert "weak" not in {finding.kind for finding in later(model, spoilt(pad, "weak"), pad, FEW)}


def test_presses_held_back_teach_no_health(localizer: LocalizerModel, recording: Recording, monkeypatch) -> None:
    monkeypatch.setattr(learning, "fit_health_model", lambda readings, times_s, *edges, **options: edges)
    learnt = np.setdiff1d(np.arange(len(recording.down_command)), localizer.test)
    edges: dict[str, Any] = {**learning.learn_health(recording, localizer.test, localizer.provenance)}
    assert 0 < len(localizer.test) < len(learnt)
    np.testing.assert_array_equal(edges[COMMANDED], (recording.down_command[learnt], recording.up_command[learnt]))
    assert len(edges[DETECTED][0]) == len(edges[DETECTED][1]) == len(learnt)


@pytest.mark.parametrize(
    ("scale", "presses", "false_alarms", "message"),
    [
        (1, LEAST_PRESSES - 1, 1e-5, f"299 whole presses, health is learnt from {LEAST_PRESSES}"),
        (0, LEARNT, 1e-5, "all 6 fibres are dead"),
        (1, LEARNT, 0.0, "false alarms a press are 0"),
    ],
)
def test_what_cannot_teach_is_refused(pad: Recording, scale: float, presses: int, false_alarms: float, message) -> None:
    edges, rng = (pad.down_command[:presses], pad.up_command[:presses]), np.random.default_rng(0)
    with pytest.raises(InputError, match=message):
        fit_health_model(scale * pad.readings, pad.times_s, *edges, rng=rng, false_alarms=false_alarms)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recording": 3}, "recording is 3, expected a Recording"),
        ({"held_back": [0, 10**6]}, "held_back is .*, allowed are presses from 0 to"),
        ({"held_back": [-1]}, "held_back is .*, allowed are presses from 0 to"),
        ({"held_back": "ab"}, "held_back"),
        ({"provenance": None}, "provenance is None, expected a table"),
        ({"provenance": {}}, "the seed of provenance is None"),
        ({"provenance": {"seed": "a"}}, "the seed of provenance is 'a'"),
    ],
)
def test_what_health_is_not_learnt_from_is_refused(pad: Recording, change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        learning.learn_health(**{"recording": pad, "held_back": (), "provenance": {"seed": 0}, **change})
