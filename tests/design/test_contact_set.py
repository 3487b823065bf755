"""Contacts that a search serves and that a pad is judged by."""

import pytest

from padforge.design import Contact, SearchSettings
from padforge.design.contact import half_width_mm
from padforge.design.contact_set import judged_contacts, served_contacts
from padforge.design.settings import PUBLISHED_CONTACT

ISOTROPIC = ["isotropic, 5.5 mm", "isotropic, 9.1 mm"]
MEASURED = Contact(model="profile")


def test_plausible_contacts_of_a_layer_are_isotropic_ones_about_as_wide():
    """As wide as the profile measured under the default press, in proportion to the layer."""
    gentle = Contact(tool="ball", tool_radius_mm=4.0, depth_mm=2.5, thickness_mm=4.0)
    for assumed in (Contact(), gentle):
        first, *others = served_contacts(assumed, SearchSettings()).values()
        share = half_width_mm(assumed) / half_width_mm(Contact())
        assert (first, {other.model for other in others}) == (assumed, {"profile"})
        widths = [half_width_mm(other) / (share * half_width_mm(MEASURED)) for other in others]
        assert widths == pytest.approx([0.75, 1.25], rel=0.01)
    assert half_width_mm(gentle) < 0.8 * half_width_mm(Contact())


@pytest.mark.parametrize(
    ("assumed", "contacts", "others"),
    [
        (Contact(), "plausible", ISOTROPIC),
        (MEASURED, "plausible", ["10% narrower", "10% wider"]),
        (PUBLISHED_CONTACT, "plausible", []),
        (Contact(), "assumed", []),
        (Contact(), (Contact(radius=0.9), Contact()), ["contact 1 of [search]"]),
    ],
)
def test_served_contacts_begin_with_the_assumed_one(assumed, contacts, others):
    served = served_contacts(assumed, SearchSettings(contacts=contacts))
    assert (list(served), served["as assumed"]) == (["as assumed", *others], assumed)


def test_judged_contacts_are_the_served_ones_and_others():
    """And none is there twice."""
    profiles, disc = ["profile of 5 mm", "profile of 6.2 mm", "profile of 7.9 mm"], ["published disc, K = 0.6"]
    presses, assumed = ["tool of 4.2 mm", "2.5 mm deep", "pressed flat alone"], SearchSettings(contacts="assumed")
    for contact, search, others in (
        (Contact(), SearchSettings(), ISOTROPIC + presses),
        (Contact(stretch=0.0), assumed, presses[:2]),
        (Contact(radius=0.9), SearchSettings(), profiles + disc),
        (MEASURED, assumed, [profiles[0], profiles[2], *disc]),
        (PUBLISHED_CONTACT, SearchSettings(), profiles),
    ):
        assert list(judged_contacts(contact, search)) == ["as assumed", *others]
