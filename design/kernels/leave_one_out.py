"""Leave-one-out error of kernel ridge regression, with its gradient by the responses, both from one inverse.

Differences of responses, unlike products, do not cancel: single precision serves. The inverse is that of a Cholesky
factor; loops run over rows of the lower triangles, four at a time, as compilers vectorise them.
"""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel

_FAST = {"reassoc", "contract"}
"""Sums may be taken in another order; NaN and infinities stay what they are."""
EPSILON = np.float32(1e-12)
"""Squared length, so that its root has a gradient at 0."""


@kernel(fastmath=_FAST)
def leave_one_out_errors(responses: Any, positions: Any, masks: Any, count: int, ridge: float, gradient: Any) -> Any:
    """Compute the mean errors (L,) for sets of working fibres, and their gradients into `gradient` (L, F, N).

    Args:
        responses: in widths of the kernel, float32; shape (F, N).
        positions: of the N presses from their middle, float32; shape (N, 2).
        masks: 1 for a fibre that works, 0 for a failed one; shape (L, F).
        count: presses, the first ones, over which the mean is taken; 1 to N.
        ridge: above 0.
        gradient: float64, overwritten; may be of no fibres (L, 0, N), then it is not computed.
    """
    fibres, n = responses.shape
    out = np.zeros(len(masks))
    # rows by an index, as unpacked ones are not known to be contiguous, and loops over them are not vectorised
    squares, rows = np.empty((3, n, n), np.float32), np.empty((10, n), np.float32)
    kernel, inverse, work = squares[0], squares[1], squares[2]
    x, y, alpha_x, alpha_y, grad_x, grad_y = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    back_x, back_y, grad_diagonal, g = rows[6], rows[7], rows[8], rows[9]
    for a in range(n):  # an assignment to a slice takes two seconds to compile
        x[a], y[a] = positions[a]
    share = np.float32(1 / count)
    for k in range(len(masks)):
        _fill_kernel(responses, masks[k], kernel)
        _invert(kernel, np.float32(ridge), inverse, work)
        for a in range(n):
            alpha_x[a], alpha_y[a] = _product(inverse[a], x), _product(inverse[a], y)
            grad_x[a] = grad_y[a] = grad_diagonal[a] = 0
            if a < count:
                c = inverse[a, a]
                length = math.sqrt(alpha_x[a] * alpha_x[a] + alpha_y[a] * alpha_y[a] + EPSILON)
                out[k] += share * length / c
                grad_x[a], grad_y[a] = share * alpha_x[a] / (length * c), share * alpha_y[a] / (length * c)
                grad_diagonal[a] = -share * length / (c * c)
        if gradient.shape[1] == 0:
            continue
        # dC = -C dk C gives the derivative of the error by every entry of k, but for the sign
        for a in range(n):
            back_x[a], back_y[a] = _product(inverse[a], grad_x), _product(inverse[a], grad_y)
        _weigh(inverse, grad_diagonal, work)
        for a in range(n):
            row, similar = work[a], kernel[a]
            bx, by, ax, ay = back_x[a], back_y[a], alpha_x[a], alpha_y[a]
            for b in range(a):
                grad_entry = 2 * row[b] + bx * alpha_x[b] + by * alpha_y[b] + ax * back_x[b] + ay * back_y[b]
                row[b] = grad_entry * similar[b]
        for f in range(fibres):
            g[:] = 0
            if masks[k, f] > 0:
                response = responses[f]
                for a in range(n):
                    row, here, total = work[a], response[a], np.float32(0)
                    for b in range(a):
                        pull = row[b] * (here - response[b])
                        total += pull
                        g[b] -= pull
                    g[a] += total
            for a in range(n):
                gradient[k, f, a] = g[a]
    return out


@kernel(fastmath=_FAST)
def _fill_kernel(responses: Any, mask: Any, out: Any) -> None:
    """Compute exp(-|x_a - x_b|^2 / 2) over the fibres of a mask into the lower triangle of out (N, N)."""
    for a in range(len(out)):
        row = out[a]
        row[:] = 0
        for f in range(len(responses)):
            if mask[f] > 0:
                x = responses[f]
                here = x[a]
                for b in range(a):
                    row[b] += (here - x[b]) * (here - x[b])
        for b in range(a + 1):
            row[b] = math.exp(np.float32(-0.5) * row[b])


@kernel(fastmath=_FAST)
def _invert(matrix: Any, ridge: Any, out: Any, work: Any) -> None:
    """Compute the inverse of matrix + ridge 1 into `out`, from its lower triangle; all (N, N), `work` overwritten."""
    n = len(matrix)
    # 1. Cholesky factor, in the lower triangle of `out`, with the reciprocals of its diagonal
    for i in range(n):
        row = out[i]
        for j in range(i + 1):
            other, total = out[j], matrix[i, j]
            for k in range(j):
                total -= row[k] * other[k]
            row[j] = total * other[j] if j < i else 1 / math.sqrt(total + ridge)
    # 2. its inverse
    for i in range(n):
        row, last = work[i], out[i, i]
        row[:] = 0
        _add_rows(out[i, :i], work[:i], row, i, np.int64(1))  # of a variable's type, else compiled anew
        for j in range(i):
            row[j] *= -last
        row[i] = last
    # 3. transpose times inverse
    factors = np.empty(n, np.float32)
    for a in range(n):
        row = out[a]
        row[:] = 0
        for k in range(a, n):
            factors[k] = work[k, a]
        _add_rows(factors[a:], work[a:], row, a + 1, a + 1)
    for a in range(n):
        for b in range(a):
            out[b, a] = out[a, b]


@kernel(fastmath=_FAST)
def _weigh(matrix: Any, weights: Any, out: Any) -> None:
    """Compute the lower triangle of matrix diag(weights) matrix into `out`, for a symmetric matrix (N, N)."""
    n = len(matrix)
    factors = np.empty(n, np.float32)
    for a in range(n):
        row, entries = out[a], matrix[a]
        row[:] = 0
        for k in range(n):
            factors[k] = entries[k] * weights[k]
        _add_rows(factors, matrix, row, a + 1, n)


@kernel(fastmath=_FAST)
def _add_rows(factors: Any, rows: Any, out: Any, width: int, n_filled: int) -> None:
    """Add factors (K,) times rows (K, N) to the first `width` columns of out (N,); row k is 0 from k + `known` on."""
    count = len(factors)
    k = 0
    while k + 4 <= count:  # four at a time: what is added to is read and written as rarely
        c0, c1, c2, c3 = factors[k], factors[k + 1], factors[k + 2], factors[k + 3]
        r0, r1, r2, r3 = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
        for j in range(min(width, k + 3 + n_filled)):
            out[j] += c0 * r0[j] + c1 * r1[j] + c2 * r2[j] + c3 * r3[j]
        k += 4
    for last in range(k, count):
        c0, r0 = factors[last], rows[last]
        for j in range(min(width, last + n_filled)):
            out[j] += c0 * r0[j]


@kernel(fastmath=_FAST)
def _product(x: Any, y: Any) -> Any:
    """Compute the product of two rows in single precision."""
    total = np.float32(0)
    for k in range(len(x)):
        total += x[k] * y[k]
    return total
