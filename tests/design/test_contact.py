import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design import Contact, Morphology, check_rules, indented_signals, press_forces_n, signals
from padforge.design.contact import half_width_mm, signals_quantized
from padforge.design.contact_set import judged_contacts, served_contacts
from padforge.design.layer import solve_press
from padforge.design.paths.curves import crossings, lengths
from padforge.design.settings import PUBLISHED_CONTACT, Layout, RulesSettings, SearchSettings
from tests.helpers.golden import Golden

CONTACTS = [Contact(radius=0.5, sides=4, length="euclidean"), Contact(), Contact(model="profile")]


@st.composite
def rectangles(draw, knots=(0, 4)):
    """Pads of up to 4 by 4 fibres, pitches up to 1 : 6, one family empty at times."""
    counts = draw(st.tuples(st.integers(0, 4), st.integers(0, 4)).filter(any))
    layout = Layout.create(counts, draw(st.sampled_from([(5.0, 30.0), (30.0, 5.0), (8.0, 15.0), (10.0, 10.0)])))
    return Morphology.random(layout, draw(st.integers(*knots)), draw(st.integers(0, 2**32 - 1)))


def turned(pad):
    """The pad with x and y, and so its families, exchanged."""
    layout = pad.layout
    other = Layout(layout.verticals, layout.horizontals, layout.pitch_y_mm, layout.pitch_x_mm)
    return Morphology.from_layout(pad.knots[order(pad)][..., ::-1], other)


def order(pad):
    """The fibres of a pad in the order of those of the turned one."""
    return np.r_[pad.layout.horizontals : pad.layout.fibres, : pad.layout.horizontals]


@pytest.mark.parametrize("contact", CONTACTS, ids=["square", "layer", "profile"])
@given(pad=rectangles())
@settings(max_examples=8)
def test_signals_of_a_transposed_rectangle(contact, pad):
    """With the depths of a layer's families exchanged."""
    exchanged = contact.model_copy(update={"fibre_depths_mm": contact.fibre_depths_mm[::-1]})
    places, other = np.random.default_rng(0).uniform(-0.3, 0.3 + np.array(pad.layout.extent), (40, 2)), turned(pad)
    found = signals(pad, places, contact)[:, order(pad)]
    np.testing.assert_allclose(signals(other, places[:, ::-1], exchanged), found, rtol=1e-8, atol=1e-8)
    # a sample on the edge of the disc may fall to either side of it by rounding
    sampled = signals_quantized(pad, places, contact, 300)[:, order(pad)]
    assert np.isclose(signals_quantized(other, places[:, ::-1], exchanged, 300), sampled, atol=1e-8).mean() > 0.99


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


PAD = Morphology.random(2, 3, 1)


def test_indented_signals_and_press_forces_are_those_of_solved_contacts():
    contact, presses = Contact(), np.random.default_rng(0).uniform(0.3, 2.7, (12, 2))
    full_scale = np.abs(signals(PAD, presses, contact)).max()
    depths_mm = (0.03, 1.3)
    interpolated = indented_signals(PAD, np.tile(presses, (2, 1)), np.repeat(depths_mm, len(presses)), contact)
    np.testing.assert_array_equal(indented_signals(PAD, presses[7:8], depths_mm[1], contact), interpolated[19:20])
    solved = [signals(PAD, presses, contact.model_copy(update={"depth_mm": each})) for each in depths_mm]
    np.testing.assert_allclose(interpolated, np.concatenate(solved), rtol=0, atol=0.01 * full_scale)
    deepest = indented_signals(PAD, presses, contact.depth_mm, contact)
    np.testing.assert_array_equal(deepest, signals(PAD, presses, contact))
    assert not indented_signals(PAD, presses, 0.0, contact).any()
    assert indented_signals(PAD, [], [], contact).shape == (0, 4)
    contact, depths_mm = Contact(tool="ball", tool_radius_mm=6.0, base="slipping"), [0.02, 1.3, 4.8]
    presses = (solve_press("ball", 6.0, depth_mm, contact.thickness_mm, "slipping") for depth_mm in depths_mm)
    expected = np.reshape([0.0, *(press.force_n() for press in presses)], (2, 2))
    deepest_n, found = press_forces_n(contact.depth_mm, contact), press_forces_n([[0.0, 0.02], [1.3, 4.8]], contact)
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-4 * float(deepest_n))


ASSUMED = {
    "layer": Contact(),
    "thin layer": Contact(tool="ball", tool_radius_mm=4.0, depth_mm=2.5, thickness_mm=4.0),
    "no stretch": Contact(stretch=0.0),
    "profile": Contact(model="profile"),
    "shape": PUBLISHED_CONTACT,
}


def test_contacts_served_and_judged_begin_with_the_assumed_one(golden: Golden) -> None:
    """And none is there twice; their profiles are given by where they end."""
    lines = []
    for name, assumed in ASSUMED.items():
        for contacts in ("plausible", "assumed", (Contact(radius=0.9), assumed)):
            search = SearchSettings(contacts=contacts)
            for what, found in (("served", served_contacts), ("judged", judged_contacts)):
                named = found(assumed, search)
                assert next(iter(named.values())) == assumed
                assert len({str(contact) for contact in named.values()}) == len(named)
                listed = [f"{other} ({contact.model}, {half_mm(contact)})" for other, contact in named.items()]
                lines.append(f"{name}, {contacts if isinstance(contacts, str) else 'stated'}, {what}: {listed}")
    golden("design/contact_names.txt", "\n".join(lines))


def half_mm(contact: Contact) -> str:
    return f"K = {contact.radius:g}" if contact.model == "shape" else f"{half_width_mm(contact):.3f} mm"
