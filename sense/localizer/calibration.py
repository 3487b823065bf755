"""Calibration: train a localizer on a recording, calibrate its uncertainty, and test it on presses held back.

Presses are split into training, calibration of the uncertainty, and test; for method "published" also into presses for
early stopping.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from padforge.common.files import provenance
from padforge.common.parallel import map_threads, one_thread
from padforge.common.profiling import stage
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import or_default
from padforge.common.validation import InputError, check_float, check_type
from padforge.design import Contact, Morphology
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer.evaluation import (
    CONVERGED_SHARE,
    PRIOR_PRESSES,
    RATIO_SHAPE,
    Evaluation,
    conformal,
    distances,
    evaluate,
    held_back_presses,
)
from padforge.sense.localizer.features import FeatureSet, PressFeatures, compute_features
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.localizer.moments import MODULATED, N_PRESS_WINDOWS, complete_at
from padforge.sense.localizer.network import (
    MAX_LOG_ERROR,
    MIN_LOG_ERROR,
    RESIDUAL,
    Networks,
    Weights,
    active_networks,
    check_weights,
    predict_members,
)
from padforge.sense.localizer.response_priors import plan_prior, planned_pad, stated_contact
from padforge.sense.localizer.scaler import FeatureScaler, ScaledFeatures, leave_one_out_residuals, refit_response
from padforge.sense.localizer.single_press import SinglePressTest, stages
from padforge.sense.recording.frames import frame_rate_hz, framed
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import LocalizerSettings

FEW_PRESSES = 500  # up to which the plan of a pad predicts its response better than basis functions
MIN_TRAINING = 3  # training presses that a split must leave, since fewer have no scale
CALIBRATION_SHARE = {"ensemble": 0.08, "published": 0.15 / 0.85}
"""Share of the presses outside of the test that calibrates the uncertainty. For "published", early stopping takes half
of it; if 15 % of all presses are tested, it is 15 % of all."""
MAX_TIME_BUDGET_S = 1e9
MIN_DEPTH_RANGE_MM = 0.2  # range of the central 90 % of depths, at or below which depth does not vary
PRIOR_COUNT = 2  # weight of the expected error of a member in the calibration of its scale, in presses
SCALE_SUBSETS = 6  # maximum sets of failed fibres of a size for the calibration of scales
CONTRADICTION = 2.5  # standard errors by which calibration presses may differ from the experience with other pads
INTERVAL_SUBSETS = 32  # maximum sets of failed fibres of a size for the calibration of intervals
MOMENT_SUBSETS = 4  # the same where there are several moments


@dataclass(frozen=True)
class Experience:
    """Errors of 26 other localizers at a moment of a press, as a prior for the radii.

    These localizers, of nine pads, simulated or published, had the default size and were trained in all steps on 235 to
    3500 presses. The standard deviation of their mean ratios is `PAD_SPREAD`.
    """

    growth_presses: float  # after n training presses, errors on new ones are 1 + growth_presses / n times the expected
    mean_ratio: float  # mean of distance / r50 before calibration, growth included

    @staticmethod
    def at_moment(n_complete: int) -> "Experience":
        """Return the experience when `n_complete` windows of a press are complete."""
        return TOUCH if n_complete < N_PRESS_WINDOWS else HELD if n_complete == N_PRESS_WINDOWS else RELEASE

    def growth(self, n_trained: int) -> float:
        """Return the ratio of the errors on new presses to the expected ones after `n_trained` presses."""
        return 1 + self.growth_presses / n_trained

    def ratio(self, n_trained: int, failed_share: float) -> float:
        """Return the mean ratio of distance to expected radius when a share of the fibres has failed.

        Errors grow less from training to new presses then, since they are large in training already.
        """
        return self.mean_ratio * (1 - FAILURE_DECREASE * failed_share * (1 - 1 / self.growth(n_trained)))


TOUCH = Experience(growth_presses=70, mean_ratio=0.78)
HELD = Experience(growth_presses=180, mean_ratio=0.84)
RELEASE = Experience(growth_presses=190, mean_ratio=0.73)
FAILURE_DECREASE = 1.1  # relative decrease of the growth of errors, per share of failed fibres
PAD_SPREAD = 0.1  # relative standard deviation of the mean ratio between pads


@dataclass(frozen=True)
class CalibrationData:
    """Q presses of known position, for training and for the calibration of the uncertainty."""

    features: PressFeatures  # of presses as commanded
    detected: PressFeatures | None  # of the same presses as detected in the readings, for augmentation
    positions_mm: Array  # (Q, 2)
    measures: Mapping[str, Array]  # depth and force to be predicted, (Q,) each
    feature_set: FeatureSet
    rate_hz: float
    sha256: str  # of the source
    # returns features by number of complete windows and indices of presses; None for features without moments
    features_at: Callable[[int, Indices], PressFeatures] | None = None
    pad: Morphology | None = None  # plan of the pad, as a prior
    contact: Contact = field(default_factory=Contact)


def calibrate(
    recording: Recording,
    options: LocalizerSettings | None = None,
    *,
    pad: Morphology | None = None,
    time_budget: float | None = None,
    by_moment: bool = True,
    on_progress: OnProgress = ignore_progress,
) -> tuple[LocalizerModel, Evaluation]:
    """Train a localizer on a part of the presses and test it on the others.

    Test presses are used once, in the test alone. Presses of unknown position are ignored.

    Args:
        recording: readings and presses of known position.
        options: of the training; the defaults if None.
        pad: plan of the pad, with its fibres on the channels in order, which serves as a prior for up to `FEW_PRESSES`
            presses; None for no prior.
        time_budget: seconds of training, which decide on the number of members; the result then depends on the speed
            of the machine. None for the length and the members of `options`.
        by_moment: as in `evaluate`.
        on_progress: called in the training with (done, total, ""), in steps, or in seconds of a time budget; before
            and after it with the stage of the work.

    Returns:
        The localizer, and its evaluation on the test presses.

    Raises:
        InputError: an option out of range, a time budget for the published method or too short to train in, too few
            presses, a pad of another number of fibres, or a training that diverged.
    """
    check_type("recording", recording, Recording)
    options = or_default("options", options, LocalizerSettings)
    pad = None if pad is None else planned_pad(recording, pad)
    time_budget = None if time_budget is None else check_float("time_budget", time_budget, 0, MAX_TIME_BUDGET_S)
    if options.method == "published" and time_budget is not None:
        raise InputError("time_budget is given: method published has no time limit, expected method ensemble")
    rng = np.random.default_rng(options.seed)
    positioned = np.flatnonzero(recording.has_position)
    training, test = split_presses(positioned, options.split, options.test_share, rng)
    made_by = calibration_provenance(recording, options)
    with stage("train"):
        model = fit_recording(recording, training, options, rng, on_progress, time_budget, pad)
    origin = {"fibre_names": recording.fibre_names, "pad_sha256": recording.pad_digest, "provenance": made_by}
    model = replace(model, split=options.split, test=tuple(test.tolist()), **origin)
    with stage("evaluate"), one_thread():
        counts = range(_n_levels(options, recording.fibres))
        evaluation = evaluate(model, recording, counts, by_moment=by_moment, on_progress=on_progress)
    evaluation = replace(evaluation, training_presses=len(training), settings=options.model_dump())
    return replace(model, errors=evaluation.errors), evaluation


def calibration_provenance(recording: Recording, options: LocalizerSettings) -> dict[str, Any]:
    """Return the provenance of what is learnt from a recording."""
    packages = ("safetensors", *["torch"] * (options.method == "published"))
    made_by = provenance("padforge sense calibrate", options.seed, packages=packages)
    return made_by | {"inputs": {"recording": recording.digest}, "recording_kind": recording.source.get("kind")}


def fit_recording(
    recording: Recording,
    training: Indices,
    options: LocalizerSettings,
    rng: np.random.Generator,
    on_progress: OnProgress = ignore_progress,
    time_budget: float | None = None,
    pad: Morphology | None = None,
) -> LocalizerModel:
    """Train a localizer on the presses `training` of a recording, without testing it; raises as `fit_model`."""
    from padforge.sense.signals.press_detection import align_to_detected  # compiled kernels take long to import

    on_progress(0, 0, "features")
    frames = framed(recording)
    readings, commands = frames.readings, (frames.down_command, frames.up_command)
    detected, measures = None, {}
    if options.method == "ensemble":
        detected = compute_features(readings, *align_to_detected(readings, frames.times_s, *commands))
        measures = trainable_targets(recording, training)
    is_published = options.method == "published"
    features = compute_features(readings, *commands, is_published=is_published)

    def features_at(n_complete: int, presses: Indices) -> PressFeatures:
        until = complete_at(n_complete, *commands)
        return compute_features(readings, *commands, until, history=features.history)[presses]

    feature_set: FeatureSet = "published" if is_published else "windows"
    source = feature_set, recording.rate_hz, recording.digest
    at_moments = None if is_published else features_at
    data = CalibrationData(features, detected, recording.presses_mm, measures, *source, at_moments)
    if pad is not None:
        data = replace(data, pad=pad, contact=stated_contact(recording))
    return fit_model(data, training, options, rng, on_progress, time_budget)


@one_thread()
def fit_model(
    data: CalibrationData,
    training: Indices,
    options: LocalizerSettings,
    rng: np.random.Generator,
    on_progress: OnProgress = ignore_progress,
    time_budget: float | None = None,
) -> LocalizerModel:
    """Train a localizer and calibrate its uncertainty.

    A share of the presses, split off by `options.split`, calibrates the uncertainty. The others are trained on twice:
    with their windows after the command, and after the detected touch. The published training stops early by presses of
    its own; if it stopped by those that calibrate, intervals would be too short.

    Raises:
        InputError: too few presses, or a training that diverged.
    """
    # compiled kernels take long to import, and predictions need none
    from padforge.sense.localizer.training import train_members, train_published

    # 1. Response model
    is_ensemble = options.method == "ensemble"
    train, early_stop, calibration = _split_training(training, options, rng)
    features, rows = data.features[train], train
    if data.detected is not None:
        features, rows = features + data.detected[train], np.concatenate([train, train])
    n_timed = data.features.complete.shape[1]
    modulated = MODULATED if n_timed else ()
    positions_mm, measures = data.positions_mm[rows], {name: values[rows] for name, values in data.measures.items()}
    on_progress(0, 0, "response model")
    scaler, table = FeatureScaler.fit(features, positions_mm, measures, modulated)
    presses = scaler.training_presses(features, positions_mm, measures, frame_rate_hz(data.rate_hz))
    leverage = None
    if data.pad is not None and is_ensemble and len(train) <= FEW_PRESSES:
        prior = plan_prior(data.pad, data.contact, scaler.origin_mm, scaler.scale_mm)
        table, fit = refit_response(scaler, presses, table, features.windows.shape[2], prior)
        leverage = fit.leverage

    # 2. Tests for single presses, networks and Bayesian localizers
    unfitted = leave_one_out_residuals(presses, table, leverage)
    tests = tuple(SinglePressTest.fit(table, unfitted, scaler.centring, n) for n in stages(n_timed))
    bayes, residual_network, trained_share = (), {}, 1.0
    if is_ensemble:
        trained = train_members(presses, table, options, rng, on_progress, time_budget, leverage)
        networks, bayes, residual_network, trained_share = trained
    else:
        held_back = scaler.training_presses(data.features[early_stop], data.positions_mm[early_stop])
        networks = {"press": train_published(presses, held_back, rng)}
    check_trained(networks, residual_network, options)
    model = LocalizerModel(
        networks=networks,
        scaler=scaler,
        table=table,
        bayes=bayes,
        residual_network=residual_network,
        single_press=tests,
        method=options.method,
        features=data.feature_set,
        interval_factors=np.ones((n_timed + 1, 1, 3 + len(measures))),
        rate_hz=data.rate_hz,
        training_recording_sha256=data.sha256,
        trained_share=trained_share,
    )

    # 3. Uncertainty
    if data.features_at is None:
        moments = [scaler.transform(data.features[calibration])]
    else:
        moments = [scaler.transform(data.features_at(n_complete, calibration)) for n_complete in range(1, n_timed + 1)]
    stage_moments = [moments[n_complete - 1] if n_complete else moments[0] for n_complete in stages(n_timed)]
    tests = tuple(test.calibrated(presses) for test, presses in zip(tests, stage_moments, strict=True))
    model = replace(model, single_press=tests)
    true_mm = data.positions_mm[calibration]
    true_measures = {name: values[calibration] for name, values in data.measures.items()}
    defaults = LocalizerSettings()
    is_default = all(getattr(options, name) == getattr(defaults, name) for name in ("members", "hidden", "layers"))
    is_converged = trained_share * options.epochs >= CONVERGED_SHARE * defaults.epochs
    # `Experience` is that with localizers of this kind alone
    has_experience = is_default and is_ensemble and n_timed and not data.measures and is_converged
    n_trained = len(train) if has_experience else None
    levels = _n_levels(options, model.fibres)
    return calibrate_uncertainty(model, moments, true_mm, levels, true_measures, on_progress, n_trained)


def calibrate_uncertainty(
    model: LocalizerModel,
    moments: Sequence[ScaledFeatures],
    positions_mm: Array,
    levels: int,
    measures: Mapping[str, Array] | None = None,
    on_progress: OnProgress = ignore_progress,
    n_trained: int | None = None,
) -> LocalizerModel:
    """Calibrate the weights of the members, and `interval_factors`, on presses that were not used in training.

    Args:
        model: to calibrate.
        moments: features of the presses when 1, 2, ... windows are complete, or once for features without moments.
        positions_mm: of the presses; shape (Q, 2).
        levels: numbers of failed fibres to calibrate for, 0 .. `levels` - 1.
        measures: as in `evaluation.conformal`.
        on_progress: called with the stage of the work.
        n_trained: number of training presses, if the experience with other pads serves as a prior.
    """
    if model.method == "ensemble":
        model = _calibrate_scales(model, moments, positions_mm, levels, on_progress, n_trained)
    uncalibrated = replace(model, interval_factors=np.ones_like(model.interval_factors))
    n_sets = MOMENT_SUBSETS if len(moments) > 1 else INTERVAL_SUBSETS
    subsets = [failure_subsets(model.fibres, n_failed, n_sets) for n_failed in range(levels)]

    def predict(features: ScaledFeatures) -> list[list[Localization]]:
        return [[uncalibrated.predict_features(features, failed) for failed in sets] for sets in subsets]

    predictions: list[list[list[Localization]]] = []  # by moment, then by number of failed fibres
    for of_moment in map_threads(predict, moments):
        on_progress(len(predictions), len(moments), "radii")
        predictions.append(of_moment)
    prior_ratios = None
    if n_trained:
        failed_shares = np.arange(levels) / model.fibres
        experience = [Experience.at_moment(n_complete) for n_complete in range(1, len(moments) + 1)]
        expected = np.array([[each.ratio(n_trained, share) for share in failed_shares] for each in experience])
        prior_ratios = adapt_ratios(expected, predictions, positions_mm)
    factors: list[list[Array]] = []
    for moment, by_level in enumerate(predictions):
        ratios = [None] * levels if prior_ratios is None else prior_ratios[moment].tolist()
        pairs = zip(by_level, ratios, strict=True)
        factors.append([conformal(sets, positions_mm, measures, ratio) for sets, ratio in pairs])
    if len(moments) > 1:
        factors = [factors[0], *factors]  # a placeholder for 0 complete windows, where nothing is predicted
    n_presses = len(positions_mm) + PRIOR_PRESSES * (prior_ratios is not None)
    return replace(model, interval_factors=np.clip(factors, 1e-6, 1e6), radii_presses=n_presses)


def adapt_ratios(
    expected: Array, predictions: Sequence[Sequence[Sequence[Localization]]], positions_mm: Array
) -> Array | None:
    """Adapt mean ratios of distance to radius, known from other pads, to this pad; None if its presses contradict them.

    The ratios of this pad are taken as those of the others times one factor, which is estimated from the presses and a
    prior about 1 of standard deviation `PAD_SPREAD`.

    Args:
        expected: ratios by moment and number of failed fibres; shape (K, L).
        predictions: by moment, by number of failed fibres, and for some sets of them.
        positions_mm: of the presses; shape (Q, 2).
    """
    ratios = [
        [np.mean([distances(each.positions_mm, positions_mm) / each.r50_mm for each in sets]) for sets in of_moment]
        for of_moment in predictions
    ]
    log_factor = float(np.log(np.array(ratios) / expected).mean())
    variance = 1 / (RATIO_SHAPE * len(positions_mm))  # of the mean of gamma distributed ratios
    if abs(log_factor) > CONTRADICTION * np.hypot(PAD_SPREAD, np.sqrt(variance)):
        return None
    return expected * np.exp(log_factor * PAD_SPREAD**2 / (PAD_SPREAD**2 + variance))


def _n_levels(options: LocalizerSettings, fibres: int) -> int:
    """Return the count of numbers of failed fibres, 0 included, that a localizer is trained for."""
    return min(options.max_failures, fibres - 1) + 1 if options.method == "ensemble" else 1


def _calibrate_scales(
    model: LocalizerModel,
    moments: Sequence[ScaledFeatures],
    positions_mm: Array,
    levels: int,
    on_progress: OnProgress,
    n_trained: int | None,
) -> LocalizerModel:
    """Scale the expected errors of members to their errors on presses that were not used in training.

    The scales correct the weights of the members. The Bayesian localizer is overconfident after few or badly placed
    presses, since it predicts training presses by the same response that augments them. If `n_trained` is given, the
    mean of the scales is known from other pads, and the presses determine only the ratios between members.
    """
    positions = model.scaler.scale_positions(positions_mm)
    subsets = [failed for n in range(levels) for failed in failure_subsets(model.fibres, n, SCALE_SUBSETS)]

    # 1. Mean ratio of error to expected error of each member, by moment and set of failed fibres, shrunk towards the
    # expected ratio; the first axis of `outputs` and `ratios` holds the members of each of the networks `names` in turn
    ratios_of: dict[str, list[Array]] = {}  # by network
    n_presses = len(positions_mm)

    def ratios_at(moment: tuple[int, ScaledFeatures]) -> list[tuple[str, Array]]:
        n_complete, features = moment
        growth = Experience.at_moment(n_complete).growth(n_trained) if n_trained else 1.0
        rows = np.flatnonzero(features.n_complete == n_complete)  # the next press cut others short
        if not len(rows):
            return []
        names = active_networks(model.networks, n_complete, features.n_timed, bool(model.bayes))
        pairs: list[tuple[str, Array]] = []
        for failed in subsets:
            outputs = predict_members(model.networks, features[rows].without(failed), *model.corrected)
            predicted, log_error = (half[:, :, :2] for half in np.split(outputs, 2, axis=2))
            error = np.abs(predicted - positions[rows]).mean(axis=2)
            expected_error = np.exp(np.clip(log_error, MIN_LOG_ERROR, MAX_LOG_ERROR)).mean(axis=2)
            ratios = (error / expected_error).mean(axis=1)
            if n_trained:
                ratios *= growth / ratios.mean()
            ratios = (PRIOR_COUNT * growth + n_presses * ratios) / (PRIOR_COUNT + n_presses)
            n_members = [1 if name == RESIDUAL else len(model.networks[name]["last.b"]) for name in names]
            pairs += zip(names, np.split(ratios, np.cumsum(n_members)[:-1]), strict=True)
        return pairs

    numbered = list(enumerate(moments, int(len(moments) > 1)))
    for done, pairs in enumerate(map_threads(ratios_at, numbered)):
        on_progress(done, len(moments), "expected errors")
        for name, of_network in pairs:
            ratios_of.setdefault(name, []).append(of_network)

    # 2. Scale of each member
    log_scales = {name: np.log(np.mean(ratios, axis=0)) for name, ratios in ratios_of.items()}

    def scaled(name: str, weights: Weights) -> Weights:
        if name not in log_scales:
            return weights
        bias = weights["last.b"].copy()
        log_errors = slice(bias.shape[2] // 2, bias.shape[2] // 2 + 2)
        bias[:, :, log_errors] += log_scales[name][:, None, None]
        return {**weights, "last.b": bias}

    networks = {name: scaled(name, weights) for name, weights in model.networks.items()}
    return replace(model, networks=networks, residual_network=scaled(RESIDUAL, model.residual_network))


def check_trained(networks: Networks, residual_network: Weights, options: LocalizerSettings) -> None:
    """Raise InputError if a training diverged."""
    try:
        for weights in (*networks.values(), residual_network):
            check_weights(weights)
    except InputError as error:
        raise InputError(
            f"training diverged at [localizer] learning_rate {options.learning_rate:g}, try a lower one: {error}"
        ) from error


def _split_training(
    training: Indices, options: LocalizerSettings, rng: np.random.Generator
) -> tuple[Indices, Indices, Indices]:
    """Return presses for training, for early stopping if published, and for calibration."""
    share = CALIBRATION_SHARE[options.method]
    train, held_back = split_presses(training, options.split, share, rng, 2)
    if options.method == "ensemble" or len(held_back) < 2:
        return train, held_back, held_back
    return train, *split_presses(held_back, options.split, 0.5, rng, 1)


def trainable_targets(recording: Recording, presses: Indices) -> dict[str, Array]:
    """Return the depths, if they vary and are known and above 0 in all `presses`; then also forces, if known in all."""
    measures = recording.measures
    depth, force = (measures[name][presses] for name in ("depth_mm", "force_n"))
    if np.isnan(depth).any() or depth.min() <= 0 or np.ptp(np.percentile(depth, [5, 95])) <= MIN_DEPTH_RANGE_MM:
        return {}
    return {"depth_mm": measures["depth_mm"]} if np.isnan(force).any() else measures


def missing_target_lines(recording: Recording, model: LocalizerModel) -> list[str]:
    """Return lines on why a model does not predict depth or force although a recording holds some of them."""
    predicted = {target.name for target in model.scaler.measures}
    depth, force = (recording.measures[name][recording.has_position] for name in ("depth_mm", "force_n"))
    presses, n_shallow = len(depth), int((depth <= 0).sum())
    n_depth, n_force = int((~np.isnan(depth)).sum()), int((~np.isnan(force)).sum())
    if model.method != "ensemble":
        return []
    if "depth_mm" not in predicted and n_shallow:
        return [f"depth is not learnt: {n_shallow} of {presses} presses reached 0 mm or less"]
    if "depth_mm" not in predicted and 0 < n_depth < presses:
        return [f"depth is not learnt: it is known of {n_depth} of {presses} presses, expected all"]
    if "depth_mm" in predicted and "force_n" not in predicted and n_force:
        return [f"force is not learnt: it is known of {n_force} of {presses} presses, expected all"]
    return []


def split_unseen(
    recording: Recording, model: LocalizerModel | None, options: LocalizerSettings
) -> tuple[Indices, Indices]:
    """Split the presses of known position into those for training and those for a test, unseen by `model` if given."""
    positioned = np.flatnonzero(recording.has_position)
    if model is not None and (test := held_back_presses(model, recording)) is not None:
        return np.setdiff1d(positioned, test), test
    return split_presses(positioned, options.split, options.test_share, np.random.default_rng(options.seed))


def split_presses(
    presses: Indices, split: str, share: float, rng: np.random.Generator, min_training: int = MIN_TRAINING
) -> tuple[Indices, Indices]:
    """Split presses into those for training and a share that is held back.

    Args:
        presses: ascending indices.
        split: "random", or "chronological" to hold the last presses back.
        share: of the presses held back.
        rng: for a random split.
        min_training: minimum number of training presses.

    Raises:
        InputError: fewer than `min_training` presses would be left.
    """
    # a further split of training presses, which has a lower `min_training`, holds back at least one
    n_held_back = max(round(share * len(presses)), 1 if min_training < MIN_TRAINING else 0)
    if not 1 <= n_held_back <= len(presses) - min_training:
        raise InputError(
            f"recording has {len(presses)} presses of known position: a share of {share:g} holds {n_held_back} back, "
            f"expected at least 1, and {min_training} to learn from"
        )
    order = rng.permutation(presses) if split == "random" else presses
    return np.sort(order[:-n_held_back]), np.sort(order[-n_held_back:])
