"""Contacts that a search serves and that a pad is judged by."""

from padforge.design import Contact, SearchSettings
from padforge.design.contact import half_width_mm
from padforge.design.contact_set import judged_contacts, served_contacts
from padforge.design.settings import PUBLISHED_CONTACT
from tests.helpers.golden import Golden

MEASURED = Contact(model="profile")


ASSUMED = {"layer": Contact(), "no stretch": Contact(stretch=0.0), "profile": MEASURED, "shape": PUBLISHED_CONTACT}


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
