"""What the forward sweep carries on keeps its height, and chains of clips are decided where their bounds have met."""

import math

import numpy as np

from sense.recordings.processing.kernels import clipping, total_variation_l1


def test_the_staircase_keeps_its_height_exactly():
    """Stairs are cut 100 000 times; what is left of them still sums to 2 lam, to the last digit."""
    y = np.random.default_rng(4).normal(size=100_000)
    low, high = np.empty((2, len(y)))
    for lam in (0.6, 4.3, np.pi, 1000 / 7):
        _, (_, below, above) = total_variation_l1.forward_sweep(
            y, lam, total_variation_l1.silent(), low, high, np.empty(0)
        )
        snapped = round(lam * total_variation_l1.GRAIN) / total_variation_l1.GRAIN
        assert math.fsum([*below[1], *above[1]]) == 2 * snapped
        assert below.shape[1] + above.shape[1] <= 2 * lam + 1


def test_a_chain_of_clips_goes_back_and_is_decided_where_its_bounds_have_met():
    low = np.array([0.0, -1.0, 2.0, -np.inf, 1.0])
    high = np.array([5.0, 1.0, 3.0, np.inf, 4.0])
    for last, expected in ((9.0, [1, 1, 3, 4, 4]), (-9.0, [1, 1, 2, 1, 1]), (2.5, [1, 1, 2.5, 2.5, 2.5])):
        out = np.empty(5)
        assert clipping.clip_back(low, high, last, out) == 2  # 1 from the second on back, whatever follows
        assert out.tolist() == expected
    assert clipping.clip_back(low[2:], high[2:], 9.0, np.empty(3)) == 0
    assert clipping.clip_back(np.append(low, 7.0), np.append(high, 7.0), 9.0, np.empty(6)) == 6
