"""Filters against optimality conditions, exhaustive search and numpy, on hostile readings, and as streams."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from padforge.benchmarks.filter import admm, fibre, linear_program
from padforge.design.common.validation import InputError
from padforge.sense import (
    RunningMedian,
    TotalVariation,
    find_segment_starts,
    running_median,
    total_variation,
)

STEP_V = 3.3 / 1023
LAMS = st.sampled_from([1e-9, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 2.3, 4.0, np.pi, 7.7, 30.0, 1e6])
FIDELITY = st.sampled_from(["robust", "squares"])
VALUES = st.one_of(
    st.integers(-3, 3).map(float),
    st.integers(0, 1023).map(STEP_V.__mul__),
    st.floats(-10, 10).map(lambda v: round(v, 9)),
)
"""Many ties, a converter's steps, or any but the very smallest."""
EXTREMES = st.sampled_from([0.0, -0.0, 5e-324, 1e-320, -1e-300, 1e-9, 1.0, 1e6, 1e100, -1e100])
PRESENT = hnp.arrays(np.float64, st.integers(1, 40), elements=VALUES)
READINGS = hnp.arrays(np.float64, st.integers(1, 40), elements=st.one_of(VALUES, VALUES, st.just(np.nan)))
STREAMS = hnp.arrays(
    np.float64, st.tuples(st.integers(0, 40), st.integers(1, 2)), elements=st.one_of(VALUES, st.just(np.nan))
)
CUTS = st.lists(st.integers(0, 40), max_size=6).map(sorted)


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


def least_by_search(y, lam):
    """The least robust objective, over all choices of x_i among the readings: a minimiser is always among them."""
    levels = np.unique(y)
    cost = np.zeros(len(levels))
    for reading in y:
        cost = (cost[:, None] + lam * np.abs(levels[:, None] - levels)).min(axis=0) + np.abs(levels - reading)
    return cost.min()


@settings(max_examples=50)
@given(READINGS, LAMS)
def test_total_variation_meets_the_optimality_conditions(y, lam):
    # heights of steps are multiples of 2^-40, which the sums of the check do not know
    assert excess_robust(y, total_variation(y, lam), lam) <= 1e-10
    # sums of 40 readings up to 10, or of shares of lam, to rounding
    assert excess_squares(y, total_variation(y, lam, "squares"), lam) <= 1e-12 * (1 + min(lam, 400))


@settings(max_examples=50)
@given(st.one_of(PRESENT, hnp.arrays(np.float64, st.integers(1, 20), elements=EXTREMES)), LAMS)
def test_robust_total_variation_is_the_least_of_an_exhaustive_search(y, lam):
    x = total_variation(y, lam)
    assert objective(y, x, lam) <= least_by_search(y, lam) * (1 + 1e-9) + 1e-300
    assert y.min() <= x.min() + 5e-324  # between subnormal values there is nothing
    assert x.max() <= y.max()


@settings(max_examples=50)
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


@settings(max_examples=50)
@given(READINGS, LAMS, FIDELITY)
def test_causal_and_latest_values_are_the_last_of_a_beginning(y, lam, fidelity):
    expected = [total_variation(y[: i + 1], lam, fidelity)[-1] for i in range(len(y))]
    np.testing.assert_array_equal(total_variation(y, lam, fidelity, causal=True), expected)
    stream = TotalVariation(1, lam, fidelity)
    assert np.isnan(stream.latest).all()
    for reading, value in zip(y, expected, strict=True):
        stream.update([[reading]])
        np.testing.assert_array_equal(stream.latest, [value])


@settings(max_examples=50)
@given(hnp.arrays(np.float64, (12, 2), elements=VALUES), st.sets(st.integers(0, 11)).map(sorted), FIDELITY)
def test_segments_and_channels_are_independent(y, starts, fidelity):
    pieces = np.split(y, starts)
    for lam, causal in ((0.7, False), (4.0, True)):
        single = [total_variation(piece[:, c], lam, fidelity, causal=causal) for piece in pieces for c in (0, 1)]
        expected = np.concatenate([np.column_stack(single[i : i + 2]) for i in range(0, len(single), 2)])
        np.testing.assert_array_equal(total_variation(y, lam, fidelity, starts, causal), expected)
    expected = np.concatenate([running_median(piece, 5) for piece in pieces])
    np.testing.assert_array_equal(running_median(y, 5, starts), expected)


