"""The rate of learning over a training, and the two files of a model, which are old or new as one."""

import os
import shutil
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from design.common.files import read_json
from sense.health.trained_model import ModelFiles, files_of, one_cycle
from tools.kills import killed


def test_the_rate_rises_once_and_ends_at_nothing() -> None:
    rates = np.array([one_cycle(share) for share in np.linspace(0, 1, 101)])
    assert rates.max() == 1
    assert rates[-1] == pytest.approx(0)
    peak = int(rates.argmax())
    assert (np.diff(rates[: peak + 1]) > 0).all()
    assert (np.diff(rates[peak:]) < 0).all()


@pytest.mark.parametrize(("share", "rate"), [(0.05, 0.25), (0.1, 0.5), (0.2, 1.0), (0.4, 0.8535533906), (0.6, 0.5)])
def test_the_rate_rises_along_a_line_and_falls_along_a_cosine(share: float, rate: float) -> None:
    assert one_cycle(share) == pytest.approx(rate)


def written(folder: Path, value: float) -> ModelFiles:
    files = files_of(folder, "model")
    files.write({"format": "model/1", "value": value}, {"weights": np.full(3, value)}, "the model")
    return files


def told(files: ModelFiles) -> tuple[float, float]:
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
        found.append(told(files))
        assert found[-1] in ((1.0, 1.0), (2.0, 2.0))
        assert told(written(folder, 3.0)) == (3.0, 3.0)
        assert sorted(path.name for path in folder.iterdir()) == ["model.json", "model.safetensors"]
        shutil.rmtree(folder)
        if ended:
            break
    assert (found[0], found[-1]) == ((1.0, 1.0), (2.0, 2.0))
