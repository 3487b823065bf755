"""Sensitivity of simulated errors to the contact model: what becomes of them if the real contact is another one.

A small network is trained afresh under every contact, as a calibration is. The result is `contacts.json`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.design.common.files import provenance, write_json
from padforge.design.common.profiling import stage
from padforge.design.contact import relative_stretch
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.expected_error import scatter_of_full_scale, straight_full_scale
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.design.settings import (
    MEASURED_PROFILE,
    MEASURED_STD_MM,
    PUBLISHED_CONTACT,
    Contact,
    PadSettings,
    Scatter,
    SearchSettings,
    read_contact,
)

if TYPE_CHECKING:
    from padforge.design.common.settings import Spec
    from padforge.design.networks import SimulatedPresses

FORMAT, NAME = "padforge-contacts/1", "contacts.json"
PROFILE_STD_MM = (5.0, MEASURED_STD_MM, 7.9)  # of the sensitivity profiles, about Gaussian, that are tried
SIDE, N_TEST = 32, 500  # training presses a side, test presses
HIDDEN = 20  # neurons: the 50 published ones overfit the scatter, and err a tenth more in more time
MAX_FAILURES, SUBSETS = 3, 4  # failed fibres, and sets of a size: pads that differ by a tenth are told apart


@dataclass(frozen=True)
class ContactErrors:
    """Mean errors of a small network for one pad under one contact."""

    contact: str  # name of the contact
    pad: str  # name of the pad
    errors_mm: tuple[float, ...]  # mean error with 0, 1, ... fibres failed


def alternative_contacts(assumed: Contact) -> dict[str, Contact]:
    """Return the assumed contact, first, and others that a pad may really meet, by name; none twice.

    Beside a layer they are presses by a tool half as large or half as deep, and fibres that answer to being pressed
    flat alone; beside another contact narrower and wider profiles, and the published disc.
    """
    if assumed.model == "layer":
        tool_mm, depth_mm = assumed.tool_radius_mm / 2, assumed.depth_mm / 2
        changes: dict[str, dict[str, float]] = {
            f"tool of {tool_mm:g} mm": {"tool_radius_mm": tool_mm},
            f"{depth_mm:g} mm deep": {"depth_mm": depth_mm},
            "pressed flat alone": {"squeeze": 1.0, "stretch": 0.0},
        }
        others = {name: Contact(**assumed.model_dump() | change) for name, change in changes.items()}
    else:
        others = {
            f"profile of {std:g} mm": Contact(
                sensitivity_profile=tuple((std / MEASURED_STD_MM * d, weight) for d, weight in MEASURED_PROFILE)
            )
            for std in PROFILE_STD_MM
        }
        others["published disc, K = 0.6"] = PUBLISHED_CONTACT
    return {"as assumed": assumed} | {name: other for name, other in others.items() if other != assumed}


def errors_by_contact(
    pads: Mapping[str, Morphology],
    contacts: Mapping[str, Contact],
    size: PadSettings,
    scatter: Scatter,
    seed: int = 0,
    subsets: int = SUBSETS,
) -> list[ContactErrors]:
    """Compute mean errors of a small network for pads of one layout under every contact, contact by contact.

    At most `subsets` sets of failed fibres of each size are tried.
    """
    fibres = size.layout.fibres
    failures = [failure_subsets(fibres, number, subsets) for number in range(min(MAX_FAILURES, fibres - 1) + 1)]
    rows = []
    for (contact_name, contact), (pad_name, pad) in product(contacts.items(), pads.items()):
        errors = _simulate(pad, contact, size, scatter, seed).failure_errors(failures, HIDDEN)
        rows.append(ContactErrors(contact_name, pad_name, tuple(pad.unit_mm * error.mean for error in errors)))
    return rows


def beside_straight(pad: Morphology) -> dict[str, Morphology]:
    """Return a pad, "designed", and straight fibres of its layout, by name."""
    return {"designed": pad, "straight": Morphology.straight(pad.layout)}


def _simulate(pad: Morphology, contact: Contact, size: PadSettings, scatter: Scatter, seed: int) -> "SimulatedPresses":
    """Simulate presses with scattered responses, by the same draws for every pad of as many fibres."""
    from padforge.design.networks import SimulatedPresses  # imports torch, which a search does without

    rng = np.random.default_rng([3, seed])
    scale = straight_full_scale(pad.layout, contact, size.sensed_mm)
    scatter = scatter_of_full_scale(scatter, contact, scale)

    def respond(positions: Array) -> Array:
        return scatter.sample(relative_stretch(pad, positions, contact) / scale, rng)

    return SimulatedPresses.simulate(pad, SIDE, N_TEST, seed, respond, size)


def design_contact(spec: "Spec", settings: SearchSettings) -> Contact:
    """Return the contact designed for: the one that `spec` states, or the default of such a search."""
    is_default = settings.method == "genetic" and not spec.stated(Contact)
    return settings.default_contact if is_default else read_contact(spec)


def compare_contacts(spec: "Spec", pad: Morphology, out: Path, seed: int | None = None) -> dict[str, Any]:
    """Write and return the errors of a pad and of straight fibres under the contact of `spec` and others."""
    settings = spec.section(SearchSettings, seed=seed)
    size = spec.section(PadSettings, **pad.layout.settings)
    contacts = alternative_contacts(design_contact(spec, settings))
    with stage("contacts"):
        errors = errors_by_contact(beside_straight(pad), contacts, size, settings.response_scatter, seed=settings.seed)
    document = {
        "format": FORMAT,
        "scatter": settings.response_scatter._asdict(),
        "rows": [{"contact": row.contact, "pad": row.pad, "errors_mm": list(row.errors_mm)} for row in errors],
        "provenance": provenance("padforge run", settings.seed, [out / "morphology.json"], packages=("torch",)),
    }
    write_json(out / NAME, document)
    return document
