"""What simulated errors owe to the contact believed: a pad and straight fibres, should a press be felt otherwise."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from padforge.design.common.errors import whole
from padforge.design.criteria.fibre_loss import lost_subsets
from padforge.design.pad.contact import relative_stretch
from padforge.design.pad.courses.keep_out import outside
from padforge.design.pad.knots import Array
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import MEASURED_REACH, PUBLISHED_CONTACT, Contact, PadSettings, Scatter

from .expected_error import straight_full_scale
from .localisation_error import LossError, PressSets, fresh_presses, training_presses

WIDTHS = (5.0, 6.2, 7.9)
"""Standard deviations of the reaches, about Gaussian, that a press may have, mm; that of MEASURED_REACH second."""
SIDE, TEST, HIDDEN = 32, 500, 20
"""Presses a side to learn from, and fresh ones; neurons of a network: the 50 published ones learn the scatter by heart,
and err a tenth more in more time."""
LOST, SUBSETS = 3, 4
"""Most fibres that are lost, and sets of a size: enough to tell pads apart by a tenth of their error."""


@dataclass(frozen=True)
class ContactErrors:
    """Errors of a small network under one contact: of which pad, and with 0, 1, ... fibres lost."""

    contact: str
    pad: str
    errors: tuple[LossError, ...]


def contacts_in_question(believed: Contact) -> dict[str, Contact]:
    """The contact believed and others that a pad may really meet, by what they are called; none twice."""
    spread = [(width, tuple((width / WIDTHS[1] * d, weight) for d, weight in MEASURED_REACH)) for width in WIDTHS]
    others = {f"reach of {width:g} mm": Contact(reach=reach) for width, reach in spread}
    others["published disc, K = 0.6"] = PUBLISHED_CONTACT
    return {"as believed": believed} | {name: other for name, other in others.items() if other != believed}


def errors_by_contact(
    pads: Mapping[str, Morphology],
    contacts: Mapping[str, Contact],
    size: PadSettings,
    scatter: Scatter,
    seed: int = 0,
    subsets: int = SUBSETS,
) -> list[ContactErrors]:
    """Return mean errors of a small network for pads of one layout under every contact, contact by contact.

    A network is trained afresh for every contact, as a calibration is, on one response of each fibre to a press.

    Args:
        pads: by name.
        contacts: by name.
        size: says what is pressed.
        scatter: of responses.
        seed: of presses, scatter and networks.
        subsets: most sets of failed fibres of a size.
    """
    seed = whole("seed", seed, 0, 2**64 - 1)
    fibres = size.layout.fibres
    losses = [lost_subsets(fibres, lost, subsets) for lost in range(min(LOST, fibres - 1) + 1)]
    return [
        ContactErrors(called, name, tuple(_sets(pad, contact, size, scatter, seed).loss_errors(losses, HIDDEN)))
        for called, contact in contacts.items()
        for name, pad in pads.items()
    ]


def beside_straight(pad: Morphology) -> dict[str, Morphology]:
    """Return a pad, "designed", and straight fibres of its layout, by name."""
    return {"designed": pad, "straight": Morphology.straight(pad.layout)}


def _sets(pad: Morphology, contact: Contact, size: PadSettings, scatter: Scatter, seed: int) -> PressSets:
    """Presses with the responses of a pad, scattered by the same draws for every pad of as many fibres."""
    rng = np.random.default_rng([3, seed])
    scale = straight_full_scale(pad.layout, contact, size.sensed_mm)

    def responses(positions: Array) -> Array:
        found = relative_stretch(pad, positions, contact) / scale
        return found * scatter.gains(found.shape, rng) + scatter.floor * rng.standard_normal(found.shape)

    learned, fresh = (
        positions[outside(positions, size)]
        for positions in (training_presses(size.sensed, SIDE, seed), fresh_presses(size.sensed, TEST, seed))
    )
    return PressSets(learned, responses(learned), fresh, responses(fresh), seed)
