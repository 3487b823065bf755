"""Planted faults are detected with their kind, healthy pads give no alarm; the estimator and the monitor."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.sense import FaultDetector, FaultMonitor, FibreFault, HealthModel, Recording, open_recording
from padforge.sense.health import fault_detector
from padforge.sense.health.domain_shift import DomainShift
from padforge.sense.health.fault_detector import TEXTS, fault_lines, mask_faults
from padforge.sense.health.fault_likelihoods import HYPOTHESES
from padforge.sense.health.health_model import MIN_PRESSES
from tests.helpers.refusals import refusal_table
from tests.sense.health.pads import BAD_FROM, FEW, PRESSES, TRAINED, detect, detect_later, faulty, fit, part_of, plant


def update_later(
    monitor: FaultMonitor, readings: np.ndarray, pad: Recording, unseen: Sequence[int] = ()
) -> Iterator[FibreFault]:
    """Faults in the presses that the model was not trained on, press by press; `unseen` ones are only counted."""
    for press in range(TRAINED, PRESSES):
        if press in unseen:
            monitor.n_presses += 1
            continue
        first = pad.down_command[press] - 10
        last = pad.down_command[press + 1] if press + 1 < PRESSES else len(readings)
        yield from monitor.update(readings[first:last], 10, int(pad.up_command[press] - first))


@pytest.mark.parametrize(
    ("fault", "kinds", "within"),
    [
        *(("stuck", {"stuck"}, 20), ("open", {"open"}, 20), ("noisy", {"noisy"}, 20), ("offset", {"offset"}, 20)),
        *(("swapped", {"swapped", "offset"}, 20), ("floating", {"open", "offset"}, 20)),
        *(("drifting", {"drifting"}, 60), ("reduced_gain", {"reduced_gain"}, 60), ("inverted", {"inverted"}, 10)),
    ],
)
def test_planted_faults_are_found(pad: Recording, model: HealthModel, fault: str, kinds: set[str], within: int) -> None:
    faults = detect_later(model, plant(pad, fault), pad)
    first, bad_from = faults[0], BAD_FROM - TRAINED
    assert first.kind in kinds
    # Where rests differ, a swap shows as two offsets before the responses show what it is.
    bad = [1, 4] if fault == "swapped" else [1]
    assert bad_from <= first.press <= bad_from + within
    assert first.since <= first.press
    assert first.score >= 5
    # No fibre is reported twice, and no sound one with it.
    assert sorted(fibre for each in faults for fibre in each.fibres) == bad


def test_most_fibres_at_fault_are_a_misfit_and_not_masked(pad: Recording, model: HealthModel) -> None:
    bad = [0, 1, 2, 4]
    readings = pad.readings.copy()
    readings[:, bad] = 3.3 - readings[:, bad]
    (misfit,) = faults = detect_later(model, readings, pad)
    assert (misfit.kind, misfit.fibres) == ("misfit", tuple(bad))
    assert mask_faults(faults, PRESSES - TRAINED, 6).all()
    monitor, kinds, failed = FaultMonitor(model), list[str](), list[int]()
    for fault in update_later(monitor, readings, pad):
        kinds.append(fault.kind)
        failed.append(len(monitor.failed))
    assert kinds.index("misfit") == len(kinds) - 1
    assert (monitor.failed, max(failed)) == ((), 3)
    # half of eight fibres, two of which were dead from the start, are not most
    with_dead = replace(model, fibres=8, dead=(6, 7))
    assert {fault.kind for fault in detect_later(with_dead, np.pad(readings, ((0, 0), (0, 2))), pad)} == {"inverted"}
    readings[:, 3] = readings[0, 3]  # what its own readings show is masked nevertheless
    faults = detect_later(model, readings, pad)
    assert {fault.kind for fault in faults} - {"stuck", "open"} == {"misfit"}
    mask = mask_faults(faults, PRESSES - TRAINED, 6)
    assert not mask[-1, 3]
    assert mask[:, bad].all()


@pytest.mark.parametrize(("distance", "kind"), [(-1.01, "open"), (0.99, "stuck")])
def test_constant_beyond_the_rests_is_open(pad: Recording, model: HealthModel, distance: float, kind: str) -> None:
    low, high = model.rest_range_v[:, 1]
    readings = pad.readings.copy()
    readings[pad.down_command[BAD_FROM] :, 1] = (high if distance > 0 else low) + distance * (high - low)
    (fault,) = detect_later(model, readings, pad)
    assert (fault.fibres, fault.kind) == ((1,), kind)


def test_healthy_pad_gives_no_alarm(pad: Recording, model: HealthModel) -> None:
    """Also if its last release is not recorded, or some readings of it."""
    assert detect_later(model, pad.readings, pad) == []
    for after in (0, 3):
        assert detect(model, part_of(pad, TRAINED, TRAINED + 30, int(pad.up_command[TRAINED + 29]) + after)) == []


def test_monitor_detects_the_same_press_by_press(pad: Recording, model: HealthModel) -> None:
    readings = plant(pad, "noisy")
    monitor = FaultMonitor(model)
    assert list(update_later(monitor, readings, pad)) == detect_later(model, readings, pad)
    assert monitor.failed == (1,)
    assert monitor.n_presses == PRESSES - TRAINED
    # faults of three fibres begin just before presses that it is not shown, as those of two fingers on a live pad
    readings[pad.down_command[BAD_FROM + 1] :, 2], readings[pad.down_command[BAD_FROM] :, 3] = 0.0, np.nan
    faults = update_later(FaultMonitor(model), readings, pad, range(BAD_FROM + 2, BAD_FROM + 22))
    since = {fault.kind: fault.since + TRAINED for fault in faults}
    assert (since.keys(), since["noisy"], since["missing"]) == ({"open", "noisy", "missing"}, BAD_FROM, BAD_FROM)


def test_fibre_is_missing_after_twenty_presses_that_lack_a_quarter(pad: Recording, model: HealthModel) -> None:
    def without(lost: int, *presses: int) -> list[tuple[int, int, tuple[int, ...]]]:
        readings = pad.readings.copy()
        for down in pad.down_command[BAD_FROM + np.array(presses)]:
            readings[down : down + lost, 2] = np.nan
        faults = detect_later(model, readings, pad)
        return [(fault.press, fault.since, fault.fibres) for fault in faults if fault.kind == "missing"]

    first = BAD_FROM - TRAINED
    assert without(12, *range(20)) == []
    assert without(13, *range(19), *range(20, 39)) == []  # the press between restarts the count
    assert without(13, *range(20)) == [(first + 19, first, (2,))]


def test_what_health_is_asked_in_vain(pad: Recording, model: HealthModel, golden: Any, tmp_path: Path) -> None:
    rows = {
        "a recording of other fibres": lambda: detect(model, replace(pad, readings=pad.readings[:, :5])),
        "few readings a second": lambda: detect(model, replace(pad, times_s=2 * pad.times_s)),
        "a press of other fibres": lambda: FaultMonitor(model).update(pad.readings[:60, :5], 10, 30),
        "a recording before a fit": lambda: FaultDetector().predict(pad),
        "files before a fit": lambda: FaultDetector().save(tmp_path),
        "a press that is not there": lambda: FaultDetector().fit(pad, [0, 10**6]),
        "no false alarms at all": lambda: FaultDetector(0.0),
        "many false alarms": lambda: FaultDetector(0.2),
        "one press less than it takes": lambda: fit(pad.readings, pad, MIN_PRESSES - 1),
        "a dead pad": lambda: fit(0 * pad.readings, pad),
    }
    golden("sense/refusals_of_health.txt", refusal_table(rows))


@pytest.mark.parametrize("seed", range(3))
def test_any_readings_are_processed(pad: Recording, model: HealthModel, seed: int) -> None:
    end = int(pad.down_command[60])
    readings = faulty(np.random.default_rng(seed), pad.readings[:end])
    for fault in detect(model, part_of(pad, 0, 60, end, readings)):
        assert 0 <= fault.since <= fault.press < 60
        assert fault.score >= 5


def test_findings_are_told_whole(golden: Any) -> None:
    """Every kind of fault, of one fibre and of several; dead fibres, sound ones or none; and shifts."""
    faults = [
        FibreFault(30 + number, 21, fibres, kind, 5.2 + number)
        for number, kind in enumerate(TEXTS)
        for fibres in [(1, 4) if kind == "swapped" else (0, 2, 3) if kind == "misfit" else (number % 6,)]
    ]
    shifts = [
        DomainShift("rest", (2,), 2.1512, (1.7, 1.8)),
        DomainShift("gain", (0, 1), 0.7049, (0.87, 1.15)),
        DomainShift("gain", (0,), 1.402, (0.87, 1.15)),
    ]
    lines = [*fault_lines(faults, 6, dead=(5,)), *fault_lines(faults[:1], 6), *fault_lines([], 2)]
    golden("sense/health.txt", "\n".join([*lines, *(shift.text for shift in shifts)]))
    # every hypothesis has a text
    assert {name for name in HYPOTHESES if not name.startswith("offset")} <= set(TEXTS)


@pytest.mark.slow
def test_published_recording_with_and_without_planted_faults(published: Path) -> None:
    pad = open_recording(published / "para5_long_first4500.mat")
    model = fit(pad.readings, pad, presses=1000)
    short = part_of(pad, 0, 1362, int(pad.down_command[1362]))
    assert detect_later(model, short.readings, short, first=1000) == []
    for fault, within in (("stuck", 20), ("swapped", 20), ("offset", 20), ("reduced_gain", 60)):
        first = detect_later(model, plant(short, fault, 1300), short, first=1280)[0]
        assert set(first.fibres) <= ({1, 4} if fault == "swapped" else {1})
        assert 20 <= first.press <= 20 + within


def test_dead_channels_are_ignored_and_few_presses_never_detect_a_reduced_gain(pad: Recording) -> None:
    readings = pad.readings.copy()
    readings[:, 0] = 3.3
    readings[:, 3] = np.minimum(readings[:, 3], np.quantile(readings[:, 3], 0.2))
    model = fit(readings, pad, FEW)
    assert model.dead == FaultMonitor(model).failed == (0, 3)
    assert detect_later(model, readings, pad) == []
    assert detect_later(model, plant(pad, "noisy", readings=readings), pad)[0].fibres == (1,)
    assert not detect(model, part_of(pad, 0, FEW, int(pad.down_command[FEW]), readings))
    faults = detect_later(model, plant(pad, "reduced_gain", readings=readings), pad, FEW)
    assert "reduced_gain" not in {fault.kind for fault in faults}


def test_fit_trains_on_commanded_and_on_detected_presses(pad: Recording, monkeypatch) -> None:
    monkeypatch.setattr(
        fault_detector, "fit_health_model", lambda readings, times_s, *presses, **options: (presses, options)
    )
    held_back = np.arange(5, 700, 7)
    trained = np.setdiff1d(np.arange(PRESSES), held_back)
    detector: Any = FaultDetector(1e-4, seed=7).fit(pad, held_back, {"command": "test"})
    commanded, options = detector.model_
    np.testing.assert_array_equal(commanded, (pad.down_command[trained], pad.up_command[trained]))
    assert (options["false_alarm_rate"], options["provenance"]) == (1e-4, {"command": "test"})
    detected, _ = detector.live_model_
    assert len(detected[0]) == len(detected[1]) == len(trained)
    assert (detected[0] != commanded[0]).any()
