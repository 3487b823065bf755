"""A healthy pad is left in peace, and a bad fibre is named with what is wrong."""

from pathlib import Path

import numpy as np
import pytest

from design import Morphology
from design.common.errors import InputError
from design.settings import PUBLISHED_CONTACT
from sense import Recording, open_recording
from sense import settings as sense_settings
from sense.health.fault_likelihoods import HYPOTHESES
from sense.health.fibre_prediction import TRACE
from sense.health.health_model import HealthModel
from sense.health.monitor import TEXTS, FibreFault, Monitor, _Press, examine, fault_lines
from sense.recordings.simulation.published_protocol import simulate
from tests.sense.health.pads import (
    BAD_FROM,
    LEARNT,
    PRESSES,
    Fault,
    drifting,
    floating,
    later,
    learn,
    noisy,
    offset,
    open_low,
    stuck,
    swapped,
    weak,
)


@pytest.mark.parametrize(
    ("fault", "kind", "within"),
    [
        (stuck, {"stuck"}, 20),
        (open_low, {"open"}, 20),
        (floating, {"open"}, 20),
        (swapped, {"swapped", "offset"}, 20),
        (noisy, {"noisy"}, 20),
        (offset, {"offset"}, 20),
        (drifting, {"drifting"}, 60),
        (weak, {"weak"}, 60),
    ],
)
def test_a_bad_fibre_is_named_once_with_its_fault(
    pad: Recording, model: HealthModel, fault: Fault, kind: set[str], within: int
) -> None:
    readings = pad.readings.copy()
    fault(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    findings = later(model, readings, pad)
    first = findings[0]
    bad_from = BAD_FROM - LEARNT
    assert first.kind in kind
    # Where rests differ a swap shows as two offsets before the answers have told what it is.
    guilty = {1, 4} if fault is swapped else {1}
    named = [fibre for finding in findings for fibre in finding.fibres]
    assert bad_from <= first.press <= bad_from + within
    assert first.since <= first.press
    assert first.score >= 5
    # Named is named: no fibre is reported twice, and no sound one with it.
    assert sorted(named) == sorted(guilty)


@pytest.mark.parametrize(("beyond", "kind"), [(-1.01, "open"), (-0.99, "stuck"), (0.99, "stuck"), (1.01, "open")])
def test_one_value_farther_off_than_rests_ever_spread_is_open_and_else_stuck(
    model: HealthModel, beyond: float, kind: str
) -> None:
    low, high = model.rests[:, 1]
    value = (high if beyond > 0 else low) + beyond * (high - low)
    monitor = Monitor(model)
    fibres = len(model.living)
    flat, none = np.full((fibres, TRACE), value), np.zeros((fibres, 1))
    monitor._recent.append(_Press(flat, none.astype(np.float32), none, np.zeros(fibres), np.ones(fibres, bool)))
    assert monitor._kind(1, 0, 0) == kind


def test_a_healthy_pad_is_left_in_peace(pad: Recording, model: HealthModel) -> None:
    assert later(model, pad.readings, pad) == []


@pytest.mark.parametrize("after", [0, 3])
def test_a_healthy_pad_is_left_in_peace_where_the_last_release_was_not_recorded(model: HealthModel, after: int) -> None:
    """A simulated recording ends when the probe is sent up; others some readings later."""
    for seed in range(9, 18):
        rig = sense_settings.RigSettings(presses=31, seed=seed, drift_mv=10)
        pad = simulate(Morphology.random(3, knots=3, seed=5), rig, PUBLISHED_CONTACT)
        end = pad.lifted[29] + after
        assert examine(model, pad.readings[:end], pad.times_s[:end], pad.begun[:30], pad.lifted[:30]) == [], seed


def test_presses_one_by_one_tell_the_same(pad: Recording, model: HealthModel) -> None:
    readings = pad.readings.copy()
    noisy(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    monitor = Monitor(model)
    findings: list[FibreFault] = []
    for press in range(LEARNT, PRESSES):
        first = pad.begun[press] - 10
        last = pad.begun[press + 1] if press + 1 < PRESSES else len(readings)
        findings += monitor.update(readings[first:last], 10, int(pad.lifted[press] - first))
    assert findings == later(model, readings, pad)
    assert monitor.lost == (1,)
    assert monitor.presses == PRESSES - LEARNT


def test_missing_readings_speak_for_nothing_until_they_are_missing_for_long(pad: Recording, model: HealthModel) -> None:
    readings = pad.readings.copy()
    start = int(pad.begun[BAD_FROM])
    readings[start : start + 12 * 40, 2] = np.nan
    assert later(model, readings, pad) == []
    readings[start:, 2] = np.nan
    (finding,) = later(model, readings, pad)
    assert (finding.kind, finding.fibres) == ("missing", (2,))
    # The trace of the press before reaches into the gap only where presses follow at once: here it does.
    assert finding.press - finding.since == 19


def test_a_fibre_is_missing_after_twenty_presses_on_end(pad: Recording, model: HealthModel) -> None:
    def without(*presses: range) -> list[tuple[int, int, str]]:
        readings = pad.readings.copy()
        for each in presses:
            readings[pad.begun[BAD_FROM + each.start] : pad.lifted[BAD_FROM + each.stop - 1], 2] = np.nan
        return [(finding.press, finding.since, finding.kind) for finding in later(model, readings, pad)]

    first = BAD_FROM - LEARNT
    assert without(range(19)) == []
    assert without(range(19), range(20, 39)) == []  # the press between begins the count anew
    assert without(range(20)) == [(first + 19, first, "missing")]
    assert without(range(45)) == [(first + 19, first, "missing")]


def test_a_recording_that_does_not_fit_is_refused(pad: Recording, model: HealthModel) -> None:
    presses = pad.begun, pad.lifted
    with pytest.raises(InputError, match="readings are of 5 fibres, health was learnt from 6"):
        examine(model, pad.readings[:, :5], pad.times_s, *presses)
    with pytest.raises(InputError, match="readings a second"):
        examine(model, pad.readings, 2 * pad.times_s, *presses)
    with pytest.raises(InputError, match="each to end before the next begins"):
        examine(model, pad.readings, pad.times_s, pad.lifted, pad.begun)
    with pytest.raises(InputError, match="times have shape"):
        examine(model, pad.readings, pad.times_s[1:], *presses)
    with pytest.raises(InputError, match=r"expected \(R, 6\)"):
        Monitor(model).update(pad.readings[:60, :5], 10, 30)
    with pytest.raises(InputError, match="begun is 0, allowed is a whole number from 1"):
        Monitor(model).update(pad.readings[:60], 0, 30)


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


def test_on_the_published_recording_faults_are_named_and_health_is_not(published: Path) -> None:
    pad = open_recording(published / "para5_long_first4500.mat")
    model = learn(pad.readings, pad, presses=1000)
    end = pad.begun[1362]
    short = Recording(pad.readings[:end], pad.times_s[:end], pad.presses_mm[:1362], pad.begun[:1362], pad.lifted[:1362])
    assert later(model, short.readings, short, first=1000) == []
    for fault, within in ((stuck, 20), (swapped, 20), (offset, 20), (weak, 60)):
        readings = short.readings.copy()
        fault(readings, int(short.begun[1300]), np.random.default_rng(0))
        found = later(model, readings, short, first=1280)[0]
        assert set(found.fibres) <= ({1, 4} if fault is swapped else {1})
        assert 20 <= found.press <= 20 + within
