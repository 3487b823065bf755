"""A mould on a page: its mesh, packed small enough to stand in it, and the view that one can turn."""

import base64
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.page import read_resource
from padforge.fabricate.mesh_files import read_mesh

from .fibre_layers import COLOURS, FAMILIES

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
    return read_resource("padforge.fabricate.report", "mould_view.js")


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
        colour = COLOURS[FAMILIES.index(fibre["fibre"].split()[0])]
        found[float(fibre["ridge_mm"])] = [part / 255 for part in bytes.fromhex(colour[1:])]
    return [[floor_mm + ridge_mm, *colour] for ridge_mm, colour in sorted(found.items())][:_MOST_LEVELS]


def _base64(values: NDArray[Any]) -> str:
    return base64.b64encode(values.tobytes()).decode()
