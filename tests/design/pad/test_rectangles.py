"""Pads of any rectangle answer as they do when they are turned, and as plain ways to say it; their files."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from design import Contact, InputError, Morphology, signals, signals_quantized
from design.criteria.differentiable import pchip_slopes, press_signals
from design.criteria.rules import check_rules
from design.criteria.score import ambiguities
from design.pad.contact import boustrophedon, fibre_axes, signals_sparse
from design.pad.courses.curves import crossings, lengths
from design.pad.indentation import Indenter, indented_signals
from design.settings import Layout, PadSettings, RulesSettings, between_fibres

ROUND = Contact(radius=0.6, sides=None)
CONTACTS = [ROUND, Contact(radius=0.5, sides=4, length="euclidean"), Contact(), Contact(weight="inverse", sides=None)]


@st.composite
def layouts(draw, least=0):
    """Of up to 4 by 4 fibres, pitches up to 1 : 6, one family empty at times."""
    counts = draw(st.tuples(st.integers(least, 4), st.integers(least, 4)).filter(any))
    return Layout.of(counts, draw(st.sampled_from([(5.0, 30.0), (30.0, 5.0), (8.0, 15.0), (10.0, 10.0)])))


@st.composite
def rectangles(draw, least=0, knots=(0, 4)):
    return Morphology.random(draw(layouts(least)), draw(st.integers(*knots)), draw(st.integers(0, 2**32 - 1)))


def turned(pad):
    """The pad with x and y, and so its families, exchanged."""
    layout = pad.layout
    other = Layout(layout.verticals, layout.horizontals, layout.pitch_y_mm, layout.pitch_x_mm)
    return Morphology.of_layout(pad.knots[order(pad)][..., ::-1], other)


def order(pad):
    """The fibres of a pad in the order of those of the turned one."""
    return np.r_[pad.layout.horizontals : pad.layout.fibres, : pad.layout.horizontals]


def places_on(pad, seed=0, count=40):
    return np.random.default_rng(seed).uniform(-0.3, 0.3 + np.array(pad.layout.extent), (count, 2))


@pytest.mark.parametrize("contact", CONTACTS, ids=["disc", "square", "reach", "inverse"])
@given(pad=rectangles())
@settings(max_examples=15)
def test_a_pad_that_is_turned_signals_alike(contact, pad):
    places, other = places_on(pad), turned(pad)
    found = signals(pad, places, contact)[:, order(pad)]
    np.testing.assert_allclose(signals(other, places[:, ::-1], contact), found, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(signals_sparse(other, places[:, ::-1], contact).toarray(), found, rtol=1e-8, atol=1e-8)


@given(pad=rectangles())
@settings(max_examples=15)
def test_a_pad_that_is_turned_is_sampled_and_indented_alike(pad):
    places, other = places_on(pad), turned(pad)
    found = signals_quantized(pad, places, ROUND, 300)[:, order(pad)]
    # a sample on the edge of the disc may fall to either side of it by rounding
    assert np.isclose(signals_quantized(other, places[:, ::-1], ROUND, 300), found, atol=1e-9).mean() > 0.99
    ball = Indenter("sphere", 0.7)
    pressed = [indented_signals(each, at, 0.2, ball) for each, at in ((pad, places), (other, places[:, ::-1]))]
    np.testing.assert_allclose(pressed[1], pressed[0][:, order(pad)], rtol=1e-4, atol=1e-9)


@given(pad=rectangles(knots=(0, 3)))
@settings(max_examples=15)
def test_a_pad_that_is_turned_breaks_the_same_rules_and_is_as_long(pad):
    rules, other = RulesSettings(max_crossings=2, min_crossing_angle_deg=30), turned(pad)
    np.testing.assert_allclose(lengths(other), lengths(pad)[order(pad)], rtol=1e-9)
    assert len(crossings(other)) == len(crossings(pad))
    names = {int(fibre) + 1: number for number, fibre in enumerate(order(pad), 1)}
    found = sorted(
        (v.rule, tuple(sorted(names[f] for f in v.fibres)), round(v.measured, 2)) for v in check_rules(pad, rules)
    )
    there = sorted((v.rule, tuple(sorted(v.fibres)), round(v.measured, 2)) for v in check_rules(other, rules))
    assert [each[:2] for each in there] == [each[:2] for each in found]
    assert [each[2] for each in there] == pytest.approx([each[2] for each in found], abs=0.02, rel=1e-2)


def test_a_pad_that_is_turned_is_as_ambiguous():
    pad = Morphology.random(Layout.of((3, 2), (8.0, 15.0)), 4, seed=1)
    found, there = (ambiguities(each, Contact(), 2, 0.05, PadSettings().of(each.layout)) for each in (pad, turned(pad)))
    assert there == pytest.approx(found, rel=2e-3)  # in single precision


@pytest.mark.parametrize("contact", CONTACTS[:3], ids=["disc", "square", "reach"])
@given(pad=rectangles(knots=(1, 3)), seed=st.integers(0, 99))
@settings(max_examples=10)
def test_the_gradient_on_a_rectangle_is_that_of_finite_differences(contact, pad, seed):
    rng, (travel, cross, ends, _) = np.random.default_rng(seed), fibre_axes(pad)
    places, upstream = places_on(pad, seed), torch.tensor(rng.normal(size=(pad.layout.fibres, 40)))
    move = torch.tensor(rng.normal(size=cross[0].shape))
    move[:, [0, -1]] = 0

    def value(across):
        there = torch.tensor(travel[0])
        slope = pchip_slopes(there, across)
        return (upstream * press_signals(there, across, slope, places, contact, ends, pad.unit_mm)).sum()

    across = torch.tensor(cross[0], requires_grad=True)
    value(across).backward()
    assert across.grad is not None
    with torch.no_grad():
        steps = [
            (value(across + step * move) - value(across - step * move)).item() / (2 * step) for step in (1e-6, 2e-6)
        ]
    if abs(steps[0] - steps[1]) < 1e-4 * (1 + abs(steps[0])):  # else a kink, of a fibre that grazes, lies between
        assert (across.grad * move).sum().item() == pytest.approx(steps[0], rel=2e-3, abs=2e-3)


def plain_signal(pad, fibre, place, radius, count=20_001):
    """The length |dx| + |dy| of a fibre in a disc, from very many samples of it."""
    axis = pad.layout.family(fibre)
    travel = np.linspace(0, pad.layout.extent[axis], count)
    cross = PchipInterpolator(pad.knots[fibre, :, axis], pad.knots[fibre, :, 1 - axis])(travel)
    step = np.abs(np.diff(travel)) + np.abs(np.diff(cross))
    middle = np.stack([travel[1:] + travel[:-1], cross[1:] + cross[:-1]]) / 2
    centre = place if axis == 0 else place[::-1]
    return step[np.hypot(middle[0] - centre[0], middle[1] - centre[1]) <= radius].sum()


@given(pad=rectangles(knots=(0, 2)), seed=st.integers(0, 99))
@settings(max_examples=15)
def test_no_fibre_that_a_press_touches_is_left_out(pad, seed):
    places = places_on(pad, seed, 3)
    expected = [[plain_signal(pad, fibre, place, 0.6) for fibre in range(pad.layout.fibres)] for place in places]
    found = signals(pad, places, ROUND)
    np.testing.assert_allclose(found, expected, atol=0.03 * (1 + max(pad.layout.extent)))
    assert ((found > 0.1) == (np.array(expected) > 0.1)).mean() > 0.9


def test_a_fibre_of_a_coarse_family_is_felt_as_far_as_it_strays():
    """Horizontals lie 6 pitches of the verticals apart; one leaves its level by nearly that and is felt there."""
    layout = Layout.of((2, 3), (5.0, 30.0))
    knots = Morphology.straight(layout).knots
    middle = knots.mean(axis=1, keepdims=True)
    middle[0, 0, 1] += 0.9 * layout.spacing[1]
    pad = Morphology.of_layout(np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1), layout)
    found = signals(pad, middle[:1, 0], ROUND)[0]
    assert found[0] > 0.5
    assert found[3] > 1.0  # the middle vertical runs there as well


def test_one_fibre_signals_the_width_of_the_press():
    for counts in ((1, 0), (0, 1)):
        pad = Morphology.straight(Layout.of(counts, (8.0, 15.0)))
        middle = np.array([pad.layout.extent]) / 2
        assert signals(pad, middle, Contact(radius=0.3, sides=None)) == pytest.approx(0.6)
        assert len(boustrophedon(between_fibres(pad.layout), 5)) == 25


@given(pad=rectangles(), data=st.data())
@settings(max_examples=20)
def test_a_rectangle_is_read_as_it_was_written_to_the_bit(tmp_path_factory, pad, data):
    pitch = data.draw(st.tuples(*[st.floats(0.1, 1000)] * 2)) if data.draw(st.booleans()) else pad.pitch_mm
    pad = Morphology.random(Layout.of(pad.layout.counts, pitch), 3, data.draw(st.integers(0, 99)))
    path = tmp_path_factory.mktemp("pads") / "pad.json"
    pad.save(path)
    again = Morphology.load(path)
    assert again == pad
    again.save(path.with_name("again.json"))
    assert path.read_bytes() == path.with_name("again.json").read_bytes()
    assert json.loads(path.read_text())["format"][-1] == ("1" if pad.layout.is_square else "2")


def written(**changes):
    """What a pad of 1 + 2 fibres writes, with changes."""
    return Morphology.random(Layout.of((1, 2), (8.0, 15.0)), 2, seed=0).document() | changes


@pytest.mark.parametrize(
    "document",
    [
        written(fibres=[2, 1]),
        written(fibres=[2, 2]),
        written(fibres=[1]),
        written(fibres=3),
        written(fibres=["1", "2"]),
        written(fibres=[0, 0]),
        written(fibres=[10**30, 1]),
        written(fibres=[1.5, 1.5]),
        written(fibres=None),
        written(pitch_mm=[0, 15.0]),
        written(pitch_mm=[8.0, -1]),
        written(pitch_mm=[8.0]),
        written(pitch_mm=None),
        written(knots=[]),
        written(knots=[[[0, 1], [3, 1]]]),
        written(knots="many"),
        written(knots=Morphology.straight(2).document()["knots"]),
        written(knots=Morphology.straight(Layout.of((1, 2), (8.0, 15.0))).knots.tolist()),
        written(format="padforge-morphology/1"),
        {key: value for key, value in written().items() if key != "fibres"},
    ],
    ids=lambda document: str({key: document[key] for key in ("fibres", "pitch_mm") if key in document}),
)
def test_files_that_are_no_rectangle_are_one_line(tmp_path, document):
    path = tmp_path / "pad.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"pad\.json: ") as refused:
        Morphology.load(path)
    assert "\n" not in str(refused.value)
