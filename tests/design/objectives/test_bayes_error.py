import numpy as np
import pytest
from scipy.stats import multivariate_normal

from padforge.design import Contact, Morphology, PadSettings, SearchSettings
from padforge.design.contact import relative_stretch
from padforge.design.objectives import bayes_error as module
from padforge.design.objectives.bayes_error import Positions, bayes_positions, expected_errors, possible_positions
from padforge.design.objectives.criterion import evaluation_windows, straight_full_scale
from padforge.design.settings import PUBLISHED_CONTACT, Scatter
from tests.design.objectives.pads import square

PLACES = np.stack(np.meshgrid(*[np.linspace(0, 4, 41)] * 2), axis=-1).reshape(-1, 2)


def test_posteriors_match_explicit_covariances(monkeypatch):
    monkeypatch.setattr(module, "BLOCK", 4)  # so that the readings are of several blocks
    rng, scatter, working = np.random.default_rng(1), Scatter(0.1, 0.3, 0.4), np.array([True, False, True])
    responses = np.sin(PLACES @ rng.standard_normal((2, 3)))
    readings = scatter.sample(responses[rng.integers(len(PLACES), size=6)], rng)
    log_areas = rng.standard_normal(len(PLACES))
    positions = Positions(PLACES, log_areas, responses, np.full(responses.shape, 0.01))
    found = bayes_positions(readings, positions, scatter, working)
    x = responses[:, working]
    own = np.array([np.diag(0.1**2 + 0.3**2 * 0.6 * row**2 + 0.01) for row in x])
    covariances = own + 0.3**2 * 0.4 * x[:, :, None] * x[:, None]
    densities = [multivariate_normal(*each) for each in zip(x, covariances, strict=True)]
    likelihoods = np.array([density.pdf(readings[:, working]) for density in densities]).T * np.exp(log_areas)
    expected = likelihoods @ PLACES / likelihoods.sum(axis=1)[:, None]
    assert found == pytest.approx(expected, abs=1e-3)


def test_positions_cover_the_pressed_area_once_and_no_keep_out_and_are_a_sample_of_huge_ones():
    size = PadSettings(grid=9, keep_out_mm=(square(-20.0, -20.0, 40.0),))
    pad, window = Morphology.straight(size.layout), evaluation_windows(size.sensed)[-1]
    possible = possible_positions(pad, PUBLISHED_CONTACT, size, window, 1.0)
    area = np.ptp(np.array(size.sensed), axis=0).prod() - 40**2 / pad.unit_mm**2
    assert np.exp(possible.log_prior).sum() == pytest.approx(area, rel=0.1)
    assert not (abs(pad.to_mm(possible.centres) + 20) < 20).all(axis=1).any()
    near = ((possible.centres > window[0]) & (possible.centres < window[1])).all(axis=1)
    assert np.ptp(possible.log_prior[near]) == pytest.approx(0)
    size = PadSettings(grid=96)
    pad = Morphology.straight(size.layout)
    possible = possible_positions(pad, PUBLISHED_CONTACT, size, evaluation_windows(size.sensed)[0], 1.0)
    assert len(possible.centres) < module.MAX_FAR + 5000


def test_blur_is_the_variance_of_a_response_over_a_cell() -> None:
    size, pad, contact, scale = PadSettings(grid=2), Morphology.random(2, 3, seed=1), Contact(model="profile"), 0.5
    centres, log_prior, _, blur = possible_positions(pad, contact, size, evaluation_windows(size.sensed)[0], scale)
    shares = (np.arange(5) - 2) / 5
    within = np.exp(log_prior[0] / 2) * np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2)
    responses = relative_stretch(pad, (centres[::7, None] + within).reshape(-1, 2), contact) / scale
    variance, blur = responses.reshape(-1, 25, 4).var(axis=1) / (1 - 1 / 25), blur[::7]
    large = blur > np.quantile(blur, 0.7)
    assert np.median(blur[large] / variance[large]) == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("scatter", [Scatter(0.2), Scatter(0.02, 0.3, 0.5)])
def test_expected_errors_are_those_of_other_presses_located_by_explicit_covariances(scatter, monkeypatch):
    """And a share more, for learning: of presses and readings that are drawn otherwise, on a grid of its own."""
    monkeypatch.setattr(module, "PRESSES", 3000)
    size, pad = PadSettings(grid=1), Morphology.random(1, 3, seed=1)
    scattered = {"noise": scatter.floor, "scatter": scatter.share, "scatter_common": scatter.common}
    search = SearchSettings(max_failures=(1.0,), **scattered)
    contact = Contact(model="profile")  # whose full scale is that of the pad's straight fibres
    scale = straight_full_scale(size.layout, contact, size.sensed_mm)
    low, high = np.array(size.sensed)
    rng, shares = np.random.default_rng(7), (np.arange(25) + 0.5) / 25
    places = low + (high - low) * np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2)
    pressed = rng.uniform(low, high, (3000, 2))
    responses, x = (relative_stretch(pad, at, contact) / scale for at in (pressed, places))
    gains = rng.standard_normal((3000, 1)), rng.standard_normal((3000, 2))
    gain = scatter.share * (np.sqrt(scatter.common) * gains[0] + np.sqrt(1 - scatter.common) * gains[1])
    readings = responses * (1 + gain) + scatter.floor * rng.standard_normal((3000, 2))
    own = scatter.floor**2 * np.eye(2) + scatter.share**2 * (1 - scatter.common) * np.eye(2) * (x**2)[:, None]
    covariances = own + scatter.share**2 * scatter.common * x[:, :, None] * x[:, None]
    away = readings[:, None] - x
    exponent = np.einsum("qpi,pij,qpj->qp", away, np.linalg.inv(covariances), away)
    likelihood = np.exp(-exponent / 2) / np.sqrt(np.linalg.det(covariances))
    located = likelihood @ places / likelihood.sum(axis=1)[:, None]
    expected = 1.05 * np.hypot(*(located - pressed).T).mean()
    assert expected_errors(pad, contact, search, size) == pytest.approx([expected], rel=0.03)
