"""The published contact rule: segments of a sampled fibre count whole if they start inside the press."""

import math
from typing import Any

import numpy as np
from numba import njit

from .pchip import pchip_sample
from .press import MANHATTAN, inside, weigh


@njit(cache=True, error_model="numpy", nogil=True)
def quantized_signals(
    knots: Any,
    presses: Any,
    radius: float,
    sides: int,
    weight: int,
    length: int,
    samples: int,
    begin: int,
    end: int,
    out: Any,
) -> None:
    """The published rule: sum over sampled segments that start inside the press.

    Args:
        knots: (P, 2M, N+2, 2). presses: (Q, 2). samples: points per fibre, uniform along its travel axis.
        begin, end: range of fibres to do, counted through the population, 0..2M P.
        out: (P, Q, 2M) zeros to fill. Only samples whose travel coordinate a press can reach are looked at.
    """
    fibres = knots.shape[1]
    step = (fibres // 2 + 1) / (samples - 1)
    curve = np.empty(samples)
    for index in range(begin, end):
        p, f = index // fibres, index % fibres
        travel = 0 if f < fibres // 2 else 1
        pchip_sample(knots[p, f, :, travel].copy(), knots[p, f, :, 1 - travel].copy(), step, curve)
        for q in range(len(presses)):
            t0, v0 = presses[q, travel], presses[q, 1 - travel]
            first = max(0, math.ceil((t0 - radius) / step) - 1)
            last = min(samples - 2, math.floor((t0 + radius) / step) + 1)
            total = 0.0
            for k in range(first, last + 1):
                dt, dv = k * step - t0, curve[k] - v0
                if abs(dv) > radius:
                    continue
                dx, dy = (dt, dv) if travel == 0 else (dv, dt)
                if inside(dx, dy, radius, sides):
                    rise = abs(curve[k + 1] - curve[k])
                    run = step + rise if length == MANHATTAN else math.hypot(step, rise)
                    total += run * weigh(dt * dt + dv * dv, radius, weight)
            out[p, q, f] = total
