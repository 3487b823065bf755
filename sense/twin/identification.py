"""A printed pad as it was identified, and as a twin.

System identification of a printed pad, from presses at known places alone.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

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
from padforge.sense.twin.as_built import LaidPad, PadPlan, Responses, information, of_one_depth, responses
from padforge.sense.twin.fitting import Fit, Freedom, Wiring, fit, response_scatter, smooth_function, wirings

POINTS, FELT = 13, 0.01
"""Points of the reach in a twin, and the least weight that counts as felt."""


@dataclass(frozen=True)
class Identification:
    """What was found.

    Attributes:
        pad: as it was planned. fit: as laid, with its certainty; its channels are the live ones.
        live: (C',) which of the `channels` recorded these are.
        explained: (C',) share of the variance of the responses on presses held out.
        on_plan: the same if every fibre lay as planned, mean over the channels.
        noise_v: (channels,) scatter of responses that neither the pad nor place nor history explains.
        noise: of the live channels, share of full scale. full_scale_v: (C',) largest response of each.
        doubts: other wirings that the presses cannot tell from the one found.
        straight: what straight fibres explain that lie and are wired as suits them best; None where this pad's are.
        readings: how they run beside what presses answer; None where too few presses tell.
        scatter: what of the noise grows with the response.
        learnt, held_out: responses of the live channels learnt from, and held out.
    """

    pad: Morphology
    fit: Fit
    live: Indices
    explained: Array
    on_plan: float
    noise_v: Array
    noise: float
    full_scale_v: Array
    doubts: list[Wiring]
    straight: float | None
    readings: TwinReadings | None
    scatter: TwinScatter
    learnt: Responses
    held_out: Responses

    def laid_mm(self) -> list[tuple[Array, Array, Mask]]:
        """For each live channel how far its fibre lies beside the plan, to its left, (F,) mm; how sure that is, (F,)
        mm; and which of its elements lie within what was pressed, (F,)."""
        laid, unit_mm = self.fit.pad, self.pad.unit_mm
        pressed = laid.plan.to_grid(laid.frame.to_plan(self.learnt.positions_mm))
        low, high = pressed.min(axis=0), pressed.max(axis=0)
        out = []
        for row, fibre in enumerate(laid.fibres):
            course, tangent = laid.plan.course[fibre], laid.plan.tangent[fibre]
            off = laid.course(row)[0] - course
            left = off[:, 1] * tangent[:, 0] - off[:, 0] * tangent[:, 1]
            within = ((course >= low) & (course <= high)).all(axis=1)
            out.append((unit_mm * left, unit_mm * self.fit.unsure(row), within))
        return out

    def twin(self, provenance: Mapping[str, Any] | None = None) -> Twin:
        """What was found, as a twin."""
        laid, unit_mm = self.fit.pad, self.pad.unit_mm
        own = dict(zip(self.live.tolist(), range(len(self.live)), strict=True))
        courses: list[Array | None] = [None] * len(self.pad.knots)
        counts: list[Array | None] = list(courses)
        gains, fibre_lengths = np.zeros(len(self.noise_v)), lengths(self.pad)
        for channel, row in own.items():
            line, counted = laid.course(row)
            fibre, mean = laid.fibres[row], counted.mean()
            ends = [1.5 * line[:1] - 0.5 * line[1:2], (line[1:] + line[:-1]) / 2, 1.5 * line[-1:] - 0.5 * line[-2:-1]]
            courses[fibre], counts[fibre] = self.pad.to_mm(np.vstack(ends)), counted / mean
            gains[channel] = laid.own[row, 0] * mean * fibre_lengths[fibre]
        distance, weights = _trimmed(laid)
        pressed = laid.frame.to_plan(self.learnt.positions_mm)
        return Twin(
            self.pad,
            tuple(
                TwinChannel(
                    channel,
                    laid.fibres[own[channel]] if channel in own else None,
                    float(gains[channel]),
                    float(noise_v),
                    float(self.explained[own[channel]]) if channel in own else 0.0,
                )
                for channel, noise_v in enumerate(self.noise_v)
            ),
            laid.frame,
            distance * unit_mm,
            weights[0],
            tuple(courses),
            self.noise,
            tuple(np.ptp(pressed, axis=0).tolist()),
            len(self.learnt),
            weights[1] if weights[1].any() else None,
            tuple(counts),
            provenance or {},
            self.readings,
            self.scatter,
        )


def _trimmed(laid: LaidPad) -> tuple[Array, Array]:
    """Distances (POINTS,), grid units, up to where a press is felt no more, and w and v there (2, POINTS)."""
    fine = np.linspace(0, laid.end, 400)
    felt = np.flatnonzero(np.abs(laid.weights(fine)).max(axis=0) > FELT)
    distance = np.linspace(0, min(fine[felt[-1]] * (1 + 1 / POINTS), laid.end), POINTS)
    weights = laid.weights(distance)
    weights[:, -1] = 0.0
    return distance, weights / np.abs(weights[0]).max()


LEAST_PRESSES = 60
LEAST_SIDE = 0.5
"""Least width and height of what was pressed, as a share of the rectangle half a pitch beyond the outermost fibres."""
HELD_OUT = 0.15
"""Share of the presses that are kept back to say how much is explained."""
MOST_PRESSES = 2000
"""Presses that the last fit looks at."""
TRIED, PATCHES = 8, 150
"""Wirings that are fitted, and presses by which they are compared: what a fit leaves over is alike within about half a
grid unit, so that more presses would count the same evidence twice."""
FIRST = Freedom(aside_mm=1.0, uneven=0.2)
LIVE = 10.0
"""Certainty, natural logarithm, from which on a channel answers to places at all."""
ALIKE = 1.0
"""Difference of evidence, natural logarithm, that is none."""
DOUBT = 10.0
"""Another wiring whose evidence is within this of the best one's, natural logarithm, cannot be told from it."""
WORTH = 0.01
"""Share of the variance by which a dependence on the angle must explain more of presses held out, to be believed."""
LEAST_MATCH = 0.25
"""Share of the variance that the best wiring must explain on the plan, else this is no recording of the pad."""


Report = Callable[[str, int, int], None]
"""Hears what is done, and how many steps of it of how many."""


@threadpool_limits.wrap(limits=1, user_api="blas")
def identify(
    recording: Recording, pad: Morphology, seed: int = 0, report: Report = lambda what, done, of: None
) -> Identification:
    """Find how a pad was laid, wired and turned, and what a press does to it.

    A response is what a channel shows while a press is held, less its rest before, as it would be after the channel's
    usual history.

    Args:
        recording: presses at known places, over most of the pad; of those of several depths the most common.
        pad: as it was planned. seed: of what is drawn.
        report: hears how far it is.

    Raises:
        InputError: too few presses of known places, all in one part of the pad, no channel that answers, more that do
            than there are fibres, or none that answers like this pad.
    """
    check_type("recording", recording, Recording)
    check_type("pad", pad, Morphology)
    recording = of_one_depth(recording)
    rng = np.random.default_rng(check_int("seed", seed, 0, 2**32 - 1))
    places = recording.presses_mm[recording.has_position]
    _refuse_places(places, pad)
    report("responses", 0, 1)
    held = np.zeros(len(places), bool)
    held[rng.permutation(len(places))[: max(round(HELD_OUT * len(places)), 2)]] = True
    answers = responses(recording, ~held)
    learnt_rows = rng.permutation(np.flatnonzero(~held))[:MOST_PRESSES]
    shown = smooth_function(answers.of(learnt_rows), pad.unit_mm)
    live = _live(shown.certainty, len(pad.knots))
    learnt, held_out = answers.of(learnt_rows, live), answers.of(np.flatnonzero(held), live)
    compared = learnt.of(np.arange(min(PATCHES, len(learnt))))
    plan = PadPlan.of(pad)
    candidates = _on_plan(plan, learnt, compared, rng, report)
    _refuse_stranger(candidates[0][0].match)
    laid = _laid(candidates, compared)
    best = laid[0][1]
    plain = PadPlan.of(Morphology.straight(pad.layout))
    straight = [] if np.allclose(plain.course, plan.course) else _on_plan(plain, learnt, compared, rng, report)
    report("courses", 0, 3)
    found = _fitted(best.pad, learnt, report)
    noise_v = _noise(shown.noise, found.pad, learnt, live)
    full_scale_v = np.abs(found.pad.predict(learnt.positions_mm) - found.pad.own[:, 1]).max(axis=0)
    return Identification(
        pad,
        found,
        live,
        held_out.explained(found.pad.predict(held_out.positions_mm)),
        _explained_on_plan([bare for _, bare in candidates], learnt, held_out),
        noise_v,
        float(noise_v[live].mean() / full_scale_v.mean()),
        full_scale_v,
        [wiring for wiring, each in laid[1:] if best.evidence - each.evidence < DOUBT],
        _explained_on_plan([bare for _, bare in straight], learnt, held_out) if straight else None,
        _readings(recording, live, found.pad, noise_v, learnt.positions_mm),
        response_scatter(found.pad, learnt, noise_v[live]),
        learnt,
        held_out,
    )


def _refuse_places(positions_mm: Array, pad: Morphology) -> None:
    """Refuse too few presses, and such as do not go over most of the pad."""
    if len(positions_mm) < LEAST_PRESSES:
        raise InputError(
            f"the recording has {len(positions_mm)} presses of known place and about one depth, allowed are"
            f" {LEAST_PRESSES} or more"
        )
    spans = np.subtract(*np.quantile(positions_mm, [0.95, 0.05], axis=0))
    low, high = np.array(sensed_rectangle(pad.layout))
    least = LEAST_SIDE * pad.unit_mm * (high - low)
    if (spans < least).any() and (spans < least[::-1]).any():  # nobody knows yet how the pad was turned
        wide, tall = least.tolist()
        allowed = f"{wide:.0f} mm both ways" if wide == tall else f"{wide:.0f} x {tall:.0f} mm"
        raise InputError(f"the presses lie within {spans[0]:.0f} x {spans[1]:.0f} mm, allowed is what spans {allowed}")


def _refuse_stranger(match: float) -> None:
    if match < LEAST_MATCH:
        raise InputError(
            f"the recording does not go with this pad: its fibres explain {match:.0%} of the responses, allowed is"
            f" {LEAST_MATCH:.0%} or more"
        )


def _live(certainty: Array, fibres: int) -> Indices:
    live = np.flatnonzero(certainty > LIVE)
    if not len(live):
        raise InputError("no channel of the recording answers to where the pad is pressed")
    if len(live) > fibres:
        raise InputError(f"{len(live)} channels of the recording answer to presses, the pad has {fibres} fibres")
    return live


def _on_plan(
    plan: PadPlan, learnt: Responses, compared: Responses, rng: np.random.Generator, report: Report
) -> list[tuple[Wiring, Fit]]:
    """The wirings that go best with the presses, best first, each with the pad fitted that lies on its plan."""
    found = wirings(plan, learnt, rng, lambda done, of: report("wiring", done, of))[:TRIED]
    starts = [LaidPad.on_plan(plan, wiring.fibres, wiring.frame, wiring.width) for wiring in found]
    fits = [fit(start.with_gains(compared), compared, Freedom()) for start in starts]
    return list(zip(found, fits, strict=True))


def _laid(candidates: list[tuple[Wiring, Fit]], compared: Responses) -> list[tuple[Wiring, Fit]]:
    """The candidates with the pad fitted as laid, the most probable first.

    Of those that are as good as one another, as on a pad of straight fibres, the one that is turned least comes first.
    """
    laid = [(wiring, fit(bare.pad, compared, FIRST)) for wiring, bare in candidates]
    most = max(each.evidence for _, each in laid)

    def rank(pair: tuple[Wiring, Fit]) -> tuple[float, float]:
        found = pair[1]
        return abs(found.pad.frame.turn_deg) if found.evidence > most - ALIKE else 360.0, -found.evidence

    return sorted(laid, key=rank)


def _explained_on_plan(fits: list[Fit], learnt: Responses, held_out: Responses) -> float:
    """Mean over the channels of what the most probable of some pads that lie on their plan explains, once fitted."""
    best = max(fits, key=lambda each: each.evidence)
    return float(held_out.explained(fit(best.pad, learnt, Freedom()).pad.predict(held_out.positions_mm)).mean())


def _fitted(pad: LaidPad, learnt: Responses, report: Report) -> Fit:
    """The pad fitted to all presses, with a dependence on the angle if presses held back from it ask for one."""
    every = np.arange(len(learnt))
    kept = every % 6 == 0
    part, rest = learnt.of(every[~kept]), learnt.of(every[kept])
    rough = fit(pad, part, FIRST, caution=_caution(pad, part))
    report("courses", 1, 3)
    plain = fit(rough.pad.settled(), part, FIRST, caution=_caution(rough.pad, part))
    caution = _caution(plain.pad, part)
    turned = fit(plain.pad, part, replace(FIRST, angle=True), caution=caution)
    report("courses", 2, 3)
    gain = rest.explained(turned.pad.predict(rest.positions_mm)) - rest.explained(plain.pad.predict(rest.positions_mm))
    best = turned if gain.mean() > WORTH else plain
    return fit(best.pad.settled(), learnt, best.freedom, caution=caution)


def _caution(pad: LaidPad, presses: Responses) -> Array:
    """(C,) by how much more than noise counts what is left over: where it is a function of place, PATCHES presses say
    all that is to be known of it."""
    left = pad.left_over(presses)
    noise = smooth_function(left, pad.plan.unit_mm).noise ** 2
    alike = np.maximum(left.spread - noise, 0)
    return np.sqrt((noise + alike * max(len(presses) / PATCHES, 1)) / (noise + alike))


def _readings(
    recording: Recording, live: Indices, pad: LaidPad, noise_v: Array, positions_mm: Array
) -> TwinReadings | None:
    """How readings run beside what presses answer, if that can be told."""
    found = measure_rig_settings(recording)
    if not found:
        return None
    told = information(recording, live).sum() / (pad.steepness(positions_mm) / noise_v[live] ** 2).sum()
    return TwinReadings(**found, information_gain=float(np.clip(told, 1, MAX_INFORMATION_GAIN)))


def _noise(alone: Array, pad: LaidPad, learnt: Responses, live: Indices) -> Array:
    """(C,) V: of a live channel what no smooth function of place explains of what the pad leaves over."""
    noise = np.nan_to_num(alone)
    noise[live] = smooth_function(pad.left_over(learnt), pad.plan.unit_mm).noise
    return noise
