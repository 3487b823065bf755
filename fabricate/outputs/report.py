"""Sections of a report on a mould, with a view of it in three dimensions, and on making the pad with it."""

import base64
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.common import page
from padforge.common.files import find_unchanged
from padforge.common.plotting import FAMILY_COLOURS
from padforge.common.validation import InputError
from padforge.design.settings import FAMILIES
from padforge.fabricate.mesh import read_mesh
from padforge.fabricate.outputs import drawings
from padforge.fabricate.outputs.laying_page import laying_page

MAX_BYTES = 3_000_000  # maximum size of a packed mesh; base64 makes 4 MB of it, half of the maximum of a page
_STEPS = np.iinfo(np.uint16).max  # steps of a coordinate along a side of the bounding box
_TOLERANCES_MM = (0.01, 0.02, 0.05, 0.1, 0.2)  # tried in order for a large mesh; the last is half a common nozzle
_CAPTIONS = {
    "figures/mould.png": "The mould from above, {size} mm: colour stands for family and height.{mirrored}",
    "figures/tracks.png": "The fibres in the tray of the mould, from above, with numbers at their starts; where two"
    " cross, the line of the deeper one is whole.",
    "figures/toolpath.svg": "The toolpath of a needle that lays the fibres, the pad turned over.",
}
_SHOWN = ("mould.stl", *_CAPTIONS, drawings.ORIENTATION_FILE, drawings.CROSSING_FILE)
_MAX_POSITIONS = 3  # positions of a finding in a table
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
class PackedMesh:
    """A mesh in the form that a page embeds."""

    low_mm: NDArray[np.float64]  # corner of the box around it; shape (3,)
    size_mm: NDArray[np.float64]  # sides of the box; shape (3,)
    vertices: NDArray[np.uint16]  # positions in the box, 0 to 65535 along each side; shape (n, 3)
    triangles: NDArray[np.uint16] | NDArray[np.uint32]  # vertex indices, of two bytes if these suffice; shape (m, 3)
    tolerance_mm: float  # tolerance to which it was simplified; 0 if it was not

    @property
    def nbytes(self) -> int:
        return self.vertices.nbytes + self.triangles.nbytes


def pack_mesh(path: Path) -> PackedMesh | None:
    """Pack the mesh of a file into `MAX_BYTES`, simplified as far as necessary; None if that does not suffice."""
    corners, triangles = read_mesh(path)
    # An STL repeats the corners that triangles share.
    vertices, indices = np.unique(corners, axis=0, return_inverse=True)
    triangles = indices.ravel()[triangles]
    packed = _pack(vertices, triangles, 0.0)
    if packed.nbytes <= MAX_BYTES:
        return packed

    from manifold3d import Error, Manifold, Mesh

    solid = Manifold(Mesh(vertices.astype(np.float32), triangles.astype(np.uint32)))
    for tolerance_mm in _TOLERANCES_MM if solid.status() == Error.NoError else ():  # a closed mesh only
        mesh = solid.simplify(tolerance_mm).to_mesh()
        packed = _pack(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), tolerance_mm)
        if packed.nbytes <= MAX_BYTES:
            return packed
    return None


def _pack(vertices: NDArray[np.floating], triangles: NDArray[np.integer], tolerance_mm: float) -> PackedMesh:
    low, size = vertices.min(axis=0).astype(np.float64), np.ptp(vertices, axis=0).astype(np.float64)
    steps = np.rint((vertices - low) / np.where(size > 0, size, 1.0) * _STEPS).astype("<u2")
    indices = triangles.astype("<u2" if len(vertices) <= _STEPS + 1 else "<u4")
    return PackedMesh(low, size, steps, indices, tolerance_mm)


def _draw_view(mesh: PackedMesh, document: Mapping[str, Any]) -> str:
    """Return the HTML of the view, which is visible only in a browser that can draw it."""
    size = " x ".join(f"{side:.4g}" for side in mesh.size_mm)
    simplified = f" Simplified to {mesh.tolerance_mm:g} mm, to limit the size of the page." if mesh.tolerance_mm else ""
    caption = f"The mould, {size} mm. {_colour_key(document)}{simplified} {_HELP}"
    label = (
        f"The mould in three dimensions, {size} mm. Arrow keys turn it, with Shift they move it; plus and minus zoom;"
        " 0 resets."
    )
    # Tops of the ridges of every layer: height, and red, green and blue of the family's colour, 0 to 1
    floor_mm = float(mesh.low_mm[2]) + float(document["settings"]["mould"]["floor_mm"])
    tops = {}
    for fibre in document["fibres"]:
        colour = FAMILY_COLOURS[FAMILIES.index(fibre["fibre"].split()[0])]
        tops[float(fibre["ridge_mm"])] = [part / 255 for part in bytes.fromhex(colour[1:])]
    data = {
        "low": mesh.low_mm.tolist(),
        "size": mesh.size_mm.tolist(),
        "tops": [[floor_mm + ridge_mm, *colour] for ridge_mm, colour in sorted(tops.items())],
        "wide": mesh.triangles.itemsize == 4,
        "vertices": base64.b64encode(mesh.vertices.tobytes()).decode(),
        "triangles": base64.b64encode(mesh.triangles.tobytes()).decode(),
    }
    return _VIEW.format(label=escape(label), caption=escape(caption), mesh=json.dumps(data, allow_nan=False))


