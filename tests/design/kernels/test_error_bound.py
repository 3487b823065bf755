"""The Cramer-Rao bound and its gradient beside sums over pairs of fibres in extended precision."""

from itertools import combinations

import numpy as np
import pytest

from padforge.design.kernels.error_bound import error_bound

SIDE, STEP = 4, np.array([0.4, 0.5])
PRIOR = 12 / (STEP * SIDE) ** 2
CELLS = np.array([row * SIDE + column for row in range(SIDE - 1) for column in range(SIDE - 1)])
WHOLE = np.finfo(np.longdouble).eps < np.finfo(float).eps  # extended precision, which Windows and macOS on ARM lack


def plain_bound(responses: np.ndarray, scatter: tuple[float, float, float]) -> np.longdouble:
    """The bound with the determinant as a sum of squares (Cauchy and Binet), which does not cancel."""
    floor, share, common = map(np.longdouble, scatter)
    bounds = []
    for first in CELLS:
        a, b, c, d = (responses[:, first + shift].astype(np.longdouble) for shift in (0, 1, SIDE, SIDE + 1))
        middle = (a + b + c + d) / 4
        deviation = np.sqrt(floor**2 + share**2 * (1 - common) * middle**2)
        x, y = (b + d - a - c) / (2 * STEP[0]) / deviation, (c + d - a - b) / (2 * STEP[1]) / deviation
        u = np.sqrt(common) * share * middle / deviation
        if (u @ u) > 0:  # whitened
            x, y = (slope - (1 - 1 / np.sqrt(1 + u @ u)) / (u @ u) * (u @ slope) * u for slope in (x, y))
        pairs = combinations(range(len(x)), 2)
        determinant = sum(((x[i] * y[j] - x[j] * y[i]) ** 2 for i, j in pairs), start=np.longdouble(0))
        xx, yy = x @ x, y @ y
        volume = determinant + PRIOR[0] * yy + PRIOR[1] * xx + PRIOR[0] * PRIOR[1]
        bounds.append(np.sqrt((xx + yy + PRIOR.sum()) / volume))
    return np.mean(bounds)


@pytest.mark.parametrize("noise", [1e-2, 1e-9])
@pytest.mark.parametrize("scatter", [(0.0, 0.0), (0.18, 0.36)])
@pytest.mark.parametrize("fibres", [1, 3])
def test_bound_holds_under_faint_noise(noise: float, scatter: tuple[float, float], fibres: int) -> None:
    """Fibres that respond in proportion tell of one direction alone: the prior remains across it."""
    rng, gradient = np.random.default_rng(0), np.empty((1, fibres, SIDE**2))
    for responses in (np.arange(1.0, fibres + 1)[:, None] * rng.random(SIDE**2), 0.2 + rng.random((fibres, SIDE**2))):
        found = error_bound(responses, STEP, CELLS, np.ones((1, fibres)), (noise, *scatter), PRIOR, gradient)
        expected = plain_bound(responses, (noise, *scatter))
        assert found[0] == pytest.approx(float(expected), rel=1e-6 if WHOLE else 0.1)
