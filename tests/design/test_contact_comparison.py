"""Expected errors if the contact is another than the assumed one."""

import pytest

from padforge.design import Contact, Morphology, PadSettings, SearchSettings
from padforge.design.contact_comparison import beside_straight, errors_by_contact
from padforge.design.objectives.bayes_error import expected_errors
from tests.helpers.less import compare_little

PAD, SIZE = Morphology.random(2, 5, seed=1), PadSettings(grid=2)


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
