"""`localizer.onnx`: the localizer as one graph, from readings and the commands of presses to positions and radii.

The graph takes the readings so far and determines which windows of each press are complete, so that it predicts at
every reading of a press. It is traced by `torch.onnx` from a torch module, which shares its networks and its Bayesian
localizers with the rest of padforge. As a graph has no branches, it evaluates all networks, and selects the output for
the moment of each press. It is written only if its outputs in onnxruntime agree with the predictions of the localizer.
"""

import io
import json
import warnings
from collections.abc import Sequence
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

from padforge.common.files import atomic_file
from padforge.common.parallel import one_thread
from padforge.common.validation import Fault, InputError
from padforge.sense.arrays import Array, Indices, press_bounds
from padforge.sense.localizer import moments
from padforge.sense.localizer.bayes import BayesianLocalizer
from padforge.sense.localizer.features import (
    compute_features,
    compute_history,
    interpolate_gaps,
    mean_at_rest,
    windows_from_rest,
)
from padforge.sense.localizer.model import MEASURE_COLUMNS, UNIFORM, LocalizerModel
from padforge.sense.localizer.network import Weights, combine_members, forward, network_inputs
from padforge.sense.localizer.scaler import MAX_INPUT
from padforge.sense.recording.frames import frame_rate_hz, framed
from padforge.sense.recording.recording import Recording

