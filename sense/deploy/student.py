"""The student: a small network, taught by the localizer, for what a microcontroller has seen by the end of a press."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from padforge.design.common.parallel import one_torch_thread
from padforge.sense.arrays import Array, Floats, Indices, Mask
from padforge.sense.deploy.streaming import LAYERS, Budget, Detector, Seen, commanded, owners, seen, widest
from padforge.sense.localizer.calibration import (
    CALIBRATION_SHARE,
    calibrate_intervals,
    check_trained,
    fit_recording,
    split_presses,
    split_unseen,
)
from padforge.sense.localizer.evaluation import distances, errors_by_loss
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.localizer.model_files import check_same_pad
from padforge.sense.localizer.network import Weights
from padforge.sense.localizer.scaler import FeatureScaler, TrainingPresses
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import LocalizerSettings

TRUSTED = 0.5
"""Share of what the teacher finds in what a press is taught as, beside what is known of it."""
LONGER = 4
"""How much longer than a localizer a student is trained, which has no observer beside it; its steps are short."""
MOST_INT8 = 127


class Matrix(NamedTuple):
    """A layer y = b + w x: (out, in) `rows` of w, float32, or int8 with a `scale` (out,) each; (out,) `bias`."""

    rows: Array
    bias: Floats
    scale: Floats | None


@dataclass(frozen=True)
class Student:
    """What `localizer.h` holds.

    Attributes:
        localizer: takes what is `commanded` or `seen`, scaled by its own normalisation; of int8, its weights are what
            these come to.
        detector: finds touches.
        quantized: whether the weights are int8.
    """

    localizer: LocalizerModel
    detector: Detector
    quantized: bool

    @property
    def hidden(self) -> int:
        """Neurons of a layer."""
        return self.localizer.weights["first.w"].shape[2]

    def touches(
        self, readings: Array, held: Mask | None = None, lost: tuple[int, ...] = ()
    ) -> tuple[Seen, Localization]:
        """What `localizer.h` tells of (R, C) readings, V: the presses it sees, and their places.

        Args:
            held: (R,) whether the pad is pressed, where somebody else says so. lost: fibres left out, by index.
        """
        fibre_mask = ~np.isin(np.arange(self.localizer.fibres), lost)
        presses = seen(readings, self.detector, held, fibre_mask)
        shown = self.localizer.scaler.transform(presses.inputs)
        return presses, self.localizer.predict_features(replace(shown, fibre_mask=shown.fibre_mask & fibre_mask))

    def matrices(self) -> dict[str, Matrix]:
        """The layers in order, by name."""
        weights = self.localizer.weights
        pairs = {"first": (weights["first.w"][0], weights["first.b"][0, 0])}
        for number, (w, b) in enumerate(zip(weights["hidden.w"], weights["hidden.b"], strict=True)):
            pairs[f"hidden_{number}"] = (w[0], b[0, 0])
        pairs["last"] = (weights["last.w"][0], weights["last.b"][0, 0])
        out = {}
        for name, (w, b) in pairs.items():
            scale = scales(w) if self.quantized else None
            rows = w.T if scale is None else np.rint(w / scale).astype(np.int8).T
            out[name] = Matrix(rows, b, None if scale is None else scale)
        return out


def scales(w: Floats) -> Floats:
    """(out,) what 1 of an int8 is worth in each column of (in, out) weights."""
    most = np.abs(w).max(axis=-2)
    return np.where(most > 0, most / np.float32(MOST_INT8), np.float32(1)).astype(np.float32)


def as_int8(weights: Weights) -> dict[str, Floats]:
    """Weights as int8 with a scale for each output give them back; biases stay as they are."""

    def rounded(w: Floats) -> Floats:
        scale = scales(w)[..., None, :]
        return (np.rint(w / scale) * scale).astype(np.float32)

    return {name: rounded(w) if name.endswith(".w") else w for name, w in weights.items()}


@dataclass(frozen=True)
class Lessons:
    """What presses are taught as: (Q, 2) places in mm, and (Q,) of each measure."""

    positions_mm: Array
    measures: Mapping[str, Array]

    def __getitem__(self, presses: Indices) -> "Lessons":
        return Lessons(self.positions_mm[presses], {name: values[presses] for name, values in self.measures.items()})

    @classmethod
    def of(cls, recording: Recording, teacher: LocalizerModel) -> "Lessons":
        """Of every press, between what is known of it and what the teacher finds, or the latter."""
        found = teacher.predict_features(teacher.scaled_features(recording))

        def between(known: Array, told: Array) -> Array:
            return np.where(np.isnan(known), told, (1 - TRUSTED) * known + TRUSTED * told)

        measures = {name: between(recording.measures[name], each.values) for name, each in found.measures.items()}
        return cls(between(recording.presses_mm, found.positions_mm), measures)


def teach(
    recording: Recording,
    teacher: LocalizerModel,
    training: Indices,
    budget: Budget,
    options: LocalizerSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Student:
    """Train a student on the presses `training` of a recording, by index, whose places are known.

    Each press is shown as it was commanded and, where the detector finds it, as the detector does.

    Args:
        options: how long and how fast to learn, and the seed; size, loss and inputs are the student's own.

    Raises:
        InputError: a budget that is too small, too few presses, or a training that diverged.
    """
    rng = np.random.default_rng(options.seed)
    taught, checked = (
        training[part] for part in split_presses(len(training), options.split, CALIBRATION_SHARE["ensemble"], rng, 2)
    )
    lessons, levels = Lessons.of(recording, teacher), len(teacher.interval_factors)
    hidden = widest(teacher.fibres, len(lessons.measures), levels, budget)
    detector, plain = Detector.fit(recording, training), commanded(recording)
    found = seen(recording.readings, detector)
    press = owners(recording, found.down_command)
    also = np.flatnonzero(np.isin(press, taught))
    shown, rows = plain[taught] + found.inputs[also], np.concatenate([taught, press[also]])
    scaling, table = FeatureScaler.fit(shown, lessons[rows].positions_mm, lessons[rows].measures)
    size = {
        "members": 1,
        "hidden": hidden,
        "layers": LAYERS,
        "max_failures": levels - 1,
        "epochs": LONGER * options.epochs,
    }
    # LONGER alone says for how long, whichever features the localizer is to take.
    own = options.model_copy(update={**size, "features": "press_and_release"})
    weights = _trained(_samples(scaling, shown, lessons[rows]), table, scaling, own, rng, progress)
    localizer = LocalizerModel(
        weights=as_int8(weights) if budget.quantized else weights,
        scaler=scaling,
        table=table,
        method="ensemble",
        features="causal",
        interval_factors=np.ones((1, 3 + len(lessons.measures))),
        rate_hz=recording.rate_hz,
        training_recording_sha256=recording.digest,
    )
    known = {name: recording.measures[name][checked] for name in lessons.measures}
    factors = calibrate_intervals(
        localizer, scaling.transform(plain[checked]), recording.presses_mm[checked], levels, known
    )
    return Student(replace(localizer, interval_factors=factors), detector, budget.quantized)


def _samples(scaling: FeatureScaler, inputs: PressFeatures, lessons: Lessons) -> TrainingPresses:
    return scaling.training_presses(inputs, lessons.positions_mm, lessons.measures)


def _trained(
    learn: TrainingPresses,
    table: Floats,
    scaling: FeatureScaler,
    options: LocalizerSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None],
) -> Weights:
    from padforge.sense.localizer.training import train_members

    with one_torch_thread():
        weights = train_members(learn, table, options, rng, progress).weights
    check_trained(weights, {}, scaling, options)
    return weights


def split(recording: Recording, teacher: LocalizerModel, options: LocalizerSettings) -> tuple[Indices, Indices]:
    """Presses of known place to learn from, and those to test on, which neither the student nor the teacher learns.

    Raises:
        InputError: the teacher was recalibrated by the recording, or there are too few presses.
    """
    check_same_pad(teacher, "the localizer", recording.fibres, recording.rate_hz)
    return split_unseen(recording, teacher, options)


def causal_beside(
    teacher: LocalizerModel,
    recording: Recording,
    training: Indices,
    options: LocalizerSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> LocalizerModel:
    """A localizer of full size that knows what can be known by the end of a press, as the student does.

    It is the teacher, or one trained here on the presses `training` of a recording, by index.

    Raises:
        InputError: as `calibration.fit_model`.
    """
    if teacher.features == "causal":
        return teacher
    options = options.model_copy(
        update={"features": "causal", "method": "ensemble", "max_failures": len(teacher.interval_factors) - 1}
    )
    with one_torch_thread():
        return fit_recording(recording, training, options, np.random.default_rng(options.seed), progress)


def examine(student: Student, beside: Sequence[LocalizerModel], recording: Recording, test: Indices) -> dict[str, Any]:
    """How far off a student is on the presses `test`, by index, beside localizers.

    Returns:
        "errors", by "header" and the features of the localizers: rows as `evaluation.evaluate` has them; "found", how
        many of the presses the detector finds, "false", how many more it finds from the first to the last reading of
        them, and "predicted_mm", the mean error of those found.
    """
    positions_mm, localizer = recording.presses_mm[test], student.localizer
    shown = {"header": (localizer, localizer.scaler.transform(commanded(recording)[test]))}
    shown |= {each.features: (each, each.scaled_features(recording)[test]) for each in beside}
    levels = range(len(localizer.interval_factors))
    rows = {
        name: errors_by_loss(model.fibres, levels, partial(model.predict_features, inputs), positions_mm)[0]
        for name, (model, inputs) in shown.items()
    }
    presses, found = student.touches(recording.readings)
    press = owners(recording, presses.down_command)
    own = np.flatnonzero(np.isin(press, test))
    false = int(np.isin(-1 - press, test).sum())
    off = distances(found.positions_mm[own], recording.presses_mm[press[own]])
    mean = float(off.mean()) if len(own) else None
    return {"errors": rows, "found": len(own), "false": false, "predicted_mm": mean}
