"""Signals of a measured profile against dense quadrature, to the precision that is asked for."""

import numpy as np
import pytest

from padforge.common.profiling import profiled
from padforge.design import Contact, Morphology, signals, signals_quantized, signals_sparse
from padforge.design.contact import fibre_axes
from padforge.design.kernels.element_signals import PROFILE_PRECISION
from padforge.design.settings import DEFAULT_PITCH_MM
from padforge.design.signal_gradients import FibreCurves
from tests.design.kernels.oracle import dense_oracle
from tests.design.wild_pads import Length

PROFILES = {
    "broad": ((0.0, 1.0), (0.3, 0.9), (0.6, 0.5), (0.9, 0.15), (1.2, -0.04), (1.6, 0.0)),
    "below 0": ((0.0, -0.3), (0.2, -0.5), (0.35, -0.35), (0.5, 0.1), (0.6, 0.2), (0.9, 0.0)),
    "beyond the pad": ((0.0, 1.0), (2.0, 0.8), (4.0, 0.3), (6.0, 0.0)),
}
"""In grid units."""


def contact_of(profile, length: Length = "euclidean"):
    """The contact on pads of the default pitch."""
    return Contact(sensitivity_profile=tuple((DEFAULT_PITCH_MM * d, w) for d, w in profile), length=length)


@pytest.mark.parametrize("length", ["manhattan", "euclidean"])
@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_profile_signals_are_as_precise_as_asked(profile, length):
    rng = np.random.default_rng(5)
    pad, contact = Morphology.random(1, 5, rng), contact_of(profile, length)
    presses = rng.uniform(0, 2, (2, 2))
    expected = np.array([[dense_oracle(pad, press, contact, fibre) for fibre in range(2)] for press in presses])
    for precision in (1e-3, 1e-5, 1e-6):
        found = signals(pad, presses, contact, precision=precision)
        assert np.abs(found - expected).max() < precision * np.abs(expected).max()
    sampled = signals_quantized(pad, presses, contact, samples=50_001)
    np.testing.assert_allclose(sampled, expected, atol=1e-3)


@pytest.mark.parametrize("contact", [contact_of(PROFILES["broad"]), Contact()], ids=["profile", "layer"])
def test_signals_of_elements_agree_in_every_form(contact):
    """One press by one, of several pads, of presses at once, sparse, and in blocks."""
    pads = [Morphology.random(2, 3, seed=seed) for seed in (1, 2)]
    presses = np.random.default_rng(0).uniform(0, 3, (2200, 2))
    found = signals(np.array([pad.knots for pad in pads]), presses, contact)
    np.testing.assert_array_equal(signals(pads[1], presses[[7]], contact), found[1, [7]])
    np.testing.assert_array_equal(signals_sparse(pads[0], presses, contact).toarray(), found[0])
    together = signals(pads[0], presses.reshape(1100, 2, 2), contact)
    np.testing.assert_allclose(together, found[0, ::2] + found[0, 1::2], rtol=1e-12, atol=1e-12)


def test_profile_signals_are_0_beyond_its_end():
    contact = contact_of(PROFILES["broad"])
    with profiled() as profile:
        found = signals(Morphology.straight(4), [[1.0, 1.0], [9.0, 9.0]], contact, precision=1e-6)
    assert profile.counts["spans, press by press"][0] == 4  # fibres 1 and 2 of both families
    assert not found[1].any()
    assert found[0, 0] == found[0, 4] > 0 > found[0, 1] == found[0, 5]
    assert not found[0, [2, 3, 6, 7]].any()


@pytest.mark.parametrize("profile", PROFILES.values(), ids=PROFILES)
def test_signals_of_a_search_are_within_precision(profile):
    contact, presses = contact_of(profile), np.random.default_rng(0).uniform(0, 3, (30, 2))
    for pad in (Morphology.straight(2), Morphology.random(2, 5, 5, (30.0, 5.0))):
        travel, cross, ends, _ = fibre_axes(pad)
        found = FibreCurves(travel[0], cross[0], ends, pad.unit_mm).signals(presses, contact)[0]
        fine = signals(pad, presses, contact, precision=1e-6)
        assert abs(found.T - fine).max() < PROFILE_PRECISION * abs(fine).max()
