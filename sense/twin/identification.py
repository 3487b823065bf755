"""System identification of a printed pad from presses at known positions alone.

1. The most common depth is kept, and a response computed for each press and channel.
2. Channels that respond to the position at all are live: a Gaussian process explains them better than noise.
3. Wirings and poses are searched for on the plan; each of the best is fitted as built, and the most probable one taken.
4. It is fitted to all presses, with an angular term if held-out presses ask for one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from padforge.design import Morphology
from padforge.design.common.validation import InputError, check_int, check_type
from padforge.design.paths.curves import lengths
from padforge.design.settings import sensed_rectangle
from padforge.design.twin import MAX_INFORMATION_GAIN, Twin, TwinChannel, TwinReadings, TwinScatter
from padforge.sense.arrays import Array, Indices, Mask
from padforge.sense.recording.recording import Recording
from padforge.sense.simulation.simulated_recording import measure_rig_settings
from padforge.sense.twin.as_built import AsBuiltPad, PadPlan
from padforge.sense.twin.fitting import AsBuiltFit, Priors, estimate_scatter, fit_as_built
from padforge.sense.twin.responses import Responses, compute_responses, fisher_information, fit_gp, select_one_depth
from padforge.sense.twin.wiring import Wiring, find_wirings

PROFILE_POINTS, MIN_WEIGHT = 13, 0.01
"""Points of the sensitivity profile of a twin, and the least weight that counts."""
MIN_PRESSES = 60
MIN_SIDE = 0.5
"""Least width and height of what was pressed, as a share of the rectangle half a pitch beyond the outermost fibres."""
HELD_OUT = 0.15
"""Share of the presses that are held out."""
MAX_PRESSES = 2000
"""Presses of the last fit."""
N_CANDIDATES, N_COMPARED = 8, 150
"""Wirings that are fitted, and presses by which they are compared: residuals are correlated over about half a grid
unit, so that more presses would count the same evidence twice."""
FIRST_PRIORS = Priors(lateral_offset_mm=1.0, log_sensitivity=0.2)
MIN_LOG_BAYES_FACTOR = 10.0
"""From which on a channel is live, and another wiring is ruled out."""
SAME_LOG_EVIDENCE = 1.0
"""Difference of log evidence below which two fits are equally good."""
MIN_ANGULAR_GAIN = 0.01
"""Share of the variance of held-out responses that an angular term must explain."""
MIN_MATCH = 0.25
"""Share of the variance that the best wiring must explain on the plan, else the recording is of another pad."""

OnProgress = Callable[[str, int, int], None]
"""Called with (what is being done, steps done, total)."""


@dataclass(frozen=True)
class Identification:
    """An identified pad; C' channels of the recording are live.

    Attributes:
        pad: as planned.
        fit: as built, with its uncertainty; its channels are the live ones.
        live: their indices in the recording; shape (C',).
        explained: share of the variance of held-out responses; shape (C',).
        explained_on_plan: the same if every fibre lay as planned, mean over channels.
        explained_by_straight: the same of straight fibres in their best pose and wiring; None for a straight plan.
        noise_v: scatter of each channel's responses that neither position nor history explains; shape (C,).
        noise: that of live channels as a share of full scale.
        alternatives: other wirings that the presses do not rule out.
        readings: statistics of the readings; None where there are too few presses.
        scatter: part of the noise that grows with the response.
        training: responses of the live channels that were fitted.
        held_out: responses of the live channels that were held out.
    """

    pad: Morphology
    fit: AsBuiltFit
    live: Indices
    explained: Array
    explained_on_plan: float
    explained_by_straight: float | None
    noise_v: Array
    noise: float
    alternatives: list[Wiring]
    readings: TwinReadings | None
    scatter: TwinScatter
    training: Responses
    held_out: Responses

    def lateral_offsets_mm(self) -> list[tuple[Array, Array, Mask]]:
        """Compute how far each live channel's fibre lies to the left of its plan.

        Returns:
            For each: offset of its elements (F,), mm; standard deviation (F,), mm; and mask (F,) of those within what
            was pressed.
        """
        built, unit_mm = self.fit.pad, self.pad.unit_mm
        pressed = built.plan.to_grid(built.transform.to_plan(self.training.positions_mm))
        low, high = pressed.min(axis=0), pressed.max(axis=0)
        out = []
        for row, fibre in enumerate(built.fibres):
            planned, tangent = built.plan.paths[fibre], built.plan.tangents[fibre]
            offset = built.path(row)[0] - planned
            left = offset[:, 1] * tangent[:, 0] - offset[:, 0] * tangent[:, 1]
            within = ((planned >= low) & (planned <= high)).all(axis=1)
            out.append((unit_mm * left, unit_mm * self.fit.offset_std(row), within))
        return out

    @property
    def twin(self) -> Twin:
        """The pad as a twin, without provenance."""
        built, unit_mm = self.fit.pad, self.pad.unit_mm
        paths_mm: list[Array | None] = [None] * len(self.pad.knots)
        sensitivities: list[Array | None] = list(paths_mm)
        channels = [TwinChannel(c, None, 0.0, float(noise_v), 0.0) for c, noise_v in enumerate(self.noise_v)]
        fibre_lengths = lengths(self.pad)
        for row, channel in enumerate(self.live.tolist()):
            path, sensitivity = built.path(row)
            fibre, mean = built.fibres[row], sensitivity.mean()
            ends = [1.5 * path[:1] - 0.5 * path[1:2], (path[1:] + path[:-1]) / 2, 1.5 * path[-1:] - 0.5 * path[-2:-1]]
            paths_mm[fibre], sensitivities[fibre] = self.pad.to_mm(np.vstack(ends)), sensitivity / mean
            gain_v = float(built.channel_values[row, 0] * mean * fibre_lengths[fibre])
            explained = float(self.explained[row])
            channels[channel] = replace(channels[channel], fibre=fibre, gain_v=gain_v, explained=explained)
        distance, weight, angular_weight = _sample_profile(built)
        pressed = built.transform.to_plan(self.training.positions_mm)
        return Twin(
            morphology=self.pad,
            channels=tuple(channels),
            frame=built.transform,
            distance_mm=distance * unit_mm,
            weight=weight,
            as_built_mm=tuple(paths_mm),
            noise=self.noise,
            sensed_mm=tuple(np.ptp(pressed, axis=0).tolist()),
            presses=len(self.training),
            angular_weight=angular_weight if angular_weight.any() else None,
            sensitivity=tuple(sensitivities),
            readings=self.readings,
            scatter=self.scatter,
        )


def _sample_profile(pad: AsBuiltPad) -> tuple[Array, Array, Array]:
    """Return distances (PROFILE_POINTS,), grid units, up to where weights are negligible, and w and v there."""
    fine = np.linspace(0, pad.max_distance, 400)
    felt = np.flatnonzero(np.abs(pad.profile(fine)).max(axis=0) > MIN_WEIGHT)
    distance = np.linspace(0, min(fine[felt[-1]] * (1 + 1 / PROFILE_POINTS), pad.max_distance), PROFILE_POINTS)
    weights = pad.profile(distance)
    weights[:, -1] = 0.0
    weight, angular_weight = weights / np.abs(weights[0]).max()
    return distance, weight, angular_weight


def identify(
    recording: Recording,
    pad: Morphology,
    seed: int = 0,
    on_progress: OnProgress = lambda what, done, total: None,
) -> Twin:
    """Identify the twin of a printed pad: its wiring, pose, fibres as built and sensitivity profile.

    Args:
        recording: presses at known positions over most of the pad; of several depths, the most common one is used.
        pad: as planned.
        seed: of what is drawn.
        on_progress: called with (what is being done, steps done, total).

    Returns:
        The twin, without provenance.

    Raises:
        InputError: too few presses of known position, all in one part of the pad, no channel that responds, more that
            do than there are fibres, or a recording of another pad.
    """
    return identify_pad(recording, pad, seed, on_progress).twin


@threadpool_limits.wrap(limits=1, user_api="blas")
def identify_pad(
    recording: Recording,
    pad: Morphology,
    seed: int = 0,
    on_progress: OnProgress = lambda what, done, total: None,
) -> Identification:
    """Identify a printed pad as `identify`, and return the fit and its evaluation with the twin."""
    check_type("recording", recording, Recording)
    check_type("pad", pad, Morphology)
    rng = np.random.default_rng(check_int("seed", seed, 0, 2**32 - 1))
    recording = select_one_depth(recording)
    positions_mm = recording.presses_mm[recording.has_position]
    _check_positions(positions_mm, pad)

    # 1. Responses
    on_progress("responses", 0, 1)
    held_out_mask = np.zeros(len(positions_mm), bool)
    held_out_mask[rng.permutation(len(positions_mm))[: max(round(HELD_OUT * len(positions_mm)), 2)]] = True
    responses = compute_responses(recording, ~held_out_mask)
    rows = rng.permutation(np.flatnonzero(~held_out_mask))[:MAX_PRESSES]

    # 2. Live channels
    gp = fit_gp(responses.select(rows), pad.unit_mm)
    live = _live_channels(gp.log_bayes_factor, len(pad.knots))
    training, held_out = responses.select(rows, live), responses.select(np.flatnonzero(held_out_mask), live)
    compared = training.select(np.arange(min(N_COMPARED, len(training))))

    # 3. Wiring
    plan = PadPlan.from_morphology(pad)
    candidates = _fit_candidates(plan, training, compared, rng, on_progress)
    if (match := candidates[0][0].match) < MIN_MATCH:
        raise InputError(
            f"the recording does not go with this pad: its fibres explain {match:.0%} of the responses, allowed is"
            f" {MIN_MATCH:.0%} or more"
        )
    ranked = _rank_as_built(candidates, compared)
    best = ranked[0][1]
    straight_plan = PadPlan.from_morphology(Morphology.straight(pad.layout))
    explained_by_straight = None
    if not np.allclose(straight_plan.paths, plan.paths):
        straight = _fit_candidates(straight_plan, training, compared, rng, on_progress)
        explained_by_straight = _explained_on_plan([fit for _, fit in straight], training, held_out)

    # 4. All presses
    on_progress("paths", 0, 3)
    fit = _fit_all(best.pad, training, on_progress)
    noise_v = np.nan_to_num(gp.noise)
    noise_v[live] = fit_gp(fit.pad.residuals(training), pad.unit_mm).noise
    full_scale_v = np.abs(fit.pad.predict(training.positions_mm) - fit.pad.rest_v).max(axis=0)
    return Identification(
        pad=pad,
        fit=fit,
        live=live,
        explained=held_out.explained_variance(fit.pad.predict(held_out.positions_mm)),
        explained_on_plan=_explained_on_plan([on_plan for _, on_plan in candidates], training, held_out),
        explained_by_straight=explained_by_straight,
        noise_v=noise_v,
        noise=float(noise_v[live].mean() / full_scale_v.mean()),
        alternatives=[
            wiring for wiring, other in ranked[1:] if best.log_evidence - other.log_evidence < MIN_LOG_BAYES_FACTOR
        ],
        readings=_estimate_readings(recording, live, fit.pad, noise_v, training.positions_mm),
        scatter=estimate_scatter(fit.pad, training, noise_v[live]),
        training=training,
        held_out=held_out,
    )


def _check_positions(positions_mm: Array, pad: Morphology) -> None:
    """Raise InputError unless there are enough presses, over most of the pad."""
    if len(positions_mm) < MIN_PRESSES:
        raise InputError(
            f"the recording has {len(positions_mm)} presses of known position and about one depth, allowed are"
            f" {MIN_PRESSES} or more"
        )
    spans = np.subtract(*np.quantile(positions_mm, [0.95, 0.05], axis=0))
    low, high = np.array(sensed_rectangle(pad.layout))
    least = MIN_SIDE * pad.unit_mm * (high - low)
    if (spans < least).any() and (spans < least[::-1]).any():  # the pad may have lain a quarter turned
        width, height = least.tolist()
        allowed = f"{width:.0f} mm both ways" if width == height else f"{width:.0f} x {height:.0f} mm"
        raise InputError(f"the presses lie within {spans[0]:.0f} x {spans[1]:.0f} mm, allowed is what spans {allowed}")


def _live_channels(log_bayes_factor: Array, fibres: int) -> Indices:
    live = np.flatnonzero(log_bayes_factor > MIN_LOG_BAYES_FACTOR)
    if not len(live):
        raise InputError("no channel of the recording responds to where the pad is pressed")
    if len(live) > fibres:
        raise InputError(f"{len(live)} channels of the recording respond to presses, the pad has {fibres} fibres")
    return live


def _fit_candidates(
    plan: PadPlan, training: Responses, compared: Responses, rng: np.random.Generator, on_progress: OnProgress
) -> list[tuple[Wiring, AsBuiltFit]]:
    """Return the best wirings on a plan, best first, each with a fit in which fibres lie as planned."""
    wirings = find_wirings(plan, training, rng, lambda done, total: on_progress("wiring", done, total))[:N_CANDIDATES]
    starts = [AsBuiltPad.from_plan(plan, wiring.fibres, wiring.transform, wiring.width) for wiring in wirings]
    fits = [fit_as_built(start.fit_gains(compared), compared, Priors()) for start in starts]
    return list(zip(wirings, fits, strict=True))


def _rank_as_built(candidates: list[tuple[Wiring, AsBuiltFit]], compared: Responses) -> list[tuple[Wiring, AsBuiltFit]]:
    """Fit the candidates as built, and sort them by evidence.

    Among equally good ones, as on a pad of straight fibres, the one that is rotated least comes first.
    """
    fits = [(wiring, fit_as_built(on_plan.pad, compared, FIRST_PRIORS)) for wiring, on_plan in candidates]
    best = max(fit.log_evidence for _, fit in fits)

    def rank(candidate: tuple[Wiring, AsBuiltFit]) -> tuple[float, float]:
        fit = candidate[1]
        turn_deg = abs(fit.pad.transform.turn_deg)
        return turn_deg if fit.log_evidence > best - SAME_LOG_EVIDENCE else 360.0, -fit.log_evidence

    return sorted(fits, key=rank)


def _explained_on_plan(fits: list[AsBuiltFit], training: Responses, held_out: Responses) -> float:
    """Return the mean explained variance of the most probable pad that lies on its plan, fitted to all presses."""
    best = max(fits, key=lambda fit: fit.log_evidence)
    pad = fit_as_built(best.pad, training, Priors()).pad
    return float(held_out.explained_variance(pad.predict(held_out.positions_mm)).mean())


def _fit_all(pad: AsBuiltPad, training: Responses, on_progress: OnProgress) -> AsBuiltFit:
    """Fit a pad to all presses, with an angular term if a sixth of them, held back, ask for one."""
    rows = np.arange(len(training))
    part, validation = training.select(rows[rows % 6 != 0]), training.select(rows[rows % 6 == 0])
    rough = fit_as_built(pad, part, FIRST_PRIORS, _noise_inflation(pad, part))
    on_progress("paths", 1, 3)
    plain = fit_as_built(rough.pad.align_transform(), part, FIRST_PRIORS, _noise_inflation(rough.pad, part))
    noise_inflation = _noise_inflation(plain.pad, part)
    angular = fit_as_built(plain.pad, part, replace(FIRST_PRIORS, angular=True), noise_inflation)
    on_progress("paths", 2, 3)
    explained, explained_plain = (
        validation.explained_variance(fit.pad.predict(validation.positions_mm)) for fit in (angular, plain)
    )
    best = angular if (explained - explained_plain).mean() > MIN_ANGULAR_GAIN else plain
    return fit_as_built(best.pad.align_transform(), training, best.priors, noise_inflation)


def _noise_inflation(pad: AsBuiltPad, responses: Responses) -> Array:
    """Return the factor (C,) on the noise by which residuals that are a function of position weigh N_COMPARED presses.

    More presses would tell nothing new about them.
    """
    residuals = pad.residuals(responses)
    noise_var = fit_gp(residuals, pad.plan.unit_mm).noise ** 2
    systematic_var = np.maximum(residuals.variance - noise_var, 0)
    repeats = max(len(responses) / N_COMPARED, 1)
    return np.sqrt((noise_var + systematic_var * repeats) / (noise_var + systematic_var))


def _estimate_readings(
    recording: Recording, live: Indices, pad: AsBuiltPad, noise_v: Array, positions_mm: Array
) -> TwinReadings | None:
    """Return noise, drift and hysteresis of the readings, and how much more than the responses they tell."""
    statistics = measure_rig_settings(recording)
    if not statistics:
        return None
    responses_information = (pad.mean_squared_slope(positions_mm) / noise_v[live] ** 2).sum()
    information_gain = fisher_information(recording, live).sum() / responses_information
    return TwinReadings(**statistics, information_gain=float(np.clip(information_gain, 1, MAX_INFORMATION_GAIN)))
