"""Sums over samples of fibres by which the rules are penalised, with their gradients; grid units.

Samples of F fibres are `points` (F, P, 2), along and across their axes, or `plan` (F, P, 2), along x and y. `arc` are
arc lengths (F, P), and `shares` the arc length (F, P) that each stands for. A sum is multiplied by `weight`, as is the
gradient, which is added to arrays `by_...` of the shape of what it is by.

Gradients hold the share of arc that a sample stands for, by which integrals along a fibre are weighted: what a breach
costs pushes the fibre, but no fibre is drawn shorter where it costs.
"""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel
from padforge.design.kernels.pchip import add_value_gradient, extremes, pchip_value

STEEPNESS = 10.0
"""By which what is too close by a share c costs c + STEEPNESS c^2."""
REACH = 6.0
"""Standard deviations beyond which a crossing has no density: less than 1e-7 of it."""


@kernel
def _closeness(distance: float, gap: float) -> tuple[float, float]:
    """Return what a distance below the gap costs, and its derivative; 0 for other ones."""
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
    """Integrate the excess of the turn within `window` of arc length over window / radius, relative to that, (F, P).

    Windows begin at samples or, half of them for `all_bends`, end at samples: the most turn, linear between samples,
    is in one of both. Fibres go on straight from both ends, by their leads, which they may meet at a corner. They turn
    by `rolled` more, at right angles, except where a window begins on a lead. The gradient is by the turns and by where
    windows end; the arc between samples that weights them is held.
    """
    fibres, n = arc.shape
    size, total, ways = n + 4, 0.0, 2 if all_bends else 1
    along, heading, turned = np.empty(size), np.zeros(size), np.zeros(size)
    grad_along, grad_turned = np.empty(size), np.empty(size)
    for f in range(fibres):
        along[0], along[1], along[size - 2], along[size - 1] = -window, 0.0, arc[f, n - 1], arc[f, n - 1] + window
        for i in range(n):
            along[i + 2], heading[i + 2] = arc[f, i], math.atan(slope[f, i])
        for i in range(1, size):
            turned[i] = turned[i - 1] + abs(heading[i] - heading[i - 1])
        grad_along[:] = 0
        grad_turned[:] = 0
        for way in range(ways):
            towards, after = 1.0 - 2.0 * way, 1  # the other end of a window lies after the sample, or before it
            for i in range(size):
                other = along[i] + towards * window
                while after < size - 1 and along[after] < other:
                    after += 1
                a0, a1, t0, t1 = along[after - 1], along[after], turned[after - 1], turned[after]
                share = min(max((other - a0) / (a1 - a0), 0.0), 1.0)
                in_plan = towards * (t0 + share * (t1 - t0) - turned[i])
                on_fibre = 2 <= i < size - 2 if towards > 0 else 0 <= other <= along[size - 2]
                angle = math.hypot(in_plan, rolled) if on_fibre else in_plan
                excess = angle * radius / window - 1
                if excess <= 0:
                    continue
                low, high = along[max(i - 1, 0)], along[min(i + 1, size - 1)]
                part = weight * (high - low) / (2 * ways)
                total += part * excess
                push = towards * part * radius / window * in_plan / angle
                grad_turned[i] -= push
                grad_turned[after - 1] += push * (1 - share)
                grad_turned[after] += push * share
                if 0 < share < 1:
                    pull = push * (t1 - t0) / (a1 - a0)
                    grad_along[i] += pull
                    grad_along[after - 1] -= pull * (1 - share)
                    grad_along[after] -= pull * share
        grad_arc[f, n - 1] += grad_along[size - 2] + grad_along[size - 1]
        later = 0.0  # derivative by all turns from here on
        for i in range(size - 1, 0, -1):
            later += grad_turned[i]
            grad_heading = later * (
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
    """Sum what it costs that samples lie nearer than `gap` to another fibre, for pairs (K, 2) of fibre and other.

    Distances are to the piece of tangent that the nearest sample stands for, a step to both sides. Where a fibre is
    paired with itself, those pieces count that lie `fold` of arc length away or more from end to end. The gradient is
    by both points; slope, arc and shares are held.
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
            nearest, least = -1, reach * reach
            j = low
            while j < n and points[g, j, 0] <= x + reach:
                if f != g or abs(arc[f, i] - arc[f, j]) >= fold + shares[f, j]:
                    square = (points[g, j, 0] - x) ** 2 + (points[g, j, 1] - y) ** 2
                    if square < least:
                        nearest, least = j, square
                j += 1
            if nearest < 0:
                continue
            norm = math.sqrt(1 + slope[g, nearest] ** 2)
            tx, ty = 1 / norm, slope[g, nearest] / norm
            dx, dy = x - points[g, nearest, 0], y - points[g, nearest, 1]
            beside = min(max(dx * tx + dy * ty, -shares[g, nearest]), shares[g, nearest])
            dx, dy = dx - beside * tx, dy - beside * ty
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
    """Sum what it costs that fibres lie less than `gap` above the next `lower` ones (K,), at evenly spaced stations."""
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
                push = weight * rate if side == 1 else -weight * rate
                t, v, d, j = along[f + side], across[f + side], slope[f + side], spans[side]
                h = t[j + 1] - t[j]
                s = (at - t[j]) / h
                grad_t = grad_along[f + side]
                add_value_gradient(t, v, d, j, s, push, 0.0, grad_t, grad_across[f + side], grad_slope[f + side])
                run = push * pchip_value(t, v, d, j, s)[1]  # the station is held, not s
                grad_t[j] -= run * (1 - s)
                grad_t[j + 1] -= run * s
    return total


@kernel
def sum_crossings(
    plan: Any, pairs: Any, axes: Any, blur: float, limit: float, weights: tuple[float, float], grad_plan: Any
) -> tuple[float, float]:
    """Count the crossings of pairs (K, 2) of fibres softly, and sum how much flatter they are than `limit`, relative.

    By the Kac-Rice formula the number of crossings of lines p and q is the sum of |dp x dq| delta(p - q), here with a
    Gaussian of standard deviation `blur` for delta, so that it has a gradient: of both sums, by their `weights`, which
    do not multiply these. `axes` (F,) are those that fibres run along, 0 for x.
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
                area, bell = abs(product), math.exp(-square / (2 * blur**2)) / norm
                lp, lq = math.hypot(px, py), math.hypot(qx, qy)
                sine = area / (lp * lq + 1e-12)
                flat = 1 - math.asin(min(sine, 1 - 1e-9)) / limit if limit > 0 else 0.0
                flat = max(flat, 0.0)
                count += area * bell
                flatness += area * bell * flat
                value = weights[0] + weights[1] * flat
                if value == 0:
                    continue
                grad_area, grad_offset = bell * value, -area * bell * value / blur**2
                grad_lp = grad_lq = 0.0
                if flat > 0 and sine < 1 - 1e-9:
                    grad_sine = -weights[1] * area * bell / limit / math.sqrt(1 - sine * sine)
                    grad_area += grad_sine / (lp * lq + 1e-12)
                    grad_lp, grad_lq = (
                        -grad_sine * sine * lq / (lp * lq + 1e-12),
                        -grad_sine * sine * lp / (lp * lq + 1e-12),
                    )
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


@kernel
def sum_border_slopes(points: Any, slope: Any, shares: Any, zone: float, weight: float, grad_slope: Any) -> float:
    """Integrate by how much slopes are steeper than 45 degrees less than `zone` from either end of their fibre.

    The gradient is by the slopes; points and shares are held.
    """
    total, (fibres, n) = 0.0, slope.shape
    for f in range(fibres):
        for i in range(n):
            along, steep = points[f, i, 0], abs(slope[f, i]) - 1
            if steep > 0 and (along < zone or along > points[f, n - 1, 0] - zone):
                total += weight * shares[f, i] * steep
                grad_slope[f, i] += weight * shares[f, i] * math.copysign(1.0, slope[f, i])
    return total


@kernel
def add_arc_gradient(points: Any, grad_arc: Any, grad_points: Any) -> None:
    """Add the gradient of sum(grad_arc * arc), of the arc lengths of the polylines through points (F, P, 2)."""
    for f in range(len(points)):
        later = 0.0
        for i in range(points.shape[1] - 1, 0, -1):
            later += grad_arc[f, i]
            dx, dy = points[f, i, 0] - points[f, i - 1, 0], points[f, i, 1] - points[f, i - 1, 1]
            step = math.hypot(dx, dy)
            if later != 0 and step > 0:
                px, py = later * dx / step, later * dy / step
                grad_points[f, i, 0] += px
                grad_points[f, i, 1] += py
                grad_points[f, i - 1, 0] -= px
                grad_points[f, i - 1, 1] -= py
