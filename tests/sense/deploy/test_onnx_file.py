"""`localizer.onnx`: onnxruntime finds in it what the localizer finds, whatever is lost and however many presses."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

from padforge.design.common.validation import Fault, InputError
from padforge.sense import Recording, calibrate, export_csv
from padforge.sense.deploy import onnx_export as onnx_file
from padforge.sense.deploy.onnx_export import MOST_OFF_MM, Exported, export_onnx, onnx_line
from padforge.sense.localizer.features import interpolate_gaps
from padforge.sense.localizer.model import Localization, LocalizerModel
from tests.sense.conftest import QUICK
from tests.sense.deploy.conftest import ROOT, tutorial

DIGEST = "a" * 64


@pytest.fixture(scope="module")
def exported(localizer: LocalizerModel, recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> tuple:
    path = tmp_path_factory.mktemp("onnx") / "localizer.onnx"
    return path, export_onnx(localizer, DIGEST, path, recording)


def opened(path: Path) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


@pytest.fixture
def graph(exported: tuple[Path, Exported]) -> onnxruntime.InferenceSession:
    return opened(exported[0])


def presses_of(recording: Recording, fibre_mask: np.ndarray) -> dict[str, np.ndarray]:
    edges = {"down_command": recording.down_command, "up_command": recording.up_command}
    return {"readings": interpolate_gaps(recording.readings), **edges, "fibre_mask": fibre_mask}


def require_places(positions_mm: Any, found: Localization) -> None:
    assert np.shape(positions_mm) == found.positions_mm.shape
    assert np.hypot(*(np.asarray(positions_mm) - found.positions_mm).T).max() < MOST_OFF_MM


def test_places_and_radii_are_those_of_locate(graph, localizer, recording) -> None:
    presses, names = localizer.scaled_features(recording), ["positions_mm", "std_mm", "r50_mm", "r90_mm"]
    for lost in ((), (2,), (0, 3), (0, 1, 2), (0, 1, 2, 3)):
        fibre_mask = presses.fibre_mask & ~np.isin(np.arange(4), lost)
        found = localizer.predict_features(replace(presses, fibre_mask=fibre_mask))
        positions_mm, *others = graph.run(names, presses_of(recording, fibre_mask))
        require_places(positions_mm, found)
        for name, values in zip(names[1:], others, strict=True):
            np.testing.assert_allclose(values, getattr(found, name), rtol=1e-4)


def test_any_number_of_presses_and_readings_will_do(graph, localizer, brief) -> None:
    """The last press of a recording is found as it is in it by itself, where the one before stands by its end."""
    presses = localizer.scaled_features(brief)
    for count in (1, 2, 7):
        part = {
            "down_command": brief.down_command[:count],
            "up_command": brief.up_command[:count],
            "fibre_mask": np.ones((count, 4), bool),
        }
        given = {"readings": brief.readings[: brief.down_command[count]], **part}
        require_places(graph.run(["positions_mm"], given)[0], localizer.predict_features(presses[np.arange(count)]))


@pytest.mark.parametrize("features", ["causal", "onset", "published"])
def test_whatever_its_inputs_are_made_of(features: str, brief: Recording, tmp_path: Path) -> None:
    options = QUICK.model_copy(update={"features": features, "epochs": 2, "members": 1})
    found = export_onnx(calibrate(brief, options)[0], DIGEST, tmp_path / "l.onnx", brief)
    assert found.positions_mm < MOST_OFF_MM
    assert found.presses == 40


def test_depth_and_force_come_too(deep_localizer, deep_recording, tmp_path) -> None:
    export_onnx(deep_localizer, DIGEST, tmp_path / "l.onnx", deep_recording)
    presses = deep_localizer.scaled_features(deep_recording)
    found, graph = deep_localizer.predict_features(presses), opened(tmp_path / "l.onnx")
    names = [each.name for each in graph.get_outputs()][4:]
    assert names == ["depth_mm", "depth_r90_mm", "force_n", "force_r90_n"]
    told = graph.run(names, presses_of(deep_recording, presses.fibre_mask))
    expected = [column for each in found.measures.values() for column in (each.values, each.r90)]
    np.testing.assert_allclose(np.array(told), np.array(expected), rtol=1e-4, atol=1e-4)


def test_the_file_says_what_it_is(exported: tuple[Path, Exported]) -> None:
    model = onnx.load(exported[0])
    onnx.checker.check_model(model, full_check=True)
    about = {each.key: each.value for each in model.metadata_props}
    assert about["format"] == "padforge-onnx/2"
    assert about["localizer_sha256"] == DIGEST
    assert json.loads(about["fibres"]) == ["fibre_0_v", "fibre_1_v", "fibre_2_v", "fibre_3_v"]
    assert list(json.loads(about["inputs"])) == [each.name for each in model.graph.input]
    assert list(json.loads(about["outputs"])) == [each.name for each in model.graph.output]
    assert [each.dim_param for each in model.graph.input[1].type.tensor_type.shape.dim] == ["presses"]
    assert onnx_line(exported[1]).startswith("1.9 MB, tried on 300 presses with up to 3 fibres lost: places within ")


def test_what_is_off_or_does_not_suit_is_not_written(localizer, tmp_path, monkeypatch) -> None:
    path = tmp_path / "l.onnx"
    with pytest.raises(InputError, match="method published, expected ensemble"):
        export_onnx(replace(localizer, method="published"), DIGEST, path)
    monkeypatch.setattr(onnx_file, "MOST_OFF_MM", 1e-9)
    with pytest.raises(Fault, match="not written, onnxruntime finds places"):
        export_onnx(localizer, DIGEST, path)
    assert not list(tmp_path.iterdir())


def test_the_script_of_the_tutorial_does_as_it_says(localizer, brief, exported, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("localizer.onnx").write_bytes(exported[0].read_bytes())
    export_csv(brief, "presses.csv")
    found: dict[str, np.ndarray] = {}
    exec(tutorial("graph", "python"), found)
    assert np.array_equal(found["down_command"], brief.down_command)
    presses = localizer.scaled_features(brief)
    require_places(
        found["positions_mm"][:-1], localizer.predict_features(presses[np.arange(len(brief.down_command) - 1)])
    )


def test_onnxruntime_is_kept_from_telling_its_maker_of_its_use(tmp_path: Path) -> None:
    """Where it does, it leaves a file in the folder for temporary ones."""
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    command = [sys.executable, "-c", "import padforge.sense.deploy.onnx_export"]
    subprocess.run(command, cwd=ROOT, env=environment | {"TMPDIR": str(tmp_path)}, check=True)
    assert list(tmp_path.iterdir()) == []
