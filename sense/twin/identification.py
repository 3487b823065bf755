"""System identification of a printed pad from presses at known positions alone, by the steps of `identify_pad`."""

from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import or_default
from padforge.common.validation import InputError
from padforge.design import Morphology
from padforge.design.paths.curves import lengths
from padforge.design.settings import Contact, sensed_rectangle
from padforge.design.twin import PARTS, Twin, TwinChannel, TwinPart, TwinReadings, TwinResidual, TwinScatter
from padforge.sense.arrays import Array, Indices, Mask
from padforge.sense.recording.frames import framed
from padforge.sense.recording.recording import Recording
from padforge.sense.simulation.built_pad import PressParts
from padforge.sense.simulation.simulated_recording import measure_rig_settings
from padforge.sense.twin.as_built import N_COARSE, AsBuiltPad, PadPlan
from padforge.sense.twin.contact_fit import ContactFit, fit_contact
from padforge.sense.twin.fitting import AsBuiltFit, Priors, estimate_scatter, fit_as_built, gain_wander
from padforge.sense.twin.press_parts import separate_parts, smooth_maps
from padforge.sense.twin.responses import (
    Responses,
    compute_responses,
    estimate_noise,
    fit_gps,
    normalize,
    select_one_depth,
)
from padforge.sense.twin.wiring import Wiring, as_stated, find_wirings, images

PROFILE_POINTS = 13  # points of the sensitivity profile of a twin
MIN_PRESSES = 60
MIN_SIDE = 0.5
"""Least width and height of what was pressed, as a share of the rectangle half a pitch beyond the outermost fibres."""
HELD_OUT = 0.15  # share of the presses that are held out
MAX_PRESSES = 2000  # presses of the last fit
N_CANDIDATES, N_COMPARED = 4, 250
"""Wirings that are fitted beside the images of the best, and presses by which they are compared: residuals are
correlated over about half a grid unit, so that more presses would count the same evidence twice."""
LOG_ODDS_IN_ORDER, LOG_ODDS_POSE = 15.0, 4.0
"""Prior log odds of channels in the order of the plan, and of a pad that lay as planned. With a probability of 1/2,
the stated one of 6! wirings and of 8 poses has log odds of 7 and 2 over any other. They are doubled, as the evidence of
presses counts double, since residuals are correlated. Their sum is less than MIN_LOG_ODDS, so that a wiring that fits
as well as the stated one is an alternative."""
N_CONTACT = 400  # presses that a contact is fitted to: the residuals of more are correlated
FIRST_PRIORS = Priors(lateral_offset_mm=1.0, log_sensitivity=0.2)
MIN_LOG_BAYES_FACTOR = 10.0  # from which on a channel is live
MIN_LOG_ODDS = 20.0  # from which on another wiring is ruled out
SAME_LOG_EVIDENCE = 1.0  # difference of log evidence below which two fits are equally good
MIN_ANGULAR_GAIN = 0.01  # share of the variance of held-out responses that an angular term must explain
MAP_STRIDE = 3  # subsampling of the maps of residuals, which change over several nodes
MIN_MATCH = 0.25
"""Share of the variance that the best wiring must explain on the plan, else the recording is of another pad."""


@dataclass(frozen=True)
class MeasuredContact:
    """Fits of the stated contact to the presses on a pad."""

    stated: Contact  # a layer, pressed as deep as the recording says if it does
    as_built: ContactFit  # to the fibres as built, whose paths were fitted together with another profile
    on_plan: ContactFit  # to fibres that lie as planned
    gaussian_on_plan: ContactFit  # to the same, of a Gaussian profile, of which the width is fitted

    @property
    def best(self) -> ContactFit:
        """The fit that explains more; either may, since the paths as built were fitted with another profile."""
        return max(self.as_built, self.on_plan, key=lambda fit: fit.explained)