def test_total_variation_removes_short_bumps_and_takes_the_middle_minimiser():
    y = np.zeros(60)
    y[20:27], y[40:49] = 1, 1  # lam = 4 removes bumps of fewer than 8 readings, and an end of fewer than 4
    x = total_variation(y, 4)
    assert not x[:40].any()
    np.testing.assert_array_equal(x[40:49], 1)
    assert not total_variation(np.append(np.zeros(30), np.ones(3)), 4).any()
    x = total_variation(y, 0.9, "squares")
    assert x[22] == pytest.approx(1 - 2 * 0.9 / 7)
    assert x[44] == pytest.approx(1 - 2 * 0.9 / 9)
    y = np.array([0.0, 1, 2, 3, -9, -9, -9, -9, -9])
    x = total_variation(y, 2)
    np.testing.assert_array_equal(x[:4], 0.5)
    levels = [np.append(np.full(4, level), y[4:]) for level in (-0.1, 0.0, 1.0, 1.1)]
    below, lowest, highest, above = (objective(y, other, 2) for other in levels)
    assert below > lowest == objective(y, x, 2) == highest < above


def test_find_segment_starts_after_long_intervals():
    times = np.array([0, 0.1, 0.2, 5.2, 5.3, 99])
    np.testing.assert_array_equal(find_segment_starts(times, 1), [3, 5])
    np.testing.assert_array_equal(find_segment_starts(times, 1000), [])
    np.testing.assert_array_equal(find_segment_starts([], 1), [])
    y = np.array([0, 0, 0, 1, 1, 0.0])
    np.testing.assert_array_equal(total_variation(y, 4, starts=find_segment_starts(times, 1)), y)


def hostile(count):
    rng = np.random.default_rng(0)
    index = np.arange(count)
    return {
        "noise": rng.normal(size=count),
        "constant": np.full(count, 2.5),
        "rising": index.astype(float),
        "falling": -(index**1.5),
        "alternating": index % 2 * 1.0,
        "growing": np.where(index % 2, index, -index).astype(float),
        "shrinking": np.where(index % 2, index, -index)[::-1].astype(float),
        "walk": np.cumsum(rng.normal(size=count)),
        "converter": np.round(3 * rng.normal(size=count)) * STEP_V,
        "offset": 1e6 + 1e-3 * rng.normal(size=count),
    }


@pytest.mark.parametrize(
    ("name", "count"),
    [*((name, 5_000) for name in hostile(2)), pytest.param("noise", 400_000, marks=pytest.mark.slow)],
)
def test_total_variation_of_hostile_and_very_many_readings(name, count):
    y = hostile(count)[name]
    for lam in (1e-12, 0.7, 4.0, 314.15, 3000.0, 1e12):
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
    assert total_variation(single, 2, fidelity).dtype == np.float64
    np.testing.assert_array_equal(single, y.astype(np.float32))  # readings are not changed
    for shape in ((0,), (0, 3), (3, 0)):
        assert total_variation(np.empty(shape), 2, fidelity).shape == shape
        assert running_median(np.empty(shape), 5).shape == shape


