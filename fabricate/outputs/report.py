"""What a report has to say of a mould, and of the making of a pad with it."""

import base64
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import find_unchanged
from padforge.design.common.page import (
    PageSection,
    collapsible,
    figures,
    heading,
    paragraph,
    read_resource,
    render_markdown,
    table,
)
from padforge.design.common.validation import InputError
from padforge.fabricate.mesh import read_mesh
from padforge.fabricate.outputs.drawings import ORIENTATION_CAPTION as ORIENTATION_CAPTION
from padforge.fabricate.outputs.drawings import ORIENTATION_FILE as ORIENTATION_FILE
from padforge.fabricate.outputs.drawings import ORIENTATION_LINK as ORIENTATION_LINK
from padforge.fabricate.outputs.laying_page import laying_page
from padforge.fabricate.plan import FAMILIES, FAMILY_COLOURS

MOST_BYTES = 3_000_000
"""A packed mesh takes no more: base64 makes 4 MB of it, half of what a page may have."""
_STEPS = np.iinfo(np.uint16).max
"""Places along a side of the box around a mesh."""
_TOLERANCES_MM = (0.01, 0.02, 0.05, 0.1, 0.2)
"""How far a mesh that is too large may be off, one after the other; the last is half of a common nozzle."""
_MOST_LEVELS = 64
"""So many heights get a colour: graphics chips have room for few numbers that all pixels share."""
_VIEW = """\
<figure class="view" id="mould-view" hidden>
<canvas tabindex="0" role="application" aria-label="{label}"></canvas>
<div class="tools">
<button type="button" data-do="out" aria-label="Zoom out">&minus;</button>
<button type="button" data-do="in" aria-label="Zoom in">+</button>
<button type="button" data-do="above">From above</button>
<button type="button" data-do="reset">Reset</button>
</div>
<figcaption>{caption}</figcaption>
</figure>
<script type="application/json" id="mould-mesh">{mesh}</script>"""

_HELP = (
    "Drag to turn it, with Shift or two fingers to move it; pinch, or click and turn the wheel, to zoom. Keys: arrows,"
    " + and -, 0 to reset."
)


@dataclass(frozen=True)
class Packed:
    """A mesh as a page holds it.

    Attributes:
        low_mm, size_mm: (3,) corner and sides of the box around it.
        vertices: (n, 3) places in the box, 0 to 65535 along each side.
        triangles: (m, 3) vertex numbers, of two bytes where they fit, else of four.
        tolerance_mm: how far it may be off for having been made coarser; 0 if it was not.
    """

    low_mm: NDArray[np.float64]
    size_mm: NDArray[np.float64]
    vertices: NDArray[np.uint16]
    triangles: NDArray[np.uint16] | NDArray[np.uint32]
    tolerance_mm: float

    @property
    def nbytes(self) -> int:
        """How many bytes it takes."""
        return self.vertices.nbytes + self.triangles.nbytes


def packed(path: Path, most_bytes: int = MOST_BYTES) -> Packed | None:
    """The mesh of a file in at most so many bytes, made coarser as far as that takes; None where that does not do.

    Raises:
        InputError: the file is missing, or holds no mesh.
    """
    corners, triangles = read_mesh(path)
    # An STL lists the corners of each triangle anew.
    vertices, numbers = np.unique(corners, axis=0, return_inverse=True)
    triangles = numbers.ravel()[triangles]
    mesh = _packed(vertices, triangles, 0.0)
    if mesh.nbytes > most_bytes:
        coarser = (_packed(*each) for each in _coarser(vertices, triangles))
        return next((each for each in coarser if each.nbytes <= most_bytes), None)
    return mesh


def view(mesh: Packed, document: Mapping[str, Any]) -> str:
    """The view, for a page that has `script`; it is seen only where a browser can draw it.

    Args:
        document: that of the fabrication, whose fibres and floor say which heights get which colour.

    Raises:
        KeyError, TypeError, ValueError: the document is not as padforge writes it.
    """
    size = " x ".join(f"{side:.4g}" for side in mesh.size_mm)
    coarser = f" Drawn to {mesh.tolerance_mm:g} mm, to be light enough." if mesh.tolerance_mm else ""
    caption = f"The mould, {size} mm. {_colours(document)}{coarser} {_HELP}"
    label = (
        f"The mould in three dimensions, {size} mm. Arrow keys turn it, with Shift they move it; plus and minus zoom;"
        " 0 resets."
    )
    data = {
        "low": mesh.low_mm.tolist(),
        "size": mesh.size_mm.tolist(),
        "tops": _tops(document, float(mesh.low_mm[2])),
        "wide": mesh.triangles.itemsize == 4,
        "vertices": _base64(mesh.vertices),
        "triangles": _base64(mesh.triangles),
    }
    return _VIEW.format(label=escape(label), caption=escape(caption), mesh=json.dumps(data, allow_nan=False))


