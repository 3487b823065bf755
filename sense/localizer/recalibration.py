"""Recalibration: a localizer trained long ago follows its pad by a few new presses, or stays as it was.

A pad that was re-made or re-mounted needs a correction first, of the gain of every fibre and of the position, angle and
scale of the pad, which folds into the scaling of features and the last layer of the networks. For a pad that drifted,
fine tuning suffices. Cross-validation over the new presses decides whether either is worth it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from types import MappingProxyType
from typing import Any

import numpy as np

from padforge.common.files import provenance
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.validation import InputError, check_int, check_type
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense.arrays import Array, Floats, Indices
from padforge.sense.localizer.evaluation import Measures, conformal, distances, error_row
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.localizer.model import Localization, LocalizerModel, concatenate
from padforge.sense.localizer.moments import CORRECTED, PHASES
from padforge.sense.localizer.network import Weights
from padforge.sense.localizer.response_model import grid_positions
from padforge.sense.recording.frames import frame_rate_hz
from padforge.sense.recording.recording import Recording

FORMAT = "padforge-recalibration/1"
GAIN_STD, ROTATION_STD, SHIFT_STD = 0.2, 0.05, 0.1
"""Prior standard deviations: of the logarithm of a gain, of the angle (radians) and the logarithm of the scale, and of
the shift (scaled position)."""
R90_STD = 1.645  # standard deviations in the half-width that holds 90 % of a normal distribution
DIFFERENCE = 0.02
"""Step of numerical derivatives, in prior standard deviations: shorter ones drown in the rounding of the network."""
MIN_PRESSES = 10  # new presses needed: fewer can neither change much nor show that it was for the better
FOLDS = 5
CORRECT_FROM, FINE_TUNE_FROM = 2.0, -1.0
"""Gains, in standard errors, from which a correction, which is coarse, and fine tuning, which is gentle, are kept. Fine
tuning gains almost always, but less than a hundred presses can show, so it is kept unless they speak against it."""
SUBSETS = 16  # sets of failed fibres of a size that are looked at, at most
Predictions = Sequence[Sequence[Localization]]  # by number and by set of failed fibres
Change = Callable[[LocalizerModel, PressFeatures, Array, Measures], LocalizerModel]


@dataclass(frozen=True)
class Recalibration:
    """What a recalibration changed and gained.

    Attributes:
        presses: number of new presses.
        changes: that were kept, of "corrected" and "fine_tuned".
        before: rows of `evaluation.error_row` on the new presses, by the old localizer.
        after: the same by the new one, each press left out of what predicts it.
        gain_mm: decrease of the error, averaged over numbers of failed fibres.
        standard_error_mm: of the gain.
        widened: factors on the intervals.
        provenance: of the new localizer.
    """

    presses: int
    changes: list[str]
    before: list[dict[str, Any]]
    after: list[dict[str, Any]]
    gain_mm: float
    standard_error_mm: float
    widened: list[list[float]]
    provenance: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the document of `recalibration.json`."""
        return {"format": FORMAT} | vars(self)


def recalibrate(
    model: LocalizerModel,
    recording: Recording,
    *,
    seed: int = 0,
    on_progress: OnProgress = ignore_progress,
) -> tuple[LocalizerModel, Recalibration]:
    """Adapt a localizer to a pad that has changed since its training.

    Radii only ever grow: they are widened where presses left out lie outside more often than they should. The `errors`
    of the model stay those of its calibration.

    Args:
        model: the localizer so far.
        recording: of the pad as it is now, with some 20 to 500 presses of known position; others are not looked at.
        seed: of the folds and of fine tuning.
        on_progress: called with (steps done, steps in all, "").

    Returns:
        The localizer from now on, which predicts as the old one if nothing was gained, and what changed.

    Raises:
        InputError: too few presses of known position, or a recording that does not suit the localizer.
    """
    check_type("model", model, LocalizerModel)
    known = np.flatnonzero(check_type("recording", recording, Recording).has_position)
    seed = check_int("seed", seed, 0, 2**32 - 1)
    if len(known) < MIN_PRESSES:
        raise InputError(f"recording has {len(known)} presses of known position, expected at least {MIN_PRESSES}")
    rows = np.random.default_rng(seed).permutation(known)
    features, positions_mm = model.raw_features(recording)[rows], recording.presses_mm[rows]
    measures = {each.name: recording.measures[each.name][rows] for each in model.scaler.measures}
    subsets = [failure_subsets(model.fibres, n_failed, SUBSETS) for n_failed in range(model.max_failures + 1)]
    validation = CrossValidation(features, positions_mm, np.array_split(np.arange(len(rows)), FOLDS), subsets, measures)
    before = validation.predict([model] * FOLDS)
    changed, after, changes = _select_changes(model, validation, before, seed, on_progress)
    gain, standard_error = validation.gain(before, after)
    widened = validation.widening(after)
    made_by = provenance("padforge sense recalibrate", seed, packages=("torch", "safetensors"))
    inputs = {"recording": recording.digest, "localizer": dict(model.provenance)}
    made_by |= {"inputs": inputs, "recording_kind": recording.source.get("kind")}
    result = Recalibration(
        presses=len(rows),
        changes=changes,
        before=validation.error_rows(before),
        after=validation.error_rows(after),
        gain_mm=gain,
        standard_error_mm=standard_error,
        widened=widened.tolist(),
        provenance=made_by,
    )
    changed = replace(
        changed,
        interval_factors=np.minimum(changed.interval_factors * widened, 1e6),
        single_press=changed.calibrate_tests(recording, rows),
        recalibrated_by=(*model.recalibrated_by, recording.digest),
        provenance=made_by,
    )
    return changed, result


