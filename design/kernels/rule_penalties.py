"""Penalties of the rules as sums over samples of fibres, with their gradients; lengths in grid units.

Common arguments are `points` (F, P, 2), samples of F fibres along and across their axes, or `plan` (F, P, 2), the same
along x and y; `slope` (F, P); `arc` (F, P), arc lengths; and `shares` (F, P), the arc length that each sample
represents. Sums and gradients are multiplied by `weight`. The gradient by an argument is added to the array `grad_...`
of its shape.

Gradients treat `shares`, the weights of integrals along a fibre, as constants. So a violation moves the fibre, but does
not shorten it where it violates a rule.
"""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel
from padforge.design.kernels.pchip import add_value_gradient, extremes, pchip_value

STEEPNESS = 10.0  # coefficient of the square in the cost of a small distance
REACH = 6.0  # standard deviations beyond which the density of a crossing is neglected, since it is below 1e-7


@kernel
def _closeness(distance: float, gap: float) -> tuple[float, float]:
    """Return the cost c + STEEPNESS c^2 of a distance of (1 - c) gap, and its derivative; 0 above the gap."""
    close = 1 - distance / gap
    if close <= 0:
        return 0.0, 0.0
    return close + STEEPNESS * close * close, -(1 + 2 * STEEPNESS * close) / gap


@kernel
def sum_excess_turns(
    slope: Any,
    arc: Any,
    radius: float,
    window: float,
    rolled: float,
    all_bends: bool,
    weight: float,
    grad_slope: Any,
    grad_arc: Any,
) -> float:
    """Integrate the relative excess of the turn within `window` of arc length over window / radius.

    Windows begin at samples and, with `all_bends`, also end at samples: since the turn is linear between samples, the
    window of the largest turn is one of these. At both ends a fibre continues straight as a lead, which it may meet at
    a corner. On a pad that is worn bent, fibres also turn by the angle `rolled` per window at right angles to the plane
    of the pad; leads do not. The gradient includes the turns and the ends of the windows.
    """
    fibres, n = arc.shape
    size, total, n_directions = n + 4, 0.0, 2 if all_bends else 1
    along, heading, turned = np.empty(size), np.zeros(size), np.zeros(size)
    grad_along, grad_turned = np.empty(size), np.empty(size)
    for f in range(fibres):
        # 1. arc length, heading, and sum of absolute turns at the samples and at two points on either lead
        along[0], along[1], along[size - 2], along[size - 1] = -window, 0.0, arc[f, n - 1], arc[f, n - 1] + window
        for i in range(n):
            along[i + 2], heading[i + 2] = arc[f, i], math.atan(slope[f, i])
        for i in range(1, size):
            turned[i] = turned[i - 1] + abs(heading[i] - heading[i - 1])
        grad_along[:] = 0
        grad_turned[:] = 0
        # 2. windows from a sample i to the arc length `other` after it, and then before it
        for backwards in range(n_directions):
            direction, after = 1.0 - 2.0 * backwards, 1
            for i in range(size):
                other = along[i] + direction * window
                while after < size - 1 and along[after] < other:
                    after += 1
                a0, a1, t0, t1 = along[after - 1], along[after], turned[after - 1], turned[after]
                share = min(max((other - a0) / (a1 - a0), 0.0), 1.0)
                in_plan = direction * (t0 + share * (t1 - t0) - turned[i])
                on_fibre = 2 <= i < size - 2 if direction > 0 else 0 <= other <= along[size - 2]
                angle = math.hypot(in_plan, rolled) if on_fibre else in_plan
                excess = angle * radius / window - 1
                if excess <= 0:
                    continue
                low, high = along[max(i - 1, 0)], along[min(i + 1, size - 1)]
                step_weight = weight * (high - low) / (2 * n_directions)
                total += step_weight * excess
                grad_turn = direction * step_weight * radius / window * in_plan / angle
                grad_turned[i] -= grad_turn
                grad_turned[after - 1] += grad_turn * (1 - share)
                grad_turned[after] += grad_turn * share
                if 0 < share < 1:
                    grad_other = grad_turn * (t1 - t0) / (a1 - a0)
                    grad_along[i] += grad_other
                    grad_along[after - 1] -= grad_other * (1 - share)
                    grad_along[after] -= grad_other * share
        # 3. from headings and arc lengths to the samples
        grad_arc[f, n - 1] += grad_along[size - 2] + grad_along[size - 1]
        grad_later = 0.0  # sum of the gradients by the later sums of turns
        for i in range(size - 1, 0, -1):
            grad_later += grad_turned[i]
            grad_heading = grad_later * (
                1.0 if heading[i] > heading[i - 1] else -1.0 if heading[i] < heading[i - 1] else 0.0
            )
            if 2 <= i < size - 2:
                grad_slope[f, i - 2] += grad_heading / (1 + slope[f, i - 2] ** 2)
                grad_arc[f, i - 2] += grad_along[i]
            if 2 <= i - 1 < size - 2:
                grad_slope[f, i - 3] -= grad_heading / (1 + slope[f, i - 3] ** 2)
    return total


