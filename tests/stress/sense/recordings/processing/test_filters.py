"""Filters and the finding of presses on any readings, against slow ways and invariants."""

from itertools import pairwise

import numpy as np
from hypothesis import given

import sense
from tests.helpers.effort import few
from tests.stress.sense.cases import EXTREMES, RATE_HZ, made, right_or_refused, seeds
from tests.stress.sense.localizer.test_worst_recordings import _faulty


def _slow_variation(readings: np.ndarray, lam: float) -> float:
    """Least robust cost of a channel, by dynamic programming over all values there are."""
    present = readings[~np.isnan(readings)]
    levels = np.unique(present)
    apart = lam * np.abs(levels[:, None] - levels)
    cost = np.zeros(len(levels))
    for value in present:
        cost = (cost[:, None] + apart).min(axis=0) + np.abs(levels - value)
    return float(cost.min())


def _channel(rng: np.random.Generator) -> np.ndarray:
    """Readings of one channel: few levels, ties, spikes, gaps, subnormals and huge ones."""
    values = rng.standard_normal(int(rng.integers(1, 40)))
    kind = rng.integers(7)
    if kind == 0:
        values = np.round(values)
    elif kind == 1:
        values = values * rng.choice([1e-300, 1e-320, 1e99, 1e-9])
    elif kind == 2:
        values = np.full_like(values, rng.choice(EXTREMES[:10]))
    elif kind == 3:
        values[rng.random(len(values)) < 0.2] = rng.choice([1e100, -1e100, 0.0])
    elif kind == 4:
        values = np.sort(values)
    if rng.random() < 0.5:
        values[rng.random(len(values)) < 0.3] = np.nan
    return values


@few(60)
@given(seed=seeds)
def test_total_variation_is_as_good_as_the_best_there_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, lam = _channel(rng), float(rng.choice([1e-3, 0.5, 1.0, 2.5, 4.0, 1e3]))
    found = right_or_refused(lambda: sense.total_variation(values, lam))
    assert found is not None
    there = ~np.isnan(values)
    if not there.any():
        assert np.isnan(found).all()
        return
    least = 5e-324  # between subnormal values there is nothing
    assert values[there].min() <= found.min() + least
    assert found.max() <= values[there].max()
    cost = np.abs(values - found)[there].sum() + lam * np.abs(np.diff(found)).sum()
    assert cost <= _slow_variation(values, lam) * (1 + 1e-9) + 1e-300
    if np.abs(values[there]).max() < 1e99:  # lam counts readings, whatever their unit
        np.testing.assert_allclose(sense.total_variation(values * 4, lam), found * 4, atol=1e-320)


@few(60)
@given(seed=seeds)
def test_running_medians_are_medians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, width = _channel(rng), int(rng.choice([1, 3, 15, 99, 2**31 - 1]))
    found = right_or_refused(lambda: sense.running_median(values, width))
    assert found is not None
    reach = width // 2
    for i in range(len(values)):
        window = values[max(0, i - reach) : i + reach + 1]
        window = window[~np.isnan(window)]
        np.testing.assert_allclose(found[i], np.median(window) if len(window) else np.nan, rtol=1e-15, atol=5e-324)


@few(40)
@given(seed=seeds)
def test_streams_give_what_the_whole_gives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = [_channel(rng) for _ in range(2)]
    count = min(map(len, columns))
    readings = np.column_stack([column[:count] for column in columns])
    if rng.random() < 0.5:
        stream, whole = sense.RunningMedian(2, 7), sense.running_median(readings, 7)
    else:
        fidelity = "robust" if rng.random() < 0.5 else "squares"
        stream, whole = sense.TotalVariation(2, 1.5, fidelity), sense.total_variation(readings, 1.5, fidelity)
    edges = [0, *np.sort(rng.integers(count + 1, size=3)).tolist(), count]
    parts = [stream.feed(readings[first:end]) for first, end in pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate([*parts, stream.finish()]), whole)


@few(40)
@given(seed=seeds)
def test_presses_found_take_turns_whatever_the_readings(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one = made(int(rng.integers(4)), presses=8)
    readings = _faulty(rng, one.readings)
    times_s = one.times_s * (RATE_HZ / float(rng.choice([1e-3, RATE_HZ, 1e6])))
    found = right_or_refused(lambda: sense.find_presses(readings, times_s))
    if found is None:
        assert np.nanmax(np.abs(readings)) > 1e3
        return
    assert (found.touched < found.released).all()
    assert (found.released[:-1] <= found.touched[1:]).all()
    order = rng.permutation(4)
    again = sense.find_presses(readings.astype(np.float32)[:, order].astype(float), times_s)
    same = sense.find_presses(readings.astype(np.float32).astype(float), times_s)
    assert abs(len(again.touched) - len(same.touched)) <= 1  # sums over fibres round otherwise in another order
