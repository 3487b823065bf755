"""Filters of streams: the same values as of the whole, however the readings come in blocks."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from padforge.design.common.validation import InputError
from padforge.sense import RunningMedian, TotalVariation, running_median, total_variation

VALUES = st.one_of(st.integers(-3, 3).map(float), st.floats(-10, 10), st.just(np.nan))
RECORDINGS = hnp.arrays(np.float64, st.tuples(st.integers(0, 40), st.integers(1, 2)), elements=VALUES)
CUTS = st.lists(st.integers(0, 40), max_size=6).map(sorted)
LAMS = st.sampled_from([0.3, 1.0, 2.3, 4.0, 30.0, 1e6])
FIDELITY = st.sampled_from(["robust", "squares"])


def streamed(stream, readings, cuts=()):
    return np.concatenate([*(stream.update(block) for block in np.split(readings, cuts)), stream.flush()])


@settings(max_examples=50)
@given(RECORDINGS, CUTS, LAMS, FIDELITY, st.sampled_from([1, 3, 7, 99]), st.booleans())
def test_what_comes_of_blocks_is_that_of_the_whole(y, cuts, lam, fidelity, width, causal):
    x = streamed(TotalVariation(y.shape[1], lam, fidelity), y, cuts)
    np.testing.assert_array_equal(x, total_variation(y, lam, fidelity))
    x = streamed(RunningMedian(y.shape[1], width, causal), y, cuts)
    np.testing.assert_array_equal(x, running_median(y, width, causal=causal))


@settings(max_examples=50)
@given(RECORDINGS, LAMS, FIDELITY)
def test_what_is_held_back_could_still_change(y, lam, fidelity):
    """Nothing waits longer than it must: of what is held, the first value does depend on what follows."""
    y = y[:, :1]
    given = TotalVariation(1, lam, fidelity).update(y)
    if len(given) < len(y):
        high, low = (np.concatenate([y, np.full((4000, 1), end)]) for end in (1e9, -1e9))
        if lam < 1e3:  # enough readings to outweigh the coupling
            first = [total_variation(z, lam, fidelity)[len(given), 0] for z in (high, low)]
            assert first[0] > first[1]


@settings(max_examples=50)
@given(RECORDINGS, LAMS, FIDELITY)
def test_latest_is_the_causal_value(y, lam, fidelity):
    stream = TotalVariation(y.shape[1], lam, fidelity)
    assert np.isnan(stream.latest).all()
    causal = total_variation(y, lam, fidelity, causal=True)
    for i, reading in enumerate(y):
        stream.update([reading])
        np.testing.assert_array_equal(stream.latest, causal[i])


def test_at_the_cap_a_channel_is_decided_as_if_it_ended():
    """0 1 0 1 ... and a dead channel stay undecided for ever, a constant never; each channel has a cap of its own."""
    y = np.column_stack([np.arange(35) % 2, np.ones(35), np.full(35, np.nan)])
    expected = total_variation(y, 2, starts=[10, 20, 30])
    for size in (1, 7, 10, 35):
        stream = TotalVariation(3, 2, max_pending=10)
        blocks = [stream.update(y[i : i + size]) for i in range(0, 35, size)]
        assert sum(map(len, blocks)) == 30
        np.testing.assert_array_equal(np.concatenate([*blocks, stream.flush()]), expected)


@settings(max_examples=50)
@given(RECORDINGS, CUTS, LAMS, FIDELITY, st.integers(1, 12))
def test_at_the_cap_the_size_of_blocks_makes_no_difference(y, cuts, lam, fidelity, most):
    x = streamed(TotalVariation(y.shape[1], lam, fidelity, most), y, cuts)
    np.testing.assert_array_equal(x, streamed(TotalVariation(y.shape[1], lam, fidelity, most), y))
    columns = [streamed(TotalVariation(1, lam, fidelity, most), column[:, None]) for column in y.T]
    np.testing.assert_array_equal(x, np.hstack(columns))


@pytest.mark.parametrize("fidelity", ["robust", "squares"])
def test_a_long_recording_is_filtered_in_little_memory(fidelity):
    """20 000 readings in blocks of 1000: the stream takes little more than a block, and holds few back."""
    rng, stream = np.random.default_rng(0), TotalVariation(1, 4, fidelity)
    blocks = [np.cumsum(rng.normal(size=1000))[:, None] for _ in range(20)]
    stream.update(blocks[0])
    tracemalloc.start()
    assert sum(len(stream.update(block)) for block in blocks) > 19_000
    kept, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 60_000
    assert most < 20_000 * 8


@pytest.mark.parametrize("make", [lambda: TotalVariation(2, 4), lambda: RunningMedian(2, 5)])
def test_what_follows_the_end_begins_anew(make):
    y = np.random.default_rng(0).normal(size=(50, 2))
    stream = make()
    first, second = streamed(stream, y[:20]), streamed(stream, y[20:])
    np.testing.assert_array_equal(first, streamed(make(), y[:20]))
    np.testing.assert_array_equal(second, streamed(make(), y[20:]))
    assert stream.flush().shape == (0, 2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: TotalVariation(0, 4), "channels is 0, allowed is a whole number from 1 to 512"),
        (lambda: TotalVariation(2, -1), "lam is -1"),
        (lambda: TotalVariation(2, 4, max_pending=0), "max_pending is 0"),
        (lambda: TotalVariation(2, 4).update([1, 2]), r"shape \(2,\), expected \(n, 2\)"),
        (lambda: TotalVariation(2, 4).update([[1, 2, 3]]), r"shape \(1, 3\), expected \(n, 2\)"),
        (lambda: TotalVariation(1, 4).update([[np.inf]]), "readings hold inf"),
        (lambda: RunningMedian(1, 2), "width is 2"),
        (lambda: RunningMedian(1, 3).update([[1, 2]]), r"expected \(n, 1\)"),
    ],
)
def test_what_a_stream_cannot_take_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
