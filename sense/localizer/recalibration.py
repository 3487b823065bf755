"""What changes in a pad as a whole when it is re-made, re-mounted or worn: few numbers, found from few presses.
Every fibre answers by its own factor more or less, and the pad lies shifted, turned and stretched under the arm. All
fold into what a localizer has anyway, the scales of its inputs and its last layer, so that a corrected one is one like
any other.

Recalibration: a localizer learnt long ago follows its pad by a few new presses, or stays as it was.
A pad that drifted needs little: its network is adapted gently (`fine_tuning`). One that was re-made or re-mounted needs
an `affine_correction` first. Whether either is worth it is tried by cross-validation: presses left out of it in turn
are found before and after. The document's errors are those of presses left out; what is kept in the end has seen them
all.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from types import MappingProxyType
from typing import Any

import numpy as np

from padforge.design.common.files import provenance
from padforge.design.common.validation import InputError, check_int, check_type
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense.arrays import Array, Floats, Indices
from padforge.sense.localizer.evaluation import conformal, distances, error_row
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.localizer.model import Localization, LocalizerModel, joined
from padforge.sense.localizer.network import Weights
from padforge.sense.recording.recording import Recording

GAIN, TURN, SHIFT = 0.2, 0.05, 0.1
"""Spreads expected: of the logarithm of a gain, of the angle (radians) and the stretch, of the shift (spans)."""
IN_R90 = 1.645
"""Standard deviations in the half-width that holds 90 % of what is normally distributed."""
STEP = 0.02
"""Way over which slopes are taken, in these spreads: shorter ones drown in the rounding of the network."""


def fit_correction(
    localizer: LocalizerModel,
    raw: PressFeatures,
    positions_mm: Array,
    measures: Mapping[str, Array] = MappingProxyType({}),
) -> LocalizerModel:
    """The corrected localizer that finds presses nearest to where they were, in robust least squares.

    A correction costs the square of its size in the spreads expected, so of three presses little is made.

    Args:
        raw: inputs of Q presses in volts. positions_mm: (Q, 2).
        measures: (Q,) of those that the localizer has learnt, as far as they are known; NaN tells nothing.
    """
    from scipy.optimize import least_squares  # slow to import, and needed here only

    expected = localizer.predict_features(localizer.scaler.inputs(raw))

    def off(numbers: Array) -> Array:
        # Numbers are counted from 1, since the solver takes its steps relative to them.
        found = _corrected(localizer, numbers - 1)
        presses = found.predict_features(found.scaler.inputs(raw))
        misses = (presses.positions_mm - positions_mm) / expected.std_mm
        more = [
            (each.values - measures[name]) / (expected.measures[name].r90 / IN_R90)
            for name, each in presses.measures.items()
            if name in measures
        ]
        return np.nan_to_num(np.concatenate([misses.ravel(), *more, numbers - 1]))

    solved = least_squares(off, np.ones(localizer.fibres + 4), loss="soft_l1", diff_step=STEP, xtol=1e-2, ftol=1e-3)
    numbers = solved.x - 1
    return replace(_corrected(localizer, numbers), table=_moved_table(localizer, *_parts(localizer, numbers)[1:]))


def _parts(localizer: LocalizerModel, numbers: Array) -> tuple[Array, Array, Array]:
    """Gains (C,), turn (2, 2) and shift (2,), in spans, from numbers in spreads."""
    angle, stretch = TURN * numbers[-4:-2]
    turn = np.exp(stretch) * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.exp(GAIN * numbers[:-4]), turn, SHIFT * numbers[-2:]


def _corrected(localizer: LocalizerModel, numbers: Array) -> LocalizerModel:
    gains, turn, shift = _parts(localizer, numbers)
    before, bayes, gains = localizer.scaler, localizer.bayes, gains[:, None]
    return replace(
        localizer,
        weights=_turned(localizer.weights, turn, shift),
        bayes=bayes and bayes.moved(turn, shift),
        residual_network=_turned(localizer.residual_network, turn, np.zeros(2)) if bayes else {},
        scaler=replace(before, centre=gains * before.centre, spread=gains * before.spread, usual=gains * before.usual),
    )


def _turned(weights: Weights, turn: Array, shift: Array) -> Weights:
    last, bias = weights["last.w"].copy(), weights["last.b"].copy()
    last[..., :2] = last[..., :2] @ turn.T
    bias[..., :2] = bias[..., :2] @ turn.T + shift
    return {**weights, "last.w": last, "last.b": bias}


def _moved_table(localizer: LocalizerModel, turn: Array, shift: Array) -> Floats:
    """The table by places as they are called now; over the edge, what is at the edge."""
    from scipy.interpolate import RegularGridInterpolator

    grid = np.linspace(-1, 1, len(localizer.table))
    places = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1)
    before = np.clip((places - shift) @ np.linalg.inv(turn).T, -1, 1)
    return RegularGridInterpolator((grid, grid), localizer.table)(before).astype(np.float32)


FORMAT = "padforge-recalibration/2"
LEAST_PRESSES = 10
"""New presses needed: fewer can neither change much nor show that it was for the better."""
FOLDS = 5
"""Parts that are left out in turn."""
CORRECT_FROM, ADAPT_FROM = 2.0, -1.0
"""Gains from which a correction, which is coarse, and adapting, which is gentle, are kept; in standard errors. Adapting
gains almost always, but less than a hundred presses can show, so it is kept unless they speak against it."""
SUBSETS = 16
"""Sets of lost fibres of a size that are looked at, at most."""

Measures = Mapping[str, Array]
FoundByLoss = Mapping[tuple[int, ...], Localization]
Change = Callable[[LocalizerModel, PressFeatures, Array, Measures], LocalizerModel]


def recalibrate(
    localizer: LocalizerModel,
    recording: Recording,
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[LocalizerModel, dict[str, Any]]:
    """Follow a pad that has changed since `localizer` was trained.

    The radii only ever grow: they are widened where presses left out lie outside more often than they should. What the
    localizer says of its own test, `errors`, stays that of the calibration.

    Args:
        recording: of the pad as it is now, with some 20 to 500 presses of known place; others are not looked at.
        seed: of the parts left out in turn, and of adapting.
        progress: called with (steps done, steps in all).

    Returns:
        The localizer to use from now on, which finds places as the old one did if nothing was gained, and the document
        of `recalibration.json`: "changes" that were kept; "before" and "after", rows as "errors" of `evaluate` on the
        new presses; "gain_mm" of the errors' mean over all numbers of lost fibres, and its "standard_error_mm".

    Raises:
        InputError: too few presses of known place, or a recording that does not suit the localizer.
    """
    check_type("localizer", localizer, LocalizerModel)
    known = np.flatnonzero(check_type("recording", recording, Recording).known)
    seed = check_int("seed", seed, 0, 2**32 - 1)
    if len(known) < LEAST_PRESSES:
        raise InputError(f"recording has {len(known)} presses of known place, expected at least {LEAST_PRESSES}")
    rows = np.random.default_rng(seed).permutation(known)
    raw, positions_mm = localizer.raw_features(recording)[rows], recording.presses_mm[rows]
    measures = {each.name: recording.measures[each.name][rows] for each in localizer.scaler.measures}
    levels = range(len(localizer.interval_factors))
    subsets = [subset for level in levels for subset in failure_subsets(localizer.fibres, level, SUBSETS)]
    validation = CrossValidation(raw, positions_mm, np.array_split(np.arange(len(rows)), FOLDS), subsets, measures)
    before = validation.found([localizer] * FOLDS)
    now, after, changes = _changed(localizer, validation, before, seed, progress)
    gain, error = validation.gain(before, after)
    made_by = provenance("padforge sense recalibrate", seed, packages=("torch", "safetensors"))
    made_by["inputs"] = {"recording": recording.digest, "localizer": dict(localizer.provenance)}
    made_by["recording_kind"] = recording.source.get("kind")
    widened = validation.widened(after)
    document = {
        "format": FORMAT,
        "presses": len(rows),
        "changes": changes,
        "before": validation.summary(before),
        "after": validation.summary(after),
        "gain_mm": gain,
        "standard_error_mm": error,
        "widened": widened.tolist(),
        "provenance": made_by,
    }
    now = replace(
        now,
        interval_factors=np.minimum(now.interval_factors * widened, 1e6),
        recalibrated_by=(*localizer.recalibrated_by, recording.digest),
        provenance=made_by,
    )
    return now, document


def _changed(
    localizer: LocalizerModel,
    validation: "CrossValidation",
    before: FoundByLoss,
    seed: int,
    progress: Callable[[int, int], None],
) -> tuple[LocalizerModel, FoundByLoss, list[str]]:
    """The localizer with the changes that are worth it, what is found of presses left out, and the changes' names."""
    steps, total = count(1), 2 + (FOLDS + 1 if localizer.method == "ensemble" else 0)

    def step() -> None:
        progress(next(steps), total)

    now, kept, after, changes = localizer, [localizer] * FOLDS, before, []
    corrected = validation.changed(kept, fit_correction)
    step()
    found = validation.found(corrected)
    gain, error = validation.gain(after, found)
    if gain > CORRECT_FROM * error:
        now, kept, after = fit_correction(now, *validation.presses), corrected, found
        changes.append("corrected")
    step()
    if localizer.method == "ensemble":

        def adapt(
            old: LocalizerModel, inputs: PressFeatures, positions_mm: Array, measures: Measures
        ) -> LocalizerModel:
            changed = _adapted(old, inputs, positions_mm, measures, np.random.default_rng([seed, len(inputs)]))
            step()
            return changed

        adapted = validation.changed(kept, adapt)
        found = validation.found(adapted)
        gain, error = validation.gain(after, found)
        if gain > ADAPT_FROM * error:
            now, after = adapt(now, *validation.presses), found
            changes.append("adapted")
    progress(total, total)
    return now, after, changes


