"""A pad as it was laid: what each of its channels answers to a press anywhere, fitted to presses.

    volts_c(p) = rest_c + gain_c * sum_i (w(r_i) + v(r_i) cos 2 phi_i) exp(s_c(i)) l_i,    r_i = x_i + a_c(i) - F(p)

over the elements i of the fibre that channel c reads: x_i where it was planned, a_c how far beside this it was laid,
l_i its length as laid, s_c its sensitivity, a_c and s_c smooth curves; F the frame; w the reach, v its dependence on
the angle between fibre and press.
"""

from dataclasses import dataclass, replace

import numpy as np

from padforge.design import Morphology
from padforge.design.paths.curves import flatten
from padforge.design.settings import Layout, sensed_rectangle
from padforge.design.twin import PlanTransform
from padforge.sense.recordings.processing.limits import Array, Indices

from padforge.sense.twin.kernels.response import along_fibre, channel_response
from padforge.sense.twin.responses import Responses

ELEMENTS = 160
"""Elements of a fibre."""
FLAT = 1e-3
"""Tolerance of the polyline they lie on, grid units."""
SPLINES = 9
"""Splines of the reach."""
NARROW = 0.36
"""Their distance, as a share of the standard deviation of the Gaussian reach that fits best."""
STEP_MM = 0.5
"""Half of the way over which is told how volts change with the place."""
ASIDE, SENSITIVITY = 12, 8
"""Splines of a fibre's way beside its plan, and of its sensitivity."""
SHARED, OWN = 4 + 2 * SPLINES, 2 + 2 * ASIDE + SENSITIVITY
"""Values that all channels share: the frame's, and two profiles; and those of each channel."""
AWAY, COUNTS = slice(2, 2 + 2 * ASIDE), slice(2 + 2 * ASIDE, OWN)
"""Of the values of a channel those of its way beside the plan, in x and then in y, and of its sensitivity."""


@dataclass(frozen=True)
class PadPlan:
    """Elements of F a fibre, evenly spaced along each.

    Attributes:
        course: (C, F, 2) their middles. tangent: (C, F, 2) of unit length. length: (C, F). layout: as of the
            morphology.
    """

    course: Array
    tangent: Array
    length: Array
    layout: Layout

    @classmethod
    def of(cls, pad: Morphology) -> "PadPlan":
        """Of a morphology."""
        course, tangent, length = [], [], []
        for line in flatten(pad, FLAT):
            run = np.append(0.0, np.hypot(*np.diff(line, axis=0).T).cumsum())
            ends = np.linspace(0, run[-1], ELEMENTS + 1)
            points = np.column_stack([np.interp(ends, run, line[:, axis]) for axis in range(2)])
            along = np.diff(points, axis=0)
            size = np.hypot(*along.T)
            course.append((points[:-1] + points[1:]) / 2)
            tangent.append(along / size[:, None])
            length.append(size)
        return cls(np.array(course), np.array(tangent), np.array(length), pad.layout)

    def to_grid(self, places_mm: Array) -> Array:
        """(Q, 2) mm on the plan, from its middle, to grid units from its corner."""
        return places_mm / self.unit_mm + self.middle

    @property
    def unit_mm(self) -> float:
        """A grid unit, mm."""
        return self.layout.unit_mm

    @property
    def middle(self) -> Array:
        """(2,) of the pad, grid units from its corner."""
        return np.array(self.layout.extent) / 2


