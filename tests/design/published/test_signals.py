"""Signals by the published rule of samples, against the published ones and a slow oracle; the serpentine of presses."""

import numpy as np
import pytest
import scipy.io

from padforge.design import Contact, Morphology, signals, signals_quantized
from padforge.design.contact import serpentine_presses
from padforge.design.settings import PUBLISHED_CONTACT


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


@pytest.mark.parametrize("pitch_mm", [4.0, (100.0, 8.0)])
def test_signals_are_as_wide_in_mm_at_any_pitch(pitch_mm):
    """A straight fibre 4 mm beside it signals the integral of a Gaussian of 6.2 mm along it."""
    pad, contact = Morphology.straight(9, pitch_mm), Contact(model="profile")
    press, expected_mm = pad.to_grid([[4.0, 4.0]]), np.sqrt(2 * np.pi) * 6.2 * np.exp(-0.5 * (4.0 / 6.2) ** 2)
    for found in (signals(pad, press, contact), signals_quantized(pad, press, contact, 20_001)):
        assert pad.unit_mm * found[0, [4, 13]] == pytest.approx(np.full(2, expected_mm), rel=0.02)


def test_quantized_signals_of_a_population():
    pads = [Morphology.random(3, 2, seed) for seed in range(3)]
    presses = np.random.default_rng(0).uniform(0, 4, (24, 2))
    batch = signals_quantized(np.stack([pad.knots for pad in pads]), presses)
    for pad, found in zip(pads, batch, strict=True):
        np.testing.assert_array_equal(found, signals_quantized(pad, presses))
    together = signals_quantized(pads[0], presses.reshape(12, 2, 2))
    np.testing.assert_allclose(together, batch[0, ::2] + batch[0, 1::2], rtol=1e-12)


def test_serpentine_presses_are_in_rows_there_and_back():

    positions = serpentine_presses(((0.5, 2), (4.5, 3)), 3)
    expected = [(0.5, 2), (2.5, 2), (4.5, 2), (4.5, 2.5), (2.5, 2.5), (0.5, 2.5), (0.5, 3), (2.5, 3), (4.5, 3)]
    assert positions.tolist() == [list(position) for position in expected]
    moved = serpentine_presses(((0.5, 2), (4.5, 3)), 3, jitter=0.1) - positions
    assert ((moved >= 0) & (moved <= 0.1)).all()
    assert np.ptp(moved) > 0.05