FORMAT = "padforge-onnx/1"
MAX_DIFFERENCE_MM = 1e-4  # maximum difference between the positions of a graph and of its localizer
N_TRIALS, TRIAL_READINGS = 64, 40  # synthetic presses that test a graph without a recording, and readings a press
INPUTS = {
    "readings": "V, (R, C): one row a reading so far, one column a fibre, which fails where one is missing",
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
    """Replaces torch in `BayesianLocalizer.predict`, and ignores the argument `out`, which cannot be exported."""

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
        for name in ("mean_v", "scale_v", "history_coef", "history_mean_v"):
            self.register_buffer(name, torch.from_numpy(getattr(model.scaler, name)))

    def forward(self, readings: Tensor, down_command: Tensor, up_command: Tensor) -> tuple[Tensor, Tensor]:
        """Return the scaled features (Q, C, F + G), and whether each window is complete (Q, K)."""
        n_readings = torch.ones_like(readings[:, 0], dtype=torch.int64).sum()  # a shape would be traced as fixed
        previous_end, until = press_bounds(down_command, up_command, n_readings, torch)
        baseline = mean_at_rest(readings, down_command, previous_end, torch)
        windows = windows_from_rest(readings, baseline, down_command, up_command, until, torch)
        windows = functional.pad(windows, (0, len(moments.MODULATED)))
        history = compute_history(readings, down_command, torch) - self.history_mean_v
        effect = (history.transpose(0, 1) @ self.history_coef).transpose(0, 1)
        scaled = torch.clip((windows - effect - self.mean_v) / self.scale_v, -MAX_INPUT, MAX_INPUT).float()
        return scaled, moments.complete_windows(down_command, up_command, until, torch)


class _NetworkModule(nn.Module):
    """An ensemble of networks in torch."""

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self.names = list(weights)
        for name, weight in weights.items():
            self.register_buffer(name.replace(".", "_"), torch.from_numpy(weight))

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs (E, Q, 2 N) for (Q, I) inputs."""
        return forward({name: getattr(self, name.replace(".", "_")) for name in self.names}, x, torch)


class _BayesModule(nn.Module):
    """The Bayesian localizers with the network that corrects them, in torch."""

    def __init__(self, stages: Sequence[BayesianLocalizer], residual_network: Weights) -> None:
        super().__init__()
        self.residual, self.n_stages = _NetworkModule(residual_network), len(stages)
        for number, stage in enumerate(stages):
            for name, array in vars(stage.map_arrays(torch.from_numpy)).items():
                self.register_buffer(f"bayes_{number}_{name}", array)

    def forward(self, scaled: Tensor, fibre_mask: Tensor, x: Tensor, n_complete: Tensor) -> Tensor:
        """Return the outputs (1, Q, 4) of presses from their scaled features and network inputs x."""
        position, summary = self._predict(0, scaled, fibre_mask)
        for number in range(1, self.n_stages):
            later = self._predict(number, scaled, fibre_mask)
            is_later = (n_complete >= moments.BAYES_STAGES[number])[:, None]
            position, summary = (torch.where(is_later, *pair) for pair in zip(later, (position, summary), strict=True))
        corrected = self.residual(torch.cat([x, summary], dim=1))
        return corrected + functional.pad(position, (0, 2))

    def _predict(self, number: int, scaled: Tensor, fibre_mask: Tensor) -> tuple[Tensor, Tensor]:
        names = (each.name for each in fields(BayesianLocalizer))
        stage = BayesianLocalizer(*(getattr(self, f"bayes_{number}_{name}").double() for name in names))
        position, summary = stage.predict(scaled.double(), fibre_mask, _Traceable())
        return position.float(), summary.float()


class _LocalizerModule(nn.Module):
    """`LocalizerModel.predict` of an ensemble in torch, from `INPUTS` to `OUTPUTS`."""

    def __init__(self, model: LocalizerModel) -> None:
        super().__init__()
        scaler = model.scaler
        self.features = _FeatureModule(model)
        self.networks = nn.ModuleDict({name: _NetworkModule(each) for name, each in model.networks.items()})
        self.bayes = _BayesModule(*model.corrected) if model.bayes else None
        latest_factor, latest_offset = scaler.latest_window_map(moments.N_TIMED)
        self.register_buffer("latest_factor", torch.from_numpy(latest_factor))
        self.register_buffer("latest_offset", torch.from_numpy(latest_offset))
        self.scale_mm, self.measures = scaler.scale_mm, scaler.measures
        units = [self.scale_mm] * 3 + [measure.scale for measure in self.measures]
        self.register_buffer("interval_factors", torch.from_numpy(model.interval_factors * units).float())
        self.register_buffer("origin_mm", torch.from_numpy(scaler.origin_mm).float())

    def forward(
        self, readings: Tensor, down_command: Tensor, up_command: Tensor, fibre_mask: Tensor
    ) -> tuple[Tensor, ...]:
        scaled, complete = self.features(readings, down_command, up_command)
        fibre_mask = fibre_mask & ~torch.isnan(scaled).any(dim=2)  # otherwise a missing reading makes predictions NaN
        n_complete = complete.sum(dim=1)
        x = network_inputs(scaled, fibre_mask, complete, torch)
        targets, std = self._predict(scaled, fibre_mask, x, n_complete)
        *followed, moved = self._follow(scaled, fibre_mask, complete)
        slid = (n_complete >= moments.N_PRESS_WINDOWS) & (moved > moments.SLIDE_THRESHOLD)
        targets, std = (torch.where(slid[:, None], *pair) for pair in zip(followed, (targets, std), strict=True))
        n_failed, moment = (~fibre_mask).sum(dim=1), torch.where(slid, moments.N_PRESS_WINDOWS - 1, n_complete)
        factors = self.interval_factors[moment, torch.clamp(n_failed, max=self.interval_factors.shape[1] - 1)]
        blind = ~fibre_mask.any(dim=1) | (n_complete == 0)  # such a press may be anywhere
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

    def _predict(self, scaled: Tensor, fibre_mask: Tensor, x: Tensor, n_complete: Tensor) -> tuple[Tensor, Tensor]:
        """Return the targets (Q, N) and their standard deviations, as `network.predict` does."""
        outputs: Any = 0.0
        for name, phase in moments.PHASES[moments.N_TIMED].items():
            network = self.networks[name]
            answers = (n_complete >= phase.first) & (n_complete < phase.first + len(phase.shares))
            outputs = torch.where(answers[:, None], network(x), outputs)
        combined = combine_members(outputs, torch)
        if self.bayes is None:
            return combined
        corrected = combine_members(torch.cat([outputs, self.bayes(scaled, fibre_mask, x, n_complete)]), torch)
        is_corrected = (n_complete >= moments.BAYES_STAGES[0])[:, None]
        targets, std = (torch.where(is_corrected, *pair) for pair in zip(corrected, combined, strict=True))
        return targets, std

    def _follow(self, scaled: Tensor, fibre_mask: Tensor, complete: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return targets, standard deviations and the relative motion, as `Sliding.follow` does."""
        network, n_timed = self.networks[moments.SLIDE_NETWORK], moments.N_TIMED

        def predict_from(scaled: Tensor, n_complete: int) -> tuple[Tensor, Tensor]:
            x = network_inputs(scaled, fibre_mask, complete & (torch.arange(n_timed) < n_complete), torch)
            return combine_members(network(x), torch)

        targets, std = predict_from(scaled, moments.N_PRESS_WINDOWS)
        latest = []
        for k in range(len(moments.LATEST_WINDOWS)):
            window = moments.EARLY_WINDOWS - 1 - k
            latest.append(scaled[:, :, window] * self.latest_factor[:, k, window] + self.latest_offset[:, k, window])
        modulation = scaled[:, :, n_timed + len(latest) :]
        early = torch.cat([scaled[:, :, :n_timed], torch.stack(latest, dim=2), modulation], dim=2)
        early_targets, early_std = predict_from(early, moments.EARLY_WINDOWS)
        distance = torch.linalg.vector_norm((targets - early_targets)[:, :2], dim=1)
        expected = torch.linalg.vector_norm(early_std[:, :2], dim=1)
        return targets, std, distance / torch.clamp(expected, min=1e-9)


def _build_graph(model: LocalizerModel, digest: str) -> onnx.ModelProto:
    """Trace a localizer of method "ensemble" as a graph for any number of presses and readings."""
    arguments = tuple(map(torch.from_numpy, (*_synthetic_presses(model), np.ones((N_TRIALS, model.fibres), bool))))
    names = [*list(OUTPUTS)[:4], *(name for each in model.scaler.measures for name in MEASURE_COLUMNS[each.name])]
    axes = {"readings": {0: "readings"}} | {name: {0: "presses"} for name in [*list(INPUTS)[1:], *names]}
    content = io.BytesIO()
    with warnings.catch_warnings(), one_thread(), torch.no_grad():
        warnings.simplefilter("ignore")  # of the deprecated exporter, and of values that are traced as constants
        torch.onnx.export(
            _LocalizerModule(model),
            arguments,
            content,
            input_names=list(INPUTS),
            output_names=names,
            dynamic_axes=axes,
            opset_version=18,  # ONNX 1.13, 2022
            do_constant_folding=False,  # which would double the size
            dynamo=False,  # the other exporter needs onnxscript
        )
    graph = onnx.load_model_from_string(content.getvalue())
    for each in (*graph.graph.input, *graph.graph.output):
        each.doc_string = (INPUTS | OUTPUTS)[each.name]
    for each in graph.graph.output[:2]:  # the size of positions and deviations is traced as unknown
        each.type.tensor_type.shape.dim[1].dim_value = 2
    graph.producer_name = "padforge"
    metadata = {
        "format": FORMAT,
        "padforge": version("padforge"),
        "localizer_sha256": digest,
        "training_recording_sha256": model.training_recording_sha256,
        "features": model.features,
        "rate_hz": f"{frame_rate_hz(model.rate_hz):.9g}",
        "fibres": json.dumps([f"fibre_{fibre}_v" for fibre in range(model.fibres)]),
        "inputs": json.dumps(INPUTS),
        "outputs": json.dumps({name: OUTPUTS[name] for name in names}),
    }
    onnx.helper.set_model_props(graph, metadata)
    return graph


@dataclass(frozen=True)
class OnnxReport:
    """Size of a written graph, and its differences from its localizer."""

    size: int  # bytes of the file
    n_presses: int  # number of presses that it was tested on
    max_failures: int  # maximum number of fibres that were masked in the tests
    position_difference_mm: float  # the largest, like the next
    r90_difference_mm: float

    @property
    def text(self) -> str:
        failed = f"{self.max_failures} failed fibre{'s' * (self.max_failures != 1)}"
        return (
            f"{self.size / 1e6:.1f} MB, tested on {self.n_presses} presses and at every moment of one, with up to "
            f"{failed}: positions within {1e3 * self.position_difference_mm:.2f} µm of the "
            f"localizer's, radii within {1e3 * self.r90_difference_mm:.2f} µm"
        )


def export_onnx(model: LocalizerModel, digest: str, path: Path, recording: Recording | None = None) -> OnnxReport:
    """Write a localizer, whose `localizer.json` has the SHA-256 `digest`, as an ONNX graph.

    The graph is tested on the presses of a recording, or on synthetic ones. Raises InputError for a localizer of the
    published method or of arrays, a recording of another pad or rate, or a path that cannot be written; Fault if
    positions differ by more than MAX_DIFFERENCE_MM.
    """
    if model.method != "ensemble":
        raise InputError(f"the localizer is of method {model.method}, expected ensemble: calibrate again")
    if model.features != "windows":
        raise InputError(f"the localizer is of features {model.features}, expected windows: calibrate on a recording")
    if recording is not None:
        model.check_recording(recording)
        frames = framed(recording)
        trial = frames.readings, frames.down_command, frames.up_command
    else:
        trial = _synthetic_presses(model)
    content = _build_graph(model, digest).SerializeToString()
    positions, radii = _compare(model, content, *trial)
    if not positions <= MAX_DIFFERENCE_MM:
        raise Fault(
            f"{path}: not written, positions by onnxruntime differ by {positions:.2g} mm from those of the localizer, "
            f"allowed are {MAX_DIFFERENCE_MM:g} mm"
        )
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)
    return OnnxReport(len(content), len(trial[1]), model.max_failures, positions, radii)


