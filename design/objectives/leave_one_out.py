"""Leave-one-out error of kernel ridge regression, with its gradient by the responses, both from one inverse.

For responses x_a, positions p_a relative to their centre, and the ridge r, the mean error of N_c presses is

    E = 1/N_c sum_a |alpha_a| / c_aa,    alpha = C p,    C = (k + r 1)^-1,    k_ab = exp(-|x_a - x_b|^2 / 2).

With the gradients g by alpha_a and d by c_aa, and beta = C g, dC = -C dk C gives for each pair a > b

    -dE/dk_ab = 2 (C diag(d) C)_ab + beta_a . alpha_b + alpha_a . beta_b,    dk_ab/dx_a = -k_ab (x_a - x_b).

Single precision is sufficient except for the products of responses, of which distances are differences.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

EPSILON = np.float32(1e-12)  # added to squared lengths, so that their root has a gradient at 0


def leave_one_out_errors(
    responses: Floats, positions: Floats, masks: Array, count: int, ridge: float, differentiate: bool = True
) -> tuple[Array, Array]:
    """Compute the mean error for each set of working fibres, and its gradient by the responses.

    Args:
        responses: responses in widths of the kernel; shape (F, N).
        positions: positions of the N presses relative to their centre; shape (N, 2).
        masks: 1 for a working fibre, 0 for a failed one; shape (L, F).
        count: number of presses, the first ones, over which the mean is taken; 1 to N.
        ridge: the ridge, above 0.
        differentiate: whether to compute the gradient.

    Returns:
        The mean errors (L,), and their gradients (L, F, N), or (L, 0, N) without `differentiate`.
    """
    (fibres, n), x, place = responses.shape, responses.astype(np.float64), np.float32(positions)
    errors, gradient = np.empty(len(masks)), np.empty((len(masks), fibres if differentiate else 0, n))
    weight = np.where(np.arange(n) < count, np.float32(1 / count), np.float32(0))
    for k, mask in enumerate(masks):
        # 1. the error, and its gradients by alpha and by the diagonal of the inverse
        masked = np.sqrt(mask)[:, None] * x
        products = masked.T @ masked
        half_squares = products.diagonal() / 2
        gram = np.exp(np.float32(products - half_squares - half_squares[:, None]))
        inverse = _invert(gram, ridge)
        alpha, diagonal = inverse @ place, inverse.diagonal()
        length = np.sqrt(np.square(alpha).sum(axis=1) + EPSILON)
        errors[k] = weight @ (length / diagonal)
        if not differentiate:
            continue
        grad_alpha = (weight / (length * diagonal))[:, None] * alpha
        grad_diagonal = -weight * length / diagonal**2
        # 2. -dE/dk_ab k_ab, and the gradient by the responses
        beta, weighted = inverse @ grad_alpha, inverse * np.sqrt(-2 * grad_diagonal)
        by_gram = np.hstack([alpha, beta]) @ np.hstack([beta, alpha]).T
        by_gram -= weighted @ weighted.T
        by_gram *= gram
        np.fill_diagonal(by_gram, 0)
        gradient[k] = mask[:, None] * (responses * by_gram.sum(axis=0) - responses @ by_gram)
    return errors, gradient


def _invert(gram: Floats, ridge: float) -> Floats:
    """Invert gram + ridge 1 by Cholesky; all NaN if responses are."""
    matrix = gram.copy()
    matrix.flat[:: len(gram) + 1] += np.float32(ridge)
    factor, failed = lapack.spotrf(matrix.T, clean=1, overwrite_a=1)
    if failed:
        return np.full_like(gram, np.nan)
    inverse_factor, _ = lapack.strtri(factor, overwrite_c=1)
    return inverse_factor @ inverse_factor.T
