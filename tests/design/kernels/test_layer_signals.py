"""Signals of a pressed layer against a dense oracle, those of a search beside them, and lengths."""

import numpy as np
import pytest

from padforge.design import Contact, Morphology, signals, signals_quantized
from padforge.design.contact import fibre_axes
from padforge.design.kernels.element_signals import LAYER_PRECISION
from padforge.design.signal_gradients import FibreCurves
from tests.design.kernels.oracle import dense_oracle

CONTACTS = {
    "default": Contact(),
    "stretched": Contact(squeeze=0.0),
    "flat, shallow": Contact(tool="flat", tool_radius_mm=4.0, depth_mm=1.0, fibre_depths_mm=(3.0, 1.0)),
    "wider": Contact(tool="finger", thickness_mm=10.0, scale=1.3),
}


def curves(pad, move: np.ndarray | float = 0.0):
    """Fibres as a search takes them, with knots moved by (2, F, n)."""
    axes = fibre_axes(pad)
    along, across = np.array([axes[0][0], axes[1][0]]) + move
    return FibreCurves(along, across, axes[2], pad.unit_mm)


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
def test_layer_signals_are_as_precise_as_asked(contact):
    pad, rng = Morphology.random((1, 1), 3, seed=1), np.random.default_rng(1)
    presses = rng.uniform(0.3, 1.7, (1, 2))
    expected = np.array([[dense_oracle(pad, press, contact, fibre) for fibre in range(2)] for press in presses])
    largest = np.abs(expected).max()
    for precision in (1e-3, 1e-5, 1e-6):
        found = signals(pad, presses, contact, precision=precision)
        np.testing.assert_allclose(found, expected, rtol=0, atol=precision * largest)
    sampled = signals_quantized(pad, presses, contact, samples=50_001)
    np.testing.assert_allclose(sampled, expected, rtol=0, atol=2e-3 * largest)


@pytest.mark.parametrize(
    ("contact", "seed", "press", "fibre"),
    [
        (Contact(model="profile"), 41, 2, 3),
        (CONTACTS["default"], 40, 1, 2),
        (CONTACTS["flat, shallow"], 38, 2, 0),
    ],
)
def test_signals_are_precise_where_a_bend_may_be_missed(contact, seed, press, fibre):
    """A profile bends between the nodes of the quadrature, or a fibre turns there within a thousandth of its span."""
    pad = Morphology.random((2, 2), 4, seed=seed, pitch_mm=4.0)
    at = np.random.default_rng(seed).uniform(0, 3, (3, 2))[press]
    expected = dense_oracle(pad, at, contact, fibre)
    assert signals(pad, [at], contact)[0, fibre] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
def test_signals_of_a_search_are_within_its_precision(contact):
    pad = Morphology.random((3, 2), 5, seed=2, pitch_mm=(8.0, 12.0))
    presses = np.random.default_rng(2).uniform(0, pad.layout.extent, (60, 2))
    fine = signals(pad, presses, contact, precision=1e-6)
    error = curves(pad).signals(presses, contact)[0].T - fine
    assert np.sqrt((error**2).mean()) < LAYER_PRECISION * np.abs(fine).max()


@pytest.mark.parametrize("contact", CONTACTS.values(), ids=CONTACTS)
def test_layer_gradient_equals_differences_of_search_signals(contact):
    """Steps so short that no span passes from near elements to far ones, and none is cut into other pieces."""
    pad, rng = Morphology.random((2, 1), 3, seed=3), np.random.default_rng(3)
    presses = rng.uniform(0, pad.layout.extent, (12, 2))
    upstream, move = rng.normal(size=(3, 12)), rng.normal(size=(2, *fibre_axes(pad)[0][0].shape))
    move[:, :, [0, -1]] = 0

    def value(step):
        return (upstream * curves(pad, step * move).signals(presses, contact)[0]).sum()

    fibres = curves(pad)
    expected = (fibres.by_knots(fibres.signals(presses, contact)[1](upstream)) * move).sum()
    assert (value(1e-6) - value(-1e-6)) / 2e-6 == pytest.approx(expected, rel=1e-4, abs=1e-4)
