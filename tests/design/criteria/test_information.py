"""Information measures against closed forms, and the published objective against its stated values."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.interpolate import PchipInterpolator

from design import Contact, Morphology, published_objective, signals
from design.criteria.information import (
    disorder,
    disorder_area,
    idle_share,
    information,
    joint_entropy,
    published_sharpness,
    quantize,
)
from design.criteria.published_objective import published_presses, published_terms
from design.pad.contact import boustrophedon
from design.settings import PUBLISHED_CONTACT, Layout, between_fibres

BETWEEN = between_fibres(Layout.of(4))


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
    assert published_sharpness(ramp) == 0
    ramp[3] += 1
    assert published_sharpness(ramp) == 4


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
    places = published_presses(Layout.of(4))
    assert places.shape == (49, 2)
    assert places.min() >= 1
    assert places.max() <= 4 + 2 / 49


def test_disorder_area_is_what_disorder_samples():
    pad = Morphology.random(4, 6, seed=3)
    assert disorder(pad.knots, 400_001) * 5 / 400_000 == pytest.approx(disorder_area(pad), rel=1e-6)
    assert disorder_area(Morphology.straight(4)) == 0


def test_disorder_area_of_a_known_bump():
    """Fibre 1 rises by 2 over a knot in the middle and back: area above fibre 2 between the crossings, by SciPy."""
    knots = Morphology.straight(2).knots
    knots = np.insert(knots, 1, (knots[:, 0] + knots[:, 1]) / 2, axis=1)
    knots[0, 1, 1] = 3.0
    curve = PchipInterpolator(knots[0, :, 0], knots[0, :, 1])
    at = np.linspace(0, 3, 300_001)
    expected = np.trapezoid(np.maximum(curve(at) - 2, 0), at)
    assert disorder_area(Morphology(knots)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("name", "share"), [("square_grid_cir", 0.70), ("5para_dis", 0.58)])
def test_idle_share_of_the_published_pads(published, name, share):
    """Table III of the paper: 70 % and 57 % in simulation."""
    places = boustrophedon(BETWEEN, 32, 5 / 49)
    assert idle_share(signals(Morphology.load(published / f"{name}.mat"), places, PUBLISHED_CONTACT)) == pytest.approx(
        share, abs=0.01
    )


def test_idle_share_counts_changes_within_the_threshold():
    changes = np.array([[0.0, 0.0], [0.01, 1.0], [1.0, 0.0]])
    assert idle_share(changes) == pytest.approx(0.5)
    assert idle_share(changes, threshold=0.02) == pytest.approx(4 / 6)


def test_information_does_not_stop_at_the_number_of_presses():
    """Each tenfold drop in noise adds log2 10 bits along both axes, where the pad tells all places apart."""
    pad = Morphology.random(4, 20, seed=0)
    coarse, fine = information(pad, noise=1.0), information(pad, noise=0.1)
    assert fine > np.log2(400)
    assert fine - coarse == pytest.approx(2 * np.log2(10), rel=0.05)


def test_information_falls_with_noise_to_nothing():
    pad = Morphology.random(4, 5, seed=0)
    found = [information(pad, noise=noise) for noise in (1, 10, 100, 1e6)]
    assert found == sorted(found, reverse=True)
    assert found[-1] == pytest.approx(0, abs=0.01)
    assert information(Morphology.straight(4), Contact(radius=1e-9, sides=None), noise=1e6) == pytest.approx(
        0, abs=0.01
    )


@pytest.mark.parametrize(("grid", "noise"), [(2, 40.0), (1, 300.0)])
def test_information_is_the_bound_of_its_formula_with_whole_covariances(grid, noise):
    """The formula of the docstring written out plainly on a few cells, without the small matrices."""
    pad, side, step = Morphology.random(grid, 3, seed=2), 4, 1e-4
    line = np.linspace(0, grid - 1, 2 * side + 1)[1::2] + 1 if grid > 1 else np.linspace(0.5, 1.5, 2 * side + 1)[1::2]
    cells = np.array([(x, y) for y in line for x in line])
    mean = signals(pad, cells)
    slopes = [(signals(pad, cells + d) - signals(pad, cells - d)) / (2 * step) for d in step * np.eye(2)]
    largest = max(signals(pad, cells + d).max() for d in step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]))
    sigma, fibres = noise * largest / 4096, 2 * grid
    jacobian = np.stack(slopes, axis=2)
    spread = (line[1] - line[0]) ** 2 / 12
    covariance = sigma**2 * np.eye(fibres) + spread * jacobian @ jacobian.transpose(0, 2, 1)
    own = np.linalg.slogdet(covariance)[1]

    def overlap(a, b):
        middle, gap = (covariance[a] + covariance[b]) / 2, mean[a] - mean[b]
        determinants = np.linalg.slogdet(middle)[1] - (own[a] + own[b]) / 2
        return np.exp(-gap @ np.linalg.solve(middle, gap) / 8 - determinants / 2)

    confused = np.array([[overlap(a, b) for b in range(len(cells))] for a in range(len(cells))]).mean(axis=1)
    expected = (own - fibres * np.log(sigma**2)).mean() / 2 - np.log(confused).mean()
    assert information(pad, noise=noise, side=side) == pytest.approx(expected / np.log(2), rel=1e-6)


def test_levels_round_up_within_each_columns_own_range():
    found = quantize(np.array([[0.0, 5.0, 2.0], [1.0, 7.0, 2.0], [4.0, 5.5, 2.0]]), levels=10)
    np.testing.assert_array_equal(found, [[0, 0, 0], [3, 10, 0], [10, 3, 0]])


def test_disorder_counts_both_families_and_only_what_is_in_the_wrong_order():
    """Verticals 1 and 3 of three change places: three pairs are wrong, by 1, 1 and 2 grid units."""
    knots = Morphology.straight(3).knots.copy()
    knots[[3, 5]] = knots[[5, 3]]
    assert disorder(knots, samples=100) == pytest.approx(400)


def test_the_sharpness_of_columns_adds():
    levels = np.array([[0.0, 3.0], [1.0, 3.0], [0.0, 0.0], [0.0, 0.0]])
    assert published_sharpness(levels) == (2 + 1) + (3 + 3)


def test_joint_entropy_looks_at_every_column():
    rows = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    assert joint_entropy(rows) == pytest.approx(3 * np.log2(5) / 5 + 2 * np.log2(2.5) / 5)
