"""A printed pad as it was identified, and as a twin."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from padforge.design import Morphology
from padforge.design.paths.curves import lengths
from padforge.design.twin import Twin, TwinChannel, TwinReadings, TwinScatter
from padforge.sense.recordings.processing.limits import Array, Indices, Mask

from padforge.sense.twin.fitting import Fit
from padforge.sense.twin.laid_pad import LaidPad
from padforge.sense.twin.responses import Responses
from padforge.sense.twin.wiring import Wiring

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
        pressed = laid.plan.to_grid(laid.frame.to_plan(self.learnt.places_mm))
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
        pressed = laid.frame.to_plan(self.learnt.places_mm)
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
