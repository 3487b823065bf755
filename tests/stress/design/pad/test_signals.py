"""Signals on degenerate geometry and at extreme scales, against slow ways and invariants."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from design import (
    Contact,
    InputError,
    Morphology,
    signals,
    signals_quantized,
    signals_sparse,
)
from design.criteria.published_objective import published_terms
from design.pad.contact import fibre_axes, press_shape
from design.pad.kernels.press import weigh
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.design.mirrors import mirrored, transposed, whole_lengths
from tests.stress.values import LAX, Array, contacts, pads, presses, seeds, wild_knots

KINDS = ["random", "steps", "lattice", "border", "alike", "edge", "needles", "level"]


def test_a_weight_that_rounding_blurs_is_summed_in_time():
    """On a span all but vertical a small press is known to some digits only; halving it would go on for ever."""
    steep = np.empty((6, 7, 2))
    steep[:] = Morphology.straight(3).knots[:, :1]
    for fibre, axis in enumerate((0, 0, 0, 1, 1, 1)):
        steep[fibre, :, axis] = np.linspace(0, 4, 7)
    steep[3, 1:6, 1] = 1.0791468550554812 + 1e-9 * np.arange(5)
    steep[3, 1:6, 0] = 2.75378692228376, 0.5403860200896449, 2.1014172899029036, 1.9433414353271563, 3.7361740638249987
    press = [3.5059369232428153, 1.0791468560554813]
    contact = Contact(radius=1e-6, sides=5, weight="inverse", length="euclidean")
    with ends_in_time():
        found = signals(Morphology(steep), [press, [1.801357466597148, 1.0791468580554815]], contact)
    assert (found[:, 3] > 1).all()
    assert (found[:, 3] < 100).all()


@settings(few(60), suppress_health_check=LAX)
@given(st.data())
def test_signals_lie_between_nothing_and_the_whole_fibre(data):
    pad, contact = data.draw(pads((1, 4), (0, 10))), data.draw(contacts())
    places = data.draw(presses(pad))
    with ends_in_time():
        found = signals(pad, places, contact)
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    most = whole_lengths(pad, contact)
    weights = {"uniform": 1.0, "inverse_square": 1 / contact.radius, "inverse": 100 / contact.radius}
    assert (found <= most * weights[contact.weight] * (1 + 1e-9)).all()
    inside = 2 * pad.grid + 4 < contact.radius * math.cos(math.pi / 3)
    if inside and contact.weight == "uniform" and contact.length == "manhattan":  # all of the pad is pressed
        near = (np.abs(np.asarray(places, float).reshape(-1, 2)) <= pad.grid + 1).all(axis=1)
        np.testing.assert_allclose(found[near], np.broadcast_to(most, found[near].shape), rtol=1e-7)


@settings(few(40), suppress_health_check=LAX)
@given(st.data())
def test_signals_of_any_measured_reach_lie_within_the_whole_fibre_at_its_heaviest(data):
    pad, rng = data.draw(pads((1, 2), (0, 6))), np.random.default_rng(data.draw(seeds()))
    end_mm = data.draw(st.sampled_from([1e-2, 1.0, 5.0, 20.0, 200.0]))
    distances = np.linspace(0, end_mm, data.draw(st.integers(8, 20)))
    waves = np.cos(np.pi * rng.uniform(0, 2) * distances / end_mm) * (1 - distances / end_mm) ** 2
    weights = data.draw(st.sampled_from([-1e3, -1.0, 1e-3, 1.0])) * waves
    contact = Contact(
        reach=tuple(zip(distances.tolist(), weights.tolist(), strict=True)),
        length=data.draw(st.sampled_from(["manhattan", "euclidean"])),
    )
    places = data.draw(presses(pad))
    with ends_in_time():
        found = signals(pad, places, contact)
    _, _, law = press_shape(contact, pad.unit_mm)
    near = np.linspace(0, law.radius, 2000)
    heaviest = max(abs(weigh(d * d, law)) for d in near)
    assert np.isfinite(found).all()
    assert (np.abs(found) <= whole_lengths(pad, contact) * heaviest * 1.01 + 1e-9).all()


@settings(few(50), suppress_health_check=LAX)
@given(st.data())
def test_signals_follow_the_pad_and_the_press_into_the_mirror(data):
    pad, contact = data.draw(pads((1, 3), (0, 8))), data.draw(contacts())
    assume(contact.sides is None or contact.sides % 4 == 0)
    assume(pad.knots.shape[1] == 2 or np.diff(fibre_axes(pad)[0]).min() > 1e-5)  # steps move by rounding in a mirror
    rng = np.random.default_rng(data.draw(seeds()))
    places = rng.uniform(-0.5, pad.grid + 1.5, (6, 2))
    found = signals(pad, places, contact)
    scale = 1e-6 * max(1.0, found.max())
    other = signals(transposed(pad), places[:, ::-1], contact)
    order = np.r_[pad.grid : 2 * pad.grid, : pad.grid]
    np.testing.assert_allclose(other[:, order], found, atol=scale)
    flipped = signals(mirrored(pad), np.stack([pad.grid + 1 - places[:, 0], places[:, 1]], axis=1), contact)
    order = np.r_[: pad.grid, 2 * pad.grid - 1 : pad.grid - 1 : -1]
    np.testing.assert_allclose(flipped[:, order], found, atol=scale)


@settings(few(40), suppress_health_check=LAX)
@given(st.data())
def test_presses_at_once_add_and_orders_do_not_matter(data):
    pad, contact = data.draw(pads((1, 3), (0, 6))), data.draw(contacts())
    places = np.random.default_rng(data.draw(seeds())).uniform(0, pad.grid + 1, (8, 2))
    one = signals(pad, places, contact)
    np.testing.assert_allclose(signals(pad, places.reshape(4, 2, 2), contact), one[::2] + one[1::2], rtol=1e-12)
    assert (signals(pad, places[::-1], contact) == one[::-1]).all()
    assert (signals(np.stack([pad.knots, pad.knots]), places, contact)[1] == one).all()
    assert (signals_sparse(pad, places, contact).toarray() == one).all()


def sampled(pad: Morphology, fibre: int, contact: Contact, press: Array, count: int = 200_001) -> float:
    """Signal of a fibre by brute force: short pieces that count where their middle lies in the press."""
    axis = 0 if fibre < pad.grid else 1
    knots = pad.knots[fibre]
    t = np.linspace(0, pad.grid + 1, count)
    t = t[np.abs(t - press[axis]) <= contact.radius + 1e-3]  # all that it can reach
    v = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])(t)
    dt, dv = np.diff(t), np.diff(v)
    middle = np.stack([t[1:] + t[:-1], v[1:] + v[:-1]][:: 1 if axis == 0 else -1], axis=1) / 2 - press
    if contact.sides is None:
        inside = np.hypot(*middle.T) <= contact.radius
    else:
        angle = 2 * np.pi * (np.arange(contact.sides) + 0.5) / contact.sides
        reach = contact.radius * math.cos(math.pi / contact.sides)
        inside = (middle @ np.stack([np.cos(angle), np.sin(angle)]) <= reach).all(axis=1)
    run = np.abs(dt) + np.abs(dv) if contact.length == "manhattan" else np.hypot(dt, dv)
    return float(run[inside].sum())


@settings(few(12), suppress_health_check=LAX)
@given(st.data())
def test_signals_are_those_of_a_plain_way(data):
    pad = data.draw(pads((1, 3), (0, 6)))
    assume(np.diff(fibre_axes(pad)[0]).min() > 0.01)  # steeper steps are between two samples of the plain way
    sides, length = data.draw(st.sampled_from([None, 3, 4, 30])), data.draw(st.sampled_from(["manhattan", "euclidean"]))
    contact = Contact(radius=data.draw(st.sampled_from([0.3, 0.6, 2.0])), sides=sides, length=length)
    place = np.random.default_rng(data.draw(seeds())).uniform(0, pad.grid + 1, 2)
    found = signals(pad, place[None], contact)[0]
    expected = [sampled(pad, fibre, contact, place) for fibre in range(2 * pad.grid)]
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_a_circle_is_the_limit_of_polygons():
    pad = Morphology.random(3, 6, seed=4)
    places = np.random.default_rng(0).uniform(0, 4, (50, 2))
    circle = signals(pad, places, Contact(sides=None))
    errors = [np.abs(signals(pad, places, Contact(sides=n)) - circle).mean() for n in (8, 32, 128, 512, 2048)]
    assert all(finer < coarser / 4 for coarser, finer in pairwise(errors))


@pytest.mark.parametrize(("sides", "place", "expected"), [
    (4, (1.6, 1.0), 1.2),  # along its diagonal
    (4, (1.0, 1.6 + 1e-9), 0.0),  # just beyond a corner
    (4, (1.0, 0.4 - 1e-9), 0.0),
    (None, (1.0, 1.6 + 1e-9), 0.0),
    (6, (1.0, 1 - 0.6 * math.sqrt(0.75)), 0.6),  # along an edge, which belongs to the press
    (6, (1.0, 1 + 0.6 * math.sqrt(0.75)), 0.6),
])  # fmt: skip
def test_a_straight_fibre_at_a_corner_or_along_an_edge(sides, place, expected):
    pad = Morphology.straight(2)
    found = signals(pad, [place], Contact(radius=0.6, sides=sides))[0, 0]
    assert found == pytest.approx(expected, abs=1e-4)


@settings(few(40), suppress_health_check=LAX)
@given(st.data())
def test_quantised_signals_come_near_the_exact_ones(data):
    pad = data.draw(pads((1, 3), (0, 6)))
    sides, radius = data.draw(st.sampled_from([None, 3, 4, 30])), data.draw(st.sampled_from([0.3, 0.6, 2.0, 100.0]))
    contact = Contact(radius=radius, sides=sides)
    places = data.draw(presses(pad))
    with ends_in_time():
        found = signals_quantized(pad, places, contact, samples=5001)
    exact = signals(pad, places, contact)
    assert (found >= 0).all()
    assert (found <= whole_lengths(pad, contact) * (1 + 1e-9)).all()
    if np.diff(fibre_axes(pad)[0]).min() > 0.2:
        np.testing.assert_allclose(found, exact, atol=0.2 + 0.01 * exact.max(initial=0))


@settings(few(40), suppress_health_check=LAX)
@given(seeds(), st.sampled_from(KINDS), st.integers(1, 3), st.integers(0, 6), st.sampled_from([0, 1, 2]))
def test_populations_of_none_one_and_more(seed, kind, grid, count, population):
    rng = np.random.default_rng(seed)
    knots = np.array([wild_knots(kind, grid, count, rng) for _ in range(population)]).reshape(
        -1, 2 * grid, count + 2, 2
    )
    places = rng.uniform(0, grid + 1, (4, 2))
    for layout in (knots, np.asfortranarray(knots), knots[:, ::-1][:, ::-1]):
        found = signals(layout, places)
        assert found.shape == (population, 4, 2 * grid)
        for own, one in zip(knots, found, strict=True):
            assert (one == signals(Morphology(own), places)).all()
    assert signals_quantized(knots, places).shape == (population, 4, 2 * grid)
    assert len(published_terms(knots, samples=50)) == population


@pytest.mark.parametrize("span", [1e-12, 1e-9, 1e-6])
def test_spans_as_short_as_allowed_and_shorter(span):
    knots = Morphology.straight(1).knots
    step = np.array([[0, 1.0], [1, 0.2], [1 + span, 1.8], [2, 1.0]])
    pad = Morphology(np.stack([step, step[:, ::-1]]))
    found = signals(pad, [[1, 1], [1, 1.9]], Contact(sides=None))
    assert np.isfinite(found).all()
    assert found[0, 0] == pytest.approx(1.2, rel=1e-3)  # straight up through the middle
    knots = pad.knots.copy()
    knots[0, 2, 0] = 1 + 2.0**-52
    for refused in (lambda: Morphology(knots), lambda: signals(knots, [[1, 1]])):
        with pytest.raises(InputError, match="ascend"):
            refused()


def test_fibres_that_leave_the_pad_are_followed():
    knots = Morphology.straight(2).knots
    out = np.insert(knots, 1, [[1.5, 50], [1.5, -50], [50, 1.5], [-50, 1.5]], axis=1)
    found = signals(out, [[1.0, 40], [1, 1], [-30, 0.6]], Contact(sides=None))
    assert found[0, 0] > 1
    assert found[2, 3] > 1
    assert np.isfinite(signals(knots * 1e5, [[1e5, 1e5]], Contact(radius=1e4))).all()


def test_a_million_presses_take_time_in_proportion():
    pad = Morphology.random(1, 3, seed=0)
    places = np.random.default_rng(0).uniform(-9, 11, (1_000_000, 2))
    signals(pad, places[:10])
    with ends_in_time(60):
        found = signals(pad, places)
    assert (found[::100_000] == signals(pad, places[::100_000])).all()
    assert signals_sparse(pad, places[:1000]).shape == (1000, 2)
    assert signals(pad, np.empty((0, 2))).shape == (0, 2)
    assert signals(pad, places[:1]).shape == (1, 2)


def test_a_large_pad_costs_what_is_touched():
    pad = Morphology.random(4, 3, seed=0).tiled(64)
    places = np.random.default_rng(0).uniform(1, 256, (2000, 2))
    with ends_in_time():
        found = signals_sparse(pad, places)
    assert found.nnz < 40 * len(places)
    few_of_them = slice(0, 20)
    assert (found[few_of_them].toarray() == signals(pad, places[few_of_them])).all()
