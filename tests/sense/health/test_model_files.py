"""A model of health on disk: every bit is kept, damage is refused, and the two files are old or new as one."""

import json
import os
import shutil
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.design.common.files import read_json
from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.health.fault_detector import health_files, health_in
from padforge.sense.health.health_model import COMMANDED, DETECTED, HealthModel
from padforge.sense.localizer.model_files import ModelFiles, files_of
from padforge.sense.localizer.training import one_cycle
from tests.sense.health.pads import later, spoilt
from tools.kills import killed

DOCUMENT, WEIGHTS = (path.name for path in files_of(Path(), COMMANDED))


def test_files_keep_every_bit(pad: Recording, model: HealthModel, tmp_path: Path) -> None:
    assert health_in(tmp_path) == {}
    for name in (COMMANDED, DETECTED):
        replace(model, provenance={"command": "test"}).save(tmp_path / "old", name)
    assert {file.name for file in (tmp_path / "old").iterdir()} == set(health_files())
    for name, each in health_in(tmp_path / "old").items():
        each.save(tmp_path / "new", name)
    for name in health_files():
        assert (tmp_path / "new" / name).read_bytes() == (tmp_path / "old" / name).read_bytes()
    read = HealthModel.load(tmp_path / "new")
    assert read.provenance == {"command": "test"}
    readings = spoilt(pad, "weak")
    assert later(read, readings, pad) == later(model, readings, pad)


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
    with pytest.raises(InputError, match=message):
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


DAMAGES = [(name, damage) for name in sorted(health_files()) for damage in (b"{", b"", "torn", "endless")]


@pytest.mark.parametrize(("name", "spoilt"), [*DAMAGES, (WEIGHTS, "missing")])
def test_damaged_files_are_refused(model: HealthModel, tmp_path: Path, name: str, spoilt: str | bytes) -> None:
    for detected in (COMMANDED, DETECTED):
        model.save(tmp_path, detected)
    torn = (tmp_path / name).read_bytes()[:-9]
    (tmp_path / name).unlink()
    if spoilt == "endless":
        (tmp_path / name).symlink_to("/dev/zero")
    elif spoilt != "missing":
        (tmp_path / name).write_bytes(torn if isinstance(spoilt, str) else spoilt)
    with pytest.raises(InputError, match=r"not the weights|cannot be read|JSON|a file"):
        health_in(tmp_path)


@pytest.mark.parametrize("name", [None, 3, "", "a/b", "..", "x" * 300, "a\nb"])
def test_a_name_that_is_none_is_refused_and_nothing_is_made(model: HealthModel, tmp_path: Path, name: Any) -> None:
    with pytest.raises(InputError, match="name is"):
        model.save(tmp_path / "new", name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("share", "rate"), [(0.05, 0.25), (0.1, 0.5), (0.2, 1.0), (0.4, 0.8535533906), (1.0, 0.0)])
def test_the_learning_rate_rises_along_a_line_and_falls_along_a_cosine(share: float, rate: float) -> None:
    assert one_cycle(share) == pytest.approx(rate)


def written(folder: Path, value: float) -> ModelFiles:
    files = files_of(folder, "model")
    files.write({"format": "model/1", "value": value}, {"weights": np.full(3, value)}, "the model")
    return files


def read(files: ModelFiles) -> tuple[float, float]:
    """What document and weights say, each."""
    document = read_json(files.document, "model/1")
    with files.arrays(document["weights_sha256"], "the model") as arrays:
        return document["value"], float(arrays["weights"][0])


@pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")
def test_a_kill_between_the_files_of_a_model_loses_neither_the_old_nor_the_new(tmp_path: Path) -> None:
    found = []
    for number in count():
        folder = tmp_path / str(number)
        files = written(folder, 1.0)
        ended = not killed(lambda folder=folder: written(folder, 2.0), number, folder)
        found.append(read(files))
        assert found[-1] in ((1.0, 1.0), (2.0, 2.0))
        assert read(written(folder, 3.0)) == (3.0, 3.0)
        assert sorted(path.name for path in folder.iterdir()) == ["model.json", "model.safetensors"]
        shutil.rmtree(folder)
        if ended:
            break
    assert (found[0], found[-1]) == ((1.0, 1.0), (2.0, 2.0))
