"""What one channel answers to presses, and how that changes with all it depends on.
A fibre is a row of short elements. An element at distance d from the press, whose tangent makes the angle phi with the
way to the press, counts with (w(d) + v(d) cos 2 phi) times its length and its sensitivity; w and v are sums of uniform
cubic B-splines mirrored at 0, so that they are smooth at the centre and 0 from their end on.

What each channel of a recording answers to each press: one number, with what came before taken off.
That number scatters, but the other windows of the press, of the probe's sinking in and of its release, tell of the
place once more. By how much is told by Fisher's information: J' S^-1 J, with J the change of the windows with the
place by the response model, and S the covariance of what that model leaves of presses it has not seen.

A pad as it was laid: what each of its channels answers to a press anywhere, fitted to presses.
    volts_c(p) = rest_c + gain_c * sum_i (w(r_i) + v(r_i) cos 2 phi_i) exp(s_c(i)) l_i,    r_i = x_i + a_c(i) - F(p)
over the elements i of the fibre that channel c reads: x_i where it was planned, a_c how far beside this it was laid,
l_i its length as laid, s_c its sensitivity, a_c and s_c smooth curves; F the frame; w the reach, v its dependence on
the angle between fibre and press.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from scipy.interpolate import RegularGridInterpolator

from padforge.design import Morphology
from padforge.design.paths.curves import flatten
from padforge.design.settings import Layout, sensed_rectangle
from padforge.design.twin import PlanTransform
from padforge.sense.arrays import Array, Indices, Mask
from padforge.sense.localizer.features import DOWN, STEPS, ResponseModel, compute_features, remove_history
from padforge.sense.recording.recording import Recording

CENTRE = 1e-6
"""Squared distance below which the way to the press has no direction, squared grid units."""


@njit(cache=True, error_model="numpy")
def spline_weights(f: float, out: Any) -> None:
    """Values (4,) of the B-splines centred at -1, 0, 1 and 2 at f in [0, 1), and their derivatives, into out (2, 4)."""
    g = 1 - f
    out[0, 0], out[0, 3] = g * g * g / 6, f * f * f / 6
    out[0, 1], out[0, 2] = (3 * f * f * f - 6 * f * f + 4) / 6, (3 * g * g * g - 6 * g * g + 4) / 6
    out[1, 0], out[1, 3] = -g * g / 2, f * f / 2
    out[1, 1], out[1, 2] = (3 * f - 4) * f / 2, -(3 * g - 4) * g / 2


@njit(cache=True, error_model="numpy")
def along_fibre(coefficients: Any, elements: int) -> Any:
    """Smooth curves over a row of elements, cubic B-splines of (n, J) coefficients from end to end.

    Returns:
        Their values at each element and how they change over it, (2, n, F); the first coefficient that each depends on
        (F,), and how its value and its change do on four of them (2, F, 4).
    """
    curves, count = coefficients.shape
    pieces = count - 3
    found, first, share = np.zeros((2, curves, elements)), np.empty(elements, np.int64), np.empty((2, elements, 4))
    bend = np.empty((2, 4))
    for i in range(elements):
        x = (i + 0.5) / elements * pieces
        first[i] = min(int(x), pieces - 1)
        spline_weights(x - first[i], bend)
        for j in range(4):
            share[0, i, j], share[1, i, j] = bend[0, j], bend[1, j] * pieces / elements
            for a in range(curves):
                found[0, a, i] += share[0, i, j] * coefficients[a, first[i] + j]
                found[1, a, i] += share[1, i, j] * coefficients[a, first[i] + j]
    return found, first, share


@njit(cache=True, error_model="numpy", nogil=True)
def channel_response(
    course: Any, tangent: Any, length: Any, aside: Any, sensitivity: Any, places: Any, profile: Any, step: float
) -> Any:
    """Signals of one fibre for presses, and their derivatives.

    Args:
        course, tangent: (F, 2) planned elements, evenly spaced along the fibre, and their unit tangents.
        length: (F,) of the elements.
        aside: (2, J) coefficients of how far each lies beside its plan in x and in y, which also stretches it.
        sensitivity: (1, J') coefficients of the logarithm of how much an element counts.
        places: (Q, 2). profile: (2, K) coefficients of w and of v, whose splines are `step` apart.

    Returns:
        Signals (Q,), and their derivatives by profile (Q, 2, K), aside (Q, 2, J), sensitivity (Q, J'), place (Q, 2).
    """
    elements, splines, presses = len(course), profile.shape[1], len(places)
    end = (splines + 1) * step
    signal, by_profile, by_place = np.zeros(presses), np.zeros((presses, 2, splines)), np.zeros((presses, 2))
    by_aside, by_sensitivity = np.zeros((presses, 2, aside.shape[1])), np.zeros((presses, sensitivity.shape[1]))
    (off, off_first, off_share), here = along_fibre(aside, elements), np.empty((2, 4))
    gain, gain_first, gain_share = along_fibre(sensitivity, elements)
    for i in range(elements):
        at_x, at_y = course[i, 0] + off[0, 0, i], course[i, 1] + off[0, 1, i]
        tx, ty = length[i] * tangent[i, 0] + off[1, 0, i], length[i] * tangent[i, 1] + off[1, 1, i]
        laid = math.sqrt(tx * tx + ty * ty)
        tx, ty = tx / laid, ty / laid
        factor, counts = math.exp(gain[0, 0, i]), math.exp(gain[0, 0, i]) * laid
        for q in range(presses):
            x, y = at_x - places[q, 0], at_y - places[q, 1]
            square = x * x + y * y
            if square >= end * end:
                continue
            far = math.sqrt(square)
            along = x * tx + y * ty
            double = 2 * along * along / (square + CENTRE) - 1
            piece = int(far / step)
            spline_weights(far / step - piece, here)
            weight, rate, turning = 0.0, 0.0, 0.0
            for j in range(4):
                k = abs(piece + j - 1)
                if k < splines:
                    weight += here[0, j] * (profile[0, k] + double * profile[1, k])
                    rate += here[1, j] * (profile[0, k] + double * profile[1, k])
                    turning += here[0, j] * profile[1, k]
                    by_profile[q, 0, k] += counts * here[0, j]
                    by_profile[q, 1, k] += counts * here[0, j] * double
            signal[q] += counts * weight
            pull = counts * rate / (step * max(far, 1e-9))
            twist = counts * turning * 4 * along / (square + CENTRE)
            shrink = pull - twist * along / (square + CENTRE)
            for axis in range(2):
                aim, way = (tx, x) if axis == 0 else (ty, y)
                moved = shrink * way + twist * aim
                stretched = factor * weight * aim + twist * (way - along * aim) / laid
                by_place[q, axis] -= moved
                for j in range(4):
                    by_aside[q, axis, off_first[i] + j] += moved * off_share[0, i, j] + stretched * off_share[1, i, j]
            for j in range(4):
                by_sensitivity[q, gain_first[i] + j] += counts * weight * gain_share[0, i, j]
    return signal, by_profile, by_aside, by_sensitivity, by_place


ALIKE = 0.15
"""Share of its depth by which another press may differ that counts as deep as one."""
HELD = 3
"""First window of the press that counts as held: the tip has come to rest in the silicone."""
HOLD = np.array([(end - first) * (k >= HELD) for k, (first, end) in enumerate(DOWN)], float)
HOLD /= HOLD.sum()
"""(9,) what makes one number of the windows of a press."""


@dataclass(frozen=True)
class Responses:
    """Answers of C channels to Q presses of known places.

    Attributes:
        positions_mm: (Q, 2) as the arm counts. volts: (Q, C) mean while held minus the rest before, as it would be after
            the channel's usual history. there: (Q, C) whether the channel gave enough readings.
    """

    positions_mm: Array
    volts: Array
    there: Mask

    def __len__(self) -> int:
        return len(self.positions_mm)

    def of(self, rows: Indices, channels: Indices | slice = slice(None)) -> "Responses":
        """Those of some presses and channels."""
        return Responses(self.positions_mm[rows], self.volts[rows][:, channels], self.there[rows][:, channels])

    @property
    def spread(self) -> Array:
        """(C,) variance of each channel's answers; 1 where it gave none."""
        counts = np.maximum(self.there.sum(axis=0), 1)
        mean = np.where(self.there, self.volts, 0).sum(axis=0) / counts
        squares = np.where(self.there, (self.volts - mean) ** 2, 0).sum(axis=0) / counts
        return np.where(squares > 0, squares, 1.0)

    def explained(self, predicted: Array) -> Array:
        """(C,) share of the variance of the answers that a prediction (Q, C) explains."""
        counts = np.maximum(self.there.sum(axis=0), 1)
        left = np.where(self.there, (self.volts - predicted) ** 2, 0).sum(axis=0) / counts
        return 1 - left / self.spread


def of_one_depth(recording: Recording) -> Recording:
    """The recording, the places of presses unknown that are not about as deep as most: a deeper one gives more.

    They stay in what came before the others. Where no depth is known, all are taken to be alike.
    """
    actual_depths_mm = np.where(recording.has_position, recording.actual_depths_mm, np.nan)
    known = np.sort(actual_depths_mm[actual_depths_mm > 0])[::-1]
    if not len(known):
        return recording
    as_deep = np.searchsorted(-known, -(1 - ALIKE) * known, "right")
    deeper = np.searchsorted(-known, -(1 + ALIKE) * known, "left")
    usual = known[np.argmax(as_deep - deeper)]  # the deepest of the most common, as it is heard best
    alike = np.abs(actual_depths_mm - usual) <= ALIKE * usual
    return replace(recording, presses_mm=np.where(alike[:, None], recording.presses_mm, np.nan))


def responses(recording: Recording, learnt: Mask) -> Responses:
    """The answers to all presses of known places.

    Args:
        learnt: (Q,) of these presses, those from which is learnt what of its history a channel still shows.
    """
    known = recording.has_position
    inputs = compute_features(recording.readings, recording.down_command[known], recording.up_command[known], "causal")
    places = recording.presses_mm[known]
    about = _about(places)
    model = ResponseModel.fit(about[learnt], inputs.windows[learnt], inputs.history[learnt], inputs.fibre_mask[learnt])
    windows = remove_history(inputs.windows, inputs.history, model.memory, model.usual)
    return Responses(places, windows @ HOLD, inputs.fibre_mask)


def information(recording: Recording, channels: Indices) -> Array:
    """(C',) 1/mm^2, what all windows of a press tell of its place: Fisher's information, mean over all places.

    Args:
        channels: (C',) which ones, each by the presses in which it gave enough readings.
    """
    known = recording.has_position
    inputs = compute_features(
        recording.readings, recording.down_command[known], recording.up_command[known], "press_and_release"
    )
    places = _about(recording.presses_mm[known])
    side_mm = np.ptp(recording.presses_mm[known], axis=0).max()
    told = []
    for channel in channels.tolist():
        there = inputs.fibre_mask[:, channel]
        told.append(_told(places[there], inputs.windows[there, channel], inputs.history[there, channel]))
    return np.array(told) * (2 / side_mm) ** 2


def _told(places: Array, windows: Array, history: Array) -> float:
    """Fisher's information, of places (Q, 2) within [-1, 1], in windows (Q, F) V after a history (Q, J) V.

    Of two response models, each of half the presses, what is left over of the other half and the product of their
    slopes are taken: noise that a model takes for a slope is not in the other one.
    """
    windows, history, fibre_mask = windows[:, None], history[:, None], np.ones((len(places), 1), bool)
    grid, odd = np.linspace(-1, 1, STEPS + 1), np.arange(len(places)) % 2 == 1
    left, tables = np.empty_like(windows), []
    for seen in (odd, ~odd):
        model = ResponseModel.fit(places[seen], windows[seen], history[seen], fibre_mask[seen])
        expected = RegularGridInterpolator((grid, grid), model.table)(places[~seen])
        left[~seen] = remove_history(windows[~seen], history[~seen], model.memory, model.usual) - expected
        tables.append(model.table[:, :, 0])
    precision, told = np.linalg.pinv(np.cov(left[:, 0].T), hermitian=True), 0.0  # short presses have readings twice
    for axis in (0, 1):
        one, other = (np.asarray(np.gradient(table, 2 / STEPS, axis=axis)) for table in tables)
        told += float(np.einsum("xyf,fg,xyg->xy", one, precision, other).mean())
    return max(told, 0.0)


def _about(positions_mm: Array) -> Array:
    """(Q, 2) places to the square [-1, 1] about all of them."""
    middle = (positions_mm.min(axis=0) + positions_mm.max(axis=0)) / 2
    return (positions_mm - middle) / np.abs(positions_mm - middle).max()


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

    def to_grid(self, positions_mm: Array) -> Array:
        """(Q, 2) mm on the plan, from its middle, to grid units from its corner."""
        return positions_mm / self.unit_mm + self.middle

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

    def predict(self, positions_mm: Array) -> Array:
        """(Q, C) volts for presses (Q, 2) mm as the arm counts."""
        return self.parts(positions_mm)[0]

    def steepness(self, positions_mm: Array) -> Array:
        """(C,) V^2/mm^2, squares of how volts change with the place, mean over places (Q, 2) mm as the arm counts."""
        steps = STEP_MM * np.eye(2)
        rates = [
            (self.predict(positions_mm + step) - self.predict(positions_mm - step)) / (2 * STEP_MM) for step in steps
        ]
        return np.sum(np.square(rates), axis=0).mean(axis=0)

    def with_gains(self, presses: Responses) -> "LaidPad":
        """The same pad with the gains and rests that go best with answers: a fit begins near enough not to run away."""
        values, signals = self.values.copy(), self.predict(presses.positions_mm)
        for channel, own in enumerate(self.own):
            there = presses.there[:, channel]
            known = np.column_stack([(signals[there, channel] - own[1]) / own[0], np.ones(there.sum())])
            found = np.linalg.lstsq(known, presses.volts[there, channel], rcond=None)[0]
            values[own_values(channel)[:2]] = found
        return replace(self, values=values)

    def remove_history(self) -> "LaidPad":
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
        return replace(presses, volts=presses.volts - self.predict(presses.positions_mm))

    def parts(self, positions_mm: Array) -> tuple[Array, list[Array]]:
        """Volts (Q, C), and for each channel their derivatives (Q, SHARED + OWN) by the shared values and its own."""
        places, by_frame = self._placed(positions_mm)
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

    def _placed(self, positions_mm: Array) -> tuple[Array, Array]:
        """Places (Q, 2) in grid units of the plan, and their derivatives (Q, 2, 4) by turn, shift and scale."""
        frame, unit_mm = self.frame, self.plan.unit_mm
        turned = frame.rotate(positions_mm)
        by = np.zeros((len(positions_mm), 2, 4))
        by[:, 0, 0], by[:, 1, 0] = -frame.scale * turned[:, 1], frame.scale * turned[:, 0]
        by[:, 0, 1] = by[:, 1, 2] = 1
        by[:, :, 3] = turned
        return np.ascontiguousarray(self.plan.to_grid(frame.to_plan(positions_mm))), by / unit_mm


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