@dataclass(frozen=True)
class LaidPad:
    """A fitted pad of C channels.

    Attributes:
        plan: what was planned. fibres: (C,) which one each channel reads.
        mirrored: whether the frame is. step: distance of the splines of the reach, grid units.
        values: (SHARED + C OWN,) all that is fitted: turn (rad), shift (mm), scale; splines of w and of v; then for
            each channel gain (V a grid unit), rest (V), splines of the way aside (grid units, in x, then in y) and of
            the sensitivity.
    """

    plan: PadPlan
    fibres: tuple[int, ...]
    mirrored: bool
    step: float
    values: Array

    @classmethod
    def on_plan(cls, plan: PadPlan, fibres: tuple[int, ...], frame: PlanTransform, width: float) -> "LaidPad":
        """A pad that lies as planned, with a Gaussian reach of standard deviation `width` and gains of 1."""
        step = NARROW * width
        distance = np.linspace(0, (SPLINES + 1) * step, 100)
        reach = np.linalg.lstsq(_splines(distance / step), np.exp(-0.5 * (distance / width) ** 2), rcond=None)[0]
        values = np.zeros(SHARED + len(fibres) * OWN)
        values[:4] = np.radians(frame.turn_deg), *frame.shift_mm, frame.scale
        values[4 : 4 + SPLINES] = reach
        values[SHARED::OWN] = 1.0
        return cls(plan, fibres, frame.mirrored, step, values)

    @property
    def frame(self) -> PlanTransform:
        """How it lay."""
        turn, x, y, scale = self.values[:4].tolist()
        return PlanTransform(self.mirrored, (float(np.degrees(turn)) + 180) % 360 - 180, (x, y), scale)

    @property
    def end(self) -> float:
        """Distance at which a press is felt no more, grid units."""
        return (SPLINES + 1) * self.step

    @property
    def own(self) -> Array:
        """(C, OWN) the values of each channel."""
        return self.values[SHARED:].reshape(-1, OWN)

    def weights(self, distance: Array) -> Array:
        """(2, n) w and v at distances (n,), grid units."""
        return self.values[4:SHARED].reshape(2, SPLINES) @ _splines(distance / self.step).T

    def course(self, channel: int) -> tuple[Array, Array]:
        """(F, 2) elements of the fibre that a channel reads as laid, grid units, and how much each counts (F,)."""
        aside, sensitivity = self._curves(channel)
        off, uneven = along_fibre(aside, ELEMENTS)[0][0], along_fibre(sensitivity, ELEMENTS)[0][0]
        return self.plan.course[self.fibres[channel]] + off.T, np.exp(uneven[0])

    def _curves(self, channel: int) -> tuple[Array, Array]:
        """(2, ASIDE) and (1, SENSITIVITY) coefficients."""
        own = self.own[channel]
        return own[AWAY].reshape(2, ASIDE), own[None, COUNTS]

    def predict(self, places_mm: Array) -> Array:
        """(Q, C) volts for presses (Q, 2) mm as the arm counts."""
        return self.parts(places_mm)[0]

    def steepness(self, places_mm: Array) -> Array:
        """(C,) V^2/mm^2, squares of how volts change with the place, mean over places (Q, 2) mm as the arm counts."""
        steps = STEP_MM * np.eye(2)
        rates = [(self.predict(places_mm + step) - self.predict(places_mm - step)) / (2 * STEP_MM) for step in steps]
        return np.sum(np.square(rates), axis=0).mean(axis=0)

    def with_gains(self, presses: Responses) -> "LaidPad":
        """The same pad with the gains and rests that go best with answers: a fit begins near enough not to run away."""
        values, signals = self.values.copy(), self.predict(presses.places_mm)
        for channel, own in enumerate(self.own):
            there = presses.there[:, channel]
            known = np.column_stack([(signals[there, channel] - own[1]) / own[0], np.ones(there.sum())])
            found = np.linalg.lstsq(known, presses.volts[there, channel], rcond=None)[0]
            values[own_values(channel)[:2]] = found
        return replace(self, values=values)

    def settled(self) -> "LaidPad":
        """The same pad, with what all its fibres have in common of their ways beside the plan told by the frame."""
        low, high = sensed_rectangle(self.plan.layout)
        planned = np.concatenate([self.plan.course[fibre] for fibre in self.fibres])
        laid = np.concatenate([self.course(channel)[0] for channel in range(len(self.fibres))])
        within = ((planned >= low) & (planned <= high)).all(axis=1)
        turn = _turn_between(laid[within], planned[within])
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        moved = laid @ rotation
        shift = (planned - moved)[within].mean(axis=0)
        aside = (moved + shift - planned).reshape(len(self.fibres), ELEMENTS, 2)
        basis = along_fibre(np.eye(ASIDE), ELEMENTS)[0][0].T
        coefficients = np.linalg.lstsq(basis, aside.transpose(1, 0, 2).reshape(ELEMENTS, -1), rcond=None)[0]
        values, middle = self.values.copy(), self.plan.middle
        values[0] += turn
        # the frame turns about the middle of the pad, the courses about its corner
        off = middle[0] * (rotation.sum(axis=0) - 1) + (middle[1] - middle[0]) * (rotation[1] - [0, 1])
        values[1:3] = values[1:3] @ rotation + self.plan.unit_mm * (off + shift)
        own = values[SHARED:].reshape(-1, OWN)
        own[:, AWAY] = coefficients.reshape(ASIDE, len(self.fibres), 2).transpose(1, 2, 0).reshape(len(own), -1)
        return replace(self, values=values)

    def left_over(self, presses: Responses) -> Responses:
        """What this pad does not explain of answers."""
        return replace(presses, volts=presses.volts - self.predict(presses.places_mm))

    def parts(self, places_mm: Array) -> tuple[Array, list[Array]]:
        """Volts (Q, C), and for each channel their derivatives (Q, SHARED + OWN) by the shared values and its own."""
        places, by_frame = self._placed(places_mm)
        profile = self.values[4:SHARED].reshape(2, SPLINES)
        volts, rates = np.empty((len(places), len(self.fibres))), []
        for c, (fibre, own) in enumerate(zip(self.fibres, self.own, strict=True)):
            elements = self.plan.course[fibre], self.plan.tangent[fibre], self.plan.length[fibre]
            signal, by_profile, by_aside, by_sensitivity, by_place = channel_response(
                *elements, *self._curves(c), places, profile, self.step
            )
            volts[:, c] = own[1] + own[0] * signal
            by_shared = [np.einsum("qx,qxp->qp", by_place, by_frame), by_profile.reshape(len(places), -1)]
            by_curves = [by_aside.reshape(len(places), -1), by_sensitivity]
            bent = np.hstack([*by_shared, np.zeros((len(places), 2)), *by_curves]) * own[0]
            bent[:, SHARED], bent[:, SHARED + 1] = signal, 1.0
            rates.append(bent)
        return volts, rates

    def at(self, values: Array) -> "LaidPad":
        """The pad of other `values`, its reach scaled to 1 at its largest."""
        moved = replace(self, values=values.copy())
        largest = np.abs(moved.weights(np.linspace(0, self.end, 101))[0]).max()
        if largest > 0:
            moved.values[4:SHARED] /= largest
            moved.values[SHARED::OWN] *= largest
        return moved

    def _placed(self, places_mm: Array) -> tuple[Array, Array]:
        """Places (Q, 2) in grid units of the plan, and their derivatives (Q, 2, 4) by turn, shift and scale."""
        frame, unit_mm = self.frame, self.plan.unit_mm
        turned = frame.rotate(places_mm)
        by = np.zeros((len(places_mm), 2, 4))
        by[:, 0, 0], by[:, 1, 0] = -frame.scale * turned[:, 1], frame.scale * turned[:, 0]
        by[:, 0, 1] = by[:, 1, 2] = 1
        by[:, :, 3] = turned
        return np.ascontiguousarray(self.plan.to_grid(frame.to_plan(places_mm))), by / unit_mm


def _turn_between(points: Array, others: Array) -> float:
    """The angle by which points (n, 2), turned about their middle, lie closest to others (n, 2)."""
    a, b = points - points.mean(axis=0), others - others.mean(axis=0)
    return float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))


def own_values(channel: int) -> Indices:
    """Where the gain, rest and splines of a channel lie in `LaidPad.values`."""
    return SHARED + channel * OWN + np.arange(OWN)


def _splines(at: Array) -> Array:
    """(n, SPLINES) the splines of a profile, mirrored at 0, at distances (n,) in steps."""
    out = np.zeros((len(at), SPLINES))
    for k in range(SPLINES):
        for centre in {k, -k}:
            far = np.abs(at - centre)
            out[:, k] += np.where(far < 1, 2 / 3 - far**2 + far**3 / 2, np.maximum(2 - far, 0) ** 3 / 6)
    return out
