"""Expected errors if the contact is another than the assumed one."""

import pytest

from padforge.design import Contact, Morphology, PadSettings, SearchSettings
from padforge.design.contact_comparison import alternative_contacts, beside_straight, errors_by_contact
from padforge.design.objectives.bayes_error import expected_errors
from padforge.design.settings import PUBLISHED_CONTACT
from tests.helpers.less import compare_little

PAD, SIZE = Morphology.random(2, 5, seed=1), PadSettings(grid=2)


def test_alternative_contacts_begin_with_the_assumed_one():
    """And have none of the others that is the same."""
    profiles, disc = ["profile of 5 mm", "profile of 6.2 mm", "profile of 7.9 mm"], ["published disc, K = 0.6"]
    presses = ["tool of 4.2 mm", "2.5 mm deep", "pressed flat alone"]
    for assumed, others in (
        (Contact(radius=0.9), profiles + disc),
        (Contact(), presses),
        (Contact(stretch=0.0), presses[:2]),
        (Contact(model="profile"), [profiles[0], profiles[2], *disc]),
        (PUBLISHED_CONTACT, profiles),
    ):
        contacts = alternative_contacts(assumed)
        assert (list(contacts), contacts["as assumed"]) == (["as assumed", *others], assumed)


def test_errors_by_contact_of_both_pads(monkeypatch):
    compare_little(monkeypatch)
    contacts, search = {"wide": Contact(), "narrow": Contact(radius=0.2)}, SearchSettings()
    found = errors_by_contact(beside_straight(PAD), contacts, SIZE, search)
    assert [(each.contact, each.pad) for each in found] == [
        (contact, pad) for contact in contacts for pad in ("designed", "straight")
    ]
    straight = expected_errors(Morphology.straight(2), Contact(), search, SIZE)
    assert found[1].errors_mm == pytest.approx([PAD.unit_mm * error for error in straight])
    assert found[1].errors_mm[0] < 0.7 * found[3].errors_mm[0]
