"""The student: a small network, taught by the localizer, for what a microcontroller has seen by the end of a press."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from padforge.design.common.parallel import one_torch_thread
from padforge.design.common.validation import InputError
from padforge.sense.arrays import Array, Floats, Indices, Mask
from padforge.sense.deploy.streaming import LAYERS, Budget, Detector, Seen, commanded, owners, seen, widest
from padforge.sense.localizer.calibration import CHECKED, learn, radii, split_presses, split_unseen
from padforge.sense.localizer.evaluation import distances, errors_by_loss
from padforge.sense.localizer.features import Inputs, Normalization, TrainingPresses
from padforge.sense.localizer.localizer import Found, Localizer
from padforge.sense.localizer.model_files import refuse_other_pad
from padforge.sense.localizer.network import Weights, refuse_unsound
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

    localizer: Localizer
    detector: Detector
    quantized: bool

    @property
    def hidden(self) -> int:
        """Neurons of a layer."""
        return self.localizer.weights["first.w"].shape[2]

    def touches(self, readings: Array, held: Mask | None = None, lost: tuple[int, ...] = ()) -> tuple[Seen, Found]:
        """What `localizer.h` tells of (R, C) readings, V: the presses it sees, and their places.

        Args:
            held: (R,) whether the pad is pressed, where somebody else says so. lost: fibres left out, by index.
        """
        alive = ~np.isin(np.arange(self.localizer.fibres), lost)
        presses = seen(readings, self.detector, held, alive)
        shown = self.localizer.normalization.inputs(presses.inputs)
        return presses, self.localizer.locate(replace(shown, alive=shown.alive & alive))

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

    places_mm: Array
    measures: Mapping[str, Array]

    def __getitem__(self, presses: Indices) -> "Lessons":
        return Lessons(self.places_mm[presses], {name: values[presses] for name, values in self.measures.items()})

    @classmethod
    def of(cls, recording: Recording, teacher: Localizer) -> "Lessons":
        """Of every press, between what is known of it and what the teacher finds, or the latter."""
        found = teacher.locate(teacher.inputs(recording))

        def between(known: Array, told: Array) -> Array:
            return np.where(np.isnan(known), told, (1 - TRUSTED) * known + TRUSTED * told)

        measures = {name: between(recording.measures[name], each.values) for name, each in found.measures.items()}
        return cls(between(recording.presses_mm, found.places_mm), measures)


def teach(
    recording: Recording,
    teacher: Localizer,
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
        training[part] for part in split_presses(len(training), options.split, CHECKED["masked"], rng, least=2)
    )
    lessons, levels = Lessons.of(recording, teacher), len(teacher.factors)
    hidden = widest(teacher.fibres, len(lessons.measures), levels, budget)
    detector, plain = Detector.fit(recording, training), commanded(recording)
    found = seen(recording.readings, detector)
    press = owners(recording, found.begun)
    also = np.flatnonzero(np.isin(press, taught))
    shown, rows = plain[taught] + found.inputs[also], np.concatenate([taught, press[also]])
    scaling, table = Normalization.fit(shown, lessons[rows].places_mm, lessons[rows].measures)
    size = {"members": 1, "hidden": hidden, "layers": LAYERS, "lost": levels - 1, "epochs": LONGER * options.epochs}
    # LONGER alone says for how long, whichever features the localizer is to take.
    own = options.model_copy(update={**size, "features": "full"})
    weights = _trained(_samples(scaling, shown, lessons[rows]), table, own, rng, progress)
    localizer = Localizer(
        as_int8(weights) if budget.quantized else weights,
        scaling,
        table,
        method="masked",
        features="causal",
        factors=np.ones((1, 3 + len(lessons.measures))),
        rate_hz=recording.rate_hz,
        learnt_from=recording.digest,
    )
    known = {name: recording.measures[name][checked] for name in lessons.measures}
    factors = radii(localizer, scaling.inputs(plain[checked]), recording.presses_mm[checked], levels, known)
    return Student(replace(localizer, factors=factors), detector, budget.quantized)


def _samples(scaling: Normalization, inputs: Inputs, lessons: Lessons) -> TrainingPresses:
    presses = scaling.inputs(inputs)
    targets = scaling.targets(lessons.places_mm, lessons.measures)
    return TrainingPresses(presses.inputs, presses.alive, targets, scaling.stretch)


def _trained(
    learn: TrainingPresses,
    table: Floats,
    options: LocalizerSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None],
) -> Weights:
    from padforge.sense.localizer.training import train_members

    with one_torch_thread():
        weights = train_members(learn, table, options, rng, progress).weights
    fibres, inputs = learn.inputs.shape[1:]
    try:
        refuse_unsound(weights, fibres * (inputs + 1), "masked", learn.targets.shape[1] - 2)
    except InputError as error:
        raise InputError(f"training diverged at [localizer] rate {options.rate:g}, try a lower one: {error}") from error
    return weights


def split(recording: Recording, teacher: Localizer, options: LocalizerSettings) -> tuple[Indices, Indices]:
    """Presses of known place to learn from, and those to test on, which neither the student nor the teacher learns.

    Raises:
        InputError: the teacher was recalibrated by the recording, or there are too few presses.
    """
    refuse_other_pad(teacher, "the localizer", recording.fibres, recording.rate_hz)
    return split_unseen(recording, teacher, options)


def causal_beside(
    teacher: Localizer,
    recording: Recording,
    training: Indices,
    options: LocalizerSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Localizer:
    """A localizer of full size that knows what can be known by the end of a press, as the student does.

    It is the teacher, or one trained here on the presses `training` of a recording, by index.

    Raises:
        InputError: as `calibration.learn`.
    """
    if teacher.features == "causal":
        return teacher
    options = options.model_copy(update={"features": "causal", "method": "masked", "lost": len(teacher.factors) - 1})
    with one_torch_thread():
        return learn(recording, training, options, np.random.default_rng(options.seed), progress)


def examine(student: Student, beside: Sequence[Localizer], recording: Recording, test: Indices) -> dict[str, Any]:
    """How far off a student is on the presses `test`, by index, beside localizers.

    Returns:
        "errors", by "header" and the features of the localizers: rows as `evaluation.evaluate` has them; "found", how
        many of the presses the detector finds, "false", how many more it finds from the first to the last reading of
        them, and "found_mm", the mean error of those found.
    """
    places_mm, localizer = recording.presses_mm[test], student.localizer
    shown = {"header": (localizer, localizer.normalization.inputs(commanded(recording)[test]))}
    shown |= {each.features: (each, each.inputs(recording)[test]) for each in beside}
    levels = range(len(localizer.factors))
    rows = {
        name: errors_by_loss(model.fibres, levels, partial(model.locate, inputs), places_mm)[0]
        for name, (model, inputs) in shown.items()
    }
    presses, found = student.touches(recording.readings)
    press = owners(recording, presses.begun)
    own = np.flatnonzero(np.isin(press, test))
    false = int(np.isin(-1 - press, test).sum())
    off = distances(found.places_mm[own], recording.presses_mm[press[own]])
    mean = float(off.mean()) if len(own) else None
    return {"errors": rows, "found": len(own), "false": false, "found_mm": mean}
