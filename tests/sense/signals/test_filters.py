"""Filters against optimality conditions and numpy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from padforge.sense import running_median, total_variation

STEP_V = 3.3 / 1023
LAMS = st.sampled_from([1e-9, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 2.3, 4.0, np.pi, 7.7, 30.0, 1e6])
FIDELITY = st.sampled_from(["robust", "squares"])
VALUES = st.one_of(
    st.integers(-3, 3).map(float),
    st.integers(0, 1023).map(STEP_V.__mul__),
    st.floats(-10, 10).map(lambda v: round(v, 9)),
)
"""Many ties, a converter's steps, or any but the very smallest."""
READINGS = hnp.arrays(np.float64, st.integers(1, 40), elements=st.one_of(VALUES, VALUES, st.just(np.nan)))


def objective(y, x, lam):
    """What robust total variation minimises."""
    return float(np.abs(y - x).sum() + lam * np.abs(np.diff(x)).sum())


def excess_robust(y, x, lam):
    """How far x violates the optimality conditions of the robust objective: 0 exactly for a minimiser.

    x is a minimiser if there are signs s_i in the subdifferential of |x_i - y_i| whose running sums are lam where x
    rises, -lam where it falls, between where it is level, and 0 at the end. The interval of possible sums is followed.
    """
    present = ~np.isnan(y)
    y, x = y[present], x[present]
    if len(x) == 0:
        return 0.0
    turn = np.sign(np.diff(x))
    least, greatest = np.where(turn > 0, lam, -lam), np.where(turn < 0, -lam, lam)
    least, greatest = np.append(least, 0.0), np.append(greatest, 0.0)
    low = high = worst = 0.0
    for up, down, a, b in zip((x > y).tolist(), (x < y).tolist(), least.tolist(), greatest.tolist(), strict=True):
        low, high = low + (1 if up else -1), high + (-1 if down else 1)
        worst = max(worst, a - high, low - b)
        low, high = min(max(low, a), b), min(max(high, a), b)
    return worst


def excess_squares(y, x, lam):
    """The same for squares: the running sums are those of x - y."""
    present = ~np.isnan(y)
    sums, turn = np.cumsum(x[present] - y[present]), np.sign(np.diff(x[present]))
    beyond = np.where(turn == 0, np.abs(sums[:-1]) - lam, np.abs(sums[:-1] - lam * turn))
    return max(abs(sums[-1]), beyond.max(initial=0)) if len(sums) else 0.0


@settings(max_examples=25)
@given(READINGS, LAMS)
def test_total_variation_meets_the_optimality_conditions(y, lam):
    # heights of steps are multiples of 2^-40, which the sums of the check do not know
    assert excess_robust(y, total_variation(y, lam), lam) <= 1e-10
    # sums of 40 readings up to 10, or of shares of lam, to rounding
    assert excess_squares(y, total_variation(y, lam, "squares"), lam) <= 1e-12 * (1 + min(lam, 400))


@settings(max_examples=25)
@given(READINGS, LAMS, FIDELITY)
def test_total_variation_of_missing_negated_and_scaled_readings(y, lam, fidelity):
    x = total_variation(y, lam, fidelity)
    present = np.flatnonzero(~np.isnan(y))
    np.testing.assert_array_equal(x[present], total_variation(y[present], lam, fidelity))
    if len(present):  # a missing reading takes the next level
        following = np.minimum(np.searchsorted(present, np.arange(len(y))), len(present) - 1)
        np.testing.assert_array_equal(x, x[present[following]])
    else:
        assert np.isnan(x).all()
    np.testing.assert_allclose(total_variation(-y, lam, fidelity), -x, rtol=0, atol=1e-13 * (fidelity == "squares"))
    unit = 2.0**20  # a power of two, so that nothing is rounded
    other_lam = lam if fidelity == "robust" else unit * lam
    np.testing.assert_array_equal(total_variation(unit * y, other_lam, fidelity), unit * x)


def test_total_variation_removes_short_bumps_and_takes_the_middle_minimiser():
    y = np.zeros(60)
    y[20:27], y[40:49] = 1, 1  # lam = 4 removes bumps of fewer than 8 readings, and an end of fewer than 4
    x = total_variation(y, 4)
    assert not x[:40].any()
    np.testing.assert_array_equal(x[40:49], 1)
    assert not total_variation(np.append(np.zeros(30), np.ones(3)), 4).any()
    assert total_variation(y, 0.9, "squares")[[22, 44]] == pytest.approx([1 - 2 * 0.9 / 7, 1 - 2 * 0.9 / 9])
    y = np.array([0.0, 1, 2, 3, -9, -9, -9, -9, -9])
    x = total_variation(y, 2)
    np.testing.assert_array_equal(x[:4], 0.5)
    levels = [np.append(np.full(4, level), y[4:]) for level in (-0.1, 0.0, 1.0, 1.1)]
    below, lowest, highest, above = (objective(y, other, 2) for other in levels)
    assert below > lowest == objective(y, x, 2) == highest < above


def test_total_variation_of_many_readings():
    """Of the kinds on which sums and queues of a solver grow most."""
    rng, index = np.random.default_rng(0), np.arange(5000)
    noise = rng.normal(size=5000)
    growing, converter = np.where(index % 2, index, -index).astype(float), np.round(3 * noise) * STEP_V
    for y in (noise, growing, converter, 1e6 + 1e-3 * noise):
        for lam in (1e-12, 0.7, 4.0, 314.15, 1e12):
            assert excess_robust(y, total_variation(y, lam), lam) <= 1e-9 * lam
            x = total_variation(y, lam, "squares")
            # x itself is rounded by 1e-16 of its greatest value, 10 000 times
            assert excess_squares(y, x, lam) <= 1e-11 * np.abs(y).max() * len(y)
        np.testing.assert_allclose(x, y.mean(), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(total_variation(y, lam), np.median(y), rtol=1e-15)


@pytest.mark.parametrize("fidelity", ["robust", "squares"])
def test_filters_take_any_shape_layout_and_type(fidelity):
    y = np.random.default_rng(2).normal(size=(2000, 6))
    x, single = total_variation(y, 2, fidelity), y.astype(np.float32)
    assert x.shape == y.shape
    np.testing.assert_array_equal(total_variation(y[:, 3], 2, fidelity), x[:, 3])
    layouts = (np.asfortranarray(y), y), (y[::2, ::-2], y[::2, ::-2].copy()), (single, single.astype(float))
    for other, plain in layouts:
        np.testing.assert_array_equal(total_variation(other, 2, fidelity), total_variation(plain, 2, fidelity))
    np.testing.assert_array_equal(single, y.astype(np.float32))  # readings are not changed
    for shape in ((0,), (0, 3), (3, 0)):
        assert total_variation(np.empty(shape), 2, fidelity).shape == shape
        assert running_median(np.empty(shape), 5).shape == shape


@settings(max_examples=25)
@given(READINGS, st.sampled_from([1, 3, 5, 15, 99, 2**31 - 1]), st.booleans())
def test_running_median_is_that_of_numpy(y, width, causal):
    before, after = (width - 1, 0) if causal else (width // 2, width // 2)
    windows = [y[max(i - before, 0) : i + after + 1] for i in range(len(y))]
    expected = [np.median(w[~np.isnan(w)]) if (~np.isnan(w)).any() else np.nan for w in windows]
    np.testing.assert_allclose(running_median(y, width, causal=causal), expected, rtol=1e-15)