@settings(max_examples=50)
@given(READINGS, st.sampled_from([1, 3, 5, 15, 99, 2**31 - 1]), st.booleans())
def test_running_median_is_that_of_numpy(y, width, causal):
    before, after = (width - 1, 0) if causal else (width // 2, width // 2)
    windows = [y[max(i - before, 0) : i + after + 1] for i in range(len(y))]
    expected = [np.median(w[~np.isnan(w)]) if (~np.isnan(w)).any() else np.nan for w in windows]
    np.testing.assert_allclose(running_median(y, width, causal=causal), expected, rtol=1e-15)


def streamed(stream, readings, cuts=()):
    return np.concatenate([*(stream.update(block) for block in np.split(readings, cuts)), stream.flush()])


@settings(max_examples=50)
@given(STREAMS, CUTS, LAMS, FIDELITY, st.sampled_from([1, 3, 7, 99]), st.booleans())
def test_streams_are_filtered_like_the_whole(y, cuts, lam, fidelity, width, causal):
    x = streamed(TotalVariation(y.shape[1], lam, fidelity), y, cuts)
    np.testing.assert_array_equal(x, total_variation(y, lam, fidelity))
    x = streamed(RunningMedian(y.shape[1], width, causal), y, cuts)
    np.testing.assert_array_equal(x, running_median(y, width, causal=causal))


@settings(max_examples=50)
@given(STREAMS, LAMS, FIDELITY)
def test_pending_values_could_still_change(y, lam, fidelity):
    y = y[:, :1]
    final = TotalVariation(1, lam, fidelity).update(y)
    if len(final) < len(y) and lam < 1e3:  # enough readings to outweigh the coupling
        extended = (np.concatenate([y, np.full((4000, 1), end)]) for end in (1e9, -1e9))
        high, low = (total_variation(z, lam, fidelity)[len(final), 0] for z in extended)
        assert high > low


def test_a_channel_with_many_pending_values_is_finished():
    """0 1 0 1 ... and a dead channel are pending for ever, a constant never; each channel has a limit of its own."""
    y = np.column_stack([np.arange(35) % 2, np.ones(35), np.full(35, np.nan)])
    expected = total_variation(y, 2, starts=[10, 20, 30])
    for size in (1, 7, 10, 35):
        stream = TotalVariation(3, 2, max_pending=10)
        blocks = [stream.update(y[i : i + size]) for i in range(0, 35, size)]
        assert sum(map(len, blocks)) == 30
        np.testing.assert_array_equal(np.concatenate([*blocks, stream.flush()]), expected)


@settings(max_examples=50)
@given(STREAMS, CUTS, LAMS, FIDELITY, st.integers(1, 12))
def test_limit_of_pending_values_does_not_depend_on_blocks(y, cuts, lam, fidelity, most):
    x = streamed(TotalVariation(y.shape[1], lam, fidelity, most), y, cuts)
    np.testing.assert_array_equal(x, streamed(TotalVariation(y.shape[1], lam, fidelity, most), y))
    columns = [streamed(TotalVariation(1, lam, fidelity, most), column[:, None]) for column in y.T]
    np.testing.assert_array_equal(x, np.hstack(columns))


@pytest.mark.parametrize("fidelity", ["robust", "squares"])
def test_streams_take_little_memory(fidelity):
    """20 000 readings in blocks of 1000: the stream takes little more than a block, and holds few back."""
    rng, stream = np.random.default_rng(0), TotalVariation(1, 4, fidelity)
    blocks = [np.cumsum(rng.normal(size=1000))[:, None] for _ in range(20)]
    stream.update(blocks[0])
    tracemalloc.start()
    assert sum(len(stream.update(block)) for block in blocks) > 19_000
    current, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert current < 60_000
    assert peak < 20_000 * 8


@pytest.mark.parametrize("make", [lambda: TotalVariation(2, 4), lambda: RunningMedian(2, 5)])
def test_a_flushed_stream_starts_anew(make):
    y = np.random.default_rng(0).normal(size=(50, 2))
    stream = make()
    first, second = streamed(stream, y[:20]), streamed(stream, y[20:])
    np.testing.assert_array_equal(first, streamed(make(), y[:20]))
    np.testing.assert_array_equal(second, streamed(make(), y[20:]))
    assert stream.flush().shape == (0, 2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: total_variation([1, np.inf], 4), r"readings hold inf \(first at \[1\]\), allowed is"),
        (lambda: total_variation([1], 0), "lam is 0, allowed is a number above 0"),
        (lambda: total_variation([1, 2], 4, starts=[2]), "starts are .*, allowed are ascending indices of 2 readings"),
        (lambda: find_segment_starts([0, 2, 1], 1), "times_s are .*, expected finite numbers that ascend"),
        (lambda: TotalVariation(2, 4).update([[1, 2, 3]]), r"shape \(1, 3\), expected \(n, 2\)"),
    ],
)
def test_filters_refuse_wrong_arguments_in_one_line(call, message):
    with pytest.raises(InputError, match=message) as error:
        call()
    assert "\n" not in str(error.value)


def test_total_variation_agrees_with_the_solvers_of_the_bench():
    clean, y = fibre(1000, np.random.default_rng(3))
    for lam in (1.0, 4.0, 17.3):
        least = objective(y, total_variation(y, lam), lam)
        assert objective(y, linear_program(y, lam), lam) == pytest.approx(least, rel=1e-9)
    least = objective(y, total_variation(y, 4), 4)
    assert least <= objective(y, admm(y, 4, 1000), 4) <= 1.01 * least
    error = (y - clean) / STEP_V
    assert np.median(np.abs(error)) < 2
    assert 0.003 < (np.abs(error) > 8).mean() < 0.03
    assert np.abs(total_variation(y, 4) - clean).mean() < 0.3 * np.abs(y - clean).mean()
