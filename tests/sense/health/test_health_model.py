"""The model of a healthy pad: what it is trained on, its files, and what it shows of a pad that has changed since."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import FaultDetector, HealthModel, Recording, calibrate
from padforge.sense.arrays import MIN_SCALE_V
from padforge.sense.health import domain_shift
from padforge.sense.health.domain_shift import detect_shifts, rest_levels
from padforge.sense.health.fault_detector import HEALTH_FILES, has_health
from padforge.sense.health.health_model import COMMANDED, HYPOTHESES, find_dead_fibres
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.model_files import files_of
from padforge.sense.localizer.response_model import interpolate_grid
from padforge.sense.localizer.scaler import ScaledFeatures
from padforge.sense.settings import LocalizerSettings
from tests.helpers.folders import files_in
from tests.helpers.once import Once
from tests.sense.conftest import few_moments
from tests.sense.health.pads import PRESSES, TRAINED, detect_later, part_of, plant

DOCUMENT = files_of(Path(), COMMANDED).document


def make_detector(model: HealthModel) -> FaultDetector:
    detector = FaultDetector()
    detector.model_ = detector.live_model_ = model
    return detector


def test_detector_files_keep_every_bit(pad: Recording, model: HealthModel, tmp_path: Path, golden: Any) -> None:
    assert not has_health(tmp_path)
    make_detector(replace(model, provenance={"command": "test"})).save(tmp_path / "old")
    assert files_in(tmp_path / "old").keys() == HEALTH_FILES
    FaultDetector.load(tmp_path / "old").save(tmp_path / "new")
    for name in HEALTH_FILES:
        assert (tmp_path / "new" / name).read_bytes() == (tmp_path / "old" / name).read_bytes()
    document = json.loads((tmp_path / "new" / DOCUMENT).read_text())
    golden("sense/health.json", document)
    loaded = HealthModel.load(tmp_path / "new")
    assert loaded.provenance == {"command": "test"}
    readings = plant(pad, "reduced_gain")
    assert detect_later(loaded, readings, pad) == detect_later(model, readings, pad)


def test_load_refuses_changed_documents_and_torn_files(model: HealthModel, tmp_path: Path) -> None:
    make_detector(model).save(tmp_path)
    whole = {name: (tmp_path / name).read_bytes() for name in HEALTH_FILES}
    document = json.loads(whole[DOCUMENT.as_posix()])
    wrong = [(DOCUMENT, json.dumps(document | {"false_alarm_rate": 0.0}).encode(), "false_alarm_rate is 0.0")]
    wrong += [(DOCUMENT, json.dumps(document | {"weights_sha256": "0" * 64}).encode(), "not the weights")]
    for name, content, message in (
        *wrong,
        *((name, each[:-9], r"not the weights|JSON") for name, each in whole.items()),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=message):
            FaultDetector.load(tmp_path)
        (tmp_path / name).write_bytes(whole[Path(name).as_posix()])


def test_find_dead_fibres() -> None:
    """Constant, missing, or at an end of the range for more than half of the time, which most fibres are not."""
    rng = np.random.default_rng(0)
    readings = 1.5 + 0.01 * rng.standard_normal((1000, 9))
    readings[:, 1] = 1.5
    readings[:510, 2] = readings[:, 2].max()
    readings[:490, 3] = readings[:, 3].max()
    readings[:510, 4] = readings[:, 4].min()
    readings[:510, 5] = np.nan
    readings[:490, 6] = np.nan
    for fibre, size in ((7, 0.99), (8, 1.01)):
        readings[:, fibre] = 1.5 + size * MIN_SCALE_V * rng.permutation(np.linspace(0, 1, 1000))
    assert find_dead_fibres(readings).tolist() == [1, 2, 4, 5, 7]


@pytest.mark.parametrize("rate", [1e-5, 1e-2])
def test_all_hypotheses_together_give_the_false_alarms_that_are_allowed(model: HealthModel, rate: float) -> None:
    threshold = replace(model, false_alarm_rate=rate).threshold
    assert len(HYPOTHESES) * np.exp(-threshold) == pytest.approx(rate)


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
    detector = make_detector(model)
    detector.include_rests(recording)
    detector.include_rests(every)
    for each in (recording, every, later):  # all of these rests are usual now
        assert detect(localizer, detector.live_model_, each) == detect(localizer, detector.model_, each) == []


@pytest.mark.parametrize("gain", [0.7, 1.4])
def test_other_gains_are_detected(model: HealthModel, localizer: LocalizerModel, later: Recording, gain: float) -> None:
    assert detect(localizer, model, changed(later, [2], gain)) == [("gain", (2,))]
    assert detect(localizer, model, changed(later, list(range(6)), gain)) == [("gain", tuple(range(6)))]


def test_usual_gains_are_as_wide_as_gains_without_single_presses_scatter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one fibre that responds twice as strongly as expected, to some presses more than to others."""
    rng, presses, count = np.random.default_rng(0), 120, 400
    table = rng.uniform(0.1, 1, (9, 9, 1, 4)) ** 3
    positions = rng.uniform(-1, 1, (presses, 2))
    expected = interpolate_grid(table, positions)
    inputs = 2 * expected * rng.uniform(0.7, 1.3, (presses, 1, 1))
    scaled = ScaledFeatures(inputs, np.ones((presses, 1), bool), np.ones((presses, 17), bool))
    scaler = Mock(scale_v=1.0, mean_v=0.0, measures=(), scale_positions=lambda positions_mm: positions_mm)
    found = SimpleNamespace(positions_mm=positions)
    known: Any = SimpleNamespace(features="windows", fibres=1, scaler=scaler, table=table)
    known.scaled_features, known.predict_features = lambda _: scaled, lambda *_: found
    monkeypatch.setattr(domain_shift, "rest_levels", lambda _: np.zeros((presses, 1)))
    health: Any = SimpleNamespace(living=np.arange(1), rest_range_v=np.zeros((2, 1)), presses=count)
    (shift,) = detect_shifts(known, health, Mock(), scaled.fibre_mask)
    energy, energy_expected = ((part**2).sum(axis=(1, 2)) for part in (inputs, expected))
    ratio = energy.sum() / energy_expected.sum()
    without = [np.delete(energy, press).sum() / np.delete(energy_expected, press).sum() for press in range(presses)]
    error = np.linalg.norm(1 - np.array(without) / ratio) / 2  # of the logarithm of a gain, the root of a ratio
    usual = np.exp(4 * np.array([-1, 1]) * np.sqrt(0.03**2 + 0.8**2 / count + error**2))
    assert (shift.value, *shift.usual) == pytest.approx((np.sqrt(ratio), *usual))


def test_same_pad_later_and_gains_of_few_presses_have_no_shift(
    model: HealthModel, localizer: LocalizerModel, pad: Recording, later: Recording
) -> None:
    end = TRAINED + domain_shift.MIN_PRESSES - 1
    few = part_of(pad, TRAINED, end, int(pad.down_command[end]))
    assert detect(localizer, model, changed(few, list(range(6)), 0.5)) == []
    assert detect(localizer, model, later) == []
    gappy = np.array(later.readings)
    gappy[:2000, 3] = gappy[1000:1100] = np.nan
    assert detect(localizer, model, replace(later, readings=gappy)) == []
