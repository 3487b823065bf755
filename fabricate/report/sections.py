"""What a report has to say of a mould, and of the making of a pad with it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from design.common.page.elements import PageSection, figures, folded, heading, html_pieces, paragraph, table

from .laying.guide import laying_page
from .mould_view import packed, script, view

_SHOWN_PLACES = 3


def fabrication_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """The mould of a `fabrication.json` in `folder` with what the checks found, and how to make the pad with it.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: the mesh or a picture beside it cannot be read.
    """
    return [_mould(folder, document), _bench(document)]


def _mould(folder: Path, document: Mapping[str, Any]) -> PageSection:
    """The mould to be turned, its pictures, and the checks."""
    solid = folder / "mould.stl"
    mesh = packed(solid) if solid.is_file() else None
    findings = document["findings"]
    size = " x ".join(f"{round(side, 2):g}" for side in document["size_mm"])
    passed = [finding for finding in findings if finding["status"] == "pass"]
    remarks = sorted((each for each in findings if each["status"] != "pass"), key=lambda each: each["status"])
    large = f"{solid.name} is too large to be turned on this page, also when made coarser; the pictures show it."
    captions = {
        "mould.png": f"The mould from above, {size} mm: colour tells family and height.",
        "tracks.png": "The fibres as they lie in the mould; the deeper one interrupts the other.",
    }
    return PageSection(
        "Mould",
        [
            *([view(mesh, document)] if mesh else [paragraph(large)] if solid.is_file() else []),
            figures([(folder / name, caption) for name, caption in captions.items()]),
            heading("Printability"),
            paragraph(f"{len(passed)} of {len(findings)} checks pass."),
            *([_checks(remarks)] if remarks else []),
            *([folded("Checks that pass", [_checks(passed)])] if passed else []),
        ],
        [
            (f"{len(passed)} / {len(findings)}", "mould checks pass"),
            (f"{document['silicone_volume_ml']:.1f} ml", "silicone to cast"),
        ],
        script() if mesh else "",
    )


def _bench(document: Mapping[str, Any]) -> PageSection:
    """How to make the pad, as `laying.md` has it: what to print and to mix, lengths to cut, the order of laying."""
    guide, _, _ = laying_page(document).partition("\n## Checks\n")  # which the mould's section has in full
    return PageSection("Making the pad", list(html_pieces(guide)))


def _checks(findings: Sequence[Mapping[str, Any]]) -> str:
    """Findings as a table, with their first places if they have any."""
    rows = [[each["name"].replace("_", " "), each["status"], each["message"], _places(each)] for each in findings]
    columns = 4 if any(row[-1] for row in rows) else 3
    return table(["check", "verdict", "finding", "where (mm)"][:columns], [row[:columns] for row in rows])


def _places(finding: Mapping[str, Any]) -> str:
    places = [f"({x:.1f}, {y:.1f})" for x, y in finding["places_mm"]]
    more = f" and {len(places) - _SHOWN_PLACES} more" if len(places) > _SHOWN_PLACES else ""
    return " ".join(places[:_SHOWN_PLACES]) + more
