"""Triangle meshes of bodies by manifold3d, and their files: STL and 3MF, the same bytes for the same mesh."""

import logging
import re
import zipfile
from collections.abc import Iterable
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from manifold3d import CrossSection, Manifold, OpType
from numpy.typing import NDArray

from padforge.common.files import check_file
from padforge.common.validation import InputError, check_path
from padforge.design.morphology import Array
from padforge.fabricate.mould import BODY_COLOURS, Body, Prism, mould_body
from padforge.fabricate.plan import Plan, polygon_rings

Numbers = NDArray[np.int64]
_log = logging.getLogger(__name__)

_STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_TITLE_BYTES = 1000  # an STL that is text has its first facet within these
_STL_HEAD_BYTES = 84  # header of a binary STL, and its number of triangles
SEPARATION_MM = 1e-4  # by which coincident vertices are separated: far below what prints, far above float resolution


def build_mesh(body: Body) -> Manifold:
    """Build the mesh of a body, mm."""
    solid = _unite(body.base)
    if body.cuts:
        solid -= _unite(body.cuts)
    return Manifold.batch_boolean([solid, *map(_extrude, body.adds)], OpType.Add)


def mould_mesh(plan: Plan) -> Manifold:
    """Build the mesh of the mould of a plan, mm."""
    return build_mesh(mould_body(plan))


def _unite(prisms: Iterable[Prism]) -> Manifold:
    return Manifold.batch_boolean([*map(_extrude, prisms)], OpType.Add)


def _extrude(prism: Prism) -> Manifold:
    rings = [ring for polygon in polygon_rings(prism.area) for ring in polygon]
    height = prism.top_mm - prism.bottom_mm
    if not prism.flare_mm:
        return Manifold.extrude(CrossSection(rings), height).translate((0, 0, prism.bottom_mm))
    low, high = np.reshape(prism.area.bounds, (2, 2))
    (x, y), (scale_x, scale_y) = ((low + high) / 2).tolist(), (1 + 2 * prism.flare_mm / (high - low)).tolist()
    section = CrossSection([ring - (x, y) for ring in rings])
    return Manifold.extrude(section, height, scale_top=(scale_x, scale_y)).translate((x, y, prism.bottom_mm))


def mesh_arrays(solid: Manifold) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return vertices (n, 3), mm, in single precision, and triangles (m, 3) of vertex indices.

    No two vertices are equal: where the solid touches itself in a point or a vertical line, by chance or by rounding,
    vertices are moved inwards by `SEPARATION_MM`, so that a reader that merges equal vertices gets a manifold.
    """
    mesh = solid.to_mesh()
    vertices, triangles = np.array(mesh.vert_properties), np.asarray(mesh.tri_verts)
    distance = SEPARATION_MM
    while len(touching := _duplicates(vertices)):
        vertices[touching] -= (distance * _vertex_normals(vertices, triangles)[touching]).astype(np.float32)
        distance *= 1.5
    return vertices, triangles


def _duplicates(vertices: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the indices of the vertices that equal another one."""
    _, inverse, count = np.unique(vertices, axis=0, return_inverse=True, return_counts=True)
    return np.flatnonzero(count[inverse.ravel()] > 1)