@kernel
def sum_closeness(
    points: Any, slope: Any, arc: Any, shares: Any, pairs: Any, gap: float, fold: float, weight: float, grad_points: Any
) -> float:
    """Sum the cost of samples that are nearer than `gap` to another fibre, for pairs (K, 2) of fibre and other.

    Distances are to the piece of the tangent that the nearest sample represents. In a pair of a fibre with itself, only
    pieces count that are at least `fold` of arc length away. The gradient is by both points; slope, arc and shares are
    treated as constants.
    """
    n, total = points.shape[1], 0.0
    for k in range(len(pairs)):
        f, g = pairs[k]
        reach = gap + extremes(shares[g])[1]
        low = 0
        for i in range(n):
            x, y = points[f, i]
            while low < n and points[g, low, 0] < x - reach:
                low += 1
            nearest, min_square = -1, reach * reach
            j = low
            while j < n and points[g, j, 0] <= x + reach:
                if f != g or abs(arc[f, i] - arc[f, j]) >= fold + shares[f, j]:
                    square = (points[g, j, 0] - x) ** 2 + (points[g, j, 1] - y) ** 2
                    if square < min_square:
                        nearest, min_square = j, square
                j += 1
            if nearest < 0:
                continue
            norm = math.sqrt(1 + slope[g, nearest] ** 2)
            tx, ty = 1 / norm, slope[g, nearest] / norm
            dx, dy = x - points[g, nearest, 0], y - points[g, nearest, 1]
            foot = min(max(dx * tx + dy * ty, -shares[g, nearest]), shares[g, nearest])
            dx, dy = dx - foot * tx, dy - foot * ty
            distance = math.hypot(dx, dy)
            cost, rate = _closeness(distance, gap)
            if cost == 0:
                continue
            total += weight * cost
            if distance > 0:
                px, py = weight * rate * dx / distance, weight * rate * dy / distance
                grad_points[f, i, 0] += px
                grad_points[f, i, 1] += py
                grad_points[g, nearest, 0] -= px
                grad_points[g, nearest, 1] -= py
    return total


@kernel
def sum_order(
    along: Any,
    across: Any,
    slope: Any,
    lower: Any,
    stations: int,
    gap: float,
    weight: float,
    grad_along: Any,
    grad_across: Any,
    grad_slope: Any,
) -> float:
    """Sum the cost of fibres less than `gap` above their neighbours `lower` (K,), at evenly spaced stations."""
    total, n = 0.0, along.shape[1]
    for f in lower:
        spans = [0, 0]
        for i in range(stations):
            at = along[f, 0] + (along[f, n - 1] - along[f, 0]) * i / (stations - 1)
            height = 0.0
            for side in range(2):
                t = along[f + side]
                while spans[side] < n - 2 and t[spans[side] + 1] <= at:
                    spans[side] += 1
                j = spans[side]
                value = pchip_value(t, across[f + side], slope[f + side], j, (at - t[j]) / (t[j + 1] - t[j]))[0]
                height += value if side == 1 else -value
            cost, rate = _closeness(height, gap)
            if cost == 0:
                continue
            total += weight * cost
            for side in range(2):
                grad_value = weight * rate if side == 1 else -weight * rate
                t, v, d, j = along[f + side], across[f + side], slope[f + side], spans[side]
                h = t[j + 1] - t[j]
                s = (at - t[j]) / h
                grad_t = grad_along[f + side]
                add_value_gradient(t, v, d, j, s, grad_value, 0.0, grad_t, grad_across[f + side], grad_slope[f + side])
                run = grad_value * pchip_value(t, v, d, j, s)[1]  # the station is constant, s is not
                grad_t[j] -= run * (1 - s)
                grad_t[j + 1] -= run * s
    return total


