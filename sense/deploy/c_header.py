"""`localizer.h`: a student network as one C99 file, rendered from the template `localizer.h.j2`.

The student is a small network distilled from the localizer, for what a microcontroller knows at any moment of a press.
Knowledge distillation (Hinton et al. 2015, "Distilling the knowledge in a neural network"): the targets are halfway
between the true positions and those that the localizer, the teacher, predicts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from padforge.design.common.files import write_text
from padforge.design.common.parallel import one_torch_thread
from padforge.design.common.progress import OnProgress, ignore_progress
from padforge.sense.arrays import Array, Floats, Indices, Mask
from padforge.sense.deploy import streaming
from padforge.sense.deploy.streaming import CODE_BYTES, N_LAYERS, N_WINDOWS, MemoryBudget, ThresholdDetector
from padforge.sense.localizer import model as localizer_model
from padforge.sense.localizer import network
from padforge.sense.localizer import scaler as feature_scaler
from padforge.sense.localizer.calibration import (
    CALIBRATION_SHARE,
    calibrate_uncertainty,
    check_trained,
    split_presses,
    split_unseen,
)
from padforge.sense.localizer.evaluation import distances, errors_by_loss
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.localizer.model_files import check_same_pad
from padforge.sense.localizer.network import Weights
from padforge.sense.localizer.scaler import FeatureScaler
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import LocalizerSettings

TEACHER_WEIGHT = 0.5  # of the teacher's predictions in the targets
EPOCHS_FACTOR = 4  # by which its training is longer than a localizer's: it has no Bayesian one, and its steps are short
MAX_INT8 = 127
WRAP_AT, WRAP_BY = 2**30, 2**29  # readings at which the 32-bit counter goes back, and by how many
LINE = 118  # characters


@dataclass(frozen=True)
class StudentNetwork:
    """What `localizer.h` holds."""

    model: LocalizerModel  # one network, of the features of `stream_presses`; int8 weights are dequantized in it
    detector: ThresholdDetector
    quantized: bool  # to int8

    @property
    def weights(self) -> Weights:
        """Of its network, which answers at every moment."""
        (weights,) = self.model.networks.values()
        return weights

    @property
    def hidden(self) -> int:
        """Neurons of a layer."""
        return self.weights["first.w"].shape[2]

    @property
    def table_bytes(self) -> int:
        """Bytes of flash beside the code."""
        n_measures, n_levels = len(self.model.scaler.measures), self.model.max_failures + 1
        return streaming.table_bytes(self.model.fibres, n_measures, n_levels, self.hidden, self.quantized)

    @property
    def state_bytes(self) -> int:
        """Bytes of RAM, at most."""
        return streaming.state_bytes(self.model.fibres, len(self.model.scaler.measures), self.hidden)

    def predict(
        self, readings: Array, pressed: Mask | None = None, failed: tuple[int, ...] = ()
    ) -> tuple[streaming.StreamedPresses, Localization]:
        """Detect presses and localize them with every estimate, as `localizer.h` does.

        `pressed` (R,) is None for the detector to decide.
        """
        fibre_mask = ~np.isin(np.arange(self.model.fibres), failed)
        presses = streaming.stream_presses(readings, self.detector, pressed, fibre_mask)
        scaled = self.model.scaler.transform(presses.features)
        return presses, self.model.predict_features(replace(scaled, fibre_mask=scaled.fibre_mask & fibre_mask))


def quantize(weights: Weights) -> dict[str, Floats]:
    """Round weights to int8 with a scale for each output, and dequantize them; biases stay as they are."""

    def rounded(w: Floats) -> Floats:
        scale = _int8_scale(w)
        return (np.rint(w / scale) * scale).astype(np.float32)

    return {name: rounded(w) if name.endswith(".w") else w for name, w in weights.items()}


def _int8_scale(w: Floats) -> Floats:
    """Return the (..., 1, out) value of 1 as int8 in each column of (..., in, out) weights."""
    largest = np.abs(w).max(axis=-2, keepdims=True)
    return np.where(largest > 0, largest / np.float32(MAX_INT8), np.float32(1)).astype(np.float32)


def _distillation_targets(
    recording: Recording, teacher: LocalizerModel, presses: Indices
) -> tuple[Array, dict[str, Array]]:
    """Mix positions and measures of presses with the predictions of the teacher, used alone where one is unknown."""
    prediction = teacher.predict(recording)

    def mix(true: Array, predicted: Array) -> Array:
        mixed = (1 - TEACHER_WEIGHT) * true + TEACHER_WEIGHT * predicted
        return np.where(np.isnan(true), predicted, mixed)[presses]

    measures = {name: mix(recording.measures[name], each.values) for name, each in prediction.measures.items()}
    return mix(recording.presses_mm, prediction.positions_mm), measures


def distill(
    recording: Recording,
    teacher: LocalizerModel,
    training: Indices,
    budget: MemoryBudget,
    options: LocalizerSettings,
    on_progress: OnProgress = ignore_progress,
) -> StudentNetwork:
    """Train a student as large as the budget allows, on presses of known position at random moments.

    Every press is used with the features of its command and, where the detector finds it, with those of its detection.
    Raises InputError if the budget is too small, there are too few presses, or the training diverged.
    """
    from padforge.sense.localizer.training import train_members

    rng = np.random.default_rng(options.seed)
    detector = ThresholdDetector.fit(recording, training)
    shares = split_presses(len(training), options.split, CALIBRATION_SHARE["ensemble"], rng, min_training=2)
    training, calibration = (training[share] for share in shares)
    n_measures, n_levels = len(teacher.scaler.measures), teacher.max_failures + 1
    hidden = streaming.max_hidden(teacher.fibres, n_measures, n_levels, budget)
    detected = streaming.stream_presses(recording.readings, detector)
    press, at_end = streaming.match_presses(recording, detected.down_command), detected.features[detected.last]
    matched = np.flatnonzero(np.isin(press, training) & at_end.seen.all(axis=1))
    features = streaming.commanded_features(recording)[training] + at_end[matched]
    positions_mm, measures = _distillation_targets(recording, teacher, np.concatenate([training, press[matched]]))
    scaler, table = FeatureScaler.fit(features, positions_mm, measures)
    size = {"members": 1, "hidden": hidden, "layers": N_LAYERS, "max_failures": n_levels - 1}
    options = options.model_copy(update=size | {"epochs": EPOCHS_FACTOR * options.epochs})
    presses = scaler.training_presses(features, positions_mm, measures, recording.rate_hz)
    with one_torch_thread():
        networks = train_members(presses, table, options, rng, on_progress).networks
    check_trained(networks, {}, scaler, options, N_WINDOWS)
    model = LocalizerModel(
        networks={name: quantize(each) if budget.quantized else each for name, each in networks.items()},
        scaler=scaler,
        table=table,
        method="ensemble",
        features="windows",
        interval_factors=np.ones((N_WINDOWS + 1, 1, 3 + n_measures)),
        rate_hz=recording.rate_hz,
        training_recording_sha256=recording.digest,
    )
    moments = [
        scaler.transform(streaming.commanded_features(recording, n_complete)[calibration])
        for n_complete in range(1, N_WINDOWS + 1)
    ]
    true_measures = {name: recording.measures[name][calibration] for name in measures}
    model = calibrate_uncertainty(model, moments, recording.presses_mm[calibration], n_levels, true_measures)
    return StudentNetwork(model, detector, budget.quantized)


def evaluate_student(
    student: StudentNetwork, teacher: LocalizerModel, recording: Recording, test: Indices
) -> dict[str, Any]:
    """Evaluate a student and its teacher on presses of known position.

    "errors" are by "header" at the end of the press, and of the teacher "at the end" and of the "whole press" with the
    readings after it, a row a number of failed fibres; "n_false" counts false detections after those presses, each up
    to the next; "detected_mean_mm" is None if none is detected.
    """
    positions_mm, model = recording.presses_mm[test], student.model
    compared = {
        "header": (model, model.scaler.transform(streaming.commanded_features(recording)[test])),
        "at the end": (teacher, teacher.scaled_features(recording, recording.up_command)[test]),
        "whole press": (teacher, teacher.scaled_features(recording)[test]),
    }
    levels = range(model.max_failures + 1)
    errors = {
        name: errors_by_loss(each.fibres, levels, partial(each.predict_features, features), positions_mm)[0]
        for name, (each, features) in compared.items()
    }
    presses, prediction = student.predict(recording.readings)
    press = streaming.match_presses(recording, presses.down_command)
    detected = np.flatnonzero(np.isin(press, test))
    at_end = prediction.positions_mm[presses.last[detected]]
    distance = distances(at_end, recording.presses_mm[press[detected]])
    return {
        "errors": errors,
        "n_detected": len(detected),
        "n_false": int(np.isin(-1 - press, test).sum()),
        "detected_mean_mm": float(distance.mean()) if len(detected) else None,
    }


@dataclass(frozen=True)
class HeaderReport:
    """A written header, and the errors of the student in it."""

    student: StudentNetwork
    evaluation: Mapping[str, Any]  # see `evaluate_student`
    n_test: int

    def lines(self, budget: MemoryBudget) -> list[str]:
        """Return the report as text, beside the budget that it was made for."""
        student, evaluation = self.student, self.evaluation
        kind = "int8" if student.quantized else "float32"
        flash = f"flash {(student.table_bytes + CODE_BYTES) / 1024:.1f} KiB of {budget.flash / 1024:.4g}"
        columns: Mapping[str, Any] = evaluation["errors"]
        width = max(7, *map(len, columns))
        lines = [
            f"{student.hidden} neurons in each of {N_LAYERS + 1} layers, {kind}: {flash}, {CODE_BYTES / 1024:g} of "
            f"them for code; RAM {student.state_bytes / 1024:.1f} KiB of {budget.ram / 1024:.4g}",
            f"mean error in mm on {self.n_test} presses never trained on",
            "failed  sets" + "".join(f" {name:>{width}}" for name in columns),
        ]
        for row in zip(*columns.values(), strict=True):
            means = "".join(f" {each['mean_mm']:{width}.2f}" for each in row)
            lines.append(f"{row[0]['n_failed']:6d} {row[0]['subsets']:5d}{means}")
        mean_mm = evaluation["detected_mean_mm"]
        of_detected = "" if mean_mm is None else f"; mean error of these {mean_mm:.2f} mm"
        lines.append(
            f"its own detector detects {evaluation['n_detected']} of {self.n_test} presses, "
            f"with {evaluation['n_false']} false detections{of_detected}"
        )
        return lines


def export_header(
    teacher: LocalizerModel,
    digest: str,
    path: Path,
    recording: Recording,
    budget: MemoryBudget,
    options: LocalizerSettings,
    on_progress: OnProgress = ignore_progress,
) -> HeaderReport:
    """Distill a localizer, whose `localizer.json` has the SHA-256 `digest`, into a student, and write that as C header.

    The student is trained and tested on presses of a recording; options are length, rate and seed of the training.
    Raises InputError as `distill`, for a recording that cannot train or test it, or a path that cannot be written.
    """
    check_same_pad(teacher, "the localizer", recording.fibres, recording.rate_hz)
    training, test = split_unseen(recording, teacher, options)
    student = distill(recording, teacher, training, budget, options, on_progress)
    evaluation = evaluate_student(student, teacher, recording, test)
    about = [
        f"by padforge {version('padforge')}, of localizer.json with SHA-256",
        digest,
        f"A simple detector detects touches: {evaluation['n_detected']} of {len(test)} presses, "
        f"with {evaluation['n_false']} false detections.",
        f"Mean error on these presses, never trained on: {evaluation['errors']['header'][0]['mean_mm']:.2f} mm.",
    ]
    write_text(path, render_header(student, budget, about))
    return HeaderReport(student, evaluation, len(test))


def render_header(student: StudentNetwork, budget: MemoryBudget, about: Sequence[str]) -> str:
    """Render the template; beyond the budget, the header does not compile. `about` is lines of its first comment."""
    environment = Environment(
        loader=PackageLoader("padforge.sense.deploy", "."), undefined=StrictUndefined, keep_trailing_newline=True
    )
    environment.filters |= {"f": _float, "literal": _literal, "numbers": _numbers}
    modules = map(vars, (network, feature_scaler, localizer_model, streaming))  # the features are those of the stream
    constants = {name: value for module in modules for name, value in module.items() if name.isupper()}
    return environment.get_template("localizer.h.j2").render(
        constants | {"WRAP_AT": WRAP_AT, "WRAP_BY": WRAP_BY},
        about=about,
        budget=budget,
        model=student.model,
        scaler=student.model.scaler,
        detector=student.detector,
        hidden=student.hidden,
        quantized=student.quantized,
        tables=_tables(student),
    )


def _tables(student: StudentNetwork) -> dict[str, Any]:
    scaler, weights = student.model.scaler, student.weights
    units = [scaler.scale_mm] * 2 + [measure.scale for measure in scaler.measures]
    tables: dict[str, Any] = {
        "rates": streaming.RATES,
        "inverse_noise": student.detector.inverse_noise,
        "mean": scaler.mean_v,
        "scale": scaler.scale_v,
        "history_coef": scaler.history_coef,
        "history_mean": scaler.history_mean_v,
        "interval_factors": student.model.interval_factors[1:, :, 1:] * units,  # of the radii, not of the deviation
    }
    names = ["first", *(f"hidden_{number}" for number in range(N_LAYERS)), "last"]
    layers = [weights["first.w"], *weights["hidden.w"], weights["last.w"]]
    biases = [weights["first.b"], *weights["hidden.b"], weights["last.b"]]
    for name, (w,), bias in zip(names, layers, biases, strict=True):  # of the one member
        tables[f"{name}_b"] = bias
        if student.quantized:
            scale = tables[f"{name}_scale"] = _int8_scale(w)
            tables[f"{name}_w"] = np.rint(w / scale).astype(np.int8).T
        else:
            tables[f"{name}_w"] = w.T
    return tables


def _numbers(table: Array | Floats) -> str:
    texts = map(str if table.dtype.kind == "i" else _float, table.ravel().tolist())
    return fill(", ".join(texts), LINE, initial_indent="  ", subsequent_indent="  ")


def _float(value: float) -> str:
    """Write a number as C reads it back to the same float."""
    return _literal(f"{np.float32(value):.9g}")


def _literal(number: str) -> str:
    """Write digits as a float of C, which 13f is not."""
    return f"{number}f" if set(".e") & set(number) else f"{number}.0f"
