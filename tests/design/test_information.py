"""Information measures against closed forms, and the published objective against its stated values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from design import Morphology, published_objective
from design.information import disorder, joint_entropy, quantize, sharpness
from design.objective import published_presses, published_terms


def test_rows_that_all_differ_reach_the_ceiling():
    assert joint_entropy(np.arange(49.0)[:, None]) == pytest.approx(np.log2(49))


def test_entropy_of_independent_bits_adds():
    bits = np.array([[a, b] for a in (0, 1) for b in (0, 1)] * 5, dtype=float)
    assert joint_entropy(bits) == pytest.approx(2)
    assert joint_entropy(bits[:, :1]) == pytest.approx(1)


def test_equal_rows_carry_nothing():
    assert joint_entropy(np.ones((10, 3))) == 0
    assert joint_entropy(np.ones((0, 3))) == 0


@given(hnp.arrays(float, st.tuples(st.integers(0, 20), st.integers(1, 4)), elements=st.floats(0, 1e6)))
def test_levels_span_the_converter_whatever_the_signals(signals):
    levels = quantize(signals)
    assert np.isfinite(levels).all()
    assert ((levels >= 0) & (levels <= 4096)).all()
    if len(signals):
        untouched = np.ptp(signals, axis=0) == 0
        assert not levels[:, untouched].any()


def test_sharpness_is_zero_on_a_ramp_and_counts_a_spike_four_times():
    ramp = np.arange(6.0)[:, None]
    assert sharpness(ramp) == 0
    ramp[3] += 1
    assert sharpness(ramp) == 4


def test_disorder_of_two_swapped_fibres_is_the_area_between_them_in_samples():
    knots = Morphology.straight(2).knots.copy()
    ordered = disorder(knots)
    swapped = knots.copy()
    swapped[[0, 1]] = knots[[1, 0]]
    assert ordered == 0
    assert disorder(swapped) == pytest.approx(2000)


@pytest.mark.parametrize(
    ("name", "value"), [("1para", 0.107365610641), ("5para_dis", 0.105238467812), ("20para", 0.137526632287)]
)
def test_objective_of_the_published_optima(published, name, value):
    """Values stated for numpy's RandomState(214) jitter of the 49 presses."""
    assert published_objective(Morphology.load(published / f"{name}.mat")) == pytest.approx(value, abs=1e-9)


def test_the_objective_is_the_sum_of_its_terms_for_each_pad_of_a_population():
    pads = np.stack([Morphology.random(4, 3, seed).knots for seed in range(3)])
    weights = (0.7, 2e-7, 3e-6)
    for knots, terms in zip(pads, published_terms(pads, weights=weights), strict=True):
        expected = 0.7 / (1 + terms.entropy) + 2e-7 * terms.sharpness + 3e-6 * terms.disorder
        assert terms.objective == pytest.approx(expected)
        assert published_objective(Morphology(knots), weights=weights) == terms.objective


def test_published_presses_cover_the_grid():
    places = published_presses(4)
    assert places.shape == (49, 2)
    assert places.min() >= 1
    assert places.max() <= 4 + 2 / 49
