"""The model of a healthy pad: what it is trained on, and its files, which are read exactly, or refused if damaged."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import FaultDetector, HealthModel, Recording
from padforge.sense.arrays import MIN_SCALE_V
from padforge.sense.health import health_model
from padforge.sense.health.fault_detector import HEALTH_FILES, has_health
from padforge.sense.health.health_model import COMMANDED, HYPOTHESES, MIN_PRESSES, WARM_UP, find_dead_fibres
from padforge.sense.health.trace_model import LEVEL_RATE, MEMBERS
from padforge.sense.localizer.model_files import files_of
from tests.helpers.folders import files_in
from tests.sense.health.pads import detect_later, fit, plant

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
    for change, message in (
        ({"false_alarm_rate": 0.0}, "false_alarm_rate is 0.0"),
        ({"weights_sha256": "0" * 64}, "not the weights"),
    ):
        (tmp_path / DOCUMENT).write_text(json.dumps(document | change))
        with pytest.raises(InputError, match=message):
            HealthModel.load(tmp_path)
    (tmp_path / DOCUMENT).write_bytes(whole[DOCUMENT.as_posix()])
    for name, content in whole.items():
        (tmp_path / name).write_bytes(content[:-9])
        with pytest.raises(InputError, match=r"not the weights|JSON"):
            FaultDetector.load(tmp_path)
        (tmp_path / name).write_bytes(content)


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


@pytest.mark.parametrize("presses", [MIN_PRESSES, 599])
def test_presses_are_held_out_in_blocks_beyond_the_memory_of_the_level(
    pad: Recording, presses: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Among presses that the networks are trained on, drift shows in their neighbours: residuals would be too small."""
    trained: list[np.ndarray] = []

    def stop_before_training(inputs: object, targets: object, rows: list[np.ndarray], rng: object) -> None:
        trained.extend(rows)
        raise InterruptedError

    monkeypatch.setattr(health_model, "train_networks", stop_before_training)
    with pytest.raises(InterruptedError):
        fit(pad.readings, pad, presses)
    held_out = np.ones((MEMBERS, presses), dtype=bool)
    for member, rows in enumerate(trained):
        held_out[member, rows] = False
    held_out = held_out[:, WARM_UP:]
    assert (held_out.sum(axis=0) == 1).all()
    changes = np.flatnonzero(held_out[:, 1:].argmax(axis=0) != held_out[:, :-1].argmax(axis=0)) + 1 + WARM_UP
    assert np.diff(changes, prepend=0, append=presses).min() >= 2 / LEVEL_RATE
    assert np.ptp(held_out.sum(axis=1)) <= WARM_UP + 1


@pytest.mark.parametrize("rate", [1e-5, 1e-2])
def test_all_hypotheses_together_give_the_false_alarms_that_are_allowed(model: HealthModel, rate: float) -> None:
    threshold = replace(model, false_alarm_rate=rate).threshold
    assert len(HYPOTHESES) * np.exp(-threshold) == pytest.approx(rate)
