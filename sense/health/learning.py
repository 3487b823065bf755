"""Learning what a healthy pad is like from a recording of one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from padforge.design.common.parallel import one_torch_thread, run_tasks
from padforge.design.common.validation import InputError, check_float, check_int, check_mapping, check_type, short_repr
from padforge.sense.recordings.processing.limits import LEAST_SPREAD_V, Array, Floats, Indices, Mask, as_numbers
from padforge.sense.recordings.recording import Recording, rate_of

from padforge.sense.health.alarm_thresholds import Tail
from padforge.sense.health.fault_likelihoods import FaultLikelihoods
from padforge.sense.health.fibre_prediction import MEMBERS, REST, Weights, expected, member, shapes_of, traces_of, train_predictors
from padforge.sense.health.health_model import COMMANDED, DETECTED, FALSE_ALARMS, SETTLED, HealthModel, checked_presses
from padforge.sense.health.schema import LEAST_PRESSES, MAX_FALSE_ALARMS, MOST_LOST, WEAK_PRESSES

BLOCK = 50
"""Each member learns from all presses but its own fold, of blocks of successive ones: neighbours share what drifts."""
LOSSES = 4
"""Random choices of fibres left out from which it is learnt what is chance without them."""


def learn_health(
    recording: Recording, held_back: Sequence[int], provenance: Mapping[str, Any]
) -> dict[str, HealthModel]:
    """Learn what the healthy pad gives from the presses of a recording but those `held_back`, by index.

    Args:
        provenance: of the calibration that this is a part of; its "seed" is that of all that is random here.

    Returns:
        By name of the files, one model for recordings whose presses were commanded, and one for those that are found.

    Raises:
        InputError: too few presses, no living fibre, or an argument of another kind.
    """
    from padforge.sense.recordings.processing.press_alignment import (
        as_detected,  # compiled, which takes a moment to load
    )

    learnt = np.ones(len(check_type("recording", recording, Recording).presses_mm), dtype=bool)
    away = as_numbers(held_back, np.int64, "held_back")
    if away.ndim != 1 or not ((away >= 0) & (away < len(learnt))).all():
        raise InputError(f"held_back is {short_repr(held_back)}, allowed are presses from 0 to {len(learnt) - 1}")
    learnt[away] = False
    seed = check_int("the seed of provenance", check_mapping("provenance", provenance).get("seed"), 0, 2**64 - 1)
    readings, times_s = recording.readings, recording.times_s
    commanded = recording.begun, recording.lifted
    edges = {COMMANDED: commanded, DETECTED: as_detected(readings, times_s, *commanded)}

    def fit(name: str) -> HealthModel:
        begun, lifted = (edge[learnt] for edge in edges[name])
        rng = np.random.default_rng(seed)
        return fit_health_model(readings, times_s, begun, lifted, rng=rng, provenance=provenance)

    with one_torch_thread():
        found = dict(run_tasks((name, partial(fit, name)) for name in edges))
    return {name: found[name] for name in edges}


def fit_health_model(
    readings: Array,
    times_s: Array,
    begun: Indices,
    lifted: Indices,
    *,
    rng: np.random.Generator,
    false_alarms: float = FALSE_ALARMS,
    provenance: Mapping[str, Any] | None = None,
) -> HealthModel:
    """Learn from a recording of a healthy pad.

    Presses that lack a reading (NaN) of a living fibre are left out. One living fibre is enough for what its own
    readings tell (stuck, noisy, offset); whether it answers rightly only two or more tell. From fewer than
    WEAK_PRESSES a press at an unusual place looks like a weak fibre; such models never call one weak.

    Args:
        readings: (R, C) volts, NaN where missing. times_s: (R,) ascending, s.
        begun, lifted: (Q,) first reading after the probe was sent down, and up.
        rng: source of all that is random. false_alarms: above 0, at most 0.1.

    Raises:
        InputError: shapes, indices or the rate of false alarms out of range, fewer than 300 presses that are
            whole, or no living fibre.
    """
    if not (false_alarms := check_float("false alarms a press", false_alarms, 0.0, MAX_FALSE_ALARMS)) > 0:
        raise InputError(f"false alarms a press are {false_alarms}, allowed is above 0 to {MAX_FALSE_ALARMS}")
    check_type("rng", rng, np.random.Generator)
    readings, times_s, begun, lifted = checked_presses(readings, times_s, begun, lifted)
    dead = dead_fibres(readings)
    traces = _whole_traces(readings, begun, lifted, dead)
    shapes, inputs, targets = shapes_of(traces)
    held_out = _HeldOut.train(inputs, targets, rng)
    measured = traces[held_out.settled], targets[held_out.settled]
    evidence = FaultLikelihoods.fit(*measured, *held_out.without(np.array([], dtype=np.int64)), shapes.targets, rng)
    tail = _tail(evidence, measured, held_out, rng)
    rests = traces[:, :, :REST].mean(axis=2)
    return HealthModel(
        shapes=shapes,
        weights=held_out.weights,
        evidence=evidence,
        tail=tail if len(traces) >= WEAK_PRESSES else tail.without("weak"),
        rests=np.stack([rests.min(axis=0), rests.max(axis=0)]),
        fibres=readings.shape[1],
        dead=tuple(dead.tolist()),
        rate_hz=rate_of(times_s),
        presses=len(traces),
        false_alarms=false_alarms,
        provenance=provenance or {},
    )


def dead_fibres(readings: Array) -> Indices:
    """Indices of fibres of (R, C) readings that give one value, mostly nothing, or, unlike most, mostly the end of
    their range."""
    missing = np.isnan(readings).mean(axis=0) > 0.5
    spread = np.where(missing, 0.0, readings)
    low, high = np.nanmin(spread, axis=0), np.nanmax(spread, axis=0)
    at_end = np.maximum((spread == low).mean(axis=0), (spread == high).mean(axis=0))
    # Where there is no noise every fibre rests at the end of its range.
    saturated = (at_end > 0.5) & (np.median(at_end) <= 0.5)
    return np.flatnonzero(missing | (high - low < LEAST_SPREAD_V) | saturated)


def _whole_traces(readings: Array, begun: Indices, lifted: Indices, dead: Indices) -> Array:
    """(Q, L, TRACE) traces of the living fibres, of the presses that lack none of their readings."""
    living = np.setdiff1d(np.arange(readings.shape[1]), dead)
    if len(living) == 0:
        raise InputError(f"all {len(dead)} fibres are dead: they read one value, or nothing; one must live")
    traces = traces_of(readings[:, living], begun, lifted)
    traces = traces[np.isfinite(traces).all(axis=(1, 2))]
    if len(traces) < LEAST_PRESSES:
        raise InputError(f"recording has {len(traces)} whole presses, health is learnt from {LEAST_PRESSES} or more")
    return traces


@dataclass(frozen=True)
class _HeldOut:
    """Members that each never saw a fold of the presses: of its own presses a network thinks too well.

    Attributes:
        inputs: (Q, L, N), targets: (Q, L, T), scaled. fold: (Q,) of each press. settled: (Q,) presses to learn from.
    """

    inputs: Floats
    targets: Array
    fold: Indices
    settled: Mask
    weights: Weights

    @classmethod
    def train(cls, inputs: Floats, targets: Array, rng: np.random.Generator) -> "_HeldOut":
        presses = np.arange(len(inputs))
        fold, settled = presses // min(BLOCK, len(inputs) // (4 * MEMBERS)) % MEMBERS, presses >= SETTLED
        rows = [np.flatnonzero(settled & (fold != k)) for k in range(MEMBERS)]
        return cls(inputs, targets, fold, settled, train_predictors(inputs, targets, rows, rng))

    def without(self, lost: Indices) -> tuple[Array, Array]:
        """Means and spreads of settled presses without the fibres `lost`, by the member that never saw the press."""
        mean, spread = np.empty_like(self.targets), np.empty_like(self.targets)
        for k in range(MEMBERS):
            own = self.fold == k
            alive = np.tile(~np.isin(np.arange(self.inputs.shape[1]), lost), (own.sum(), 1))
            mean[own], spread[own] = expected(member(self.weights, k), self.inputs[own], alive)
        return mean[self.settled], spread[self.settled]


def _tail(
    evidence: FaultLikelihoods, measured: tuple[Array, Array], held_out: _HeldOut, rng: np.random.Generator
) -> Tail:
    """What is chance, learnt for each number of fibres left out; of those left out none has a say."""
    fibres, ratios = measured[0].shape[1], []
    for lost in range(min(MOST_LOST, fibres - 1) + 1):
        told = []
        for chosen in [rng.permutation(fibres)[:lost] for _ in range(LOSSES if lost else 1)]:
            stay, begin = evidence.ratios(*measured, *held_out.without(chosen))
            stay[:, chosen] = begin[:, chosen] = 0.0
            told.append((stay, begin))
        ratios.append((np.concatenate([stay for stay, _ in told]), np.concatenate([begin for _, begin in told])))
    return Tail.fit(ratios)
