"""What a report has to say of a mould, and of the making of a pad with it."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from padforge.design.common.files import find_unchanged
from padforge.design.common.page import PageSection, collapsible, figures, heading, paragraph, render_markdown, table
from padforge.design.common.validation import InputError

from .laying import orientation
from .laying.guide import laying_page
from .mould_view import packed, script, view

_SHOWN = ("mould.stl", "mould.png", "tracks.png", "dispensing.svg", orientation.FILE)
_SHOWN_PLACES = 3


def fabrication_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """The mould of a `fabrication.json` in `folder` with what the checks found, and how to make the pad with it.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: the mesh or a picture that was written with it is another one now.
    """
    shown = _written_with(folder, document)
    return [_mould(folder, shown, document), _bench(folder, shown, document)]


def _mould(folder: Path, shown: Collection[str], document: Mapping[str, Any]) -> PageSection:
    """The mould to be turned, its pictures, and the checks."""
    solid = folder / "mould.stl"
    mesh = packed(solid) if solid.name in shown else None
    findings = document["findings"]
    size = " x ".join(f"{round(side, 2):g}" for side in document["size_mm"])
    passed = [finding for finding in findings if finding["status"] == "pass"]
    remarks = sorted((each for each in findings if each["status"] != "pass"), key=lambda each: each["status"])
    large = f"{solid.name} is too large to be turned on this page, also when made coarser; the pictures show it."
    captions = {
        "mould.png": f"The mould from above, {size} mm: colour tells family and height.",
        "tracks.png": "The fibres as they lie in the mould; the deeper one interrupts the other.",
        "dispensing.svg": "The ways of a needle that lays the fibres, the pad turned over.",
    }
    return PageSection(
        "Mould",
        [
            *([view(mesh, document)] if mesh else [paragraph(large)] if solid.name in shown else []),
            figures([(folder / name, caption) for name, caption in captions.items() if name in shown]),
            heading("Printability"),
            paragraph(f"{len(passed)} of {len(findings)} checks pass."),
            *([_checks(remarks)] if remarks else []),
            *([collapsible("Checks that pass", [_checks(passed)])] if passed else []),
        ],
        [
            (f"{len(passed)} / {len(findings)}", "mould checks pass"),
            (f"{document['silicone_volume_ml']:.1f} ml", "silicone to cast"),
        ],
        script() if mesh else "",
    )


def _written_with(folder: Path, document: Mapping[str, Any]) -> set[str]:
    """Names of the mesh and the pictures in a folder that were written with its fabrication document.

    Raises:
        InputError: one of them is another one now.
    """
    digests = {name: document["sha256"][name] for name in _SHOWN if name in document["sha256"]}
    own = find_unchanged(folder, digests)
    for name in digests.keys() - own:
        if (folder / name).exists():
            raise InputError(f"{folder / name}: is not the one fabrication.json was written with; fabricate again")
    return own


def _bench(folder: Path, shown: Collection[str], document: Mapping[str, Any]) -> PageSection:
    """How to make the pad, as `laying.md` has it: what to print and to mix, lengths to cut, the order of laying."""
    guide, _, _ = laying_page(document).partition("\n## Checks\n")  # which the mould's section has in full
    before, _, after = guide.partition(orientation.LINK)
    drawing = [figures([(folder / orientation.FILE, orientation.CAPTION)])] if orientation.FILE in shown else []
    return PageSection("Making the pad", [*render_markdown(before), *drawing, *render_markdown(after)])


def _checks(findings: Sequence[Mapping[str, Any]]) -> str:
    """Findings as a table, with their first places if they have any."""
    rows = [[each["name"].replace("_", " "), each["status"], each["message"], _places(each)] for each in findings]
    columns = 4 if any(row[-1] for row in rows) else 3
    return table(["check", "verdict", "finding", "where (mm)"][:columns], [row[:columns] for row in rows])


def _places(finding: Mapping[str, Any]) -> str:
    places = [f"({x:.1f}, {y:.1f})" for x, y in finding["places_mm"]]
    more = f" and {len(places) - _SHOWN_PLACES} more" if len(places) > _SHOWN_PLACES else ""
    return " ".join(places[:_SHOWN_PLACES]) + more
