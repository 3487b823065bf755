"""The heap against a sorted list."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sense.recordings.processing.kernels import interval_heap


@given(
    st.lists(st.integers(-9, 9).map(float), max_size=60),
    st.lists(st.one_of(st.integers(-9, 9).map(float), st.sampled_from(["smallest", "greatest"])), max_size=60),
)
def test_the_interval_heap_gives_what_a_sorted_list_gives(there, orders):
    keys, values = np.empty(121), np.empty(121)
    listed: list[tuple[float, float]] = []
    for number, order in enumerate([*there, *orders]):
        if isinstance(order, float):
            interval_heap.push(keys, values, len(listed), order, number)
            listed.append((order, number))
        elif listed:
            end = interval_heap.HIGH if order == "greatest" else interval_heap.LOW
            slot = interval_heap.end_slot(len(listed), end)
            key, value = keys[slot], values[slot]
            assert key == (max if order == "greatest" else min)(listed)[0]
            interval_heap.pop(keys, values, len(listed), end)
            listed.remove((key, value))
        assert sorted(zip(keys[: len(listed)], values[: len(listed)], strict=True)) == sorted(listed)
