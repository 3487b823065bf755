"""How near places of fibres come to a fibre of the other family, with the gradient by the samples of both."""

import math
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy", nogil=True)
def lying_beside(
    place: Any, slope: Any, arc: Any, fibres: Any, beside: Any, middles: Any, half: float, width: float, gradient: Any
) -> float:
    """Return by how much places `half` before and behind middles are nearer than `width`, summed, as shares of it.

    Args:
        place: (F, P, 2) samples of fibres along their travel and cross axes.
        slope: (F, P) slopes there.
        arc: (F, P) lengths of the fibres up to there.
        fibres: (K,) index of the fibre that each middle is on.
        beside: (K,) index of the fibre, of the other family, that it lies by.
        middles: (K,) arcs of the middles.
        half: arc from a middle to either place.
        width: distance from which a place costs nothing.
        gradient: (F, P, 2) that of the sum by `place` is added to it, for places that keep their arcs.
    """
    total, samples = 0.0, place.shape[1]
    for k in range(len(fibres)):
        f, g = fibres[k], beside[k]
        for side in (-half, half):
            # 1. the place, between two samples of its fibre, in the axes of the other fibre
            after = min(max(np.searchsorted(arc[f], middles[k] + side), 1), samples - 1)
            share = (middles[k] + side - arc[f, after - 1]) / (arc[f, after] - arc[f, after - 1])
            dx, dy = place[f, after, 1] - place[f, after - 1, 1], place[f, after, 0] - place[f, after - 1, 0]
            x, y = place[f, after - 1, 1] + share * dx, place[f, after - 1, 0] + share * dy
            # 2. its distance to the tangent in the sample that is next to it
            nearest, least = 0, np.inf
            for i in range(samples):
                square = (place[g, i, 0] - x) ** 2 + (place[g, i, 1] - y) ** 2
                if square < least:
                    nearest, least = i, square
            run = math.hypot(1.0, slope[g, nearest])
            nx, ny = -slope[g, nearest] / run, 1.0 / run
            away = (x - place[g, nearest, 0]) * nx + (y - place[g, nearest, 1]) * ny
            close = 1.0 - abs(away) / width
            if close <= 0:
                continue
            total += close
            push = -math.copysign(1.0, away) / width
            # the fibre beside it turns there with the sample on the other side of its foot
            beyond = (x - place[g, nearest, 0]) * ny - (y - place[g, nearest, 1]) * nx
            behind = min(max(nearest + (1 if beyond > 0 else -1), 0), samples - 1)
            step = abs(arc[g, behind] - arc[g, nearest])
            foot = min(abs(beyond) / step, 1.0) if step > 0 else 0.0
            for i, part in ((nearest, 1.0 - foot), (behind, foot)):
                gradient[g, i, 0] -= part * push * nx
                gradient[g, i, 1] -= part * push * ny
            # 3. a place keeps its arc: what moves it along its own fibre does not count
            length = math.hypot(dx, dy)
            along = (nx * dx + ny * dy) / length
            px, py = push * (nx - along * dx / length), push * (ny - along * dy / length)
            for i, part in ((after - 1, 1.0 - share), (after, share)):
                gradient[f, i, 1] += part * px
                gradient[f, i, 0] += part * py
    return total