@kernel
def sum_crossings(
    plan: Any, pairs: Any, axes: Any, blur: float, limit: float, weights: tuple[float, float], grad_plan: Any
) -> tuple[float, float]:
    """Return the smoothed number of crossings of pairs of fibres, and the sum of their relative flatness below `limit`.

    By the Kac-Rice formula the number of crossings of lines p and q is the integral of |dp x dq| delta(p - q). Here a
    Gaussian replaces delta, so that the number has a gradient.

    Args:
        plan: samples; shape (F, P, 2).
        pairs: pairs of fibres; shape (K, 2).
        axes: axis along which each fibre runs, 0 for x; shape (F,).
        blur: standard deviation of the Gaussian.
        limit: minimum angle of a crossing, rad; 0 for no limit.
        weights: weights of both sums in the gradient; the returned sums are not weighted.
        grad_plan: receives the gradient; shape (F, P, 2).
    """
    n, count, flatness, norm = plan.shape[1], 0.0, 0.0, 2 * math.pi * blur**2
    reach = REACH * blur
    for k in range(len(pairs)):
        p, q = plan[pairs[k, 0]], plan[pairs[k, 1]]
        grad_p, grad_q, axis = grad_plan[pairs[k, 0]], grad_plan[pairs[k, 1]], axes[pairs[k, 1]]
        for i in range(n - 1):
            px, py = p[i + 1, 0] - p[i, 0], p[i + 1, 1] - p[i, 1]
            mx, my = (p[i + 1, 0] + p[i, 0]) / 2, (p[i + 1, 1] + p[i, 1]) / 2
            at = mx if axis == 0 else my
            j = max(np.searchsorted(q[:, axis], at - reach) - 1, 0)
            while j < n - 1 and q[j, axis] <= at + reach:
                qx, qy = q[j + 1, 0] - q[j, 0], q[j + 1, 1] - q[j, 1]
                ox, oy = mx - (q[j + 1, 0] + q[j, 0]) / 2, my - (q[j + 1, 1] + q[j, 1]) / 2
                j += 1
                square = ox * ox + oy * oy
                if square > reach * reach:
                    continue
                product = px * qy - py * qx
                area, density = abs(product), math.exp(-square / (2 * blur**2)) / norm
                lp, lq = math.hypot(px, py), math.hypot(qx, qy)
                sine = area / (lp * lq + 1e-12)
                flat = 1 - math.asin(min(sine, 1 - 1e-9)) / limit if limit > 0 else 0.0
                flat = max(flat, 0.0)
                count += area * density
                flatness += area * density * flat
                value = weights[0] + weights[1] * flat
                if value == 0:
                    continue
                grad_area, grad_offset = density * value, -area * density * value / blur**2
                grad_lp = grad_lq = 0.0
                if flat > 0 and sine < 1 - 1e-9:
                    grad_sine = -weights[1] * area * density / limit / math.sqrt(1 - sine * sine)
                    grad_area += grad_sine / (lp * lq + 1e-12)
                    grad_lp = -grad_sine * sine * lq / (lp * lq + 1e-12)
                    grad_lq = -grad_sine * sine * lp / (lp * lq + 1e-12)
                sign = 1.0 if product > 0 else -1.0 if product < 0 else 0.0
                dpx, dpy = grad_area * sign * qy + grad_lp * px / lp, -grad_area * sign * qx + grad_lp * py / lp
                dqx, dqy = -grad_area * sign * py + grad_lq * qx / lq, grad_area * sign * px + grad_lq * qy / lq
                hx, hy = grad_offset * ox / 2, grad_offset * oy / 2
                grad_p[i, 0] += hx - dpx
                grad_p[i, 1] += hy - dpy
                grad_p[i + 1, 0] += hx + dpx
                grad_p[i + 1, 1] += hy + dpy
                grad_q[j - 1, 0] -= hx + dqx
                grad_q[j - 1, 1] -= hy + dqy
                grad_q[j, 0] -= hx - dqx
                grad_q[j, 1] -= hy - dqy
    return count, flatness
