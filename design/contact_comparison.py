"""What simulated errors owe to the contact believed: computed into a file, told in a line and in the report."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.design.common.files import provenance, write_json
from padforge.design.common.page import PageSection, paragraph, table
from padforge.design.common.profiling import stage
from padforge.design.common.validation import check_int
from padforge.design.contact import relative_stretch
from padforge.design.morphology import Array, Morphology
from padforge.design.networks import FailureError, PressSets, fresh_presses, training_presses
from padforge.design.objectives.expected_error import straight_full_scale
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.design.paths.keep_outs import is_outside
from padforge.design.settings import MEASURED_PROFILE, PUBLISHED_CONTACT, Contact, PadSettings, Scatter, SearchSettings

if TYPE_CHECKING:
    from padforge.design.common.settings import Spec

WIDTHS = (5.0, 6.2, 7.9)
"""Standard deviations of the reaches, about Gaussian, that a press may have, mm; that of MEASURED_PROFILE second."""
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
    errors: tuple[FailureError, ...]


def contacts_in_question(believed: Contact) -> dict[str, Contact]:
    """The contact believed and others that a pad may really meet, by what they are called; none twice."""
    spread = [(width, tuple((width / WIDTHS[1] * d, weight) for d, weight in MEASURED_PROFILE)) for width in WIDTHS]
    others = {f"reach of {width:g} mm": Contact(sensitivity_profile=reach) for width, reach in spread}
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
    seed = check_int("seed", seed, 0, 2**64 - 1)
    fibres = size.layout.fibres
    losses = [failure_subsets(fibres, lost, subsets) for lost in range(min(LOST, fibres - 1) + 1)]
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
        return found * scatter.sample_gains(found.shape, rng) + scatter.floor * rng.standard_normal(found.shape)

    learned, fresh = (
        positions[is_outside(positions, size)]
        for positions in (training_presses(size.sensed, SIDE, seed), fresh_presses(size.sensed, TEST, seed))
    )
    return PressSets(learned, responses(learned), fresh, responses(fresh), seed)


FORMAT, NAME = "padforge-contacts/1", "contacts.json"


def contact_of(spec: "Spec", settings: SearchSettings) -> Contact:
    """What is designed for: the contact that `spec` states, or the usual one of such a search."""
    return spec.section(Contact) if spec.stated(Contact) else settings.default_contact


def compare_contacts(spec: "Spec", pad: Morphology, out: Path, seed: int | None = None) -> dict[str, Any]:
    """Errors of a pad and of straight fibres under the contact of `spec` and others, into `contacts.json` in `out`.

    Args:
        seed: that of `[search]` if None.

    Returns:
        The document: rows of contact, pad and mean errors in mm with 0, 1, ... fibres lost.
    """

    settings = spec.section(SearchSettings, seed=seed)
    size = spec.section(PadSettings, **pad.layout.settings)
    believed = contact_of(spec, settings)
    with stage("contacts"):
        asked = contacts_in_question(believed), size, settings.response_scatter, settings.seed
        found = errors_by_contact(beside_straight(pad), *asked)
    rows = [
        {"contact": each.contact, "pad": each.pad, "errors_mm": [pad.unit_mm * error.mean for error in each.errors]}
        for each in found
    ]
    made_by = provenance("padforge run", settings.seed, [out / "morphology.json"], packages=("torch",))
    document = {"format": FORMAT, "scatter": settings.response_scatter._asdict(), "rows": rows, "provenance": made_by}
    write_json(out / NAME, document)
    return document


def contact_line(document: Mapping[str, Any]) -> str:
    """The errors with all fibres as believed, and the worst of them under another contact."""
    told = []
    for pad in ("designed", "straight"):
        believed, *others = [row["errors_mm"][0] for row in document["rows"] if row["pad"] == pad]
        told.append(f"{believed:.2f} mm as believed, {min(others):.2f} to {max(others):.2f} mm otherwise")
    return f"contact: a small network on one reading of each fibre errs by {told[0]}; of straight ones by {told[1]}"


def contact_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """How the simulated errors in a `contacts.json` depend on the contact believed.

    Raises:
        KeyError, TypeError, ValueError: the document is not as padforge writes it.
    """
    rows, scatter = document["rows"], document["scatter"]
    most = max(len(row["errors_mm"]) for row in rows)
    return [
        PageSection(
            "The contact believed",
            [
                paragraph(
                    "What a press does to a fibre is believed, not known, until a printed pad is identified. Here the"
                    " pad, and straight fibres of the same pad, are simulated under other contacts as well: mean error"
                    " in mm of a small network, trained afresh under each on one reading of each"
                    f" fibre that scatters by {float(scatter['share']):.0%} of itself and {float(scatter['floor']):.1%}"
                    " of full scale. Where rows differ, simulated errors tell of the contact as much as of the pad;"
                    " where straight fibres are ahead, optimising has not paid there."
                ),
                table(
                    ["contact", "fibres", *(f"{lost} lost" for lost in range(most))],
                    [[row["contact"], row["pad"], *(f"{error:.2f}" for error in row["errors_mm"])] for row in rows],
                ),
            ],
        )
    ]
