import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sense.rig.devices.protocols import ConverterSamples
from sense.rig.session.averaging import Averager
from tests.helpers.effort import few


def samples(count: int, lost: set[int]) -> ConverterSamples:
    """A ramp of `count` samples at 1 kHz without those in `lost`."""
    kept = np.array([i for i in range(count) if i not in lost], dtype=np.int64)
    missing = np.diff(kept, prepend=-1) - 1
    return ConverterSamples(kept / 1000, np.column_stack([kept, -kept]).astype(float), missing)


@few(40)
@given(st.integers(1, 12), st.integers(1, 200), st.sets(st.integers(0, 199), max_size=60), st.data())
def test_any_pieces_give_the_means_of_whole_stretches(ratio, count, lost, data):
    whole = samples(count, lost)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole.times_s)), max_size=6)))
    averager = Averager(ratio, 2)
    pieces = [
        averager.feed(ConverterSamples(whole.times_s[a:b], whole.volts[a:b], whole.missing[a:b]))
        for a, b in zip([0, *cuts], [*cuts, len(whole.times_s)], strict=True)
    ]
    times, volts = (np.concatenate(column) for column in zip(*pieces, strict=True))
    last = int(np.round(1000 * whole.times_s[-1])) if len(whole.times_s) else -1
    expected = []
    for first in range(0, last + 1 - (last + 1) % ratio, ratio):
        kept = [i for i in range(first, first + ratio) if i not in lost]
        if kept:
            expected.append(np.mean(kept))
    assert np.allclose(volts[:, 0], expected)
    assert np.allclose(volts[:, 1], -np.array(expected))
    assert np.allclose(1000 * times, expected)
    assert averager.lost == sum(1 for i in lost if i <= last)
