"""The kernels of `design` on degenerate geometry and at extreme scales, against slow ways and invariants."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from design import (
    Contact,
    Indenter,
    InputError,
    Morphology,
    crossings,
    flatten,
    indented_signals,
    signals,
    signals_quantized,
    signals_sparse,
)
from design.criteria.information import (
    disorder,
    disorder_area,
    idle_share,
    information,
    joint_entropy,
    published_sharpness,
    quantize,
)
from design.criteria.penalties import penalties
from design.criteria.published_objective import published_terms
from design.criteria.rules import check_rules
from design.evaluation.levenberg_marquardt import fit_many
from design.optimisers.parametrization import Fibres
from design.pad.bending import bend_radius, fold_gap, traced_curve
from design.pad.contact import fibre_axes, press_shape
from design.pad.curves import beziers, crossing_angles, lengths, slope_beziers, slopes
from design.pad.kernels.exact_gradient import signals_gradient
from design.pad.kernels.pchip import population_slopes
from design.pad.kernels.press import family_strays
from design.pad.kernels.roots import SCRATCH, roots_in_unit
from design.pad.knots import assemble
from design.settings import PadSettings, RulesSettings
from tests.stress.clock import ends_in_time, few
from tests.stress.values import LAX, Array, contacts, pads, presses, seeds, wild_knots

KINDS = ["random", "steps", "lattice", "border", "alike", "edge", "needles", "level"]


def mirrored(pad: Morphology) -> Morphology:
    """The pad seen in a mirror along y: fibres of either family keep their places in it from the other side."""
    knots, size = pad.knots.copy(), pad.grid + 1
    knots[..., 0] = size - knots[..., 0]
    return Morphology(np.concatenate([knots[: pad.grid, ::-1], knots[pad.grid :][::-1]]), pad.pitch_mm)


def transposed(pad: Morphology) -> Morphology:
    """The pad with x and y exchanged."""
    return Morphology(np.concatenate([pad.knots[pad.grid :], pad.knots[: pad.grid]])[..., ::-1], pad.pitch_mm)


def whole_lengths(pad: Morphology, contact: Contact) -> Array:
    """(2M,) the longest a signal can be with weight 1."""
    axes = [0] * pad.grid + [1] * pad.grid
    if contact.length == "manhattan":
        return np.array([np.abs(np.diff(knots, axis=0)).sum() for knots in pad.knots])
    return np.array([np.hypot(*np.diff(knots, axis=0).T).sum() + np.abs(np.diff(knots[:, 1 - a])).sum() + pad.grid + 1
                     for knots, a in zip(pad.knots, axes, strict=True)])  # fmt: skip


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


@settings(few(25), suppress_health_check=LAX)
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
    errors = [np.abs(signals(pad, places, Contact(sides=n)) - circle).mean() for n in (8, 32, 128, 512, 4096)]
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


@settings(few(30), suppress_health_check=LAX)
@given(st.data())
def test_gradients_are_finite_and_right_away_from_kinks(data):
    pad = data.draw(pads((1, 2), (1, 5)))
    contact = data.draw(contacts())
    travel, cross = (axis[0].copy() for axis in fibre_axes(pad)[:2])
    slope = population_slopes(travel[None], cross[None])[0]
    places = np.random.default_rng(data.draw(seeds())).uniform(0, pad.grid + 1, (3, 2))
    shape = press_shape(contact)
    upstream = np.ones((len(places), 2 * pad.grid))
    with ends_in_time():
        found = signals_gradient(travel, cross, slope, family_strays(cross[None])[0], places, upstream, *shape)
    if np.diff(travel).min() > 1e-6:
        assert np.isfinite(found).all()
    if (
        contact.sides is None
        and contact.weight == "uniform"
        and 0.1 <= contact.radius <= 1
        and np.diff(travel).min() > 0.1
    ):
        # whatever the kinks, the mean change over a small step is within the steepest that the rule for grazing allows
        assert np.abs(found).max() < 1e3 * len(places)


@settings(few(20), suppress_health_check=LAX)
@given(seeds(), st.sampled_from(["uniform", "inverse_square"]), st.sampled_from(["manhattan", "euclidean"]))
def test_gradients_are_finite_differences(seed, weight, length):
    rng = np.random.default_rng(seed)
    level = np.array([[1.0], [1.0]])
    travel = np.broadcast_to(np.linspace(0, 2, 5), (2, 5)).copy()
    cross = np.concatenate([level, level + np.cumsum(rng.uniform(0.05, 0.15, (2, 3)), axis=1), level + 0.5], axis=1)
    contact = Contact(radius=0.6, sides=None, weight=weight, length=length)
    slope, place = population_slopes(travel[None], cross[None])[0], np.array([[1.0, 1.1]])
    shape, strays = press_shape(contact), np.array([2.0, 2.0])

    def total(v: Array) -> float:
        from design.pad.kernels.exact_signals import exact_signals

        out, none = np.zeros(2), np.empty(0, np.int64)
        exact_signals(travel[None], v[None], slope[None], strays[None], place, *shape, 0, 1, none, none, out)
        return float(out.sum())

    found = signals_gradient(travel, cross, slope, strays, place, np.ones((1, 2)), *shape)[1]
    step = 1e-6
    for fibre in range(2):
        for knot in range(1, 4):
            ahead, behind = cross.copy(), cross.copy()
            ahead[fibre, knot] += step
            behind[fibre, knot] -= step
            change = (total(ahead) - total(behind)) / (2 * step)
            assert found[fibre, knot] == pytest.approx(change, abs=1e-4)


@settings(few(25), suppress_health_check=LAX)
@given(st.data())
def test_lengthenings_are_finite_and_follow_the_mirror(data):
    pad = data.draw(pads((1, 2), (0, 5)))
    shape = data.draw(st.sampled_from(["sphere", "cone", "flat"]))
    indenter = Indenter(
        shape, data.draw(st.sampled_from([1e-6, 0.7, 1e4])), data.draw(st.sampled_from([0.01, 30.0, 89.9]))
    )
    places = np.asarray(data.draw(presses(pad, 3)), dtype=float).reshape(-1, 2)
    depth = data.draw(st.sampled_from([0.0, 1e-300, 1e-9, 1e-6, 0.3, 1e3])) * (
        indenter.radius if shape == "sphere" else 1
    )
    if shape == "sphere":
        depth = min(depth, indenter.radius)
    with ends_in_time():
        found = indented_signals(pad, places, depth, indenter)
        other = indented_signals(transposed(pad), places[:, ::-1], depth, indenter)
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    assert depth > 0 or not found.any()
    order = np.r_[pad.grid : 2 * pad.grid, : pad.grid]
    np.testing.assert_allclose(other[:, order], found, rtol=1e-3, atol=1e-6 * max(depth, 1e-9))


@settings(few(60), suppress_health_check=LAX)
@given(st.data())
def test_curves_keep_to_their_knots(data):
    pad = data.draw(pads((1, 4), (0, 12)))
    d, spans, bends = slopes(pad), beziers(pad), slope_beziers(pad)
    assert np.isfinite(d).all()
    assert np.isfinite(spans).all()
    assert np.isfinite(bends).all()
    for fibre, knots in enumerate(pad.knots):
        axis = 0 if fibre < pad.grid else 1
        rise = np.diff(knots[:, 1 - axis]) / np.diff(knots[:, axis])
        assert (d[fibre, :-1] * rise >= 0).all()  # monotone between knots
        assert (np.abs(d[fibre, :-1]) <= 3 * np.abs(rise) * (1 + 1e-9) + 1e-300).all()
        if np.diff(knots[:, axis]).min() > 1e-4:
            t = np.linspace(0, pad.grid + 1, 301)
            expected = PchipInterpolator(knots[:, axis], knots[:, 1 - axis])(t)
            line = flatten(pad, 1e-7)[fibre]
            np.testing.assert_allclose(
                np.interp(t, line[:, axis], line[:, 1 - axis]), expected, atol=1e-4 + 1e-6 * np.abs(rise).max()
            )
    long = lengths(pad)
    assert (long >= (pad.grid + 1) * (1 - 1e-9)).all()
    assert (long <= whole_lengths(pad, Contact()) * (1 + 1e-4)).all()


@settings(few(30), suppress_health_check=LAX)
@given(st.data())
def test_every_horizontal_crosses_every_vertical_somewhere(data):
    pad = data.draw(pads((1, 3), (0, 8)))
    with ends_in_time():
        found = crossings(pad)
        angles = crossing_angles(pad, [c for c in found if c.first < pad.grid <= c.second])
    assert {(c.first, c.second) for c in found} >= {
        (h, v) for h in range(pad.grid) for v in range(pad.grid, 2 * pad.grid)
    }
    places = np.array([c.place for c in found])
    assert ((places >= -1e-9) & (places <= pad.grid + 1 + 1e-9)).all()
    assert ((angles >= 0) & (angles <= 90)).all()


@settings(few(30), suppress_health_check=LAX)
@given(st.data())
def test_bends_and_folds_of_any_curve(data):
    pad = data.draw(pads((1, 2), (0, 8)))
    limit, gap = data.draw(st.sampled_from([1e-9, 0.05, 1.0, 100.0])), data.draw(st.sampled_from([1e-6, 0.1, 3.0]))
    with ends_in_time():
        for fibre in range(2 * pad.grid):
            points, headings = traced_curve(beziers(pad)[fibre], slope_beziers(pad)[fibre], 0.01)
            assert np.isfinite(points).all()
            assert (np.abs(headings) <= math.pi / 2).all()
            radius, place = bend_radius(points, headings, limit)
            assert radius > 0
            assert np.isfinite(place).all()
            fold = fold_gap(flatten(pad, 1e-3)[fibre], gap)
            assert fold is None or 0 <= fold[0] < gap
    found = check_rules(pad, RulesSettings())
    order = [2 * f - (pad.grid if f > pad.grid else -pad.grid) - f for v in found for f in v.fibres]
    other = check_rules(transposed(pad), RulesSettings())
    assert len(order) == sum(len(v.fibres) for v in other)
    assert sorted(v.rule for v in found) == sorted(v.rule for v in other)


@settings(few(60), suppress_health_check=LAX)
@given(seeds(), st.integers(0, 30), st.integers(0, 5), st.sampled_from([0, 1e-300, 5e-324, 1e-9, 1.0, 1e300]))
def test_quantities_of_information_keep_to_their_bounds(seed, count, columns, scale):
    rng = np.random.default_rng(seed)
    values = rng.choice([rng.normal(size=(count, columns)), rng.integers(0, 2, (count, columns))]) * scale
    for layout in (
        values,
        np.asfortranarray(values),
        np.repeat(values, 2, axis=0)[::2],
        values.astype("f4" if scale < 1e30 else "f8"),
    ):
        levels = quantize(layout, 16)
        assert ((levels >= 0) & (levels <= 16)).all()
        assert (levels == np.round(levels)).all()
        entropy = joint_entropy(levels)
        assert -1e-12 <= entropy <= math.log2(max(count, 1)) + 1e-9
        assert 0 <= published_sharpness(levels) <= 4 * 16 * count * columns
        assert 0 <= idle_share(layout) <= 1
    numbers = np.unique(levels, axis=0, return_counts=True)[1] if columns and count else np.array([1])
    expected = -(numbers / numbers.sum() * np.log2(numbers / numbers.sum())).sum()
    assert joint_entropy(levels) == pytest.approx(expected, abs=1e-9)


@settings(few(15), suppress_health_check=LAX)
@given(st.data())
def test_terms_of_a_wild_pad_are_finite(data):
    pad, contact = data.draw(pads((1, 3), (0, 6))), data.draw(contacts())
    with ends_in_time():
        terms = published_terms(pad, contact, samples=data.draw(st.sampled_from([2, 3, 500])))[0]
        told = information(pad, contact, side=6)
        area = disorder_area(pad)
    assert np.isfinite([terms.entropy, terms.sharpness, terms.disorder, terms.objective, told, area]).all()
    assert 0 <= terms.entropy <= 2 * math.log2(49) + 1e-9
    assert area >= 0
    if np.diff(fibre_axes(pad)[0]).min() > 0.05:
        assert disorder(pad.knots, 20_001) * (pad.grid + 1) / 20_000 == pytest.approx(area, abs=2e-3 * (1 + area))


@settings(few(20), suppress_health_check=LAX)
@given(st.data())
def test_penalties_and_their_gradients_are_finite(data):
    import torch

    pad = data.draw(pads((1, 3), (1, 6)))
    rules = RulesSettings(
        min_gap_mm=data.draw(st.sampled_from([0.0, 0.8, 5.0])),
        same_family_crossings=data.draw(st.sampled_from([0, 2])),
        max_crossings=data.draw(st.sampled_from([None, 9])),
        min_crossing_angle_deg=data.draw(st.sampled_from([0.0, 40.0])),
    )
    course = Fibres.through(pad.knots, 0.01)
    assert np.isfinite(course.knots()).all()
    with ends_in_time():
        found = penalties(*course.axes(), PadSettings(grid=pad.grid, pitch_mm=pad.pitch_mm), rules)
        torch.stack(list(found.values())).sum().backward()
    assert all(value.isfinite() and value >= 0 for value in found.values())
    assert course.spans.grad is not None
    assert course.spans.grad.isfinite().all()
    assert course.cross.grad is not None
    assert course.cross.grad.isfinite().all()


@settings(few(15), suppress_health_check=LAX)
@given(
    seeds(),
    st.sampled_from([3, 4, 30]),
    st.sampled_from([1, 3]),
    st.sampled_from([1e-12, 1e-300, 0.0, 1.0, 1e12]),
    st.sampled_from(["random", "equal", "two", "zero column", "line"]),
)
def test_networks_learn_something_finite_or_say_why_not(seed, samples, networks, scale, kind):
    rng = np.random.default_rng(seed)
    inputs, targets = rng.normal(size=(samples, 2)) * scale, rng.normal(size=(samples, 2)) * scale
    if kind == "equal":
        inputs[:] = inputs[0]
    elif kind == "two":
        inputs = np.where(inputs > 0, 1.0, 0.0)
    elif kind == "zero column":
        inputs[:, 0] = 0
    elif kind == "line":
        targets = inputs @ rng.normal(size=(2, 2))
    rngs = [np.random.default_rng(i) for i in range(networks)]
    with ends_in_time():
        found = fit_many(inputs, targets, rngs, hidden=4, epochs=20)
    assert len(found) == networks
    for network in found:
        assert np.isfinite(network(inputs)).all()


@settings(few(100), suppress_health_check=LAX)
@given(seeds(), st.integers(1, 6), st.sampled_from([1e-300, 1e-12, 1.0, 1e12, 1e150]), st.booleans())
def test_roots_are_sign_changes_none_missed(seed, degree, scale, doubled):
    rng = np.random.default_rng(seed)
    true = rng.uniform(-0.5, 1.5, degree)
    if doubled:
        true[: degree // 2] = true[degree // 2 : 2 * (degree // 2)]
    p = np.zeros(7)
    p[: degree + 1] = np.polynomial.polynomial.polyfromroots(true) * scale
    out = np.empty(16)
    count = roots_in_unit(p, degree, 0.0, out, 0, np.empty(SCRATCH))
    assert (out[:count] >= 0).all()
    assert (out[:count] <= 1).all()
    if (
        not doubled
        and degree > 0
        and np.diff(np.sort(true)).min(initial=1) > 1e-3
        and np.abs(true * (1 - true)).min() > 1e-6
    ):
        expected = np.sort(true[(true > 0) & (true < 1)])
        np.testing.assert_allclose(out[:count], expected, atol=1e-6)


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


@settings(few(40), suppress_health_check=LAX)
@given(seeds(), st.sampled_from(KINDS), st.integers(1, 4), st.integers(0, 20))
def test_assembled_knots_are_a_pad(seed, kind, grid, count):
    knots = wild_knots(kind, grid, count, np.random.default_rng(seed))
    pad = Morphology(knots)
    again = Morphology(assemble(pad.knots[:, 1:-1]))
    np.testing.assert_allclose(again.knots, pad.knots, atol=1e-12)
