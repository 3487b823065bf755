"""The contact model against the published samples, a slow oracle and closed forms."""

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from scipy.interpolate import PchipInterpolator

from design import Contact, InputError, Morphology, signals, signals_quantized, signals_sparse
from design.criteria.published_objective import published_terms
from design.pad.contact import boustrophedon
from design.settings import DEFAULT_PITCH_MM, PUBLISHED_CONTACT, Layout, between_fibres

SETS = [
    ("1para", PUBLISHED_CONTACT),
    ("5para_dis", PUBLISHED_CONTACT),
    ("20para", PUBLISHED_CONTACT),
    ("5para_moresamps", Contact(weight="inverse_square")),
    ("square_grid_cir", Contact(sides=50)),
]


@pytest.mark.parametrize(("name", "contact"), SETS, ids=[name for name, _ in SETS])
def test_quantized_signals_are_the_published_samples(published, name, contact):
    content = scipy.io.loadmat(published / f"{name}.mat")
    pad = Morphology.load(published / f"{name}.mat")
    found = signals_quantized(pad, content["loc_all"], contact)
    np.testing.assert_allclose(found, content["sens_raw_all"], rtol=0, atol=1e-12)


@pytest.mark.parametrize("pitch_mm", [4.0, 11.25, 25.0, (100.0, 8.0), (8.0, 100.0)])
def test_a_measured_press_is_as_wide_in_mm_on_pads_of_any_pitch(pitch_mm):
    """A straight fibre right under it signals the integral of a Gaussian of 6.2 mm, one beside it the lesser."""
    pad = Morphology.straight(9, pitch_mm)
    for offset_mm in (0.0, 4.0):
        press = pad.to_grid([[offset_mm, offset_mm]])
        expected_mm = np.sqrt(2 * np.pi) * 6.2 * np.exp(-0.5 * (offset_mm / 6.2) ** 2)
        for found in (
            signals(pad, press),
            signals_sparse(pad, press).toarray(),
            signals_quantized(pad, press, Contact(), 20_001),
        ):
            assert pad.unit_mm * found[0, [4, 13]] == pytest.approx(np.full(2, expected_mm), rel=0.02)


def test_knots_without_a_pitch_are_of_the_default_one():
    pad, presses = Morphology.random(3, 4, seed=0), np.random.default_rng(0).uniform(0, 4, (20, 2))
    assert pad.pitch_mm == DEFAULT_PITCH_MM
    np.testing.assert_array_equal(signals(pad.knots, presses), signals(pad, presses))
    other = Morphology(pad.knots, 5.0)
    assert not np.allclose(signals(other, presses), signals(pad, presses), atol=0.1)


def test_a_population_has_the_grid_unit_of_its_layout():
    pad = Morphology.random((3, 2), 4, seed=0, pitch_mm=(5.0, 8.0))
    assert published_terms(pad.knots[None], Contact(), layout=pad.layout) == published_terms(pad, Contact())


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


contacts = st.builds(
    Contact,
    radius=st.floats(0.05, 3),
    sides=st.one_of(st.none(), st.integers(3, 64)),
    weight=st.sampled_from(["uniform", "inverse_square", "inverse"]),
    length=st.sampled_from(["manhattan", "euclidean"]),
)


@given(contacts, st.integers(1, 4), st.integers(0, 8), st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_culled_sums_equal_the_full_scan(contact, grid, knots, seed):
    rng = np.random.default_rng(seed)
    pad = Morphology.random(grid, knots, rng)
    presses = rng.uniform(-1, grid + 2, (5, 2))
    expected = oracle(pad, presses, contact, 300)
    np.testing.assert_allclose(signals_quantized(pad, presses, contact, 300), expected, rtol=1e-9, atol=1e-9)


def test_a_straight_fibre_through_the_centre_signals_the_diameter():
    found = signals_quantized(Morphology.straight(1), [[1, 1]], Contact(radius=0.5, sides=None), samples=200_001)
    np.testing.assert_allclose(found, 1.0, atol=2e-5)


def test_a_population_is_its_members_one_by_one():
    pads = [Morphology.random(3, 2, seed) for seed in range(4)]
    presses = boustrophedon(between_fibres(Layout.of(3)), 5, 0.1)
    batch = signals_quantized(np.stack([pad.knots for pad in pads]), presses)
    assert batch.shape == (4, 25, 6)
    for pad, found in zip(pads, batch, strict=True):
        np.testing.assert_array_equal(found, signals_quantized(pad, presses))


def test_no_presses_give_no_signals_and_far_presses_none_either():
    pad = Morphology.straight(2)
    assert signals_quantized(pad, []).shape == (0, 4)
    assert not signals_quantized(pad, [[50, 50], [-9, 1]]).any()


@pytest.mark.parametrize("presses", [[[np.nan, 1]], [[np.inf, 1]], [1, 2, 3], [[1, 2, 3]]])
def test_presses_that_are_no_places_are_refused(presses):
    with pytest.raises(InputError, match="presses"):
        signals_quantized(Morphology.straight(2), presses)


def test_the_serpentine_moves_one_cell_at_a_time():
    places = boustrophedon(between_fibres(Layout.of(4)), 7)
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), 0.5)
    assert (places.min(), places.max()) == (1, 4)


def test_the_serpentine_fills_the_rectangle_it_is_given():
    places = boustrophedon(((0.5, 2), (4.5, 3)), 3)
    expected = [(0.5, 2), (2.5, 2), (4.5, 2), (4.5, 2.5), (2.5, 2.5), (0.5, 2.5), (0.5, 3), (2.5, 3), (4.5, 3)]
    assert places.tolist() == [list(place) for place in expected]
