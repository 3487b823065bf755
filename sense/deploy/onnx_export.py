"""`localizer.onnx`: the localizer as one graph, from readings and the commands of presses to positions and radii.

The graph is traced by `torch.onnx` from a torch module, which shares its networks and its Bayesian localizer with the
rest of padforge. It is written only if onnxruntime computes from it what the localizer predicts.
"""

import io
import json
import warnings
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn
from torch.nn import functional

from padforge.design.common.files import atomic_file
from padforge.design.common.parallel import one_torch_thread
from padforge.design.common.validation import Fault, InputError
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer import features
from padforge.sense.localizer.bayes import BayesianLocalizer
from padforge.sense.localizer.features import Window, compute_features, interpolate_gaps
from padforge.sense.localizer.model import MEASURE_COLUMNS, UNIFORM, LocalizerModel
from padforge.sense.localizer.model_files import check_same_pad
from padforge.sense.localizer.network import MAX_LOG_ERROR, MIN_LOG_ERROR
from padforge.sense.localizer.scaler import MAX_INPUT
from padforge.sense.localizer.torch_network import EnsembleMlp, network_inputs
from padforge.sense.recording.recording import Recording

FORMAT = "padforge-onnx/3"
OPSET = 18  # of the operators: ONNX 1.13, 2022
MAX_DIFFERENCE_MM = 1e-4
"""A graph whose positions differ more from those of its localizer is not written."""
N_TRIALS, TRIAL_READINGS = 64, 40
"""Presses that are made up to test a graph where there is no recording, and readings from one to the next."""
INPUTS = {
    "readings": "V, (R, C): one row a reading, one column a fibre, none missing",
    "down_command": "(Q,), ascending: row of the first reading after the probe was sent down",
    "up_command": "(Q,): row of the first reading after it was sent up; R where there is none yet",
    "fibre_mask": "(Q, C): which fibres count in each press",
}
OUTPUTS = {
    "positions_mm": "mm from the middle of the pad, x and y",
    "std_mm": "mm, standard deviation in x and in y",
    "r50_mm": "mm, radius around the position that holds the press in 50 % of cases",
    "r90_mm": "mm, the same in 90 % of cases",
    "depth_mm": "mm, depth of the press",
    "depth_r90_mm": "mm, half the width of its 90 % interval",
    "force_n": "N, force of the press",
    "force_r90_n": "N, half the width of its 90 % interval",
}
"""Inputs and outputs of a graph; depth and force only where the localizer predicts them."""


class _Traceable:
    """torch as `BayesianLocalizer.predict` calls it, without the argument `out`, which cannot be exported."""

    def __getattr__(self, name: str) -> Any:
        return getattr(torch, name)

    @staticmethod
    def clip(x: Tensor, low: Any, high: Any, out: object = None) -> Tensor:
        if isinstance(low, Tensor):
            return torch.minimum(torch.maximum(x, low), high)
        return torch.clip(x, low, high)

    @staticmethod
    def exp(x: Tensor, out: object = None) -> Tensor:
        return torch.exp(x)