@dataclass(frozen=True)
class Identification:
    """An identified pad; C' channels of the recording are live, and only these in `fit`, `training` and `held_out`."""

    pad: Morphology  # as planned
    fit: AsBuiltFit
    live: Indices  # (C',)
    explained: Array  # (C',), share of the variance of held-out responses
    explained_smooth: Array  # (C',), the same by a smooth function of the position, without any pad
    explained_on_plan: float  # the same if every fibre lay as planned, mean over channels
    noise_v: Array  # (C,), scatter of the responses that neither position nor history explains
    noise: float  # that of live channels as a share of full scale
    alternatives: list[Wiring]  # those that the presses do not rule out
    parts: dict[str, AsBuiltFit]  # of a press, by name in `PARTS`; none where there are too few presses
    residual: TwinResidual | None  # smooth residuals of the parts; None as `readings`
    readings: TwinReadings | None  # None where there are too few presses
    scatter: TwinScatter
    contact: MeasuredContact | None  # None if no layer, or one thinner than a press is deep
    training: Responses
    held_out: Responses

    def lateral_offsets_mm(self) -> list[tuple[Array, Array, Mask]]:
        """Compute for each live channel the lateral offset of its fibre from the plan, to the left, mm.

        Returned are the offset of each element (E,), its standard deviation, and a mask of the pressed elements.
        """
        built, unit_mm = self.fit.pad, self.pad.unit_mm
        presses = built.plan.to_grid(built.transform.to_plan(self.training.positions_mm))
        low, high = presses.min(axis=0), presses.max(axis=0)
        out = []
        for row, fibre in enumerate(built.fibres):
            planned, tangent = built.plan.paths[fibre], built.plan.tangents[fibre]
            offset = built.path(row)[0] - planned
            lateral = offset[:, 1] * tangent[:, 0] - offset[:, 0] * tangent[:, 1]
            within = ((planned >= low) & (planned <= high)).all(axis=1)
            out.append((unit_mm * lateral, unit_mm * self.fit.offset_std(row), within))
        return out

    @property
    def twin(self) -> Twin:
        """The pad as a twin, without provenance."""
        built = self.fit.pad
        response = self._part(built)
        paths_mm: list[Array | None] = [None] * len(self.pad.knots)
        channels = [TwinChannel(c, None, 0.0, float(noise_v), 0.0) for c, noise_v in enumerate(self.noise_v)]
        for row, channel in enumerate(self.live.tolist()):
            fibre, path = built.fibres[row], built.path(row)[0]  # middles of elements
            # the ends of the elements, in the middle between these middles, and extrapolated at both ends of the fibre
            line = [1.5 * path[:1] - 0.5 * path[1:2], (path[1:] + path[:-1]) / 2, 1.5 * path[-1:] - 0.5 * path[-2:-1]]
            paths_mm[fibre] = self.pad.to_mm(np.vstack(line))
            gain_v, explained = float(response.gains_v[channel]), float(self.explained[row])
            channels[channel] = replace(channels[channel], fibre=fibre, gain_v=gain_v, explained=explained)
        presses = built.transform.to_plan(self.training.positions_mm)
        return Twin(
            morphology=self.pad,
            channels=tuple(channels),
            frame=built.transform,
            distance_mm=response.distance_mm,
            weight=response.weight,
            as_built_mm=tuple(paths_mm),
            noise=self.noise,
            sensed_mm=tuple(np.ptp(presses, axis=0).tolist()),
            presses=len(self.training),
            angular_weight=response.angular_weight,
            sensitivity=response.sensitivity,
            readings=self.readings,
            scatter=self.scatter,
            parts={name: self._part(fit.pad) for name, fit in self.parts.items()},
            residual=self.residual,
        )

    def _part(self, built: AsBuiltPad) -> TwinPart:
        """Return the response of the pad to a press, or to a part of one."""
        sensitivities: list[Array | None] = [None] * len(self.pad.knots)
        gains_v, fibre_lengths = np.zeros(len(self.noise_v)), lengths(self.pad)
        for row, channel in enumerate(self.live.tolist()):
            fibre, sensitivity = built.fibres[row], built.path(row)[1]
            sensitivities[fibre] = sensitivity / sensitivity.mean()
            gains_v[channel] = built.channel_values[row, 0] * sensitivity.mean() * fibre_lengths[fibre]
        # the profile, up to where its weights are negligible
        fine = np.linspace(0, built.max_distance, 400)
        end = fine[np.flatnonzero(np.abs(built.profile(fine)).max(axis=0) > 0.01)[-1]]
        distance = np.linspace(0, min(end * (1 + 1 / PROFILE_POINTS), built.max_distance), PROFILE_POINTS)
        weights = built.profile(distance)
        weights[:, -1] = 0.0
        weight, angular_weight = weights / np.abs(weights[0]).max()
        angular = angular_weight if angular_weight.any() else None
        return TwinPart(distance * self.pad.unit_mm, weight, gains_v, angular, tuple(sensitivities))


