from dataclasses import replace

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.benchmarks import contact as objective
from padforge.design import Contact, Morphology, published_objective, signals, signals_quantized
from padforge.design.contact import serpentine_presses
from padforge.design.published.objective import idle_share, information, joint_entropy, published_terms, quantize
from padforge.design.settings import PUBLISHED_CONTACT, Layout, between_fibres


@pytest.mark.parametrize(("name", "value"), [("5para_dis", 0.105238467812), ("20para", 0.137526632287)])
def test_published_objective_of_the_published_optima(published, name, value):
    """Values stated for numpy's RandomState(214) jitter of the 49 presses."""
    assert published_objective(Morphology.load(published / f"{name}.mat")) == pytest.approx(value, abs=1e-9)


def test_published_objective_is_formula_5_and_that_of_plain_numpy_and_nearly_the_exact_one():
    """Of a pad that no press touches, without joint entropy, it is large and finite."""
    pad = Morphology.random(4, 3, 0)
    [joint], [families] = (published_terms(pad, entropy=entropy) for entropy in ("joint", "families"))
    assert replace(joint, objective=families.objective) == families
    expected = 2 / joint.joint_entropy + 1e-6 * joint.sharpness + 1e-5 * joint.disorder
    assert published_terms(pad, weights=(2, 1e-6, 1e-5), entropy="joint")[0].objective == pytest.approx(expected)
    [untouched] = published_terms(pad, presses=[[1e3, 1e3]] * 9, entropy="joint")
    assert (untouched.joint_entropy, untouched.objective > 1e8) == (0, True)
    pad = Morphology.random(3, 4, seed=1)
    assert objective.plain_objective(pad) == pytest.approx(published_objective(pad), abs=1e-12)
    assert objective.exact_objective(pad) == pytest.approx(published_objective(pad), rel=0.02)


def test_information_matches_explicit_covariances():
    """The formula of the docstring written out plainly on a few cells, without the small matrices."""
    pad, side, step, noise = Morphology.random(2, 3, seed=2), 4, 1e-4, 40.0
    line = 1 + np.linspace(0, 1, 2 * side + 1)[1::2]
    cells = np.array([(x, y) for y in line for x in line])
    contact = Contact(model="profile")
    mean = signals(pad, cells, contact)
    ahead, behind = (np.stack([signals(pad, cells + d, contact) for d in s * step * np.eye(2)], 2) for s in (1, -1))
    sigma, fibres = noise * max(mean.max(), ahead.max(), behind.max()) / 4096, 4
    jacobian = (ahead - behind) / (2 * step)
    position_var = (line[1] - line[0]) ** 2 / 12
    covariance = sigma**2 * np.eye(fibres) + position_var * jacobian @ jacobian.transpose(0, 2, 1)
    log_det = np.linalg.slogdet(covariance)[1]

    def overlap(a, b):
        middle, gap = (covariance[a] + covariance[b]) / 2, mean[a] - mean[b]
        determinants = np.linalg.slogdet(middle)[1] - (log_det[a] + log_det[b]) / 2
        return np.exp(-gap @ np.linalg.solve(middle, gap) / 8 - determinants / 2)

    confused = np.array([[overlap(a, b) for b in range(len(cells))] for a in range(len(cells))]).mean(axis=1)
    expected = (log_det - fibres * np.log(sigma**2)).mean() / 2 - np.log(confused).mean()
    # a pad is evaluated by elements of its fibres
    assert information(pad, contact, noise=noise, side=side) == pytest.approx(expected / np.log(2), rel=1e-5)


def test_idle_share_of_the_published_pad(published):
    """Table III of the paper: 57 % in simulation."""
    places = serpentine_presses(between_fibres(Layout.create(4)), 32, 5 / 49)
    changes = signals(Morphology.load(published / "5para_dis.mat"), places, PUBLISHED_CONTACT)
    assert idle_share(changes) == pytest.approx(0.58, abs=0.01)


def test_disorder_counts_samples_in_the_wrong_order():
    """Two fibres that change places, and verticals 1 and 3 of three: wrong by 1, 1 and 2 grid units."""
    for grid, order, samples, expected in ((2, [0, 1, 2, 3], 2000, 0), (3, [0, 1, 2, 5, 4, 3], 100, 400)):
        knots = Morphology.straight(grid).knots[order]
        assert published_terms(knots[None], samples=samples)[0].disorder == pytest.approx(expected)


@settings(max_examples=20)
@given(st.integers(0, 99), st.integers(0, 20), st.integers(0, 4), st.sampled_from([0, 5e-324, 1e-9, 1.0, 1e300]))
def test_information_measures_are_within_bounds(seed, count, columns, scale):
    rng = np.random.default_rng(seed)
    values = rng.choice([rng.normal(size=(count, columns)), rng.integers(0, 2, (count, columns))]) * scale
    levels = quantize(values, 16)
    assert np.isin(levels, np.arange(17)).all()
    assert not levels[:, (values == values[:1]).all(axis=0)].any()
    assert 0 <= idle_share(values) <= 1
    numbers = np.unique(levels, axis=0, return_counts=True)[1] if columns and count else np.array([1])
    expected = -(numbers / numbers.sum() * np.log2(numbers / numbers.sum())).sum()
    assert joint_entropy(levels) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "contact"),
    [
        ("5para_dis", PUBLISHED_CONTACT),
        ("5para_moresamps", Contact(weight="inverse_square")),
        ("square_grid_cir", Contact(sides=50)),
    ],
)
def test_quantized_signals_are_the_published_samples(published, name, contact):
    content = scipy.io.loadmat(published / f"{name}.mat")
    pad = Morphology.load(published / f"{name}.mat")
    found = signals_quantized(pad, content["loc_all"], contact)
    np.testing.assert_allclose(found, content["sens_raw_all"], rtol=0, atol=1e-12)


def test_serpentine_presses_are_in_rows_there_and_back():
    positions = serpentine_presses(((0.5, 2), (4.5, 3)), 3)
    expected = [(0.5, 2), (2.5, 2), (4.5, 2), (4.5, 2.5), (2.5, 2.5), (0.5, 2.5), (0.5, 3), (2.5, 3), (4.5, 3)]
    assert positions.tolist() == [list(position) for position in expected]
    moved = serpentine_presses(((0.5, 2), (4.5, 3)), 3, jitter=0.1) - positions
    assert ((moved >= 0) & (moved <= 0.1)).all()
    assert np.ptp(moved) > 0.05