def _select_changes(
    model: LocalizerModel,
    validation: "CrossValidation",
    before: Predictions,
    seed: int,
    on_progress: OnProgress,
) -> tuple[LocalizerModel, Predictions, list[str]]:
    """The model with the changes that are worth it, predictions of presses left out, and the names of the changes."""
    steps, total = count(1), 2 + FOLDS + 1 if model.method == "ensemble" else 1

    def tune(old: LocalizerModel, features: PressFeatures, positions_mm: Array, measures: Measures) -> LocalizerModel:
        tuned = _fine_tuned(old, features, positions_mm, measures, np.random.default_rng([seed, len(features)]))
        on_progress(next(steps), total, "")
        return tuned

    candidates: list[tuple[str, Change, float]] = [("corrected", fit_correction, CORRECT_FROM)]
    if model.method == "ensemble":
        candidates.append(("fine_tuned", tune, FINE_TUNE_FROM))
    folds, after, changes = [model] * FOLDS, before, []
    for name, change, threshold in candidates:
        changed = validation.change(folds, change)
        predictions = validation.predict(changed)
        on_progress(next(steps), total, "")
        gain, standard_error = validation.gain(after, predictions)
        if gain > threshold * standard_error:
            model, folds, after = change(model, *validation.presses), changed, predictions
            changes.append(name)
    on_progress(total, total, "")
    return model, after, changes


def _fine_tuned(
    model: LocalizerModel, features: PressFeatures, positions_mm: Array, measures: Measures, rng: np.random.Generator
) -> LocalizerModel:
    from padforge.sense.localizer.training import fine_tune  # torch takes long to import

    predicted = model.predict_features(model.scaler.transform(features)).measures
    # Where the depth of a press is unknown, its prediction is kept.
    known = {name: np.where(np.isnan(values), predicted[name].values, values) for name, values in measures.items()}
    presses = model.scaler.training_presses(features, positions_mm, known, frame_rate_hz(model.rate_hz))
    phases = PHASES[features.seen.shape[1]]
    networks = {
        name: fine_tune(weights, presses, model.table, model.max_failures, rng, phases[name])
        for name, weights in model.networks.items()
    }
    residual_network = model.residual_network
    if model.bayes:
        phase = CORRECTED if features.seen.shape[1] else phases["press"]
        residual_network = fine_tune(
            residual_network, presses, model.table, model.max_failures, rng, phase, model.bayes
        )
    return replace(model, networks=networks, residual_network=residual_network)


def fit_correction(
    model: LocalizerModel, features: PressFeatures, positions_mm: Array, measures: Measures = MappingProxyType({})
) -> LocalizerModel:
    """Correct gains of fibres, rotation, scale and shift by robust least squares with a normal prior."""
    from scipy.optimize import least_squares  # slow to import, and needed here only

    expected = model.predict_features(model.scaler.transform(features))

    def residuals(parameters: Array) -> Array:
        # Parameters are counted from 1, since the steps of the solver are relative to them.
        corrected = _corrected(model, parameters - 1)
        prediction = corrected.predict_features(corrected.scaler.transform(features))
        errors = [((prediction.positions_mm - positions_mm) / expected.std_mm).ravel()]
        errors += [
            (each.values - measures[name]) / (expected.measures[name].r90 / R90_STD)
            for name, each in prediction.measures.items()
            if name in measures
        ]
        return np.nan_to_num(np.concatenate([*errors, parameters - 1]))

    start = np.ones(model.fibres + 4)
    solution = least_squares(residuals, start, loss="soft_l1", diff_step=DIFFERENCE, xtol=1e-2, ftol=1e-3)
    _, rotation, shift = _transform(solution.x - 1)
    return replace(_corrected(model, solution.x - 1), table=_transformed_table(model.table, rotation, shift))


def _transform(parameters: Array) -> tuple[Array, Array, Array]:
    """Gains (C,), rotation with scale (2, 2) and shift (2,), scaled, from parameters in prior standard deviations."""
    angle, log_scale = ROTATION_STD * parameters[-4:-2]
    rotation = np.exp(log_scale) * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.exp(GAIN_STD * parameters[:-4]), rotation, SHIFT_STD * parameters[-2:]


