"""What simulated errors owe to the contact believed: a pad and straight fibres, should a press be felt otherwise."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from design.common.errors import instance, whole
from design.criteria.fibre_loss import lost_subsets
from design.pad.contact import signals
from design.pad.knots import Array
from design.pad.morphology import Morphology
from design.settings import MEASURED_REACH, PUBLISHED_CONTACT, Contact, Sensed

from .localisation_error import LossError, PressSets

WIDTHS = (5.0, 6.2, 7.9)
"""Standard deviations of the reaches, about Gaussian, that a press may have, mm; that of MEASURED_REACH second."""
NOISE = 0.02
"""Of a signal, share of full scale: what all readings of a press leave of the scatter of a built pad's responses."""
SIDE, TEST, HIDDEN = 24, 500, 50
"""Presses a side to learn from, and fresh ones; neurons of a network."""
LOST, SUBSETS = 3, 4
"""Most fibres that are lost, and sets of a size: enough to tell pads apart by a tenth of their error."""


@dataclass(frozen=True)
class ContactErrors:
    """Errors of the published network under one contact: of which pad, and with 0, 1, ... fibres lost."""

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
    pad: Morphology, contacts: Mapping[str, Contact], sensed_mm: Sensed = "beyond", seed: int = 0
) -> list[ContactErrors]:
    """Mean errors of the published network of a pad, "designed", and of straight fibres, under every contact.

    A network is trained afresh for every contact, as a calibration is, on signals under NOISE.

    Args:
        sensed_mm: what is pressed (`PadSettings`). seed: of presses, noise and networks.
    """
    instance("pad", pad, Morphology)
    seed = whole("seed", seed, 0, 2**64 - 1)
    fibres = len(pad.knots)
    losses = [lost_subsets(fibres, lost, SUBSETS) for lost in range(min(LOST, fibres - 1) + 1)]
    pads = {"designed": pad, "straight": Morphology.straight(pad.layout)}
    return [
        ContactErrors(called, name, tuple(_sets(each, contact, sensed_mm, seed).loss_errors(losses, HIDDEN)))
        for called, contact in contacts.items()
        for name, each in pads.items()
    ]


def _sets(pad: Morphology, contact: Contact, sensed_mm: Sensed, seed: int) -> PressSets:
    """Presses with the signals of a pad under noise, the same draws for every pad of as many fibres."""
    rng = np.random.default_rng([3, seed])

    def answer(places: Array) -> Array:
        found = signals(pad, places, contact)
        return found + NOISE * np.abs(found).max(axis=0).mean() * rng.standard_normal(found.shape)

    return PressSets.of(pad, SIDE, TEST, seed, answer, sensed_mm)