def _vertex_normals(vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Sum the unit normals (n, 3) of the triangles around every vertex."""
    normals, faces = np.zeros((len(vertices), 3)), unit_normals(vertices[triangles].astype(np.float64))
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], faces)
    return normals


def unit_normals(corners: np.ndarray) -> np.ndarray:
    """Compute the unit normals (m, 3) of triangles (m, 3, 3); 0 for degenerate ones."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)


def write_stl(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Write a binary STL, mm: vertices (n, 3), triangles (m, 3) of vertex indices."""
    corners = vertices[triangles].astype("<f4")
    records = np.zeros(len(corners), _STL_RECORD)
    records["normal"] = unit_normals(corners)
    records["corners"] = corners
    path.write_bytes(b"padforge, mm".ljust(80) + np.uint32(len(records)).astype("<u4").tobytes() + records.tobytes())


def write_3mf(path: Path, vertices: np.ndarray, triangles: np.ndarray, *, name: str, title: str, material: str) -> None:
    """Write a 3MF, mm, of one object: vertices (n, 3), with the precision of an STL, and triangles (m, 3).

    `name` is the name of the body, whose colour `BODY_COLOURS` states; `title` is for people.
    """
    points = "".join(f'<vertex x="{x:.9g}" y="{y:.9g}" z="{z:.9g}"/>' for x, y, z in vertices.tolist())
    faces = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in triangles.tolist())
    package = "http://schemas.openxmlformats.org/package/2006"
    core = "http://schemas.microsoft.com/3dmanufacturing"
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Id="model" Target="/3D/3dmodel.model" Type="{core}/2013/01/3dmodel"/></Relationships>',
        "3D/3dmodel.model": f'<model unit="millimeter" xml:lang="en" xmlns="{core}/core/2015/02">'
        f'<metadata name="Title">{escape(title)}</metadata>'
        f'<metadata name="Application">padforge {version("padforge")}</metadata><resources>'
        f'<basematerials id="1"><base name={quoteattr(material)} displaycolor="{BODY_COLOURS[name]}"/></basematerials>'
        f'<object id="2" type="model" name={quoteattr(name)} pid="1" pindex="0">'
        f"<mesh><vertices>{points}</vertices><triangles>{faces}</triangles></mesh></object>"
        '</resources><build><item objectid="2"/></build></model>',
    }
    content = BytesIO()
    archive = zipfile.ZipFile(content, "w")  # without `with`, whose exit would raise ValueError after Ctrl-C
    for part, text in parts.items():
        entry = zipfile.ZipInfo(part)  # has a fixed date
        archive.writestr(entry, '<?xml version="1.0" encoding="UTF-8"?>\n' + text, zipfile.ZIP_DEFLATED)
    archive.close()
    path.write_bytes(content.getvalue())


def read_mesh(path: Path) -> tuple[Array, Numbers]:
    """Read vertices (n, 3), mm, and triangles (m, 3), m > 0, of a .stl, in mm, or of all printed objects of a .3mf."""
    import trimesh

    path = check_file(check_path("path", path))
    kind = path.suffix[1:].lower()
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # its errors are raised as well
    try:
        with np.errstate(all="ignore"):
            content = {"stl": _repair_stl, "3mf": _remove_unprinted}.get(kind, Path.read_bytes)(path)
            scene = trimesh.load_scene(BytesIO(content), file_type=kind, process=False)  # keeps triangles with NaN
            mesh = (scene.convert_units("millimeters") if scene.units else scene).to_mesh()
        vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # broken files can raise any exception
        is_missing = isinstance(error, KeyError)
        reason = f"{error} is missing" if is_missing else " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not a readable mesh ({reason})") from error
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(f"{path}: no readable triangles, or the file is incomplete")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: vertices hold NaN or infinity")
    return vertices, triangles


def _repair_stl(path: Path) -> bytes:
    """Return an STL without small defects that slicers ignore but trimesh refuses; log a warning about each."""
    content = path.read_bytes()
    text = content.lower()
    if text.startswith(b"solid") and b"facet" in text[:_STL_TITLE_BYTES]:
        end = text.rfind(b"endfacet") + len(b"endfacet")
        if b"endsolid" not in text[end:]:
            _log.warning("%s: its end is missing, all facets before it are read", path)
            content = content[:end] + b"\nendsolid\n"
        with_points, n_commas = re.subn(rb"(?<=\d),(?=\d)", b".", content)
        if n_commas:
            _log.warning("%s: commas in %d numbers are read as decimal points", path, n_commas)
        return with_points
    n_stated = int.from_bytes(content[80:_STL_HEAD_BYTES], "little")
    n_whole, n_stray = divmod(len(content) - _STL_HEAD_BYTES, _STL_RECORD.itemsize)
    # A file that holds half of the stated number or less is incomplete, or no STL: other text states half a billion.
    if n_stated < 2 * n_whole and (n_whole, n_stray) != (n_stated, 0):
        _log.warning("%s: states %d triangles, holds %d and %d stray bytes", path, n_stated, n_whole, n_stray)
        content = content[:80] + n_whole.to_bytes(4, "little") + content[_STL_HEAD_BYTES : len(content) - n_stray]
    return content


def _is_printed(part: ElementTree.Element) -> bool:
    """Return whether a slicer prints an object or a build item of a 3MF; True for other elements."""
    if part.tag.endswith("}object"):
        return part.get("type", "model") == "model"
    return not (part.tag.endswith("}item") and part.get("printable", "1") in ("0", "false"))


def _remove_unprinted(path: Path) -> bytes:
    """Return a 3MF without objects that slicers do not print, such as supports, which trimesh would read."""
    content, count = BytesIO(), 0
    with zipfile.ZipFile(path) as package, zipfile.ZipFile(content, "w") as printed:
        for name in package.namelist():
            data = package.read(name)
            if name.lower().endswith(".model"):
                model = ElementTree.fromstring(data)
                unprinted = [(node, child) for node in model for child in node if not _is_printed(child)]
                for node, child in unprinted:
                    node.remove(child)
                count += len(unprinted)
                data = ElementTree.tostring(model) if unprinted else data
            printed.writestr(name, data)
    if count:
        _log.warning("%s: %d objects that are not printed are left out", path, count)
    return content.getvalue()
