"""Signals by the published rule of samples, against the published ones and a slow oracle; the serpentine of presses."""

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from scipy.interpolate import PchipInterpolator

from padforge.design import Contact, Morphology, signals, signals_quantized
from padforge.design.contact import serpentine_presses
from padforge.design.settings import PUBLISHED_CONTACT
from tests.design.wild_pads import SEEDS, contacts


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


def oracle(pad, presses, contact, samples):
    """The rule written out plainly: every sample of every fibre, point in polygon by matplotlib."""
    at = np.linspace(0, pad.grid + 1, samples)
    out = np.zeros((len(presses), 2 * pad.grid))
    for fibre in range(2 * pad.grid):
        axis = 0 if fibre < pad.grid else 1
        cross = PchipInterpolator(pad.knots[fibre, :, axis], pad.knots[fibre, :, 1 - axis])(at)
        points = np.column_stack([at, cross] if axis == 0 else [cross, at])
        step = np.abs(np.diff(points, axis=0))
        run = step.sum(axis=1) if contact.length == "manhattan" else np.hypot(*step.T)
        for q, press in enumerate(presses):
            away = points[:-1] - press
            d = np.hypot(*away.T)
            if contact.sides is None:
                hit = d <= contact.radius
            else:
                angle = np.linspace(0, 2 * np.pi, contact.sides + 1)
                hit = Outline(contact.radius * np.column_stack([np.cos(angle), np.sin(angle)])).contains_points(away)
            weight = {
                "uniform": np.ones_like(d),
                "inverse_square": 1 / (contact.radius + d**2),
                "inverse": 1 / np.maximum(d, contact.radius / 100),
            }[contact.weight]
            out[q, fibre] = (run * weight)[hit].sum()
    return out


@given(contacts, st.integers(1, 4), st.integers(0, 8), SEEDS)
@settings(max_examples=15)
def test_quantized_signals_equal_the_full_scan(contact, grid, knots, seed):
    rng = np.random.default_rng(seed)
    pad = Morphology.random(grid, knots, rng)
    presses = rng.uniform(-1, grid + 2, (5, 2))
    expected = oracle(pad, presses, contact, 300)
    np.testing.assert_allclose(signals_quantized(pad, presses, contact, 300), expected, rtol=1e-9, atol=1e-9)


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
