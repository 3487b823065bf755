"""Calibration: learn places from a recording, and say how far off they are on presses never learnt from.

Of presses of several depths, depth is learnt as well, and force where it is known of all."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from padforge.design.common.files import provenance
from padforge.design.common.profiling import stage
from padforge.design.common.settings import or_default, validate
from padforge.design.common.validation import InputError, check_float, check_type
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense import settings
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer.bayes import TOLD
from padforge.sense.localizer.evaluation import conformal, evaluate, held_back
from padforge.sense.localizer.features import PHASES, FeatureScaler, ScaledFeatures, TrainingPresses, press_inputs
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.network import LEAST_LOG, MOST_LOG, Weights, learnt, refuse_unsound
from padforge.sense.recording.recording import Recording

LEAST_TRAINING = 3
"""Presses needed to learn from and to check on: of fewer, the span is none."""
CHECKED = {"ensemble": 0.08, "published": 0.15 / 0.85}
"""Share of the presses of training that are not learnt from but find the radii. Of the published method, 15 % of all,
half of which end the training."""
MOST_SECONDS = 1e9
"""Longest time budget: some thirty years."""
LEAST_SPREAD_MM = 0.2
"""Depths of which nine tenths lie within so much are one."""
TRUSTED, PROVEN = 2, 6
"""Presses that count for what a member expects of itself; sets of lost fibres of a size that it is proven on."""
SUBSETS = 32
"""Sets of lost fibres of a size that the radii are found on, at most."""


def calibrate(
    recording: Recording,
    options: settings.LocalizerSettings | None = None,
    *,
    split: str | None = None,
    seed: int | None = None,
    time_budget: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[LocalizerModel, dict[str, Any]]:
    """Train a localizer on a part of the presses and test it on the rest.

    Test presses enter nothing but the test, which looks at them once: not the scaling, not the training, not its
    length, not the radii. Presses whose place is not known are left out.

    Args:
        recording: readings and presses with known places.
        options: how to learn; the defaults if None. split, seed: win over those of `options`.
        time_budget: seconds to train for, with as many members as that is good for; what is found depends on the pace
            then. None for the length and the members of `options`.
        progress: called with (steps done, steps in all); in a time budget, with seconds.

    Returns:
        The localizer, and the document of `calibration.json`.

    Raises:
        InputError: an option out of range, a time budget for the published method, too few presses to hold a share
            back, or a training that diverged.
    """
    check_type("recording", recording, Recording)
    options = or_default("options", options, settings.LocalizerSettings)
    given = {key: value for key, value in (("split", split), ("seed", seed)) if value is not None}
    options = validate(settings.LocalizerSettings, {**options.model_dump(), **given}, "[localizer]")
    time_budget = None if time_budget is None else check_float("time_budget", time_budget, 0, MOST_SECONDS)
    if options.method == "published":
        if time_budget is not None:
            raise InputError("time_budget is given: method published trains until it gains no more, expected masked")
        options = options.model_copy(update={"features": "published"})
    rng = np.random.default_rng(options.seed)
    known = np.flatnonzero(recording.has_position)
    training, test = (known[part] for part in split_presses(len(known), options.split, options.test_share, rng))
    made_by = provenance("padforge sense calibrate", options.seed, packages=("torch", "safetensors"))
    made_by |= {"inputs": {"recording": recording.digest}, "recording_kind": recording.source.get("kind")}
    from padforge.design.common.parallel import one_torch_thread

    with stage("train"), one_torch_thread():
        localizer = learn(recording, training, options, rng, progress, time_budget)
    localizer = replace(localizer, split=options.split, test=tuple(test.tolist()), provenance=made_by)
    levels = range(min(options.max_failures, recording.fibres - 1) + 1) if options.method == "ensemble" else (0,)
    with stage("evaluate"):
        document = evaluate(localizer, recording, levels)
    document |= {"training_presses": len(training), "settings": options.model_dump()}
    return replace(localizer, errors=document["errors"]), document


def learn(
    recording: Recording,
    training: Indices,
    options: settings.LocalizerSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] = lambda done, total: None,
    time_budget: float | None = None,
) -> LocalizerModel:
    """Train a localizer on the presses `training` of a recording, by index.

    Of them, a share finds the radii: drawn at random, or the last ones, as the split is. The others are shown as they
    were commanded and, once more, as they would be found in the readings. The published training ends by presses of
    its own: were they those that find the radii, the weights would be those that suit them, and the radii too short.

    Raises:
        InputError: the training diverged.
    """
    taught, ending, proving = _parts(training, options, rng)
    masked = options.method == "ensemble"
    raw = press_inputs(recording.readings, recording.down_command, recording.up_command, options.features)
    measures = learnable(recording, training) if masked else {}
    shown_raw, rows = raw[taught], taught
    if masked:
        from padforge.sense.signals.press_detection import align_to_detected

        again = align_to_detected(recording.readings, recording.times_s, recording.down_command, recording.up_command)
        shown_raw += press_inputs(recording.readings, *again, options.features)[taught]
        rows = np.concatenate([taught, taught])
    shown_mm, shown_more = recording.presses_mm[rows], _of(measures, rows)
    scaling, table = FeatureScaler.fit(shown_raw, shown_mm, shown_more, PHASES[options.features])
    shown = _samples(scaling, scaling.inputs(shown_raw), shown_mm, shown_more)
    bayes, residual_network = None, {}
    if masked:
        from padforge.sense.localizer.training import train_members

        weights, bayes, residual_network = train_members(shown, table, options, rng, progress, time_budget)
    else:
        from padforge.sense.localizer.training import train_published

        held = _samples(scaling, scaling.inputs(raw[ending]), recording.presses_mm[ending], {})
        weights = train_published(shown, held, rng)
    _refuse_diverged(weights, residual_network, scaling, options)
    localizer = LocalizerModel(
        weights=weights,
        scaler=scaling,
        table=table,
        bayes=bayes,
        residual_network=residual_network,
        method=options.method,
        features=options.features,
        interval_factors=np.ones((1, 3 + len(measures))),
        rate_hz=recording.rate_hz,
        training_recording_sha256=recording.digest,
    )
    levels = min(options.max_failures, recording.fibres - 1) + 1 if masked else 1
    presses, positions_mm = scaling.inputs(raw[proving]), recording.presses_mm[proving]
    if bayes is not None:
        localizer = proven(localizer, presses, positions_mm, levels)
    return replace(localizer, interval_factors=radii(localizer, presses, positions_mm, levels, _of(measures, proving)))


def proven(localizer: LocalizerModel, presses: ScaledFeatures, positions_mm: Array, levels: int) -> LocalizerModel:
    """One whose members expect the errors that they make of presses never learnt from, and so count as they deserve.

    Of few presses, or badly placed ones, an observer is far surer than it may be: it finds the presses of training,
    moved as the response says, by that same response.
    """
    targets = localizer.scaler.targets(positions_mm)
    ratios = []
    for lost in (lost for level in range(levels) for lost in failure_subsets(localizer.fibres, level, PROVEN)):
        fibre_mask = presses.fibre_mask & ~np.isin(np.arange(localizer.fibres), lost)
        outputs = learnt(
            localizer.weights, presses.inputs, fibre_mask, "ensemble", localizer.bayes, localizer.residual_network
        )
        found, logs = np.split(outputs, 2, axis=2)
        ratios.append(np.abs(found - targets).mean(axis=2) / np.exp(np.clip(logs, LEAST_LOG, MOST_LOG)).mean(axis=2))
    whole = np.mean(ratios, axis=0)
    logs = np.log((TRUSTED + whole.sum(axis=1)) / (TRUSTED + whole.shape[1]))

    def honest(weights: Weights, more: Array) -> Weights:
        bias = weights["last.b"].copy()
        bias[:, :, 2:] += more[:, None, None]
        return {**weights, "last.b": bias}

    weights, residual_network = honest(localizer.weights, logs[:-1]), honest(localizer.residual_network, logs[-1:])
    return replace(localizer, weights=weights, residual_network=residual_network)


def _refuse_diverged(
    weights: Weights, residual_network: Weights, scaling: FeatureScaler, options: settings.LocalizerSettings
) -> None:
    entries = scaling.entries(options.method)
    try:
        refuse_unsound(weights, entries, options.method, len(scaling.measures))
        if residual_network:
            refuse_unsound(residual_network, entries + TOLD, options.method)
    except InputError as error:
        raise InputError(
            f"training diverged at [localizer] learning_rate {options.learning_rate:g}, try a lower one: {error}"
        ) from error


def _parts(
    training: Indices, options: settings.LocalizerSettings, rng: np.random.Generator
) -> tuple[Indices, Indices, Indices]:
    """Presses to learn from, those that end a published training and those that find the radii."""
    taught, checked = (
        training[part] for part in split_presses(len(training), options.split, CHECKED[options.method], rng, least=2)
    )
    if options.method == "ensemble" or len(checked) < 2:
        return taught, checked, checked
    ending, proving = (checked[part] for part in split_presses(len(checked), options.split, 0.5, rng, least=1))
    return taught, ending, proving


def _samples(
    scaling: FeatureScaler, presses: ScaledFeatures, positions_mm: Array, measures: Mapping[str, Array]
) -> TrainingPresses:
    return TrainingPresses(presses.inputs, presses.fibre_mask, scaling.targets(positions_mm, measures), scaling.stretch)


def _of(measures: Mapping[str, Array], presses: Indices) -> dict[str, Array]:
    return {name: values[presses] for name, values in measures.items()}


def learnable(recording: Recording, presses: Indices) -> dict[str, Array]:
    """What is learnt of the presses beside their places, (Q,) of all there are, by the names of `Recording.measures`.

    Depth, where it is known of all `presses` and not the same; then force too, where it is known of all.
    """
    measures = recording.measures
    deep, force = (measures[name][presses] for name in ("depth_mm", "force_n"))
    if np.isnan(deep).any() or deep.min() <= 0 or np.ptp(np.percentile(deep, [5, 95])) <= LEAST_SPREAD_MM:
        return {}
    return measures if not np.isnan(force).any() else {"depth_mm": measures["depth_mm"]}


def left_out(recording: Recording, localizer: LocalizerModel) -> list[str]:
    """Why `localizer` has not learnt a depth or force that is known of some presses of `recording`, a line each."""
    if localizer.method != "ensemble":
        return []
    learnt = {target.name for target in localizer.scaler.measures}
    measures = {name: values[recording.has_position] for name, values in recording.measures.items()}
    deep, force = measures["depth_mm"], measures["force_n"]
    out = []
    if "depth_mm" not in learnt:
        above = int((deep <= 0).sum())
        if above:
            out.append(f"depth is not learnt: {above} of {len(deep)} presses reached 0 mm or less")
        elif 0 < (known := int((~np.isnan(deep)).sum())) < len(deep):
            out.append(f"depth is not learnt: it is known of {known} of {len(deep)} presses, needed is of all")
    elif "force_n" not in learnt and (known := int((~np.isnan(force)).sum())):
        out.append(f"force is not learnt: it is known of {known} of {len(force)} presses, needed is of all")
    return out


def radii(
    localizer: LocalizerModel,
    presses: ScaledFeatures,
    positions_mm: Array,
    levels: int,
    measures: Mapping[str, Array] | None = None,
) -> Array:
    """(levels, 3 + T) what makes of expected errors, by number of lost fibres, standard deviations and radii."""
    plain = replace(localizer, interval_factors=np.ones((1, localizer.interval_factors.shape[1])))
    by_level = (failure_subsets(localizer.fibres, level, SUBSETS) for level in range(levels))
    found = ([plain.predict_features(presses, subset) for subset in subsets] for subsets in by_level)
    return np.clip([conformal(each, positions_mm, measures) for each in found], 1e-6, 1e6)


def split_unseen(
    recording: Recording, localizer: LocalizerModel | None, options: settings.LocalizerSettings
) -> tuple[Indices, Indices]:
    """Presses of known place to learn from, and those to test on, which `localizer`, if there is one, has not learnt.

    Raises:
        InputError: the localizer was recalibrated by the recording, or there are too few presses.
    """
    known, digest = np.flatnonzero(recording.has_position), recording.digest
    if localizer is not None and digest in localizer.recalibrated_by:
        raise InputError("recording is one that the localizer was recalibrated by, expected one it has not seen")
    if localizer is not None and digest == localizer.training_recording_sha256:
        test = held_back(localizer, recording)
        return np.setdiff1d(known, test), test
    rng = np.random.default_rng(options.seed)
    training, test = split_presses(len(known), options.split, options.test_share, rng)
    return known[training], known[test]


def split_presses(
    presses: int, split: str, share: float, rng: np.random.Generator, least: int = LEAST_TRAINING
) -> tuple[Indices, Indices]:
    """Indices (ascending) of the presses to learn from and of those held back: drawn at random, or the last.

    Raises:
        InputError: a share of so few presses leaves none on one side, or fewer than `least` to learn from.
    """
    held = max(round(share * presses), 1 if least < LEAST_TRAINING else 0)
    if not 1 <= held <= presses - least:
        raise InputError(
            f"recording has {presses} presses of known place: a share of {share:g} holds {held} back, "
            f"expected at least 1, and {least} to learn from"
        )
    order = rng.permutation(presses) if split == "random" else np.arange(presses)
    return np.sort(order[:-held]), np.sort(order[-held:])
