"""Cramer-Rao bound of the localisation error on the cells of a grid of presses, with its gradient by the responses.

For a cell between four presses, J = dx / dp are the slopes of the responses, and S = diag(deviation^2) + u u' is their
covariance, with deviation^2 = floor^2 + (1 - common) (share x)^2 and u = sqrt(common) share x. The bound is
sqrt(trace F^-1) with F = J' S^-1 J + prior; S^-1 follows from the Sherman-Morrison formula.
"""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel


@kernel
def error_bound(responses: Any, step: Any, cells: Any, masks: Any, scatter: Any, prior: Any, gradient: Any) -> Any:
    """Compute the mean bound over cells for each set of working fibres, and its gradient by the responses.

    Args:
        responses: responses of F fibres to the Q presses of a square grid, row by row; shape (F, Q).
        step: distance of neighbours on the grid; shape (2,).
        cells: index of the first, lower left, press of each cell that counts, one or more; shape (C,).
        masks: 1 for a working fibre, 0 for a failed one; shape (L, F).
        scatter: floor, share and common of the scatter.
        prior: prior precision of both coordinates; shape (2,).
        gradient: receives the gradient; shape (L, F, Q), or (L, 0, Q) to compute none.

    Returns:
        The mean bounds; shape (L,).
    """
    floor, share, common = scatter
    fibres, side = len(responses), int(math.sqrt(responses.shape[1]) + 0.5)
    independent, shared = share * share * (1 - common), math.sqrt(common) * share
    out = np.zeros(len(masks))
    gradient[:] = 0
    differentiate = gradient.shape[1] > 0
    middle, deviation, x, y, u = np.empty((5, fibres))
    for first in cells:
        # 1. slopes in units of the deviation, and the shared part of the noise, for all sets
        for f in range(fibres):
            a, b = responses[f, first], responses[f, first + 1]
            c, d = responses[f, first + side], responses[f, first + side + 1]
            middle[f] = (a + b + c + d) / 4
            deviation[f] = math.sqrt(floor * floor + independent * middle[f] * middle[f])
            x[f] = (b + d - a - c) / (2 * step[0]) / deviation[f]
            y[f] = (c + d - a - b) / (2 * step[1]) / deviation[f]
            u[f] = shared * middle[f] / deviation[f]
        for k in range(len(masks)):
            xx = yy = xy = ux = uy = 0.0
            total = 1.0
            for f in range(fibres):
                if masks[k, f] > 0:
                    xx += x[f] * x[f]
                    yy += y[f] * y[f]
                    xy += x[f] * y[f]
                    ux += u[f] * x[f]
                    uy += u[f] * y[f]
                    total += u[f] * u[f]
            xx, yy, xy = xx - ux * ux / total, yy - uy * uy / total, xy - ux * uy / total
            # 2. the determinant by the residual r of y after projection on x, as in a QR decomposition: xx yy - xy^2
            # would cancel under small noise if only one direction is observed
            along_x, rr, ur = xy / xx if xx > 0 else 0.0, 0.0, 0.0
            for f in range(fibres):
                if masks[k, f] > 0:
                    residual = y[f] - along_x * x[f]
                    rr += residual * residual
                    ur += u[f] * residual
            rr -= ur * ur / total
            volume = xx * rr + prior[0] * yy + prior[1] * xx + prior[0] * prior[1]
            trace = xx + yy + prior[0] + prior[1]
            bound = math.sqrt(trace / volume)
            out[k] += bound / len(cells)
            if not differentiate:
                continue
            # 3. reverse pass
            grad_trace, grad_volume = bound / (2 * trace * len(cells)), -bound / (2 * volume * len(cells))
            grad_xx = grad_trace + grad_volume * (rr + prior[1])
            grad_yy = grad_trace + grad_volume * prior[0]
            grad_rr = grad_volume * xx  # with along_x held: a multiple of x in y does not change the determinant
            grad_ux, grad_uy, grad_ur = -2 * grad_xx * ux / total, -2 * grad_yy * uy / total, -2 * grad_rr * ur / total
            grad_total = (grad_xx * ux * ux + grad_yy * uy * uy + grad_rr * ur * ur) / (total * total)
            for f in range(fibres):
                if masks[k, f] > 0:
                    residual = y[f] - along_x * x[f]
                    grad_residual = 2 * grad_rr * residual + grad_ur * u[f]
                    grad_x = 2 * grad_xx * x[f] + grad_ux * u[f] - along_x * grad_residual
                    grad_y = 2 * grad_yy * y[f] + grad_uy * u[f] + grad_residual
                    grad_u = grad_ux * x[f] + grad_uy * y[f] + grad_ur * residual + 2 * grad_total * u[f]
                    grad_deviation = -(grad_x * x[f] + grad_y * y[f] + grad_u * u[f]) / deviation[f]
                    grad_middle = (grad_u * shared + grad_deviation * independent * middle[f]) / deviation[f] / 4
                    along, across = grad_x / (2 * step[0] * deviation[f]), grad_y / (2 * step[1] * deviation[f])
                    gradient[k, f, first] += grad_middle - along - across
                    gradient[k, f, first + 1] += grad_middle + along - across
                    gradient[k, f, first + side] += grad_middle - along + across
                    gradient[k, f, first + side + 1] += grad_middle + along + across
    return out
