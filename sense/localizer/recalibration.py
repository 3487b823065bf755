"""Recalibration: adapt a localizer to its pad, or to another one of the same plan, with a few new presses.

The localizer as it is, a corrected and a refitted one (`fit_correction`, `refit`) are compared by cross-validation over
these presses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from padforge.common.files import provenance
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.validation import InputError, check_int, check_type
from padforge.design import Morphology
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense.arrays import Array, Floats, Mask
from padforge.sense.localizer.bayes import fit_stages
from padforge.sense.localizer.evaluation import Measures, conformal, distances, error_row
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.localizer.model import Localization, LocalizerModel, concatenate
from padforge.sense.localizer.network import Weights, active_networks
from padforge.sense.localizer.response_model import grid_positions
from padforge.sense.localizer.response_priors import map_prior, plan_prior, planned_pad, stated_contact
from padforge.sense.localizer.response_process import ResponseFit, ResponsePrior
from padforge.sense.localizer.scaler import TrainingPresses, leave_one_out_residuals, refit_response
from padforge.sense.localizer.single_press import SinglePressTest, stages
from padforge.sense.recording.frames import frame_rate_hz
from padforge.sense.recording.recording import Recording

FORMAT = "padforge-recalibration/1"
GAIN_STD = 0.2  # prior standard deviation of the logarithm of a gain
ROTATION_STD = 0.05  # prior standard deviation of the angle (radians) and of the logarithm of the scale
SHIFT_STD = 0.1  # prior standard deviation of the shift (scaled position)
R90_STD = 1.645  # half-width of the central 90 % of a normal distribution, in standard deviations
DIFF_STEP = 0.02  # step of finite differences, in prior standard deviations; smaller ones are lost in rounding
MIN_PRESSES = 10  # new presses needed; fewer can neither change much nor show an improvement
MAX_PRESSES = 500  # new presses used at most; the time of a fit grows with their cube, and more gain nothing
FOLDS = 5
MAX_EXPONENT = 0.5  # largest p in error ~ presses ** -p; a mean of independent errors has it
SUBSETS = 16  # maximum sets of failed fibres of a size
Predictions = Sequence[Sequence[Localization]]  # by number and by set of failed fibres
Change = Callable[[LocalizerModel, PressFeatures, Array, Measures], LocalizerModel]
"""Change of a model, by features, positions and measures of new presses."""


@dataclass(frozen=True)
class Recalibration:
    """Result of a recalibration.

    Attributes:
        presses: number of new presses.
        change: "corrected", "refitted", or None if neither was kept.
        candidates: "change" (None for the old localizer), "mean_mm" and "standard_error_mm" of each model compared:
            its mean error on presses left out, and the standard error of its gain, over all numbers of failed fibres.
        new_fibres: indices of the fibres that respond differently from before, if refitted.
        twice_as_many_mm: error expected with twice as many presses, if refitted; else None.
        before: rows of `evaluation.error_row` on the new presses, by the old localizer.
        after: the same by the new localizer, cross-validated.
        gain_mm: decrease of the error, averaged over numbers of failed fibres.
        standard_error_mm: of the gain.
        widened: factors on the intervals.
        provenance: of the new localizer.
    """

    presses: int
    change: str | None
    candidates: list[dict[str, Any]]
    new_fibres: list[int]
    twice_as_many_mm: float | None
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
    pad: Morphology | None = None,
    seed: int = 0,
    on_progress: OnProgress = ignore_progress,
) -> tuple[LocalizerModel, Recalibration]:
    """Adapt a localizer to a pad that has drifted, was cast again, or has a new fibre.

    Radii never shrink; they are widened if presses left out lie outside too often. The `errors` of the model remain
    those of its calibration.

    Args:
        model: the old localizer.
        recording: of the pad as it is now, with some 20 to 500 presses of known position; of more presses, 500 are
            sampled.
        pad: plan of the pad, with its fibres on the channels in order; None for that of the recording, if it holds one.
        seed: of the folds and of the training.
        on_progress: called with (steps done, total steps, "").

    Returns:
        The new localizer, which predicts as the old one if nothing was gained, and the result.

    Raises:
        InputError: too few presses of known position, a recording that does not suit the localizer, or a pad of another
            number of fibres.
    """
    check_type("model", model, LocalizerModel)
    positioned = np.flatnonzero(check_type("recording", recording, Recording).has_position)
    seed = check_int("seed", seed, 0, 2**32 - 1)
    if len(positioned) < MIN_PRESSES:
        raise InputError(f"recording has {len(positioned)} presses of known position, expected at least {MIN_PRESSES}")
    pad = planned_pad(recording, pad)
    rows = np.random.default_rng(seed).permutation(positioned)[:MAX_PRESSES]
    features, positions_mm = model.raw_features(recording)[rows], recording.presses_mm[rows]
    measures = {each.name: recording.measures[each.name][rows] for each in model.scaler.measures}
    subsets = [failure_subsets(model.fibres, n_failed, SUBSETS) for n_failed in range(model.max_failures + 1)]
    samples = features, positions_mm, measures
    validation, halves = (CrossValidation(samples, n_folds, subsets) for n_folds in (FOLDS, 2))
    before = validation.predict([model] * FOLDS)
    total = FOLDS + 4 if model.method == "ensemble" else 1  # correction, folds, two halves, final fit
    folds = [model] * FOLDS
    after, changed, change = before, model, None  # predictions, model and name of the change that is kept so far
    candidates = [validation.candidate(None, before, before)]

    # 1. Correction
    predictions = validation.predict(validation.adapt(folds, fit_correction))
    candidates.append(validation.candidate("corrected", before, predictions))
    gain, standard_error = validation.gain(before, predictions)
    if gain > 2 * standard_error:  # a correction is coarse
        changed, after, change = fit_correction(model, *samples), predictions, "corrected"
    on_progress(1, total, "")

    # 2. Response
    new_fibres, twice_as_many_mm = [], None
    if model.method == "ensemble":
        plan = None
        if pad is not None:
            plan = plan_prior(pad, stated_contact(recording), model.scaler.origin_mm, model.scaler.scale_mm)

        def refit_last(old: LocalizerModel, *training: Any) -> LocalizerModel:
            return refit(old, *training, plan=plan, seed=seed, only_last=True)[0]

        adapted = validation.adapt(folds, refit_last, lambda fold: on_progress(2 + fold, total, ""))
        predictions = validation.predict(adapted)
        candidates.append(validation.candidate("refitted", before, predictions))
        gain, _ = validation.gain(after, predictions)
        if gain > 0:  # any gain counts, since it grows with more presses
            adapted = halves.adapt([model] * 2, refit_last, lambda half: on_progress(2 + FOLDS + half, total, ""))
            half_error_mm = halves.mean_error(halves.predict(adapted))
            twice_as_many_mm = _extrapolate(validation.mean_error(predictions), half_error_mm)
            changed, is_new = refit(model, *samples, plan=plan, seed=seed)
            after, change, new_fibres = predictions, "refitted", np.flatnonzero(is_new).tolist()
    on_progress(total, total, "")

    # 3. Radii
    gain, standard_error = validation.gain(before, after)
    widened = validation.widening(after)
    origin = provenance("padforge sense recalibrate", seed, packages=("safetensors",))
    inputs = {"recording": recording.digest, "localizer": dict(model.provenance)}
    origin |= {"inputs": inputs, "recording_kind": recording.source.get("kind")}
    result = Recalibration(
        presses=len(rows),
        change=change,
        candidates=candidates,
        new_fibres=new_fibres,
        twice_as_many_mm=twice_as_many_mm,
        before=validation.error_rows(before),
        after=validation.error_rows(after),
        gain_mm=gain,
        standard_error_mm=standard_error,
        widened=widened.tolist(),
        provenance=origin,
    )
    changed = replace(
        changed,
        interval_factors=np.minimum(changed.interval_factors * widened, 1e6),
        single_press=changed.single_press if change == "refitted" else changed.calibrate_tests(recording, rows),
        recalibrated_by=(*model.recalibrated_by, recording.digest),
        provenance=origin,
    )
    return changed, result


def _extrapolate(error_mm: float, half_mm: float) -> float:
    """Extrapolate errors after 1 - 1 / FOLDS and 1 / 2 of the presses to twice all of them, by a power law."""
    exponent = float(np.clip(np.log(half_mm / error_mm) / np.log(2 * (1 - 1 / FOLDS)), 0, MAX_EXPONENT))
    return error_mm * (2 / (1 - 1 / FOLDS)) ** -exponent


def refit(
    old: LocalizerModel,
    features: PressFeatures,
    positions_mm: Array,
    measures: Measures,
    *,
    plan: ResponsePrior | None,
    seed: int,
    only_last: bool = False,
) -> tuple[LocalizerModel, Mask]:
    """Refit response, Bayesian localizers and networks to new presses; return the localizer, and which fibres are new.

    This serves a pad that has drifted, was cast again, or has a new fibre: an unchanged fibre keeps its response,
    and a new one gets another. Positions are (Q, 2), measures the depth and force (Q,), NaN where unknown; `plan` is
    the prior from the plan of the pad. With `only_last`, only the networks that answer at the end of a press are
    retrained.
    """
    from padforge.sense.localizer.training import retrain  # torch takes long to import

    # 1. Response, about the table of the old or of the corrected localizer, whichever has the larger evidence
    starts = [old, fit_correction(old, features, positions_mm, measures)]
    fits = [_fit_response(start, features, positions_mm, measures, plan) for start in starts]
    best = int(np.argmax([fit.log_evidence for *_, fit in fits]))
    start, (presses, table, response) = starts[best], fits[best]
    presses, n_timed = leave_one_out_residuals(presses, table, response.leverage), features.complete.shape[1]

    # 2. Bayesian localizers, networks and tests
    fitted = presses.inputs, presses.fibre_mask, presses.targets[:, :2]
    bayes = fit_stages(table, *fitted, n_timed, earlier=start.bayes) if start.bayes else ()
    last = active_networks(start.networks, n_timed, n_timed, bool(bayes))
    networks = {name: weights for name, weights in start.networks.items() if not only_last or name in last}
    rng = np.random.default_rng([seed, len(features)])
    retrained = retrain(networks, start.residual_network, presses, table, start.max_failures, rng, bayes)
    tests = [
        SinglePressTest.fit(table, presses, start.scaler.centring, n_complete, test).calibrated(presses)
        for n_complete, test in zip(stages(n_timed), start.single_press, strict=True)
    ]
    changed = replace(
        start,
        networks={**start.networks, **retrained[0]},
        residual_network=retrained[1],
        bayes=bayes,
        table=table,
        single_press=tuple(tests),
    )
    return changed, response.is_new


def _fit_response(
    old: LocalizerModel, features: PressFeatures, positions_mm: Array, measures: Measures, plan: ResponsePrior | None
) -> tuple[TrainingPresses, Floats, ResponseFit]:
    """Return scaled presses, the response table (S, S, C, F + G), and its fit with the evidence of windows in volts."""
    scaler, n_windows = old.scaler, features.windows.shape[2]
    predicted = old.predict_features(scaler.transform(features)).measures
    # Unknown depths and forces are replaced by their predictions.
    completed = {name: np.where(np.isnan(values), predicted[name].values, values) for name, values in measures.items()}
    presses = scaler.training_presses(features, positions_mm, completed, frame_rate_hz(old.rate_hz))
    maps = scaler.uncentre(old.table)[..., :n_windows]
    prior = map_prior(maps) if plan is None else replace(plan, mean=maps)
    table, response = refit_response(scaler, presses, old.table, n_windows, prior)
    log_scale = float(presses.fibre_mask.sum(axis=0) @ np.log(scaler.scale_v[:, :n_windows]).sum(axis=1))
    return presses, table, replace(response, log_evidence=response.log_evidence - log_scale)


def fit_correction(
    model: LocalizerModel, features: PressFeatures, positions_mm: Array, measures: Measures = MappingProxyType({})
) -> LocalizerModel:
    """Correct gains of fibres, rotation, scale and shift by robust least squares with a normal prior.

    Gains change the feature scaler; rotation, scale and shift change the last layers, `bayes` and `table`.
    """
    from scipy.optimize import least_squares  # slow to import

    before = model.predict_features(model.scaler.transform(features))

    def residuals(parameters: Array) -> Array:
        # Parameters are offset by 1, since the steps of the solver are relative to their values.
        corrected = _corrected(model, parameters - 1)
        prediction = corrected.predict_features(corrected.scaler.transform(features))
        errors = [((prediction.positions_mm - positions_mm) / before.std_mm).ravel()]
        errors += [
            (estimate.values - measures[name]) / (before.measures[name].r90 / R90_STD)
            for name, estimate in prediction.measures.items()
            if name in measures
        ]
        return np.nan_to_num(np.concatenate([*errors, parameters - 1]))

    start = np.ones(model.fibres + 4)
    solution = least_squares(residuals, start, loss="soft_l1", diff_step=DIFF_STEP, xtol=1e-2, ftol=1e-3)
    _, rotation, shift = _transform(solution.x - 1)
    return replace(_corrected(model, solution.x - 1), table=_transformed_table(model.table, rotation, shift))


def _transform(parameters: Array) -> tuple[Array, Array, Array]:
    """Return gains (C,), rotation times scale (2, 2) and scaled shift (2,), from parameters in prior deviations."""
    angle, log_scale = ROTATION_STD * parameters[-4:-2]
    rotation = np.exp(log_scale) * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.exp(GAIN_STD * parameters[:-4]), rotation, SHIFT_STD * parameters[-2:]


def _corrected(model: LocalizerModel, parameters: Array) -> LocalizerModel:
    """Correct all but the table, by parameters in prior standard deviations."""
    gains, rotation, shift = _transform(parameters)
    names = ("mean_v", "scale_v", "history_mean_v")
    bayes = tuple(stage.transformed(rotation, shift) for stage in model.bayes)
    return replace(
        model,
        networks={name: _transformed_weights(each, rotation, shift) for name, each in model.networks.items()},
        bayes=bayes,
        # its outputs are offsets from Bayesian positions, so that a shift does not change them
        residual_network=_transformed_weights(model.residual_network, rotation, np.zeros(2)) if bayes else {},
        scaler=replace(model.scaler, **{name: gains[:, None] * getattr(model.scaler, name) for name in names}),
    )


def _transformed_weights(weights: Weights, rotation: Array, shift: Array) -> Weights:
    last, bias = weights["last.w"].copy(), weights["last.b"].copy()
    last[..., :2] = last[..., :2] @ rotation.T
    bias[..., :2] = bias[..., :2] @ rotation.T + shift
    return {**weights, "last.w": last, "last.b": bias}


def _transformed_table(table: Floats, rotation: Array, shift: Array) -> Floats:
    """Resample the response table at transformed positions, clipped to its edge."""
    from scipy.interpolate import RegularGridInterpolator

    axis = np.linspace(-1, 1, len(table))
    original = np.clip((grid_positions(len(table)) - shift) @ np.linalg.inv(rotation).T, -1, 1)
    return RegularGridInterpolator((axis, axis), table)(original).astype(np.float32)


class CrossValidation:
    """Cross-validation of changes of a localizer, on features, positions (Q, 2), mm, and measures of new presses.

    Each fold is predicted without each set of failed fibres in `subsets`, which are ordered by their size from 0.
    """

    def __init__(
        self, presses: tuple[PressFeatures, Array, Measures], n_folds: int, subsets: Sequence[Sequence[tuple[int, ...]]]
    ) -> None:
        self.presses = presses
        self._folds, self._subsets = np.array_split(np.arange(len(presses[1])), n_folds), subsets

    def adapt(
        self, models: Sequence[LocalizerModel], change: Change, on_fold: Callable[[int], None] = lambda fold: None
    ) -> list[LocalizerModel]:
        """Change each model, one per fold, by the presses outside its fold; `on_fold` is called after each."""
        features, positions_mm, measures = self.presses
        changed = []
        for number, (model, fold) in enumerate(zip(models, self._folds, strict=True)):
            rows = np.setdiff1d(np.arange(len(positions_mm)), fold)
            training = {name: values[rows] for name, values in measures.items()}
            changed.append(change(model, features[rows], positions_mm[rows], training))
            on_fold(number)
        return changed

    def predict(self, models: Sequence[LocalizerModel]) -> Predictions:
        """Predict the presses of each fold by its model, without each set of failed fibres."""
        features = self.presses[0]
        parts = [(each, each.scaler.transform(features[fold])) for each, fold in zip(models, self._folds, strict=True)]
        return [
            [concatenate([each.predict_features(part, failed) for each, part in parts]) for failed in level]
            for level in self._subsets
        ]

    def _errors(self, predictions: Predictions) -> list[Array]:
        """Return the errors (S, Q), mm, of the presses without each of S sets, by number of failed fibres."""
        return [np.array([distances(each.positions_mm, self.presses[1]) for each in level]) for level in predictions]

    def mean_error(self, predictions: Predictions) -> float:
        """Return the mean error, mm, averaged over numbers of failed fibres."""
        return float(np.mean([errors.mean() for errors in self._errors(predictions)]))

    def candidate(self, change: str | None, before: Predictions, predictions: Predictions) -> dict[str, Any]:
        """Return a row of `Recalibration.candidates`."""
        standard_error = self.gain(before, predictions)[1]
        return {"change": change, "mean_mm": self.mean_error(predictions), "standard_error_mm": standard_error}

    def gain(self, before: Predictions, after: Predictions) -> tuple[float, float]:
        """Return the mean decrease of errors, mm, averaged over numbers of failed fibres, and its standard error."""
        levels = zip(self._errors(before), self._errors(after), strict=True)
        decrease = np.mean([(old - new).mean(axis=0) for old, new in levels], axis=0)
        return float(decrease.mean()), float(decrease.std(ddof=1) / np.sqrt(len(decrease)))

    def error_rows(self, predictions: Predictions) -> list[dict[str, Any]]:
        """Return rows of `evaluation.error_row`."""
        return [error_row(n_failed, level, *self.presses[1:]) for n_failed, level in enumerate(predictions)]

    def widening(self, predictions: Predictions) -> Array:
        """Return (L, 3 + T) factors, 1 or more, with which intervals hold on these presses."""
        return np.maximum([conformal(level, *self.presses[1:]) for level in predictions], 1.0)


def recalibration_lines(result: Recalibration) -> list[str]:
    """Format a recalibration: the error of each candidate, a table of the one that was kept, and a conclusion."""
    names = {None: "as it was", "corrected": "corrected by gains and pose", "refitted": "response fitted again"}
    lines = [f"{result.presses} new presses, each predicted by a localizer adapted without it; error in mm"]
    for each in result.candidates:
        error = f" ± {each['standard_error_mm']:.2f}" if each["change"] else ""
        mark = "  <- kept" if each["change"] == result.change else ""
        lines.append(f"{each['mean_mm']:6.2f}{error:7}  {names[each['change']]}{mark}")
    lines += [
        "failed  sets  before mm  after mm  in r90 before  in r90 after",
        *(
            f"{old['n_failed']:6d} {old['subsets']:5d}  {old['mean_mm']:9.2f}  {new['mean_mm']:8.2f}  "
            f"{old['within_r90']:13.1%}  {new['within_r90']:12.1%}"
            for old, new in zip(result.before, result.after, strict=True)
        ),
    ]
    if result.new_fibres:
        numbers = ", ".join(str(fibre + 1) for fibre in result.new_fibres)
        lines.append(f"learnt again, as they respond unlike those of the old model: fibres {numbers}")
    if result.change:
        gain = f"{result.gain_mm:.3f} mm (standard error {result.standard_error_mm:.3f} mm)"
        lines.append(f"{result.change}: errors shrink by {gain}")
    else:
        lines.append("nothing gained: positions are predicted as before")
    if result.twice_as_many_mm is not None:
        lines.append(f"twice as many presses: about {result.twice_as_many_mm:.2f} mm")
    return lines