class _FeatureModule(nn.Module):
    """`compute_features` and `FeatureScaler.transform` in torch."""

    def __init__(self, model: LocalizerModel) -> None:
        super().__init__()
        self.kind, scaler = features.FEATURES[model.features], model.scaler
        for name in ("mean_v", "scale_v", "history_coef", "history_mean_v"):
            self.register_buffer(name, torch.from_numpy(getattr(scaler, name)))

    def forward(self, readings: Tensor, down_command: Tensor, up_command: Tensor) -> Tensor:
        """Return (Q, C, F + G) scaled features."""
        n_readings = torch.ones_like(readings[:, 0], dtype=torch.int64).sum()[None]  # a shape would be traced as fixed
        previous_end = torch.cat([torch.zeros_like(up_command[:1]), up_command[:-1]])
        next_begin = torch.cat([down_command[1:], n_readings])

        def gather(origin: Tensor, window: Window, low: Tensor, high: Tensor) -> Tensor:
            index = torch.maximum(origin[:, None] + torch.arange(*window), low[:, None])
            return readings[torch.minimum(index, torch.minimum(high, n_readings)[:, None] - 1)]

        if not self.kind.n_history:  # the published running medians
            half = -(features.MEDIAN // 2), features.MEDIAN // 2 + 1
            before = _median(gather(down_command - features.MEDIAN_OFFSET, half, previous_end, down_command))
            within = _median(gather(down_command + features.MEDIAN_OFFSET, half, down_command, up_command))
            after = _median(gather(up_command + features.MEDIAN_OFFSET, half, down_command, next_begin))
            return self._scale(torch.stack([before, within, after], dim=2))
        means = [gather(down_command, each, down_command, up_command).mean(dim=1) for each in self.kind.down]
        means += [gather(up_command, each, down_command, next_begin).mean(dim=1) for each in self.kind.up]
        rest = gather(down_command, features.REST, previous_end, down_command).mean(dim=1)
        windows = functional.pad(torch.stack(means, dim=2) - rest[:, :, None], (0, len(self.kind.phases)))
        history = _history(readings, down_command) - self.history_mean_v
        effect = (history.transpose(0, 1) @ self.history_coef).transpose(0, 1)
        if effect.shape[2] < windows.shape[2]:  # a scaler without modulations of the sensitivity
            windows = windows[:, :, : effect.shape[2]]
        return self._scale(windows - effect)

    def _scale(self, windows: Tensor) -> Tensor:
        return torch.clip((windows - self.mean_v) / self.scale_v, -MAX_INPUT, MAX_INPUT).float()


def _median(values: Tensor) -> Tensor:
    """(Q, W, C) to (Q, C), as `np.median`."""
    n = values.shape[1]
    return torch.sort(values, dim=1).values[:, (n - 1) // 2 : n // 2 + 1].mean(dim=1)


def _history(readings: Tensor, down_command: Tensor) -> Tensor:
    """(Q, C, J) V, as `features.compute_history`."""
    sums = torch.cumsum(readings - readings[:1], dim=0)
    sums = torch.cat([torch.zeros_like(sums[:1]), sums])

    def mean(window: Window) -> Tensor:
        first = torch.clamp(down_command + window[0], min=0)
        end = torch.maximum(down_command + window[1], first + 1)
        return (sums[end] - sums[first]) / (end - first)[:, None] + readings[:1]

    means = [mean(window) for window in features.PAST]
    for length in features.SLOW:
        offsets = torch.arange(-length, 0, length // features.SLOW_SAMPLES)
        means.append(_median(readings[torch.clamp(down_command[:, None] + offsets, min=0)]))
    return torch.stack(means, dim=2) - mean(features.REST)[:, :, None]


class _LocalizerModule(nn.Module):
    """`LocalizerModel.predict` of an ensemble in torch, from `INPUTS` to `OUTPUTS`."""

    def __init__(self, model: LocalizerModel) -> None:
        super().__init__()
        scaler = model.scaler
        self.features, self.members = _FeatureModule(model), EnsembleMlp.from_numpy(model.weights)
        self.residual = EnsembleMlp.from_numpy(model.residual_network) if model.bayes is not None else None
        if model.bayes is not None:
            for each in fields(model.bayes):  # single precision is exact, and half the size
                self.register_buffer(each.name, torch.from_numpy(getattr(model.bayes, each.name).astype(np.float32)))
        self.scale_mm, self.measures = scaler.scale_mm, scaler.measures
        units = [self.scale_mm] * 3 + [measure.scale for measure in self.measures]
        self.register_buffer("interval_factors", torch.from_numpy(model.interval_factors * units).float())
        self.register_buffer("origin_mm", torch.from_numpy(scaler.origin_mm).float())

    def forward(
        self, readings: Tensor, down_command: Tensor, up_command: Tensor, fibre_mask: Tensor
    ) -> tuple[Tensor, ...]:
        scaled = self.features(readings, down_command, up_command)
        x, _ = network_inputs(scaled, fibre_mask, None)
        outputs = self.members(x.expand(self.members.n_members, -1, -1))
        if self.residual is not None:
            bayes = BayesianLocalizer(*(getattr(self, each.name).double() for each in fields(BayesianLocalizer)))
            position, summary = bayes.predict(scaled.double(), fibre_mask, _Traceable())
            corrected = self.residual(torch.cat([x, summary.float()], dim=1)[None])
            outputs = torch.cat([outputs, corrected + functional.pad(position.float(), (0, 2))])
        targets, std = _combine_members(outputs)
        n_failed = (~fibre_mask).sum(dim=1)
        factors = self.interval_factors[torch.clamp(n_failed, max=len(self.interval_factors) - 1)]
        blind = ~fibre_mask.any(dim=1)  # which may be anywhere
        radius = torch.linalg.vector_norm(std[:, :2], dim=1)

        def unless_blind(value: Tensor, otherwise: float) -> Tensor:
            return torch.where(blind if value.ndim == 1 else blind[:, None], otherwise, value)

        values = [
            unless_blind(targets[:, :2], 0.0) * self.scale_mm + self.origin_mm,
            unless_blind(factors[:, :1] * std[:, :2], UNIFORM[0] * self.scale_mm),
            unless_blind(factors[:, 1] * radius, UNIFORM[1] * self.scale_mm),
            unless_blind(factors[:, 2] * radius, UNIFORM[2] * self.scale_mm),
        ]
        for column, measure in enumerate(self.measures):
            values.append(unless_blind(targets[:, 2 + column], 0.0) * measure.scale + measure.origin)
            values.append(unless_blind(factors[:, 3 + column] * std[:, 2 + column], measure.scale))
        return tuple(values)


def _combine_members(outputs: Tensor) -> tuple[Tensor, Tensor]:
    """(E, Q, 2 N) outputs to (Q, N) targets and their standard deviations, as `network.combine_members`."""
    targets, log_errors = outputs.chunk(2, dim=2)
    variance = 2 * torch.exp(2 * torch.clip(log_errors, MIN_LOG_ERROR, MAX_LOG_ERROR))
    pooled = variance[:, :, :2].mean(dim=2, keepdim=True)
    precision = 1 / torch.cat([pooled, pooled, variance[:, :, 2:]], dim=2)
    weight = precision / precision.sum(dim=0)
    mean = (weight * targets).sum(dim=0)
    return mean, torch.sqrt((weight * (variance + (targets - mean) ** 2)).sum(dim=0))


def _build_graph(model: LocalizerModel, digest: str) -> onnx.ModelProto:
    """Export a localizer of method "ensemble" as a graph for any number of presses and readings."""
    arguments = tuple(map(torch.from_numpy, (*_made_up_presses(model), np.ones((N_TRIALS, model.fibres), bool))))
    names = [*list(OUTPUTS)[:4], *(name for each in model.scaler.measures for name in MEASURE_COLUMNS[each.name])]
    axes = {"readings": {0: "readings"}} | {name: {0: "presses"} for name in [*list(INPUTS)[1:], *names]}
    content = io.BytesIO()
    with warnings.catch_warnings(), one_torch_thread(), torch.no_grad():
        warnings.simplefilter("ignore")  # the exporter is deprecated, and constants are traced as such
        torch.onnx.export(
            _LocalizerModule(model),
            arguments,
            content,
            input_names=list(INPUTS),
            output_names=names,
            dynamic_axes=axes,
            opset_version=OPSET,
            do_constant_folding=False,  # which would double the size
            dynamo=False,  # the other exporter needs onnxscript
        )
    graph = onnx.load_model_from_string(content.getvalue())
    for each in (*graph.graph.input, *graph.graph.output):
        each.doc_string = (INPUTS | OUTPUTS)[each.name]
    graph.producer_name = "padforge"
    metadata = {
        "format": FORMAT,
        "padforge": version("padforge"),
        "localizer_sha256": digest,
        "training_recording_sha256": model.training_recording_sha256,
        "features": model.features,
        "rate_hz": f"{model.rate_hz:.9g}",
        "fibres": json.dumps([f"fibre_{fibre}_v" for fibre in range(model.fibres)]),
        "inputs": json.dumps(INPUTS),
        "outputs": json.dumps({name: OUTPUTS[name] for name in names}),
    }
    onnx.helper.set_model_props(graph, metadata)
    return graph


@dataclass(frozen=True)
class OnnxReport:
    """A written graph, and how it compares with its localizer."""

    size: int  # bytes of the file
    n_presses: int  # that it was tested on
    max_failures: int  # fibres that were masked in the tests, at most
    position_difference_mm: float  # the largest
    r90_difference_mm: float

    @property
    def text(self) -> str:
        return (
            f"{self.size / 1e6:.1f} MB, tested on {self.n_presses} presses with up to {self.max_failures} failed "
            f"fibres: positions within {1e3 * self.position_difference_mm:.2f} µm of the localizer's, "
            f"radii within {1e3 * self.r90_difference_mm:.2f} µm"
        )


def export_onnx(model: LocalizerModel, digest: str, path: Path, recording: Recording | None = None) -> OnnxReport:
    """Write a localizer, whose `localizer.json` has the SHA-256 `digest`, as an ONNX graph.

    It is tested on the presses of a recording, or on made-up ones. Raises InputError for a localizer of the published
    method, a recording of another pad or rate, or a path that cannot be written; Fault if positions differ by more than
    MAX_DIFFERENCE_MM.
    """
    if model.method != "ensemble":
        raise InputError(f"the localizer is of method {model.method}, expected ensemble: calibrate again")
    if recording is not None:
        check_same_pad(model, "the localizer", recording.fibres, recording.rate_hz)
        trial = recording.readings, recording.down_command, recording.up_command
    else:
        trial = _made_up_presses(model)
    content = _build_graph(model, digest).SerializeToString()
    positions, radii = _compare(model, content, *trial)
    if not positions <= MAX_DIFFERENCE_MM:
        raise Fault(
            f"{path}: not written, positions by onnxruntime differ by {positions:.2g} mm from those of the localizer, "
            f"allowed are {MAX_DIFFERENCE_MM:g} mm"
        )
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)
    return OnnxReport(len(content), len(trial[1]), len(model.interval_factors) - 1, positions, radii)


def _made_up_presses(model: LocalizerModel) -> tuple[Array, Indices, Indices]:
    """Return noise with presses as strong as those of the training, and their commands."""
    rng, scaler = np.random.default_rng(0), model.scaler
    down_command = TRIAL_READINGS // 2 + TRIAL_READINGS * np.arange(N_TRIALS)
    up_command = down_command + features.DOWN[-1][1]
    readings = 1e-3 * rng.standard_normal(((N_TRIALS + 1) * TRIAL_READINGS, model.fibres))
    response = np.abs(scaler.mean_v).max(axis=1) + scaler.scale_v.max(axis=1)
    for first, end in zip(down_command, up_command, strict=True):
        readings[first:end] += response * rng.uniform(-1, 1, model.fibres)
    return readings, down_command, up_command


def _compare(
    model: LocalizerModel, content: bytes, readings: Array, down_command: Indices, up_command: Indices
) -> tuple[float, float]:
    """Return the largest differences of positions and of radii, mm."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    presses = model.scaler.transform(compute_features(readings, down_command, up_command, model.features))
    inputs = {"readings": interpolate_gaps(readings), "down_command": down_command, "up_command": up_command}
    rng, differences = np.random.default_rng(0), []
    for n_failed in range(len(model.interval_factors)):
        # In every press another random set of fibres is masked.
        fibre_mask = presses.fibre_mask & (rng.random(presses.fibre_mask.shape).argsort(axis=1) >= n_failed)
        expected = model.predict_features(replace(presses, fibre_mask=fibre_mask))
        outputs = session.run(["positions_mm", "r90_mm"], inputs | {"fibre_mask": fibre_mask})
        positions_mm, r90_mm = map(np.asarray, outputs)
        distance = np.hypot(*(positions_mm - expected.positions_mm).T)
        differences.append((distance.max(), np.abs(r90_mm - expected.r90_mm).max()))
    positions, radii = np.max(differences, axis=0)
    return float(positions), float(radii)
