"""Errors by the contact believed: which contacts, the same for the same seed, and as a wider press must have them."""

import math

from design import Contact, Morphology
from design.evaluation.contacts_believed import beside_straight, contacts_in_question, errors_by_contact
from design.settings import PUBLISHED_CONTACT, PadSettings, Scatter

PAD = Morphology.random(2, knots=2, seed=1)
ASKED = PadSettings(grid=2), Scatter(0.02, 0.05, 0.36)


def test_the_contact_believed_comes_first_and_none_twice() -> None:
    for believed in (Contact(), PUBLISHED_CONTACT, Contact(radius=0.9)):
        contacts = contacts_in_question(believed)
        assert next(iter(contacts.items())) == ("as believed", believed)
        assert len({contact.model_dump_json() for contact in contacts.values()}) == len(contacts)
    assert list(contacts_in_question(Contact(radius=0.9)))[1:] == [
        *("reach of 5 mm", "reach of 6.2 mm", "reach of 7.9 mm"),
        "published disc, K = 0.6",
    ]
    assert "reach of 6.2 mm" not in contacts_in_question(Contact())
    assert "published disc, K = 0.6" not in contacts_in_question(PUBLISHED_CONTACT)


def test_both_pads_have_errors_under_every_contact_and_feel_more_of_a_wide_press() -> None:
    contacts = {"wide": Contact(), "narrow": Contact(radius=0.2)}
    found = errors_by_contact(beside_straight(PAD), contacts, *ASKED, seed=4)
    assert [(each.contact, each.pad) for each in found] == [
        (contact, pad) for contact in contacts for pad in ("designed", "straight")
    ]
    for each in found:
        assert [error.lost for error in each.errors] == [0, 1, 2, 3]
        assert all(math.isfinite(error.mean) and 0 < error.mean < 2 for error in each.errors)
        assert each.errors[0].mean < each.errors[3].mean
    wide, narrow = found[1].errors, found[3].errors
    assert wide[0].mean < 0.5 * narrow[0].mean
    assert errors_by_contact(beside_straight(PAD), {"narrow": contacts["narrow"]}, *ASKED, seed=4) == found[2:]


def test_a_pad_of_two_fibres_loses_one_at_most() -> None:
    (designed, _) = errors_by_contact(
        beside_straight(Morphology.straight(1)), {"as believed": Contact()}, PadSettings(grid=1), ASKED[1]
    )
    assert [error.lost for error in designed.errors] == [0, 1]
