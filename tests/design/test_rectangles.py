"""Pads of any rectangle answer as they do when they are turned, and as plain ways to say it; their files."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge import InputError
from padforge.design import Contact, Morphology, signals, signals_quantized
from padforge.design.contact import signals_sparse
from padforge.design.objectives.rules import check_rules
from padforge.design.paths.curves import crossings, lengths
from padforge.design.settings import Layout, RulesSettings

ROUND = Contact(radius=0.6, sides=None)
CONTACTS = [
    Contact(radius=0.5, sides=4, length="euclidean"),
    Contact(),
    Contact(model="profile"),
]


@st.composite
def layouts(draw, least=0):
    """Of up to 4 by 4 fibres, pitches up to 1 : 6, one family empty at times."""
    counts = draw(st.tuples(st.integers(least, 4), st.integers(least, 4)).filter(any))
    return Layout.create(counts, draw(st.sampled_from([(5.0, 30.0), (30.0, 5.0), (8.0, 15.0), (10.0, 10.0)])))


@st.composite
def rectangles(draw, least=0, knots=(0, 4)):
    return Morphology.random(draw(layouts(least)), draw(st.integers(*knots)), draw(st.integers(0, 2**32 - 1)))


def turned(pad):
    """The pad with x and y, and so its families, exchanged."""
    layout = pad.layout
    other = Layout(layout.verticals, layout.horizontals, layout.pitch_y_mm, layout.pitch_x_mm)
    return Morphology.from_layout(pad.knots[order(pad)][..., ::-1], other)


def with_exchanged_depths(contact):
    """The contact with the depths of a layer's families exchanged."""
    return contact.model_copy(update={"fibre_depths_mm": contact.fibre_depths_mm[::-1]})


def order(pad):
    """The fibres of a pad in the order of those of the turned one."""
    return np.r_[pad.layout.horizontals : pad.layout.fibres, : pad.layout.horizontals]


def places_on(pad, seed=0, count=40):
    return np.random.default_rng(seed).uniform(-0.3, 0.3 + np.array(pad.layout.extent), (count, 2))


@pytest.mark.parametrize("contact", CONTACTS, ids=["square", "layer", "profile"])
@given(pad=rectangles())
@settings(max_examples=8)
def test_signals_of_a_transposed_rectangle(contact, pad):
    places, other, exchanged = places_on(pad), turned(pad), with_exchanged_depths(contact)
    found = signals(pad, places, contact)[:, order(pad)]
    np.testing.assert_allclose(signals(other, places[:, ::-1], exchanged), found, rtol=1e-8, atol=1e-8)
    sparse = signals_sparse(other, places[:, ::-1], exchanged).toarray()
    np.testing.assert_allclose(sparse, found, rtol=1e-8, atol=1e-8)


@given(pad=rectangles())
@settings(max_examples=15)
def test_quantized_signals_of_a_transposed_rectangle(pad):
    places, other = places_on(pad), turned(pad)
    found = signals_quantized(pad, places, ROUND, 300)[:, order(pad)]
    # a sample on the edge of the disc may fall to either side of it by rounding
    assert np.isclose(signals_quantized(other, places[:, ::-1], ROUND, 300), found, atol=1e-9).mean() > 0.99


@given(pad=rectangles(knots=(0, 3)))
@settings(max_examples=6)
def test_rules_and_lengths_of_a_transposed_rectangle(pad):
    rules, other = RulesSettings(max_crossings=2, min_crossing_angle_deg=30), turned(pad)
    np.testing.assert_allclose(lengths(other), lengths(pad)[order(pad)], rtol=1e-9)
    assert len(crossings(other)) == len(crossings(pad))
    names = {int(fibre) + 1: number for number, fibre in enumerate(order(pad), 1)}
    found = sorted((v.rule, sorted(names[f] for f in v.fibres), round(v.measured, 2)) for v in check_rules(pad, rules))
    swapped = sorted((v.rule, sorted(v.fibres), round(v.measured, 2)) for v in check_rules(other, rules))
    assert [each[:2] for each in swapped] == [each[:2] for each in found]
    assert [each[2] for each in swapped] == pytest.approx([each[2] for each in found], abs=0.02, rel=1e-2)


def test_signals_of_coarse_families_and_single_fibres():
    """Horizontals lie 6 pitches of the verticals apart; one leaves its level by nearly that and is felt there."""
    for counts in ((1, 0), (0, 1)):
        pad = Morphology.straight(Layout.create(counts, (8.0, 15.0)))
        middle = np.array([pad.layout.extent]) / 2
        assert signals(pad, middle, Contact(radius=0.3, sides=None)) == pytest.approx(0.6)
    layout = Layout.create((2, 3), (5.0, 30.0))
    knots = Morphology.straight(layout).knots
    middle = knots.mean(axis=1, keepdims=True)
    middle[0, 0, 1] += 0.9 * layout.spacing[1]
    pad = Morphology.from_layout(np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1), layout)
    found = signals(pad, middle[:1, 0], ROUND)[0]
    assert found[0] > 0.5
    assert found[3] > 1.0  # the middle vertical runs there as well


@given(pad=rectangles(), data=st.data())
@settings(max_examples=8)
def test_rectangle_file_round_trip(tmp_path_factory, pad, data):
    pitch = data.draw(st.tuples(*[st.floats(0.1, 1000)] * 2)) if data.draw(st.booleans()) else pad.pitch_mm
    pad = Morphology.random(Layout.create(pad.layout.counts, pitch), 3, data.draw(st.integers(0, 99)))
    path = tmp_path_factory.mktemp("pads") / "pad.json"
    pad.save(path)
    again = Morphology.load(path)
    assert again == pad
    again.save(path.with_name("again.json"))
    assert path.read_bytes() == path.with_name("again.json").read_bytes()
    assert json.loads(path.read_text())["fibres"] == list(pad.layout.counts)


PAD = Morphology.random(Layout.create((1, 2), (8.0, 15.0)), 2, seed=0)
WRONG = [
    *({"fibres": value} for value in ([2, 1], 3, ["1", "2"], [0, 0])),
    *({"pitch_mm": value} for value in ([8.0, -1], [8.0])),
    *({"knots": value} for value in ([], "many", Morphology.straight(2).to_dict()["knots"])),
]


@pytest.mark.parametrize("change", WRONG, ids=lambda change: str(change)[:40])
def test_load_refuses_invalid_rectangles_in_one_line(tmp_path, change):
    path = tmp_path / "pad.json"
    path.write_text(json.dumps(PAD.to_dict() | change))
    with pytest.raises(InputError, match=r"pad\.json: "):
        Morphology.load(path)