def script() -> str:
    """JavaScript that draws the view of a page and turns it."""
    return read_resource("padforge.fabricate.outputs", "mould_view.js")


def _packed(vertices: NDArray[np.floating], triangles: NDArray[np.integer], tolerance_mm: float) -> Packed:
    low, size = vertices.min(axis=0).astype(np.float64), np.ptp(vertices, axis=0).astype(np.float64)
    steps = np.rint((vertices - low) / np.where(size > 0, size, 1.0) * _STEPS).astype("<u2")
    numbers = triangles.astype("<u2" if len(vertices) <= _STEPS + 1 else "<u4")
    return Packed(low, size, steps, numbers, tolerance_mm)


def _coarser(
    vertices: NDArray[np.float64], triangles: NDArray[np.integer]
) -> Iterator[tuple[NDArray[np.floating], NDArray[np.integer], float]]:
    """The same mesh with ever fewer triangles, and how far each is off, mm; none of a mesh that is not closed."""
    from manifold3d import Error, Manifold, Mesh

    solid = Manifold(Mesh(vertices.astype(np.float32), triangles.astype(np.uint32)))
    for tolerance_mm in _TOLERANCES_MM if solid.status() == Error.NoError else ():
        mesh = solid.simplify(tolerance_mm).to_mesh()
        yield np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), tolerance_mm


def _colours(document: Mapping[str, Any]) -> str:
    """A sentence that says what the colours mean."""
    shallow = document["fibres"][-1 if document["settings"]["pad"]["deep_family"] == FAMILIES[0] else 0]
    numbers = " and the numbers" if document["settings"]["mould"]["number_mm"] else ""
    first, second = (numbers if shallow["fibre"].startswith(family) else "" for family in FAMILIES)
    there = {fibre["fibre"].split()[0] for fibre in document["fibres"]}
    if len(there) == 1:
        return f"Tops of ridges{numbers} are {'blue' if FAMILIES[0] in there else 'orange'}."
    return f"Tops of {FAMILIES[0]} ridges{first} are blue, of {FAMILIES[1]} ones{second} orange."


def _tops(document: Mapping[str, Any], ground_mm: float) -> list[list[float]]:
    """Height of the ridges of every level, mm, and its family's colour: red, green and blue from 0 to 1."""
    floor_mm = ground_mm + float(document["settings"]["mould"]["floor_mm"])
    found = {}
    for fibre in document["fibres"]:
        colour = FAMILY_COLOURS[FAMILIES.index(fibre["fibre"].split()[0])]
        found[float(fibre["ridge_mm"])] = [part / 255 for part in bytes.fromhex(colour[1:])]
    return [[floor_mm + ridge_mm, *colour] for ridge_mm, colour in sorted(found.items())][:_MOST_LEVELS]


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(values.tobytes()).decode()


_SHOWN = ("mould.stl", "mould.png", "tracks.png", "toolpath.svg", ORIENTATION_FILE)
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
        "toolpath.svg": "The ways of a needle that lays the fibres, the pad turned over.",
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
    before, _, after = guide.partition(ORIENTATION_LINK)
    drawing = [figures([(folder / ORIENTATION_FILE, ORIENTATION_CAPTION)])] if ORIENTATION_FILE in shown else []
    return PageSection("Making the pad", [*render_markdown(before), *drawing, *render_markdown(after)])


def _checks(findings: Sequence[Mapping[str, Any]]) -> str:
    """Findings as a table, with their first places if they have any."""
    rows = [[each["name"].replace("_", " "), each["status"], each["message"], _places(each)] for each in findings]
    columns = 4 if any(row[-1] for row in rows) else 3
    return table(["check", "verdict", "finding", "where (mm)"][:columns], [row[:columns] for row in rows])


def _places(finding: Mapping[str, Any]) -> str:
    places = [f"({x:.1f}, {y:.1f})" for x, y in finding["positions_mm"]]
    more = f" and {len(places) - _SHOWN_PLACES} more" if len(places) > _SHOWN_PLACES else ""
    return " ".join(places[:_SHOWN_PLACES]) + more
