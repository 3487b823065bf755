"""A model of health on disk, and the presses and rates that it takes."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from design.common.errors import InputError
from sense import Recording
from sense.health.fault_likelihoods import HYPOTHESES
from sense.health.health_model import COMMANDED, DETECTED, HealthModel, checked_presses
from sense.health.model_folder import health_files, health_in
from sense.health.trained_model import files_of
from tests.sense.health.pads import BAD_FROM, later, weak

DOCUMENT, WEIGHTS = (path.name for path in files_of(Path(), COMMANDED))


def test_files_keep_every_bit(pad: Recording, model: HealthModel, tmp_path: Path) -> None:
    replace(model, provenance={"command": "test"}).save(tmp_path)
    read = HealthModel.load(tmp_path)
    assert read.provenance == {"command": "test"}
    readings = pad.readings.copy()
    weak(readings, int(pad.begun[BAD_FROM]), np.random.default_rng(2))
    assert later(read, readings, pad) == later(model, readings, pad)
    assert {file.name for file in tmp_path.iterdir()} == {DOCUMENT, WEIGHTS}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"false_alarms": 0.0}, "false_alarms: got 0.0"),
        ({"rate_hz": "fast"}, "rate_hz: got 'fast'"),
        ({"dead": [6]}, "dead is \\[6\\]"),
        ({"dead": [2]}, "is .*, expected"),
        ({"format": "padforge-localizer/1"}, "format is 'padforge-localizer/1'"),
        ({"weights_sha256": "0" * 64}, "not the weights"),
        ({"more": 1}, "more: no such key"),
    ],
)
def test_a_changed_document_is_refused(model: HealthModel, tmp_path: Path, change: dict, message: str) -> None:
    model.save(tmp_path)
    document = json.loads((tmp_path / DOCUMENT).read_text())
    (tmp_path / DOCUMENT).write_text(json.dumps(document | change))
    with pytest.raises(InputError, match=message) as caught:
        HealthModel.load(tmp_path)
    assert "\n" not in str(caught.value)


def test_torn_files_are_refused(model: HealthModel, tmp_path: Path) -> None:
    model.save(tmp_path)
    content = (tmp_path / WEIGHTS).read_bytes()
    (tmp_path / WEIGHTS).write_bytes(content[:-1])
    with pytest.raises(InputError, match="not the weights"):
        HealthModel.load(tmp_path)
    (tmp_path / WEIGHTS).unlink()
    with pytest.raises(InputError, match="cannot be read"):
        HealthModel.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("tail.slope", 0.0), ("evidence.noise", np.nan), ("shapes.basis", np.inf), ("evidence.scale", -1.0)],
)
def test_unsound_numbers_are_refused(model: HealthModel, tmp_path: Path, name: str, value: float) -> None:
    part, key = name.split(".")
    spoilt = getattr(getattr(model, part), key).copy()
    spoilt.flat[0] = value
    replace(model, **{part: replace(getattr(model, part), **{key: spoilt})}).save(tmp_path)
    with pytest.raises(InputError, match=name):
        HealthModel.load(tmp_path)


@pytest.mark.parametrize(
    ("begun", "lifted", "sound"),
    [
        ([1, 5], [5, 9], True),
        ([0, 5], [4, 9], False),
        ([1, 4], [5, 9], False),
        ([1, 5], [1, 9], False),
        ([1, 5], [2, 5], False),
        ([1, 5], [5, 10], False),
    ],
)
def test_presses_follow_each_other_within_the_readings(begun: list[int], lifted: list[int], sound: bool) -> None:
    readings, times_s = np.zeros((9, 2)), np.arange(9.0)
    if sound:
        found = checked_presses(readings, times_s, begun, lifted)
        assert [part.tolist() for part in found[2:]] == [begun, lifted]
    else:
        with pytest.raises(InputError, match="each to end before the next begins"):
            checked_presses(readings, times_s, begun, lifted)


def test_every_hypothesis_has_an_equal_part_of_the_false_alarms(model: HealthModel) -> None:
    for alarms in (1e-3, 1e-5):
        assert np.exp(-replace(model, false_alarms=alarms).threshold) == pytest.approx(alarms / len(HYPOTHESES))


def test_health_goes_to_another_folder_bit_by_bit(model: HealthModel, tmp_path: Path) -> None:
    assert health_in(tmp_path) == {}
    for name in (COMMANDED, DETECTED):
        model.save(tmp_path / "old", name)
    for name, each in health_in(tmp_path / "old").items():
        each.save(tmp_path / "new", name)
    for name in health_files():
        assert (tmp_path / "new" / name).read_bytes() == (tmp_path / "old" / name).read_bytes()


@pytest.mark.parametrize("name", sorted(health_files()))
def test_health_that_is_damaged_or_endless_is_none(model: HealthModel, tmp_path: Path, name: str) -> None:
    for spoilt in (b"{", b"", None):
        for detected in (COMMANDED, DETECTED):
            model.save(tmp_path, detected)
        (tmp_path / name).unlink()
        if spoilt is None:
            (tmp_path / name).symlink_to("/dev/zero")
        else:
            (tmp_path / name).write_bytes(spoilt)
        with pytest.raises(InputError, match=name):
            health_in(tmp_path)
        (tmp_path / name).unlink()


@pytest.mark.parametrize("name", [None, 3, "", "a/b", "..", "x" * 300, "a\nb"])
def test_a_name_that_is_none_is_refused_and_nothing_is_made(model: HealthModel, tmp_path: Path, name: Any) -> None:
    with pytest.raises(InputError, match="name is"):
        model.save(tmp_path / "new", name)
    assert list(tmp_path.iterdir()) == []
