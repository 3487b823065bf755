"""Recordings of a pad that has changed since calibration are named as such, those of the same pad are not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.sense import FaultDetector, HealthModel, Recording, calibrate
from padforge.sense.health.domain_shift import MIN_PRESSES, detect_shifts, rest_levels
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.settings import LocalizerSettings
from tests.helpers.once import Once
from tests.sense.conftest import few_moments
from tests.sense.health.pads import PRESSES, TRAINED, part_of

COARSE = LocalizerSettings(members=2, hidden=24, layers=1, epochs=2, batch=64, max_failures=1)
"""Errs by 3 mm, by which the size of responses must not look like another."""


@pytest.fixture(scope="session")
def localizer(once: Once, pad: Recording) -> LocalizerModel:
    @few_moments()
    def make(folder: Path) -> LocalizerModel:
        return calibrate(part_of(pad, 0, TRAINED, int(pad.down_command[TRAINED])), COARSE)[0]

    return once("health-localizer", make)


@pytest.fixture
def later(pad: Recording) -> Recording:
    return part_of(pad, TRAINED, PRESSES, len(pad.readings))


def changed(recording: Recording, fibres: list[int], gain: float = 1.0, offset_v: float = 0.0) -> Recording:
    readings, level = np.array(recording.readings), np.median(recording.readings, axis=0)
    readings[:, fibres] = (level + offset_v + gain * (readings - level))[:, fibres]
    return replace(recording, readings=readings)


def detect(
    localizer: LocalizerModel, health: HealthModel, recording: Recording, failed: tuple[int, ...] = ()
) -> list[tuple[str, tuple[int, ...]]]:
    mask = np.tile(~np.isin(np.arange(recording.fibres), failed), (len(recording.down_command), 1))
    return [(shift.kind, shift.fibres) for shift in detect_shifts(localizer, health, recording, mask)]


def test_other_rests_are_detected(model: HealthModel, localizer: LocalizerModel, later: Recording) -> None:
    recording = changed(later, [1], offset_v=-0.33)
    assert detect(localizer, model, recording) == [("rest", (1,))]
    assert detect(localizer, model, recording, failed=(1,)) == []
    [shift] = detect_shifts(localizer, model, recording, np.ones((len(recording.down_command), 6), bool))
    assert shift.value == np.median(rest_levels(recording)[:, 1])
    low, high = model.rest_range_v[:, 1]
    assert shift.usual == pytest.approx((low - (high - low) / 4, high + (high - low) / 4))
    every = changed(later, list(range(6)), offset_v=0.33)
    assert detect(localizer, model, every) == [("rest", (fibre,)) for fibre in range(6)]
    detector = FaultDetector()
    detector.model_ = detector.live_model_ = model
    detector.include_rests(recording)
    detector.include_rests(every)
    for each in (recording, every, later):  # all of these rests are usual now
        assert detect(localizer, detector.live_model_, each) == detect(localizer, detector.model_, each) == []


@pytest.mark.parametrize("gain", [0.7, 1.4])
def test_other_gains_are_detected(model: HealthModel, localizer: LocalizerModel, later: Recording, gain: float) -> None:
    assert detect(localizer, model, changed(later, [2], gain)) == [("gain", (2,))]
    assert detect(localizer, model, changed(later, list(range(6)), gain)) == [("gain", tuple(range(6)))]


def test_same_pad_later_and_gains_of_few_presses_have_no_shift(
    model: HealthModel, localizer: LocalizerModel, pad: Recording, later: Recording
) -> None:
    few = part_of(pad, TRAINED, TRAINED + MIN_PRESSES - 1, int(pad.down_command[TRAINED + MIN_PRESSES - 1]))
    assert detect(localizer, model, changed(few, list(range(6)), 0.5)) == []
    assert detect(localizer, model, later) == []
    gappy = np.array(later.readings)
    gappy[:2000, 3] = gappy[1000:1100] = np.nan
    assert detect(localizer, model, replace(later, readings=gappy)) == []
