"""What simulated errors owe to the contact believed: computed into a file, told in a line and in the report."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from padforge.design.common.files import provenance, write_json
from padforge.design.common.page.elements import PageSection, paragraph, table
from padforge.design.common.profiling import stage
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import Contact, PadSettings, SearchSettings

if TYPE_CHECKING:
    from padforge.design.common.settings import Spec

FORMAT, NAME = "padforge-contacts/1", "contacts.json"


def contact_of(spec: "Spec", settings: SearchSettings) -> Contact:
    """What is designed for: the contact that `spec` states, or the usual one of such a search."""
    return spec.section(Contact) if spec.given(Contact) else settings.usual_contact


def compare_contacts(spec: "Spec", pad: Morphology, out: Path, seed: int | None = None) -> dict[str, Any]:
    """Errors of a pad and of straight fibres under the contact of `spec` and others, into `contacts.json` in `out`.

    Args:
        seed: that of `[search]` if None.

    Returns:
        The document: rows of contact, pad and mean errors in mm with 0, 1, ... fibres lost.
    """
    from padforge.design.evaluation.contacts_believed import beside_straight, contacts_in_question, errors_by_contact

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
