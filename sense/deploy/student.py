"""The student: a small network distilled from the localizer, for what a microcontroller knows at the end of a press.

Knowledge distillation (Hinton et al. 2015, "Distilling the knowledge in a neural network"): the targets are halfway
between the true positions and those that the localizer, the teacher, predicts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from padforge.design.common.parallel import one_torch_thread
from padforge.sense.arrays import Array, Floats, Indices, Mask
from padforge.sense.deploy import streaming
from padforge.sense.localizer.calibration import (
    CALIBRATION_SHARE,
    calibrate_intervals,
    check_trained,
    fit_recording,
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

Measures = dict[str, Array]


class Layer(NamedTuple):
    """A layer y = b + W x."""

    weights: Array  # W (out, in), float32 or int8
    bias: Floats
    scale: Floats | None  # (out,) that rows of int8 are multiplied by; None for float32


@dataclass(frozen=True)
class StudentNetwork:
    """What `localizer.h` holds."""

    model: LocalizerModel  # one member, of the features of `stream_presses`; int8 weights are dequantized in it
    detector: streaming.ThresholdDetector
    quantized: bool  # to int8

    @property
    def hidden(self) -> int:
        """Neurons of a layer."""
        return self.model.weights["first.w"].shape[2]

    def predict(
        self, readings: Array, pressed: Mask | None = None, failed: tuple[int, ...] = ()
    ) -> tuple[streaming.StreamedPresses, Localization]:
        """Detect and localize presses as `localizer.h` does; `pressed` (R,) is None for the detector to decide."""
        fibre_mask = ~np.isin(np.arange(self.model.fibres), failed)
        presses = streaming.stream_presses(readings, self.detector, pressed, fibre_mask)
        scaled = self.model.scaler.transform(presses.features)
        return presses, self.model.predict_features(replace(scaled, fibre_mask=scaled.fibre_mask & fibre_mask))

    def layers(self) -> dict[str, Layer]:
        """Return the layers in order, by name."""
        weights, layers = self.model.weights, {}
        pairs = {"first": (weights["first.w"], weights["first.b"])}
        for number, pair in enumerate(zip(weights["hidden.w"], weights["hidden.b"], strict=True)):
            pairs[f"hidden_{number}"] = pair
        pairs["last"] = weights["last.w"], weights["last.b"]
        for name, ((w,), ((b,),)) in pairs.items():  # of the one member
            scale = _int8_scale(w) if self.quantized else None
            layers[name] = Layer(w.T if scale is None else np.rint(w / scale).astype(np.int8).T, b, scale)
        return layers


def _int8_scale(w: Floats) -> Floats:
    """Return the (..., out) value of 1 as int8 in each column of (..., in, out) weights."""
    largest = np.abs(w).max(axis=-2)
    return np.where(largest > 0, largest / np.float32(MAX_INT8), np.float32(1)).astype(np.float32)


def quantize(weights: Weights) -> dict[str, Floats]:
    """Round weights to int8 with a scale for each output, and dequantize them; biases stay as they are."""

    def rounded(w: Floats) -> Floats:
        scale = _int8_scale(w)[..., None, :]
        return (np.rint(w / scale) * scale).astype(np.float32)

    return {name: rounded(w) if name.endswith(".w") else w for name, w in weights.items()}


def _distillation_targets(recording: Recording, teacher: LocalizerModel, presses: Indices) -> tuple[Array, Measures]:
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
    budget: streaming.MemoryBudget,
    options: LocalizerSettings,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> StudentNetwork:
    """Train a student as large as the budget allows, on presses of known position.

    Every press is used with the features of its command and, where the detector finds it, with those of its detection.

    Raises:
        InputError: the budget is too small, there are too few presses, or the training diverged.
    """
    from padforge.sense.localizer.training import train_members

    rng = np.random.default_rng(options.seed)
    detector = streaming.ThresholdDetector.fit(recording, training)
    shares = split_presses(len(training), options.split, CALIBRATION_SHARE["ensemble"], rng, min_training=2)
    training, calibration = (training[share] for share in shares)
    n_measures, n_levels = len(teacher.scaler.measures), len(teacher.interval_factors)
    hidden = streaming.max_hidden(teacher.fibres, n_measures, n_levels, budget)
    commanded = streaming.commanded_features(recording)
    detected = streaming.stream_presses(recording.readings, detector)
    press = streaming.match_presses(recording, detected.down_command)
    matched = np.flatnonzero(np.isin(press, training))
    features = commanded[training] + detected.features[matched]
    positions_mm, measures = _distillation_targets(recording, teacher, np.concatenate([training, press[matched]]))
    scaler, table = FeatureScaler.fit(features, positions_mm, measures)
    size = {"members": 1, "hidden": hidden, "layers": streaming.N_LAYERS, "max_failures": n_levels - 1}
    # `train_members` lengthens the training of other features by a factor of its own.
    length = {"epochs": EPOCHS_FACTOR * options.epochs, "features": "press_and_release"}
    options = options.model_copy(update=size | length)
    presses = scaler.training_presses(features, positions_mm, measures)
    with one_torch_thread():
        weights = train_members(presses, table, options, rng, on_progress).weights
    check_trained(weights, {}, scaler, options)
    model = LocalizerModel(
        weights=quantize(weights) if budget.quantized else weights,
        scaler=scaler,
        table=table,
        method="ensemble",
        features="causal",
        interval_factors=np.ones((1, 3 + n_measures)),
        rate_hz=recording.rate_hz,
        training_recording_sha256=recording.digest,
    )
    scaled, positions_mm = scaler.transform(commanded[calibration]), recording.presses_mm[calibration]
    true_measures = {name: recording.measures[name][calibration] for name in measures}
    factors = calibrate_intervals(model, scaled, positions_mm, n_levels, true_measures)
    return StudentNetwork(replace(model, interval_factors=factors), detector, budget.quantized)


def split_student_presses(
    recording: Recording, teacher: LocalizerModel, options: LocalizerSettings
) -> tuple[Indices, Indices]:
    """Return presses to train on, and those to test on, which the teacher was not trained on either."""
    check_same_pad(teacher, "the localizer", recording.fibres, recording.rate_hz)
    return split_unseen(recording, teacher, options)


def causal_reference(
    teacher: LocalizerModel,
    recording: Recording,
    training: Indices,
    options: LocalizerSettings,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> LocalizerModel:
    """Return the teacher or a localizer of its size that, as the student, uses no readings after the end of a press."""
    if teacher.features == "causal":
        return teacher
    max_failures = len(teacher.interval_factors) - 1
    update = {"features": "causal", "method": "ensemble", "max_failures": max_failures}
    with one_torch_thread():
        rng = np.random.default_rng(options.seed)
        return fit_recording(recording, training, options.model_copy(update=update), rng, on_progress)


def evaluate_student(
    student: StudentNetwork, references: Sequence[LocalizerModel], recording: Recording, test: Indices
) -> dict[str, Any]:
    """Evaluate a student, and localizers to compare it with, on presses of known position.

    Returns:
        "errors": by "header" and the features of the localizers, a row for each number of failed fibres;
        "n_detected": how many presses the detector finds; "n_false": its false detections after them, each up to the
        next press; "detected_mean_mm": mean error of those detected, None if there are none.
    """
    positions_mm, model = recording.presses_mm[test], student.model
    compared = {"header": (model, model.scaler.transform(streaming.commanded_features(recording)[test]))}
    compared |= {each.features: (each, each.scaled_features(recording)[test]) for each in references}
    levels = range(len(model.interval_factors))
    errors = {
        name: errors_by_loss(each.fibres, levels, partial(each.predict_features, features), positions_mm)[0]
        for name, (each, features) in compared.items()
    }
    presses, prediction = student.predict(recording.readings)
    press = streaming.match_presses(recording, presses.down_command)
    detected = np.flatnonzero(np.isin(press, test))
    distance = distances(prediction.positions_mm[detected], recording.presses_mm[press[detected]])
    return {
        "errors": errors,
        "n_detected": len(detected),
        "n_false": int(np.isin(-1 - press, test).sum()),
        "detected_mean_mm": float(distance.mean()) if len(detected) else None,
    }
