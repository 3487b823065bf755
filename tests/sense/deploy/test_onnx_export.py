"""onnxruntime computes from `localizer.onnx` what the localizer predicts, with any fibres masked."""

import importlib
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

from padforge.common.validation import Fault
from padforge.sense import Recording, deploy, export_csv
from padforge.sense.deploy import onnx_export
from padforge.sense.deploy.onnx_export import MAX_DIFFERENCE_MM, OnnxReport, export_onnx
from padforge.sense.localizer.features import interpolate_gaps
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.localizer.network import predict
from padforge.sense.localizer.scaler import MAX_INPUT
from tests.sense.conftest import first_presses

DIGEST = "a" * 64


@pytest.fixture(scope="module")
def exported(localizer: LocalizerModel, brief: Recording, tmp_path_factory) -> tuple[Path, OnnxReport]:
    """A graph of frames of a fast board, tested on presses of which the recording cuts off the last one."""
    path = tmp_path_factory.mktemp("onnx") / "localizer.onnx"
    return path, export_onnx(replace(localizer, rate_hz=1000.0), DIGEST, path, first_presses(brief, 5))


@pytest.fixture(scope="module")
def graph(exported: tuple[Path, OnnxReport]) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(exported[0])


def graph_inputs(recording: Recording, fibre_mask: np.ndarray) -> dict[str, np.ndarray]:
    commands = {"down_command": recording.down_command, "up_command": recording.up_command}
    return {"readings": interpolate_gaps(recording.readings), **commands, "fibre_mask": fibre_mask}


def check_graph(graph: onnxruntime.InferenceSession, inputs: dict[str, np.ndarray], expected: Localization) -> None:
    """Compare positions, deviations and radii."""
    names = ["std_mm", "r50_mm", "r90_mm"]
    outputs: list[Any] = list(graph.run(["positions_mm", *names], inputs))
    positions_mm, *others = map(np.asarray, outputs)
    assert positions_mm.shape == expected.positions_mm.shape
    assert np.hypot(*(positions_mm - expected.positions_mm).T).max() < MAX_DIFFERENCE_MM
    for name, values in zip(names, others, strict=True):
        np.testing.assert_allclose(values, getattr(expected, name), rtol=1e-4)


def test_graph_predicts_with_masked_fibres_missing_readings_and_far_beyond_training(graph, localizer, brief) -> None:
    presses, fibres = localizer.scaled_features(brief), np.arange(4)
    for failed in ((), (2,), (0, 3), (0, 1, 2), (0, 1, 2, 3)):
        fibre_mask = presses.fibre_mask & ~np.isin(fibres, failed)
        expected = localizer.predict_features(replace(presses, fibre_mask=fibre_mask))
        check_graph(graph, graph_inputs(brief, fibre_mask), expected)
    # a fibre is masked in the presses that its mean or its history is missing in; the others are as ever
    readings, first = np.array(interpolate_gaps(brief.readings)), 25
    readings[brief.down_command[first] + 2, 1] = np.nan
    expected_mask = np.array(presses.fibre_mask)
    expected_mask[first:, 1] = False
    expected = localizer.predict_features(replace(presses, fibre_mask=expected_mask))
    check_graph(graph, graph_inputs(brief, presses.fibre_mask) | {"readings": readings}, expected)
    readings = np.full_like(brief.readings, -1000.0)
    for down, up in zip(brief.down_command, brief.up_command, strict=True):
        readings[down:up] = 1000.0
    strong = replace(brief, readings=readings)
    presses = localizer.scaled_features(strong)
    assert (np.abs(presses.inputs) == MAX_INPUT).any()
    check_graph(graph, graph_inputs(strong, presses.fibre_mask), localizer.predict_features(presses))


def test_graph_gives_the_predictions_at_every_reading(graph, localizer, recording) -> None:
    """It is called with the readings so far, from the touch to after the release; first, nothing is known."""
    so_far = first_presses(recording, 2)
    readings, down, up = so_far.readings, so_far.down_command, so_far.up_command
    n_complete = []
    for end in range(down[-1] + 1, up[-1] + 24):
        expected = localizer.predict(so_far, until=np.full(2, end))
        n_complete.append(localizer.raw_features(so_far, np.full(2, end)).complete[-1].sum())
        inputs = {"down_command": down, "up_command": np.minimum(up, end), "fibre_mask": np.ones((2, 4), bool)}
        check_graph(graph, inputs | {"readings": readings[:end]}, expected)
    assert sorted(set(n_complete)) == list(range(18))