def _colour_key(document: Mapping[str, Any]) -> str:
    """Return a sentence that explains the colours."""
    shallow = document["fibres"][-1 if document["settings"]["pad"]["deep_family"] == FAMILIES[0] else 0]
    numbers = " and the numbers" if document["settings"]["mould"]["number_mm"] else ""
    families = {fibre["fibre"].split()[0] for fibre in document["fibres"]}
    if len(families) == 1:
        return f"Tops of ridges{numbers} are {'blue' if FAMILIES[0] in families else 'orange'}."
    first, second = (numbers if shallow["fibre"].startswith(family) else "" for family in FAMILIES)
    return f"Tops of {FAMILIES[0]} ridges{first} are blue, of {FAMILIES[1]} ones{second} orange."


def fabrication_sections(folder: Path, document: Mapping[str, Any]) -> list[page.PageSection]:
    """Build the sections on a mould with its checks, and on making the pad with it.

    Args:
        folder: folder of the fabrication's files.
        document: contents of `fabrication.json`.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: the mesh or a picture has changed since it was written with the document.
    """
    digests = {name: document["sha256"][name] for name in _SHOWN if name in document["sha256"]}
    unchanged = find_unchanged(folder, digests)
    for name in digests:
        if name not in unchanged and (folder / name).exists():
            raise InputError(f"{folder / name}: is not the one fabrication.json was written with; fabricate again")
    return [_mould_section(folder, unchanged, document), _bench_section(folder, unchanged, document)]


def _mould_section(folder: Path, names: Collection[str], document: Mapping[str, Any]) -> page.PageSection:
    """Build the section of the view of the mould, its pictures and checks; `names` are the files to show."""
    solid = folder / "mould.stl"
    mesh = pack_mesh(solid) if solid.name in names else None
    findings = document["findings"]
    width, height = np.broadcast_to(document["sizes"]["pad_mm"], 2)
    size = " x ".join(f"{round(side, 2):g}" for side in document["size_mm"])
    passed = [finding for finding in findings if finding["status"] == "pass"]
    remarks = sorted((f for f in findings if f["status"] != "pass"), key=lambda finding: finding["status"])
    large = f"{solid.name} is too large to be turned on this page, also if simplified; the pictures show it."
    mirrored = f" {drawings.MIRRORED}" if document["settings"]["mould"]["number_mm"] else ""
    captions = {name: caption.format(size=size, mirrored=mirrored) for name, caption in _CAPTIONS.items()}
    return page.PageSection(
        "Mould",
        [
            *([_draw_view(mesh, document)] if mesh else [page.paragraph(large)] if solid.name in names else []),
            page.figures([(folder / name, caption) for name, caption in captions.items() if name in names]),
            page.heading("Printability"),
            page.paragraph(f"{len(passed)} of {len(findings)} checks passed."),
            *([_findings_table(remarks)] if remarks else []),
            *([page.collapsible("Checks that pass", [_findings_table(passed)])] if passed else []),
        ],
        [
            (f"{width:.5g} x {height:.5g} mm", "pad, as it is cast"),
            (f"{len(passed)} / {len(findings)}", "mould checks passed"),
            (f"{document['silicone_volume_ml']:.1f} ml", "silicone to cast"),
        ],
        page.read_resource("padforge.fabricate.outputs", "mould_view.js") if mesh else "",
    )


def _bench_section(folder: Path, names: Collection[str], document: Mapping[str, Any]) -> page.PageSection:
    """Build the section of `laying.md`, with the drawings in place of their links."""
    guide, _, _ = laying_page(document).partition("\n## Checks\n")  # the mould's section has the full checks
    body = []
    for link, name, caption in (
        (drawings.ORIENTATION_LINK, drawings.ORIENTATION_FILE, drawings.ORIENTATION_CAPTION),
        (drawings.CROSSING_LINK, drawings.CROSSING_FILE, drawings.CROSSING_CAPTION),
    ):
        before, _, guide = guide.partition(link)
        body += [*page.render_markdown(before), *([page.figures([(folder / name, caption)])] if name in names else [])]
    return page.PageSection("Making the pad", [*body, *page.render_markdown(guide)])


def _findings_table(findings: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of findings with up to `_MAX_POSITIONS` of their positions."""
    rows = []
    for finding in findings:
        positions = [f"({x:z.1f}, {y:z.1f})" for x, y in finding["positions_mm"]]
        more = f" and {len(positions) - _MAX_POSITIONS} more" if len(positions) > _MAX_POSITIONS else ""
        name, where = finding["name"].replace("_", " "), " ".join(positions[:_MAX_POSITIONS]) + more
        rows.append([name, finding["status"], finding["message"], where])
    columns = 4 if any(row[-1] for row in rows) else 3
    return page.table(["check", "result", "finding", "where (mm)"][:columns], [row[:columns] for row in rows])