def identify(
    recording: Recording,
    pad: Morphology,
    contact: Contact | None = None,
    seed: int = 0,
    on_progress: OnProgress = ignore_progress,
) -> Twin:
    """Identify the twin of a printed pad: its wiring, pose, fibres as built and sensitivity profile.

    Args:
        recording: presses at known positions over most of the pad; of several depths, the most common one is used.
        pad: as planned.
        contact: the contact by which the pad is believed to be pressed; `Contact()` if None. The twin does not depend
            on it.
        seed: of the random split and samples of presses.
        on_progress: called with (steps done, total, name of the stage).

    Returns:
        The twin, without provenance.

    Raises:
        InputError: too few presses of known position, all in one part of the pad, no channel that responds, more that
            do than there are fibres, or a recording of another pad.
    """
    return identify_pad(recording, pad, contact, seed, on_progress).twin


@threadpool_limits.wrap(limits=1, user_api="blas")
def identify_pad(
    recording: Recording,
    pad: Morphology,
    contact: Contact | None = None,
    seed: int = 0,
    on_progress: OnProgress = ignore_progress,
) -> Identification:
    """Identify a printed pad as `identify`, and return the fit and its evaluation with the twin."""
    rng = np.random.default_rng(seed)
    contact = or_default("contact", contact, Contact)
    recording = framed(select_one_depth(recording))
    positions_mm = recording.presses_mm[recording.has_position]
    _check_positions(positions_mm, pad)

    # 1. Responses to presses of the most common depth
    on_progress(0, 1, "responses")
    held_out_mask = np.zeros(len(positions_mm), bool)
    held_out_mask[rng.permutation(len(positions_mm))[: max(round(HELD_OUT * len(positions_mm)), 2)]] = True
    responses = compute_responses(recording, ~held_out_mask)
    rows = rng.permutation(np.flatnonzero(~held_out_mask))[:MAX_PRESSES]

    # 2. Live channels: a Gaussian process of the position explains them better than noise
    gps = fit_gps(responses.select(rows), pad.unit_mm)
    live = np.flatnonzero([gp.log_bayes_factor > MIN_LOG_BAYES_FACTOR for gp in gps])
    if not len(live):
        raise InputError("no channel of the recording responds to where the pad is pressed")
    if len(live) > len(pad.knots):
        raise InputError(
            f"{len(live)} channels of the recording respond to presses, the pad has {len(pad.knots)} fibres"
        )
    training, held_out = responses.select(rows, live), responses.select(np.flatnonzero(held_out_mask), live)
    compared = training.select(np.arange(min(N_COMPARED, len(training))))

    # 3. Wiring and pose: the most probable of the best, each fitted as built
    candidates = _fit_candidates(PadPlan.from_morphology(pad, N_COARSE), training, compared, live, rng, on_progress)
    plan, best = PadPlan.from_morphology(pad), candidates[0]

    # 4. Paths and profile, by all presses
    on_progress(0, 3, "paths")
    fit = _fit_all(replace(best.fit.pad, plan=plan), training, on_progress)

    # 5. Parts of a press, fitted on the same paths
    readings, parts, residual, pressed = None, {}, None, training
    if statistics := measure_rig_settings(recording):
        on_progress(0, 1, "parts of a press")
        separated = separate_parts(recording, ~held_out_mask, statistics["hysteresis_s"])
        parts = {name: _fit_part(fit, getattr(separated.parts, name).select(rows, live)) for name in PARTS}
        residual = _residual_maps(separated.parts, parts, live, ~held_out_mask)
        pressed = separated.pressed.select(rows, live)
        wander = gain_wander(parts["held"].pad, separated.pressed.select(np.arange(len(positions_mm)), live))
        readings = TwinReadings(**statistics | separated.rig, gain_wander=wander)

    # 6. Contact, by a fit of the layer that is believed to be pressed; and the scatter of responses
    on_plan = replace(best.on_plan.pad, plan=plan)
    measured = _measure_contact(contact, recording, fit.pad, on_plan, training, held_out)
    noise_v = np.nan_to_num([gp.noise_v for gp in gps])
    held = parts["held"].pad if parts else fit.pad
    noise_v[live] = estimate_noise(held.residuals(pressed), pad.unit_mm)
    scatter = estimate_scatter(held, pressed, noise_v[live])
    if readings:  # `share` includes the wander of gains, which they state
        scatter = replace(scatter, share=float(np.sqrt(max(scatter.share**2 - readings.gain_wander**2, 0))))
    smooth = np.column_stack([gps[channel].predict(held_out.positions_mm / pad.unit_mm) for channel in live])
    likeliest_on_plan = max((candidate.on_plan for candidate in candidates), key=lambda one: one.log_evidence)
    planned = fit_as_built(replace(likeliest_on_plan.pad, plan=plan), training, Priors()).pad
    full_scale_v = np.abs(fit.pad.predict(training.positions_mm) - fit.pad.channel_values[:, 1]).max(axis=0)
    return Identification(
        pad=pad,
        fit=fit,
        live=live,
        explained=held_out.explained_variance(fit.pad.predict(held_out.positions_mm)),
        explained_on_plan=float(held_out.explained_variance(planned.predict(held_out.positions_mm)).mean()),
        explained_smooth=held_out.explained_variance(smooth),
        noise_v=noise_v,
        noise=float(noise_v[live].mean() / full_scale_v.mean()),
        alternatives=[
            other.wiring for other in candidates[1:] if best.log_posterior - other.fit.log_evidence < MIN_LOG_ODDS
        ],
        readings=readings,
        parts=parts,
        residual=residual,
        scatter=scatter,
        contact=measured,
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
    min_spans = MIN_SIDE * pad.unit_mm * (high - low)
    if (spans < min_spans).any() and (spans < min_spans[::-1]).any():  # the pad may have lain a quarter turned
        width, height = min_spans.tolist()
        raise InputError(
            f"the presses lie within {spans[0]:.0f} x {spans[1]:.0f} mm, allowed from {width:.0f} x {height:.0f} mm on"
        )


@dataclass(frozen=True)
class _FittedWiring:
    """A wiring and its fits, of fibres that lie as planned and as built."""

    wiring: Wiring
    on_plan: AsBuiltFit
    fit: AsBuiltFit
    log_prior: float

    @property
    def log_posterior(self) -> float:
        """Logarithm of its probability, up to a constant."""
        return self.fit.log_evidence + self.log_prior


def _fit_candidates(
    plan: PadPlan,
    training: Responses,
    compared: Responses,
    live: Indices,
    rng: np.random.Generator,
    on_progress: OnProgress,
) -> list[_FittedWiring]:
    """Fit the best wirings, the stated one, and images of the most probable, which is first.

    Of equally probable ones, the one rotated least is first.
    """
    candidates: dict[tuple[bool, tuple[int, ...]], _FittedWiring] = {}

    def add(wirings: list[Wiring]) -> _FittedWiring:
        for wiring in wirings:
            start = AsBuiltPad.from_plan(plan, wiring.fibres, wiring.transform, wiring.width)
            on_plan = fit_as_built(start.fit_gains(compared), compared, Priors())
            as_built = fit_as_built(on_plan.pad, compared, FIRST_PRIORS)
            is_unturned = not wiring.transform.mirrored and abs(as_built.pad.transform.turn_deg) < 45
            log_prior = LOG_ODDS_IN_ORDER * (wiring.fibres == tuple(live.tolist())) + LOG_ODDS_POSE * is_unturned
            key = wiring.transform.mirrored, wiring.fibres
            candidate = _FittedWiring(wiring, on_plan, as_built, log_prior)
            if key not in candidates or candidates[key].log_posterior < candidate.log_posterior:
                candidates[key] = candidate
        return max(candidates.values(), key=lambda candidate: candidate.log_posterior)

    wirings = find_wirings(plan, training, rng, on_progress)[:N_CANDIDATES]
    if (match := wirings[0].match) < MIN_MATCH:
        raise InputError(
            f"the recording does not go with this pad: its fibres explain {match:.0%} of the responses, allowed is"
            f" {MIN_MATCH:.0%} or more"
        )
    if live.max() < plan.layout.fibres:
        wirings.append(as_stated(live, training, plan.layout.unit_mm))
    best = add(wirings)
    best = add(images(replace(best.wiring, transform=best.fit.pad.transform), plan.layout))
    for key, candidate in candidates.items():  # which of the best is the most probable shows when they have converged
        if candidate.log_posterior > best.log_posterior - 2 * MIN_LOG_ODDS:
            refit = fit_as_built(candidate.fit.pad, compared, candidate.fit.priors)
            candidates[key] = max(candidate, replace(candidate, fit=refit), key=lambda each: each.log_posterior)
    best = max(candidates.values(), key=lambda candidate: candidate.log_posterior)

    def rank(candidate: _FittedWiring) -> tuple[float, float]:
        is_best = candidate.log_posterior > best.log_posterior - SAME_LOG_EVIDENCE
        return abs(candidate.fit.pad.transform.turn_deg) if is_best else 360.0, -candidate.log_posterior

    return sorted(candidates.values(), key=rank)


def _fit_all(pad: AsBuiltPad, training: Responses, on_progress: OnProgress) -> AsBuiltFit:
    """Fit a pad to all presses, with an angular term if it improves predictions of a sixth that is held back."""
    rows = np.arange(len(training))
    part, validation = training.select(rows[rows % 6 != 0]), training.select(rows[rows % 6 == 0])
    rough = fit_as_built(pad, part, FIRST_PRIORS, _noise_inflation(pad, part))
    on_progress(1, 3, "paths")
    plain = fit_as_built(rough.pad.align_transform(), part, FIRST_PRIORS, _noise_inflation(rough.pad, part))
    noise_inflation = _noise_inflation(plain.pad, part)
    angular = fit_as_built(plain.pad, part, replace(FIRST_PRIORS, angular=True), noise_inflation)
    on_progress(2, 3, "paths")
    explained, explained_plain = (
        validation.explained_variance(fit.pad.predict(validation.positions_mm)) for fit in (angular, plain)
    )
    best = angular if (explained - explained_plain).mean() > MIN_ANGULAR_GAIN else plain
    return fit_as_built(best.pad.align_transform(), training, best.priors, noise_inflation)


def _noise_inflation(pad: AsBuiltPad, responses: Responses) -> Array:
    """Return factors (C,) on the noise by which smooth residuals weigh no more than those of N_COMPARED presses."""
    residuals = pad.residuals(responses)
    noise_var = estimate_noise(residuals, pad.plan.layout.unit_mm) ** 2
    systematic_var = np.maximum(residuals.variance - noise_var, 0)
    repeats = max(len(responses) / N_COMPARED, 1)
    return np.sqrt((noise_var + systematic_var * repeats) / (noise_var + systematic_var))


def _measure_contact(
    contact: Contact,
    recording: Recording,
    as_built: AsBuiltPad,
    on_plan: AsBuiltPad,
    training: Responses,
    held_out: Responses,
) -> MeasuredContact | None:
    """Fit a layer to a pad as built, and for comparison to the pad as planned, as well as a Gaussian.

    The layer is pressed as deep as the recording says, if it does. Return None if it is thinner, or no layer.
    """
    depths_mm = recording.actual_depths_mm[recording.has_position]
    depths_mm = depths_mm[depths_mm > 0]
    depth_mm = float(np.median(depths_mm)) if len(depths_mm) else contact.depth_mm
    if contact.model != "layer" or depth_mm >= contact.thickness_mm:
        return None
    contact = contact.model_copy(update={"depth_mm": depth_mm})
    training = training.select(np.arange(min(N_CONTACT, len(training))))

    def fit(pad: AsBuiltPad, contact: Contact) -> ContactFit:
        noise_v = _noise_inflation(pad, training) * np.sqrt(pad.residuals(training).variance)
        return fit_contact(pad, contact, training, held_out, noise_v)

    return MeasuredContact(
        stated=contact,
        as_built=fit(as_built, contact),
        on_plan=fit(on_plan, contact),
        gaussian_on_plan=fit(on_plan, Contact(model="profile")),
    )


def _fit_part(fit: AsBuiltFit, training: Responses) -> AsBuiltFit:
    """Fit a part of a press to fibres that lie where the fit of the response has put them."""
    start = fit.pad.fit_gains(training)
    priors = replace(fit.priors, lateral_offset_mm=0.0, pose=False)
    return fit_as_built(start, training, priors, _noise_inflation(start, training))


def _residual_maps(
    parts: PressParts[Responses], fits: dict[str, AsBuiltFit], live: Indices, trained: Mask
) -> TwinResidual:
    """Return the smooth function of the position in the residuals of the parts of presses."""
    positions, middle_mm, half_mm = normalize(parts.held.positions_mm)
    valid = parts.held.valid[trained][:, live]
    residuals = []
    for name, fit in fits.items():
        part: Responses = getattr(parts, name)
        # without the rest of the channel, so that the response far from any fibre belongs to the residual
        stretched = fit.pad.predict(part.positions_mm[trained]) - fit.pad.channel_values[:, 1]
        residuals.append(part.volts[trained][:, live] - stretched)
    maps = smooth_maps(positions[trained], np.stack(residuals, axis=2), valid)[::MAP_STRIDE, ::MAP_STRIDE]
    volts = np.zeros((len(fits), parts.held.volts.shape[1], *maps.shape[:2]))
    volts[:, live] = maps.transpose(3, 2, 0, 1)
    return TwinResidual(tuple(middle_mm.tolist()), half_mm, volts)