def _adapted(
    localizer: LocalizerModel, raw: PressFeatures, positions_mm: Array, measures: Measures, rng: np.random.Generator
) -> LocalizerModel:
    from padforge.sense.localizer.features import TrainingPresses
    from padforge.sense.localizer.training import adapt

    scaling, scaled = localizer.scaler, localizer.scaler.inputs(raw)
    found = localizer.predict_features(
        scaled
    ).measures  # where it is not known how deep a press was, it goes on being found so
    known = {name: np.where(np.isnan(values), found[name].values, values) for name, values in measures.items()}
    samples = TrainingPresses(scaled.inputs, scaled.fibre_mask, scaling.targets(positions_mm, known), scaling.stretch)
    given, lost = (samples, localizer.table), len(localizer.interval_factors) - 1
    weights, bayes, residual_network = (
        adapt(localizer.weights, *given, lost, rng),
        localizer.bayes,
        localizer.residual_network,
    )
    if bayes is not None:
        residual_network = adapt(residual_network, *given, lost, rng, bayes=bayes)
    return replace(localizer, weights=weights, residual_network=residual_network)


class CrossValidation:
    """Cross-validation on the new presses.

    Args:
        raw, positions_mm: inputs and places (Q, 2) of the presses. folds: indices that are left out in turn, in order.
        subsets: the sets of lost fibres to look at, by number of lost fibres.
        measures: (Q,) of each that the localizers have learnt, NaN where it is not known.
    """

    def __init__(
        self,
        raw: PressFeatures,
        positions_mm: Array,
        folds: Sequence[Indices],
        subsets: Sequence[tuple[int, ...]],
        measures: Measures = MappingProxyType({}),
    ) -> None:
        self._raw, self._positions_mm, self._measures = raw, positions_mm, measures
        self._folds, self._subsets = folds, subsets

    @property
    def presses(self) -> tuple[PressFeatures, Array, Measures]:
        """Inputs, places and measures of them all."""
        return self._raw, self._positions_mm, self._measures

    def changed(self, localizers: Sequence[LocalizerModel], change: Change) -> list[LocalizerModel]:
        """The localizers, one a fold, each changed by the presses that its fold does not hold."""
        out = []
        for localizer, fold in zip(localizers, self._folds, strict=True):
            rest = np.setdiff1d(np.arange(len(self._positions_mm)), fold)
            measures = {name: values[rest] for name, values in self._measures.items()}
            out.append(change(localizer, self._raw[rest], self._positions_mm[rest], measures))
        return out

    def found(self, localizers: Sequence[LocalizerModel]) -> FoundByLoss:
        """Each press found by the localizer of the fold that holds it, with each set of lost fibres."""
        scaled = [each.scaler.inputs(self._raw[fold]) for each, fold in zip(localizers, self._folds, strict=True)]
        out = {}
        for lost in self._subsets:
            parts = [each.predict_features(part, lost) for each, part in zip(localizers, scaled, strict=True)]
            out[lost] = joined(parts)
        return out

    def gain(self, before: FoundByLoss, after: FoundByLoss) -> tuple[float, float]:
        """By how much the errors shrink, mm, the mean over numbers of lost fibres, and its standard error."""
        by_level = [
            np.mean([self._errors(before[lost]) - self._errors(after[lost]) for lost in level], axis=0)
            for level in self._levels()
        ]
        shrunk = np.mean(by_level, axis=0)
        return float(shrunk.mean()), float(shrunk.std(ddof=1) / np.sqrt(len(shrunk)))

    def summary(self, found: FoundByLoss) -> list[dict[str, Any]]:
        """Rows as "errors" of `evaluate`."""
        return [
            error_row(len(level[0]), [found[lost] for lost in level], self._positions_mm, self._measures)
            for level in self._levels()
        ]

    def widened(self, found: FoundByLoss) -> Array:
        """(K, 3) what makes the deviations and radii hold at least for these presses; 1 where they do."""
        by_level = ([found[lost] for lost in sets] for sets in self._levels())
        return np.maximum([conformal(each, self._positions_mm, self._measures) for each in by_level], 1.0)

    def _levels(self) -> list[list[tuple[int, ...]]]:
        sizes = dict.fromkeys(len(lost) for lost in self._subsets)
        return [[lost for lost in self._subsets if len(lost) == size] for size in sizes]

    def _errors(self, found: Localization) -> Array:
        return distances(found.positions_mm, self._positions_mm)


def recalibration_lines(document: Mapping[str, Any]) -> list[str]:
    """A recalibration for people."""
    gain, error = document["gain_mm"], document["standard_error_mm"]
    names = ("lost  sets", "before mm", "after mm", "in r90 before", "in r90 after")
    verdict = (
        f"{' and '.join(document['changes'])}: errors shrink by {gain:.3f} mm (standard error {error:.3f} mm)"
        if document["changes"]
        else "nothing gained: places are found as before"
    )
    return [
        f"{document['presses']} new presses, each found by what was changed without it",
        "  ".join(names),
        *(
            f"{old['n_failed']:4d} {old['subsets']:5d}  {old['mean_mm']:9.2f}  {new['mean_mm']:8.2f}  "
            f"{old['within_r90']:13.1%}  {new['within_r90']:12.1%}"
            for old, new in zip(document["before"], document["after"], strict=True)
        ),
        verdict,
    ]