def test_graph_gives_the_predictions_of_presses_without_pauses(graph, localizer, recording, brief) -> None:
    """Short ones, too, and from the first readings on: windows and rests end where a press or the recording begins."""
    edges = np.cumsum(np.random.default_rng(0).choice([1, 2, 3, 7, 12, 25], 2 * 60))
    until = edges[-1] + 2
    unknown = np.full((60, 2), np.nan)
    quick = Recording(recording.readings[:until], recording.times_s[:until], unknown, edges[::2], edges[1::2])
    scaled = localizer.scaled_features(quick)
    for failed in ((), (1,)):
        fibre_mask = scaled.fibre_mask & ~np.isin(np.arange(4), failed)
        expected = localizer.predict_features(replace(scaled, fibre_mask=fibre_mask))
        check_graph(graph, graph_inputs(quick, fibre_mask), expected)
    # a finger that slides: after the touch of a press come the readings of another one
    readings = np.array(brief.readings)
    for press in range(0, 38, 2):
        here, there = (brief.down_command[row] + np.arange(8, 20) for row in (press, press + 1))
        readings[here] = brief.readings[there]
    sliding = replace(brief, readings=readings)
    scaled = localizer.scaled_features(sliding)
    *_, slid = predict(localizer.networks, scaled, *localizer.corrected, sliding=localizer.sliding)
    assert 3 < slid.sum() < 37
    check_graph(graph, graph_inputs(sliding, scaled.fibre_mask), localizer.predict_features(scaled))


@pytest.mark.slow
def test_graph_gives_depth_and_force(deep_localizer, deep_recording, tmp_path) -> None:
    """Of one member, which has no Bayesian localizers."""
    path = tmp_path / "localizer.onnx"
    report = export_onnx(deep_localizer, DIGEST, path, first_presses(deep_recording, 5))
    assert report.position_difference_mm < MAX_DIFFERENCE_MM
    assert report.n_presses == 5
    presses, graph = deep_localizer.scaled_features(deep_recording), onnxruntime.InferenceSession(path)
    names = [each.name for each in graph.get_outputs()][4:]
    assert names == ["depth_mm", "depth_r90_mm", "force_n", "force_r90_n"]
    for failed in ((), (0, 1, 2, 3)):
        fibre_mask = presses.fibre_mask & ~np.isin(np.arange(4), failed)
        expected = deep_localizer.predict_features(replace(presses, fibre_mask=fibre_mask))
        values = graph.run(names, graph_inputs(deep_recording, fibre_mask))
        columns = [column for each in expected.measures.values() for column in (each.values, each.r90)]
        np.testing.assert_allclose(np.array(values), np.array(columns), rtol=1e-4, atol=1e-4)


def test_graph_describes_itself(exported: tuple[Path, OnnxReport], golden: Any) -> None:
    """Inputs, outputs and metadata, as any program reads them; what differs from pad to pad is compared here."""
    path, report = exported
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    metadata = {each.key: each.value for each in model.metadata_props}
    assert metadata["localizer_sha256"] == DIGEST
    lines = [f"{model.producer_name}, operators {[each.version for each in model.opset_import]}"]
    for kind, values in (("input", model.graph.input), ("output", model.graph.output)):
        for each in values:
            tensor = each.type.tensor_type
            size = ", ".join(part.dim_param or str(part.dim_value) for part in tensor.shape.dim)
            type_name = onnx.TensorProto.DataType.Name(tensor.elem_type)
            lines.append(f"{kind} {each.name} {type_name} ({size}): {each.doc_string}")
    lines += [f"metadata {name}: {value}" for name, value in sorted(metadata.items())]
    lines += [report.text, replace(report, max_failures=1).text]
    golden("sense/onnx.txt", "\n".join(lines), forget=(r"padforge: \d.*", r"[\d.]+ MB", r"[\d.]+ µm"))
    assert report.size == path.stat().st_size
    assert 0 < report.position_difference_mm < MAX_DIFFERENCE_MM


def test_a_graph_that_differs_is_not_written(localizer, brief, exported, tmp_path, monkeypatch) -> None:
    """The graph is the one that torch has exported of the same localizer before, which takes long."""
    path, content = tmp_path / "l.onnx", exported[0].read_bytes()
    monkeypatch.setattr("torch.onnx.export", lambda module, inputs, file, **options: file.write(content))
    monkeypatch.setattr(onnx_export, "MAX_DIFFERENCE_MM", 1e-9)
    intact = replace(localizer, interval_factors=localizer.interval_factors[:, :1])  # tested with all fibres alone
    with pytest.raises(Fault, match="not written, positions by onnxruntime differ"):
        export_onnx(intact, DIGEST, path, first_presses(brief, 2))
    assert not list(tmp_path.iterdir())


def test_script_of_the_tutorial_predicts_positions(localizer, brief, exported, here: Path) -> None:
    Path("localizer.onnx").write_bytes(exported[0].read_bytes())
    export_csv(brief, "presses.csv")
    names: dict[str, np.ndarray] = {}
    page = (Path(__file__).parents[3] / "docs" / "howto-deploy.md").read_text(encoding="utf-8")
    exec(page.partition("```python\n")[2].partition("```")[0], names)
    assert np.array_equal(names["down_command"], brief.down_command)
    presses = localizer.scaled_features(brief)
    without_last = localizer.predict_features(presses[np.arange(len(brief.down_command) - 1)])
    np.testing.assert_allclose(names["positions_mm"][:-1], without_last.positions_mm, atol=MAX_DIFFERENCE_MM)


def test_onnxruntime_sends_no_telemetry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor in programs that import it behind padforge, which sets what it reads as it is loaded."""
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY")
    importlib.reload(deploy)
    assert os.environ["ORT_DISABLE_TELEMETRY"] == "1"