def _synthetic_presses(model: LocalizerModel) -> tuple[Array, Indices, Indices]:
    """Return readings of noise and presses of the size of those in the training, and their commands."""
    rng, scaler = np.random.default_rng(0), model.scaler
    down_command = TRIAL_READINGS // 2 + TRIAL_READINGS * np.arange(N_TRIALS)
    up_command = down_command + moments.PRESS_WINDOWS[-1][1]
    readings = 1e-3 * rng.standard_normal(((N_TRIALS + 1) * TRIAL_READINGS, model.fibres))
    response = np.abs(scaler.mean_v).max(axis=1) + scaler.scale_v.max(axis=1)
    for first, end in zip(down_command, up_command, strict=True):
        readings[first:end] += response * rng.uniform(-1, 1, model.fibres)
    return readings, down_command, up_command


def _compare(
    model: LocalizerModel, content: bytes, readings: Array, down_command: Indices, up_command: Indices
) -> tuple[float, float]:
    """Return the largest differences of positions and of radii, mm: complete presses, and every moment of the last."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    filled, last, with_previous = interpolate_gaps(readings), slice(-1, None), slice(-2, None)
    commands = down_command, up_command
    # The readings after the last press may end before all of its windows are complete.
    ends = {min(int(moments.complete_at(n, *commands)[-1]), len(readings)) for n in range(1, moments.N_TIMED + 1)}
    trials = [(slice(None), compute_features(readings, *commands), filled, *commands)]
    for end in sorted(end for end in ends if end > down_command[-1] + 1):
        until = np.full(len(down_command), end)
        so_far = filled[:end], down_command[with_previous], np.minimum(up_command, end)[with_previous]
        trials.append((last, compute_features(readings, *commands, until)[with_previous], *so_far))
    rng, differences = np.random.default_rng(0), []
    for rows, raw, *arguments in trials:
        presses = model.scaler.transform(raw)
        for n_failed in range(model.max_failures + 1):
            # In every press another random set of fibres is masked.
            fibre_mask = presses.fibre_mask & (rng.random(presses.fibre_mask.shape).argsort(axis=1) >= n_failed)
            expected = model.predict_features(replace(presses, fibre_mask=fibre_mask))
            inputs = dict(zip(INPUTS, (*arguments, fibre_mask), strict=True))
            positions_mm, r90_mm = map(np.asarray, session.run(["positions_mm", "r90_mm"], inputs))
            distance = np.hypot(*(positions_mm - expected.positions_mm).T)
            differences.append((distance[rows].max(), np.abs(r90_mm - expected.r90_mm)[rows].max()))
    positions, radii = np.max(differences, axis=0)
    return float(positions), float(radii)
