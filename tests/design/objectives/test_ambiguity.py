import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design import Contact, Morphology
from padforge.design.contact import relative_stretch
from padforge.design.objectives.ambiguity import ambiguities, ambiguity_map, free_presses, press_ambiguities
from padforge.design.objectives.fibre_loss import failure_shares, failure_subsets, sample_failures
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings


def plain_ambiguities(signals: np.ndarray, presses: np.ndarray, masks: np.ndarray, noise: float) -> np.ndarray:
    """The formula (L, Q) for signals (Q, F) under sets of working fibres (L, F)."""
    squares = (signals[:, None] - signals) ** 2 @ masks.T / (4 * noise**2)
    posterior = np.exp(-squares) / np.exp(-squares).sum(axis=1, keepdims=True)
    distances = np.linalg.norm(presses[:, None] - presses, axis=2)
    return np.einsum("abl,ab->la", posterior, distances)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.floats(0.05, 2))
def test_ambiguities_of_presses_are_those_of_the_formula(seed, fibres, noise):
    rng = np.random.default_rng(seed)
    signals, presses = rng.uniform(0, 1, (9, fibres)), rng.uniform(1, 4, (9, 2))
    masks = 1 - np.eye(fibres + 1, fibres)  # one fibre failed, or none
    values = press_ambiguities(signals / (2 * noise), presses, np.arange(fibres + 1)[:, None])
    assert pytest.approx(plain_ambiguities(signals, presses, masks, noise), abs=1e-7) == values.T


@settings(max_examples=20)
@given(st.integers(0, 4) | st.lists(st.sampled_from([0.0, 1.0, 3.0]), min_size=1, max_size=5).filter(sum).map(tuple))
def test_sample_failures_draws_one_set_of_each_possible_size(lost):
    shares = failure_shares(lost)
    n_failed = 8 - sample_failures(8, shares, np.random.default_rng(0)).sum(axis=1)
    draws = [int(share > 0) for share in shares]
    assert [(n_failed == k).sum() for k in range(len(shares))] == draws
    masks = sample_failures(2, failure_shares(5), np.random.default_rng(0))
    assert masks.sum(axis=1).min() == 1  # a pad is never left without a fibre


def test_failures_are_shared_equally_or_as_weighted_and_subsets_are_all_or_a_sample():
    assert failure_shares(3) == (1 / 4,) * 4
    assert failure_shares((1.0, 0.0, 3.0)) == (0.25, 0.0, 0.75)
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    assert failure_subsets(4, 2) == failure_subsets(4, 2, max_subsets=6) == pairs
    assert failure_subsets(3, 0) == [()]
    drawn = failure_subsets(8, 3, max_subsets=20)
    assert drawn == sorted(set(drawn)) == failure_subsets(8, 3, max_subsets=20)
    assert len(drawn) == 20
    assert all(0 <= a < b < c < 8 for a, b, c in drawn)
    assert {fibre for loss in drawn for fibre in loss} == set(range(8))


@pytest.mark.parametrize(("pitch_y_mm", "contact"), [(13.0, PUBLISHED_CONTACT), (5.0, Contact())])
def test_ambiguity_map_has_the_ambiguity_as_mean(pitch_y_mm, contact):
    pad = Morphology.random((2, 5), 3, 2, (8.0, pitch_y_mm))
    size = PadSettings().for_layout(pad.layout)
    means = ambiguity_map(pad, free_presses(size), contact, 3, 0.05).mean(axis=1)
    # the map's signals are those of a search
    assert means == pytest.approx(ambiguities(pad, contact, 3, 0.05, size), rel=1e-3, abs=3e-4)
    assert (np.diff(means) >= 0).all()


def test_ambiguity_map_has_the_full_scale_of_touched_fibres():
    """Presses beside the lowest of six fibres, of which it is the only one to respond."""
    pad, presses = Morphology.straight((6, 0)), np.stack([np.ones(5), np.linspace(0.8, 1.4, 5)], axis=1)
    stretch = relative_stretch(pad, presses, PUBLISHED_CONTACT)
    assert stretch.any(axis=0).tolist() == [True] + 5 * [False]
    expected = plain_ambiguities(stretch, presses, np.ones((1, 6)), 0.05 * stretch.max()).mean()
    assert expected > 0.05
    assert ambiguity_map(pad, presses, PUBLISHED_CONTACT, 0, 0.05)[0].mean() == pytest.approx(expected, rel=1e-9)
