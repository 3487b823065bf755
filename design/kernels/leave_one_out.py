"""Leave-one-out error of kernel ridge regression, with its gradient by the responses, both from one inverse.

For responses x_a, positions p_a relative to their centre, and the ridge r, the mean error of N_c presses is

    E = 1/N_c sum_a |alpha_a| / c_aa,    alpha = C p,    C = (k + r 1)^-1,    k_ab = exp(-|x_a - x_b|^2 / 2).

With the gradients g by alpha_a and d by c_aa, and beta = C g, dC = -C dk C gives for each pair a > b

    -dE/dk_ab = 2 (C diag(d) C)_ab + beta_a . alpha_b + alpha_a . beta_b,    dk_ab/dx_a = -k_ab (x_a - x_b).

Single precision is sufficient since distances are computed from differences, not from products, of responses. Loops run
over rows of lower triangles, four at a time, which compilers vectorise.
"""

import math
from typing import Any

import numpy as np

from padforge.common.compilation import kernel

_FAST = {"reassoc", "contract"}  # fast-math flags: sums may be reordered, but NaN and infinities are kept
EPSILON = np.float32(1e-12)  # added to squared lengths, so that their root has a gradient at 0


@kernel(fastmath=_FAST)
def leave_one_out_errors(responses: Any, positions: Any, masks: Any, count: int, ridge: float, gradient: Any) -> Any:
    """Compute the mean error for each set of working fibres, and its gradient by the responses.

    Args:
        responses: responses in widths of the kernel, float32; shape (F, N).
        positions: positions of the N presses relative to their centre, float32; shape (N, 2).
        masks: 1 for a working fibre, 0 for a failed one; shape (L, F).
        count: number of presses, the first ones, over which the mean is taken; 1 to N.
        ridge: the ridge, above 0.
        gradient: receives the gradients, float64; shape (L, F, N), or (L, 0, N) to compute none.

    Returns:
        The mean errors; shape (L,).
    """
    fibres, n = responses.shape
    out = np.zeros(len(masks))
    gram, inverse, work = np.empty((n, n), np.float32), np.empty((n, n), np.float32), np.empty((n, n), np.float32)
    x, y = np.empty(n, np.float32), np.empty(n, np.float32)
    alpha_x, alpha_y = np.empty(n, np.float32), np.empty(n, np.float32)
    grad_alpha_x, grad_alpha_y = np.empty(n, np.float32), np.empty(n, np.float32)
    beta_x, beta_y = np.empty(n, np.float32), np.empty(n, np.float32)
    grad_diagonal, grad_response = np.empty(n, np.float32), np.empty(n, np.float32)
    for a in range(n):  # an assignment to a slice takes two seconds to compile
        x[a], y[a] = positions[a]
    per_press = np.float32(1 / count)
    for k in range(len(masks)):
        # 1. the error, and its gradients by alpha and by the diagonal of the inverse
        _fill_gram(responses, masks[k], gram)
        _invert(gram, np.float32(ridge), inverse, work)
        for a in range(n):
            alpha_x[a], alpha_y[a] = _product(inverse[a], x), _product(inverse[a], y)
            grad_alpha_x[a] = grad_alpha_y[a] = grad_diagonal[a] = 0
            if a < count:
                c = inverse[a, a]
                length = math.sqrt(alpha_x[a] * alpha_x[a] + alpha_y[a] * alpha_y[a] + EPSILON)
                out[k] += per_press * length / c
                grad_alpha_x[a] = per_press * alpha_x[a] / (length * c)
                grad_alpha_y[a] = per_press * alpha_y[a] / (length * c)
                grad_diagonal[a] = -per_press * length / (c * c)
        if gradient.shape[1] == 0:
            continue
        # 2. -dE/dk_ab k_ab, in the lower triangle of `work`
        for a in range(n):
            beta_x[a], beta_y[a] = _product(inverse[a], grad_alpha_x), _product(inverse[a], grad_alpha_y)
        _weigh(inverse, grad_diagonal, work)
        for a in range(n):
            row, gram_row = work[a], gram[a]
            bx, by, ax, ay = beta_x[a], beta_y[a], alpha_x[a], alpha_y[a]
            for b in range(a):
                grad_entry = 2 * row[b] + bx * alpha_x[b] + by * alpha_y[b] + ax * beta_x[b] + ay * beta_y[b]
                row[b] = grad_entry * gram_row[b]
        # 3. the gradient by the responses
        for f in range(fibres):
            grad_response[:] = 0
            if masks[k, f] > 0:
                response = responses[f]
                for a in range(n):
                    row, response_a, total = work[a], response[a], np.float32(0)
                    for b in range(a):
                        term = row[b] * (response_a - response[b])
                        total += term
                        grad_response[b] -= term
                    grad_response[a] += total
            for a in range(n):
                gradient[k, f, a] = grad_response[a]
    return out


@kernel(fastmath=_FAST)
def _fill_gram(responses: Any, mask: Any, out: Any) -> None:
    """Compute exp(-|x_a - x_b|^2 / 2) over the fibres of a mask into the lower triangle of out (N, N)."""
    for a in range(len(out)):
        row = out[a]
        row[:] = 0
        for f in range(len(responses)):
            if mask[f] > 0:
                x = responses[f]
                x_a = x[a]
                for b in range(a):
                    row[b] += (x_a - x[b]) * (x_a - x[b])
        for b in range(a + 1):
            row[b] = math.exp(np.float32(-0.5) * row[b])


@kernel(fastmath=_FAST)
def _invert(matrix: Any, ridge: Any, out: Any, work: Any) -> None:
    """Invert matrix + ridge 1, given by its lower triangle, by Cholesky into `out`; all (N, N), `work` overwritten."""
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
        _add_rows(out[i, :i], work[:i], row, i, np.int64(1))  # a literal 1 would be another type to compile for
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
    """Add factors (K,) times rows (K, N) to the first `width` columns of out (N,); row k is 0 from k + n_filled on."""
    count = len(factors)
    k = 0
    while k + 4 <= count:  # four rows at a time, so that `out` is read and written a fourth as often
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
