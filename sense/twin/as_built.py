"""Parametric model of a pad as built: the responses of its channels to presses anywhere, and their derivatives.

    volts_c(p) = rest_c + gain_c * sum_i (w(r_i) + v(r_i) cos 2 phi_i) exp(s_c(i)) l_i,    r_i = |x_i + a_c(i) - T(p)|

over the elements i of the fibre that channel c reads: x_i where it was planned, a_c its lateral offset, l_i its length
as built, s_c its log-sensitivity, T the plan transform, phi_i the angle between the element and the direction to the
press, w the sensitivity profile and v its dependence on that angle. w and v are uniform cubic B-splines mirrored at 0,
smooth at the centre and 0 from their end on; a_c and s_c are cubic B-splines along the fibre.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from padforge.common.compilation import kernel
from padforge.design import Morphology
from padforge.design.paths.curves import flatten
from padforge.design.settings import Layout, sensed_rectangle
from padforge.design.twin import PlanTransform
from padforge.sense.arrays import Array, Indices
from padforge.sense.twin.responses import Responses

EPSILON = 1e-6  # squared distance below which the direction to the press is undefined, squared grid units
N_ELEMENTS, N_COARSE = 160, 48  # elements of a fibre, and of one where wirings are compared
N_SPLINES = 12  # splines of a profile
SPLINE_STEP = 0.48
"""Distance of these splines, as a share of the standard deviation of the Gaussian profile that fits best. Strains of a
layer reach more than five standard deviations; a profile that ends before makes a fit shrink the pad to compensate."""
N_OFFSET, N_SENSITIVITY = 12, 8  # splines of a fibre's lateral offset, for x and for y, and of its log-sensitivity
N_SHARED, N_CHANNEL = 4 + 2 * N_SPLINES, 2 + 2 * N_OFFSET + N_SENSITIVITY
"""Parameters that all channels share (transform and two profiles), and those of each channel."""
OFFSET, SENSITIVITY = slice(2, 2 + 2 * N_OFFSET), slice(2 + 2 * N_OFFSET, N_CHANNEL)
"""Among the parameters of a channel, those of its lateral offset, x before y, and of its log-sensitivity."""


@kernel
def spline_weights(f: float, out: Any) -> None:
    """Write values and derivatives at f in [0, 1) of the B-splines centred at -1, 0, 1 and 2 into out (2, 4)."""
    g = 1 - f
    out[0, 0], out[0, 3] = g * g * g / 6, f * f * f / 6
    out[0, 1], out[0, 2] = (3 * f * f * f - 6 * f * f + 4) / 6, (3 * g * g * g - 6 * g * g + 4) / 6
    out[1, 0], out[1, 3] = -g * g / 2, f * f / 2
    out[1, 1], out[1, 2] = (3 * f - 4) * f / 2, -(3 * g - 4) * g / 2


@kernel
def evaluate_along_fibre(coefficients: Any, elements: int) -> Any:
    """Evaluate cubic B-splines of coefficients (n, J) from end to end of F elements.

    Returned are values at each element and their change over it (2, n, F); the first coefficient that each element
    depends on (F,); and the derivatives of value and change by that one and the next three (2, F, 4).
    """
    curves, count = coefficients.shape
    pieces = count - 3
    values, first, basis = np.zeros((2, curves, elements)), np.empty(elements, np.int64), np.empty((2, elements, 4))
    weights = np.empty((2, 4))
    for i in range(elements):
        x = (i + 0.5) / elements * pieces
        first[i] = min(int(x), pieces - 1)
        spline_weights(x - first[i], weights)
        for j in range(4):
            basis[0, i, j], basis[1, i, j] = weights[0, j], weights[1, j] * pieces / elements
            for a in range(curves):
                values[0, a, i] += basis[0, i, j] * coefficients[a, first[i] + j]
                values[1, a, i] += basis[1, i, j] * coefficients[a, first[i] + j]
    return values, first, basis


@kernel
def channel_response(
    fibre: Any, lateral_offset: Any, log_sensitivity: Any, positions: Any, profile: Any, step: float
) -> Any:
    """Compute the responses (Q,) of one fibre to presses at positions (Q, 2), and their derivatives; grid units.

    The fibre is middles (F, 2), unit tangents (F, 2) and lengths (F,) of its planned elements, evenly spaced. Splines
    have the coefficients `lateral_offset` (2, J), in x and y, which also stretches it, `log_sensitivity` (1, J') and
    `profile` (2, K), of w and v, whose splines are `step` apart. Derivatives are by profile (Q, 2, K), lateral offset
    (Q, 2, J), log-sensitivity (Q, J') and position (Q, 2).
    """
    path, tangent, length = fibre
    elements, splines, presses = len(path), profile.shape[1], len(positions)
    end = (splines + 1) * step
    signal, by_profile, by_position = np.zeros(presses), np.zeros((presses, 2, splines)), np.zeros((presses, 2))
    by_offset = np.zeros((presses, 2, lateral_offset.shape[1]))
    by_sensitivity = np.zeros((presses, log_sensitivity.shape[1]))
    (offset, offset_first, offset_basis), spline = evaluate_along_fibre(lateral_offset, elements), np.empty((2, 4))
    log_gain, gain_first, gain_basis = evaluate_along_fibre(log_sensitivity, elements)
    for i in range(elements):
        at_x, at_y = path[i, 0] + offset[0, 0, i], path[i, 1] + offset[0, 1, i]
        tx, ty = length[i] * tangent[i, 0] + offset[1, 0, i], length[i] * tangent[i, 1] + offset[1, 1, i]
        built_length = math.sqrt(tx * tx + ty * ty)
        tx, ty = tx / built_length, ty / built_length
        gain = math.exp(log_gain[0, 0, i])
        weighted_length = gain * built_length
        for q in range(presses):
            x, y = at_x - positions[q, 0], at_y - positions[q, 1]
            square = x * x + y * y
            if square >= end * end:
                continue
            distance = math.sqrt(square)
            along = x * tx + y * ty
            cos_2phi = 2 * along * along / (square + EPSILON) - 1
            piece = int(distance / step)
            spline_weights(distance / step - piece, spline)
            weight, slope, angular = 0.0, 0.0, 0.0
            for j in range(4):
                k = abs(piece + j - 1)  # mirrored at 0
                if k < splines:
                    weight += spline[0, j] * (profile[0, k] + cos_2phi * profile[1, k])
                    slope += spline[1, j] * (profile[0, k] + cos_2phi * profile[1, k])
                    angular += spline[0, j] * profile[1, k]
                    by_profile[q, 0, k] += weighted_length * spline[0, j]
                    by_profile[q, 1, k] += weighted_length * spline[0, j] * cos_2phi
            signal[q] += weighted_length * weight
            radial = weighted_length * slope / (step * max(distance, 1e-9))
            twist = weighted_length * angular * 4 * along / (square + EPSILON)
            by_square = radial - twist * along / (square + EPSILON)
            for axis in range(2):
                t, r = (tx, x) if axis == 0 else (ty, y)
                by_shift = by_square * r + twist * t
                by_stretch = gain * weight * t + twist * (r - along * t) / built_length
                by_position[q, axis] -= by_shift
                for j in range(4):
                    by_offset[q, axis, offset_first[i] + j] += (
                        by_shift * offset_basis[0, i, j] + by_stretch * offset_basis[1, i, j]
                    )
            for j in range(4):
                by_sensitivity[q, gain_first[i] + j] += weighted_length * weight * gain_basis[0, i, j]
    return signal, by_profile, by_offset, by_sensitivity, by_position


@dataclass(frozen=True)
class PadPlan:
    """Planned fibres, cut into E elements that are evenly spaced along each; grid units."""

    paths: Array  # (fibres, E, 2), middles of the elements
    tangents: Array  # (fibres, E, 2), unit vectors
    lengths: Array  # (fibres, E)
    layout: Layout

    @classmethod
    def from_morphology(cls, pad: Morphology, elements: int = N_ELEMENTS) -> "PadPlan":
        """Cut the fibres of a morphology into elements."""
        ends = []
        for line in flatten(pad, 1e-3):  # grid units
            arc = np.append(0.0, np.hypot(*np.diff(line, axis=0).T).cumsum())
            along = np.linspace(0, arc[-1], elements + 1)
            ends.append(np.column_stack([np.interp(along, arc, line[:, axis]) for axis in range(2)]))
        points = np.array(ends)
        step = np.diff(points, axis=1)
        lengths = np.hypot(step[..., 0], step[..., 1])
        return cls((points[:, :-1] + points[:, 1:]) / 2, step / lengths[..., None], lengths, pad.layout)

    @property
    def elements(self) -> int:
        """Elements E of a fibre."""
        return self.paths.shape[1]

    def to_grid(self, positions_mm: Array) -> Array:
        """Convert positions (Q, 2) on the plan from mm from its middle to grid units from its corner."""
        return positions_mm / self.layout.unit_mm + np.array(self.layout.extent) / 2


@dataclass(frozen=True)
class AsBuiltPad:
    """Parameters of a pad of C channels.

    `values` (N_SHARED + C N_CHANNEL,) holds turn (rad), shift (mm) and scale; splines of w and of v; then for each
    channel gain (V per grid unit), rest (V), splines of the lateral offset (grid units, x before y) and of the
    log-sensitivity.
    """

    plan: PadPlan
    fibres: tuple[int, ...]  # the fibre that each channel reads
    mirrored: bool  # the plan transform
    step: float  # distance of the splines of the profiles, grid units
    values: Array

    @classmethod
    def from_plan(cls, plan: PadPlan, fibres: tuple[int, ...], transform: PlanTransform, width: float) -> "AsBuiltPad":
        """Return a pad as planned, with gains of 1 and a Gaussian profile of standard deviation `width`, grid units."""
        step = SPLINE_STEP * width
        distance = np.linspace(0, (N_SPLINES + 1) * step, 100)
        gaussian = np.exp(-0.5 * (distance / width) ** 2)
        values = np.zeros(N_SHARED + len(fibres) * N_CHANNEL)
        values[:4] = np.radians(transform.turn_deg), *transform.shift_mm, transform.scale
        values[4 : 4 + N_SPLINES] = np.linalg.lstsq(_profile_basis(distance / step), gaussian, rcond=None)[0]
        values[N_SHARED::N_CHANNEL] = 1.0
        return cls(plan, fibres, transform.mirrored, step, values)

    @property
    def transform(self) -> PlanTransform:
        """Plan transform: how the pad lay under the arm."""
        turn, x, y, scale = self.values[:4].tolist()
        return PlanTransform(self.mirrored, (float(np.degrees(turn)) + 180) % 360 - 180, (x, y), scale)

    @property
    def max_distance(self) -> float:
        """Distance from which on a fibre does not respond to a press, grid units."""
        return (N_SPLINES + 1) * self.step

    @property
    def channel_values(self) -> Array:
        """Parameters of each channel; shape (C, N_CHANNEL)."""
        return self.values[N_SHARED:].reshape(-1, N_CHANNEL)

    def profile(self, distance: Array) -> Array:
        """Evaluate w and v at distances (n,) in grid units; shape (2, n)."""
        return self.values[4:N_SHARED].reshape(2, N_SPLINES) @ _profile_basis(distance / self.step).T

    def path(self, channel: int) -> tuple[Array, Array]:
        """Return the middles (E, 2), grid units, and sensitivities (E,) of a channel's fibre."""
        offset, log_gain = (evaluate_along_fibre(curves, self.plan.elements)[0][0] for curves in self._curves(channel))
        return self.plan.paths[self.fibres[channel]] + offset.T, np.exp(log_gain[0])

    def elements(self, channel: int) -> tuple[Array, Array, Array]:
        """Return the elements of a channel's fibre, grid units.

        They are middles (E, 2), lengths times sensitivities (E,) and unit tangents (E, 2).
        """
        plan, fibre = self.plan, self.fibres[channel]
        middles, sensitivities = self.path(channel)
        change = evaluate_along_fibre(self._curves(channel)[0], plan.elements)[0][1]
        steps = np.ascontiguousarray(plan.lengths[fibre][:, None] * plan.tangents[fibre] + change.T)
        lengths = np.hypot(*steps.T)
        return np.ascontiguousarray(middles), sensitivities * lengths, steps / lengths[:, None]

    def _curves(self, channel: int) -> tuple[Array, Array]:
        """Return the coefficients of lateral offset (2, N_OFFSET) and log-sensitivity (1, N_SENSITIVITY)."""
        values = self.channel_values[channel]
        return values[OFFSET].reshape(2, N_OFFSET), values[None, SENSITIVITY]

    def predict(self, positions_mm: Array) -> Array:
        """Predict the responses (Q, C), V, to presses (Q, 2), mm in the arm's frame."""
        return self.predict_with_jacobian(positions_mm)[0]

    def predict_with_jacobian(self, positions_mm: Array) -> tuple[Array, list[Array]]:
        """Predict responses (Q, C), and return for each channel their derivatives (Q, N_SHARED + N_CHANNEL)."""
        transform, plan = self.transform, self.plan
        positions = np.ascontiguousarray(plan.to_grid(transform.to_plan(positions_mm)))
        rotated = transform.turned(positions_mm)
        by_transform = np.zeros((len(positions), 2, 4))  # of positions, by turn, shift and scale
        by_transform[:, 0, 0], by_transform[:, 1, 0] = -transform.scale * rotated[:, 1], transform.scale * rotated[:, 0]
        by_transform[:, 0, 1] = by_transform[:, 1, 2] = 1
        by_transform[:, :, 3] = rotated
        by_transform /= plan.layout.unit_mm
        profile = self.values[4:N_SHARED].reshape(2, N_SPLINES)
        volts, jacobians = np.empty((len(positions), len(self.fibres))), []
        for c, (fibre, (gain, rest_v, *_)) in enumerate(zip(self.fibres, self.channel_values, strict=True)):
            elements = plan.paths[fibre], plan.tangents[fibre], plan.lengths[fibre]
            signal, by_profile, by_offset, by_sensitivity, by_position = channel_response(
                elements, *self._curves(c), positions, profile, self.step
            )
            volts[:, c] = rest_v + gain * signal
            by_shared = [np.einsum("qx,qxp->qp", by_position, by_transform), by_profile.reshape(len(positions), -1)]
            by_curves = [by_offset.reshape(len(positions), -1), by_sensitivity]
            jacobian = np.hstack([*by_shared, np.zeros((len(positions), 2)), *by_curves]) * gain
            jacobian[:, N_SHARED], jacobian[:, N_SHARED + 1] = signal, 1.0
            jacobians.append(jacobian)
        return volts, jacobians

    def residuals(self, responses: Responses) -> Responses:
        """Return the residuals of responses."""
        return replace(responses, volts=responses.volts - self.predict(responses.positions_mm))

    def with_values(self, values: Array) -> "AsBuiltPad":
        """Return the pad of other parameters, with w scaled to 1 at its largest and gains to match."""
        pad = replace(self, values=values.copy())
        largest = np.abs(pad.profile(np.linspace(0, self.max_distance, 101))[0]).max()
        if largest > 0:
            pad.values[4:N_SHARED] /= largest
            pad.values[N_SHARED::N_CHANNEL] *= largest
        return pad

    def fit_gains(self, responses: Responses) -> "AsBuiltPad":
        """Fit gains and rests alone, by linear least squares: a start from which a fit of all does not diverge."""
        values, volts = self.values.copy(), self.predict(responses.positions_mm)
        for channel, (gain, rest_v, *_) in enumerate(self.channel_values):
            valid = responses.valid[:, channel]
            design_matrix = np.column_stack([(volts[valid, channel] - rest_v) / gain, np.ones(valid.sum())])
            coefficients = np.linalg.lstsq(design_matrix, responses.volts[valid, channel], rcond=None)[0]
            values[channel_indices(channel)[:2]] = coefficients
        return replace(self, values=values)

    def align_transform(self) -> "AsBuiltPad":
        """Move the rotation and shift that all lateral offsets have in common into the plan transform."""
        low, high = sensed_rectangle(self.plan.layout)
        planned = np.concatenate([self.plan.paths[fibre] for fibre in self.fibres])
        built = np.concatenate([self.path(channel)[0] for channel in range(len(self.fibres))])
        within = ((planned >= low) & (planned <= high)).all(axis=1)
        # 1. rotation and shift that bring the fibres as built closest to the plan
        a, b = (points[within] - points[within].mean(axis=0) for points in (built, planned))
        cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        turn = float(np.arctan2(cross.sum(), (a * b).sum()))
        rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        rotated = built @ rotation
        shift = (planned - rotated)[within].mean(axis=0)
        # 2. splines of the offsets that remain
        offset = (rotated + shift - planned).reshape(len(self.fibres), self.plan.elements, 2)
        basis = evaluate_along_fibre(np.eye(N_OFFSET), self.plan.elements)[0][0].T
        coefficients = np.linalg.lstsq(basis, offset.transpose(1, 0, 2).reshape(self.plan.elements, -1), rcond=None)[0]
        # 3. the same in the transform, which rotates about the middle of the pad, and not about its corner
        values, middle = self.values.copy(), np.array(self.plan.layout.extent) / 2
        values[0] += turn
        values[1:3] = values[1:3] @ rotation + self.plan.layout.unit_mm * (middle @ rotation - middle + shift)
        rows = values[N_SHARED:].reshape(-1, N_CHANNEL)
        rows[:, OFFSET] = coefficients.reshape(N_OFFSET, len(self.fibres), 2).transpose(1, 2, 0).reshape(len(rows), -1)
        return replace(self, values=values)


def channel_indices(channel: int) -> Indices:
    """Return the indices (N_CHANNEL,) of a channel's parameters in `AsBuiltPad.values`."""
    return N_SHARED + channel * N_CHANNEL + np.arange(N_CHANNEL)


def _profile_basis(distance: Array) -> Array:
    """Evaluate the splines of a profile, mirrored at 0, at distances (n,) in steps; shape (n, N_SPLINES)."""
    far = np.abs(distance[:, None] - np.arange(1 - N_SPLINES, N_SPLINES))
    splines = np.where(far < 1, 2 / 3 - far**2 + far**3 / 2, np.maximum(2 - far, 0) ** 3 / 6)
    basis = splines[:, N_SPLINES - 1 :]
    basis[:, 1:] += splines[:, N_SPLINES - 2 :: -1]
    return basis