def _corrected(model: LocalizerModel, parameters: Array) -> LocalizerModel:
    gains, rotation, shift = _transform(parameters)
    names = ("mean_v", "scale_v", "history_mean_v")
    bayes = tuple(stage.transformed(rotation, shift) for stage in model.bayes)
    return replace(
        model,
        networks={name: _transformed_weights(each, rotation, shift) for name, each in model.networks.items()},
        bayes=bayes,
        residual_network=_transformed_weights(model.residual_network, rotation, np.zeros(2)) if bayes else {},
        scaler=replace(model.scaler, **{name: gains[:, None] * getattr(model.scaler, name) for name in names}),
    )


def _transformed_weights(weights: Weights, rotation: Array, shift: Array) -> Weights:
    last, bias = weights["last.w"].copy(), weights["last.b"].copy()
    last[..., :2] = last[..., :2] @ rotation.T
    bias[..., :2] = bias[..., :2] @ rotation.T + shift
    return {**weights, "last.w": last, "last.b": bias}


def _transformed_table(table: Floats, rotation: Array, shift: Array) -> Floats:
    """The response table by transformed positions; beyond the edge, what is at the edge."""
    from scipy.interpolate import RegularGridInterpolator

    axis = np.linspace(-1, 1, len(table))
    original = np.clip((grid_positions(len(table)) - shift) @ np.linalg.inv(rotation).T, -1, 1)
    return RegularGridInterpolator((axis, axis), table)(original).astype(np.float32)


class CrossValidation:
    """Cross-validation of changes on new presses: each fold is left out in turn, for each subset of failed fibres.

    `subsets` are listed by the number of failed fibres, from 0.
    """

    def __init__(
        self,
        features: PressFeatures,
        positions_mm: Array,
        folds: Sequence[Indices],
        subsets: Sequence[Sequence[tuple[int, ...]]],
        measures: Measures = MappingProxyType({}),
    ) -> None:
        self.presses = features, positions_mm, measures
        self._folds, self._subsets = folds, subsets

    def change(self, models: Sequence[LocalizerModel], change: Change) -> list[LocalizerModel]:
        """Change the models, one a fold, each by the presses that its fold leaves."""
        features, positions_mm, measures = self.presses
        changed = []
        for model, fold in zip(models, self._folds, strict=True):
            rows = np.setdiff1d(np.arange(len(positions_mm)), fold)
            training = {name: values[rows] for name, values in measures.items()}
            changed.append(change(model, features[rows], positions_mm[rows], training))
        return changed

    def predict(self, models: Sequence[LocalizerModel]) -> Predictions:
        """Predict each press by the model of the fold that leaves it out, without each set of failed fibres."""
        features = self.presses[0]
        parts = [(each, each.scaler.transform(features[fold])) for each, fold in zip(models, self._folds, strict=True)]
        return [
            [concatenate([each.predict_features(part, failed) for each, part in parts]) for failed in level]
            for level in self._subsets
        ]

    def gain(self, before: Predictions, after: Predictions) -> tuple[float, float]:
        """Return the mean decrease of errors, mm, numbers of failed fibres weighing alike, and its standard error."""

        def errors(prediction: Localization) -> Array:
            return distances(prediction.positions_mm, self.presses[1])

        levels = [
            [errors(old) - errors(new) for old, new in zip(*level, strict=True)]
            for level in zip(before, after, strict=True)
        ]
        decrease = np.mean([np.mean(level, axis=0) for level in levels], axis=0)
        return float(decrease.mean()), float(decrease.std(ddof=1) / np.sqrt(len(decrease)))

    def error_rows(self, predictions: Predictions) -> list[dict[str, Any]]:
        """Return rows of `evaluation.error_row`."""
        return [error_row(n_failed, level, *self.presses[1:]) for n_failed, level in enumerate(predictions)]

    def widening(self, predictions: Predictions) -> Array:
        """Return (K, 3 + T) factors, 1 or more, with which intervals hold on these presses."""
        return np.maximum([conformal(level, *self.presses[1:]) for level in predictions], 1.0)


def recalibration_lines(result: Recalibration) -> list[str]:
    """Format a recalibration as a table and a conclusion."""
    conclusion = "nothing gained: positions are predicted as before"
    if result.changes:
        names = " and ".join(result.changes).replace("_", "-")
        gain = f"{result.gain_mm:.3f} mm (standard error {result.standard_error_mm:.3f} mm)"
        conclusion = f"{names}: errors shrink by {gain}"
    return [
        f"{result.presses} new presses, each predicted by what was changed without it",
        "failed  sets  before mm  after mm  in r90 before  in r90 after",
        *(
            f"{old['n_failed']:6d} {old['subsets']:5d}  {old['mean_mm']:9.2f}  {new['mean_mm']:8.2f}  "
            f"{old['within_r90']:13.1%}  {new['within_r90']:12.1%}"
            for old, new in zip(result.before, result.after, strict=True)
        ),
        conclusion,
    ]
