"""Files of a localizer: every bit is kept, one line refuses what is none, and a save is whole or nothing."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from itertools import count
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.localizer.model import LocalizerModel
from tools.kills import killed

Change = Callable[[Any], dict[str, Any]]


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("features", "smell", "features"),
        ("scaler", {}, "scaler"),
        ("features", "published", r"scaler\.mean_v"),
        ("method", "guess", "method"),
        ("method", "published", "force_n of method published"),
        ("interval_factors.0", [1.0, 1.0], "interval_factors"),
        ("interval_factors.0.0", -1.0, "interval_factors"),
        ("scaler.history_coef.0.0", [1.0], r"scaler\.history_coef"),
        ("scaler.history_coef.0.0.0", np.nan, "history_coef"),
        *(("rate_hz", value, "rate_hz") for value in (0, "13", np.nan)),
        *((f"scaler.{key}.0.0", value, key) for key in ("mean_v", "scale_v") for value in (np.nan, 1e9, "1")),
        ("scaler.scale_v.0.0", 0.0, "scale_v"),
        *(("scaler.origin_mm", value, "origin_mm") for value in ([0.0], 3)),
        *(("scaler.scale_mm", value, "scale_mm") for value in (0.0, 1e30)),
        ("split", "alphabetical", "split"),
        *(("test", value, "test") for value in ([-1], [True], [3, 3])),
        ("errors", [{"mean_mm": np.nan}], r"errors\.0\.mean_mm"),
        ("training_recording_sha256", 7, "training_recording_sha256"),
        ("weights_sha256", 7, "weights_sha256"),
        ("more", 1, "more"),
        ("scaler.measures", [{"name": "force_n", "origin": 1.0, "scale": 1.0}], "force_n of method ensemble"),
        ("scaler.measures.0.name", "width_mm", "measures"),
        ("scaler.measures.0.scale", 0.0, "scale"),
        ("scaler.measures.0.origin", np.nan, "origin"),
        ("scaler.measures", [], "interval_factors has shape .4, 5."),
    ],
)
def test_load_refuses_documents_out_of_range(
    deep_localizer: LocalizerModel, tmp_path: Path, path: str, value: object, named: str
) -> None:
    deep_localizer.save(tmp_path)
    document = json.loads((tmp_path / "localizer.json").read_text())
    *way, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    reduce(getitem, way, document)[last] = value
    (tmp_path / "localizer.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=rf"localizer\.json: .*{named}") as caught:
        LocalizerModel.load(tmp_path)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "change",
    [
        lambda of: {"weights": of.weights | {"first.w": of.weights["first.w"] + np.float32(1e30)}},
        lambda of: {"weights": of.weights | {"first.w": of.weights["first.w"][:, 1:]}},
        lambda of: {"weights": of.weights | {"hidden.b": of.weights["hidden.b"].astype(np.float64)}},
        lambda of: {"weights": {name: weight for name, weight in of.weights.items() if name != "last.w"}},
        lambda of: {"residual_network": {}},
        lambda of: {"residual_network": {name: weight * np.nan for name, weight in of.residual_network.items()}},
        lambda of: {"bayes": replace(of.bayes, grid=of.bayes.grid[1:])},
        lambda of: {"bayes": replace(of.bayes, shift=np.array([np.nan, 0.0]))},
        lambda of: {"bayes": replace(of.bayes, shift=np.array([1e13, 0.0]))},
        lambda of: {"bayes": replace(of.bayes, linearization=-of.bayes.linearization)},
    ],
)
def test_load_refuses_arrays_of_other_documents(localizer: LocalizerModel, tmp_path: Path, change: Change) -> None:
    assert localizer.bayes is not None
    replace(localizer, **change(localizer)).save(tmp_path)
    with pytest.raises(InputError, match=r"localizer\.safetensors: no weights of the localizer"):
        LocalizerModel.load(tmp_path)


def test_save_keeps_every_bit(localizer: LocalizerModel, recording: Recording, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    found = LocalizerModel.load(tmp_path)
    presses = localizer.scaled_features(recording)
    assert np.array_equal(found.scaled_features(recording).inputs, presses.inputs)
    again, before = found.predict_features(presses, [2]), localizer.predict_features(presses, [2])
    assert np.array_equal(again.positions_mm, before.positions_mm)
    assert np.array_equal(again.r90_mm, before.r90_mm)
    assert (found.errors, found.test) == (localizer.errors, localizer.test)
    found.save(tmp_path / "again")
    for name in ("localizer.json", "localizer.safetensors"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / name).read_bytes()
    document = json.loads((tmp_path / "localizer.json").read_text())
    assert document["scaler"]["measures"] == []
    assert not [key for row in document["errors"] for key in row if key.startswith(("depth", "force"))]
    (tmp_path / "localizer.json").write_text(json.dumps(document | {"method": "published"}))
    with pytest.raises(InputError, match="features"):
        LocalizerModel.load(tmp_path)


def test_save_keeps_depth_and_force(deep_localizer: LocalizerModel, deep_recording: Recording, tmp_path: Path) -> None:
    deep_localizer.save(tmp_path)
    again = LocalizerModel.load(tmp_path)
    assert again.scaler.measures == deep_localizer.scaler.measures
    presses = deep_localizer.scaled_features(deep_recording)
    found = again.predict_features(presses).measures
    for name, before in deep_localizer.predict_features(presses).measures.items():
        assert np.array_equal(before.values, found[name].values)
        assert np.array_equal(before.r90, found[name].r90)


@pytest.mark.parametrize("name", ["localizer.json", "localizer.safetensors"])
@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0, 1, exclude_max=True), flip=st.integers(0, 255), cut=st.integers(0, 300))
def test_load_refuses_damaged_bytes(
    localizer: LocalizerModel, brief: Recording, tmp_path: Path, name: str, at: float, flip: int, cut: int
) -> None:
    """A byte is changed, and some behind it are lost."""
    localizer.save(tmp_path)
    content = bytearray((tmp_path / name).read_bytes())
    where = int(at * len(content))
    content[where] ^= flip
    del content[where + 1 : where + 1 + cut]
    sound = (tmp_path / name).read_bytes() == content
    (tmp_path / name).write_bytes(content)
    try:
        read = LocalizerModel.load(tmp_path)
    except InputError:
        return
    assert sound or name == "localizer.json"
    assert np.isfinite(read.predict_features(read.scaled_features(brief)).positions_mm).all()


@pytest.mark.parametrize("value", [np.nan, object()])
def test_save_that_fails_changes_nothing(localizer: LocalizerModel, tmp_path: Path, value: object) -> None:
    localizer.save(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    other = {name: weight + 1 for name, weight in localizer.weights.items()}
    with pytest.raises(InputError, match="cannot be written as JSON"):
        replace(localizer, weights=other, provenance={"note": value}).save(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_save_into_an_unusable_folder_changes_nothing(localizer: LocalizerModel, tmp_path: Path) -> None:
    localizer.save(tmp_path)
    (tmp_path / "localizer.json").unlink()
    (tmp_path / "localizer.json").mkdir()
    before = (tmp_path / "localizer.safetensors").read_bytes()
    with pytest.raises(InputError, match="is a folder, expected a file or nothing"):
        replace(localizer, weights={name: weight + 1 for name, weight in localizer.weights.items()}).save(tmp_path)
    assert (tmp_path / "localizer.safetensors").read_bytes() == before
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        localizer.save(tmp_path / "file")
    with pytest.raises(InputError, match=r"folder is .*, expected a path"):
        LocalizerModel.load("")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")
def test_save_killed_leaves_the_old_or_the_new_model(localizer: LocalizerModel, tmp_path: Path) -> None:
    later = replace(localizer, weights={name: weight + 1 for name, weight in localizer.weights.items()})
    name, found = next(iter(localizer.weights)), []
    for number in count():
        folder = tmp_path / str(number)
        replace(localizer, split="random").save(folder)
        ended = not killed(lambda folder=folder: replace(later, split="chronological").save(folder), number, folder)
        loaded = LocalizerModel.load(folder)
        is_new = np.array_equal(loaded.weights[name], later.weights[name])
        assert is_new == (loaded.split == "chronological")
        found.append(is_new)
        if ended:
            break
    assert (found[0], found[-1]) == (False, True)
