"""Triangle meshes of bodies by manifold3d, and their files: STL and 3MF, the same bytes for the same mesh."""

import logging
import zipfile
from collections.abc import Iterable
from functools import cache
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from manifold3d import CrossSection, Manifold, OpType
from numpy.typing import NDArray

from padforge.design.common.files import check_file
from padforge.design.common.validation import InputError
from padforge.design.common.validation import check_path as as_path
from padforge.design.morphology import Array
from padforge.fabricate.mould import COLOURS, Body, Prism, mould_body
from padforge.fabricate.plan import Plan, polygon_rings

APART_MM = 1e-4
"""How far vertices that coincide by chance are moved apart: far below what prints, far above a float's step."""


def build_mesh(body: Body) -> Manifold:
    """The mesh of a body, mm."""
    solid = _joined(body.base)
    if body.cuts:
        solid -= _joined(body.cuts)
    return Manifold.batch_boolean([solid, *map(_prism, body.adds)], OpType.Add)


def mould_mesh(plan: Plan) -> Manifold:
    """Build the mesh of the mould of a plan, mm."""
    return build_mesh(mould_body(plan))


def mesh_arrays(solid: Manifold) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Vertices (n, 3) mm, in the precision of an STL, and triangles (m, 3) vertex numbers.

    No two vertices are equal. Where the solid touches itself in a point or an upright line, which happens by chance
    among thousands of dense outlines, or in that precision, its corners are drawn back by `APART_MM`: whoever joins
    equal vertices when reading the file still finds two faces at every edge.
    """
    parts = solid.to_mesh()
    vertices, triangles = np.array(parts.vert_properties), np.asarray(parts.tri_verts)
    away = APART_MM
    while len(touching := _not_unique(vertices)):
        vertices[touching] -= (away * _normals(vertices, triangles)[touching]).astype(np.float32)
        away *= 1.5
    return vertices, triangles


def _not_unique(vertices: NDArray[np.float32]) -> NDArray[np.intp]:
    """Numbers of the vertices that equal another one."""
    _, which, count = np.unique(vertices, axis=0, return_inverse=True, return_counts=True)
    return np.flatnonzero(count[which.ravel()] > 1)


def _normals(vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> NDArray[np.float64]:
    """(n, 3) outward direction at every vertex: the sum of the normals of its triangles."""
    corners = vertices[triangles].astype(np.float64)
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), np.finfo(float).tiny)
    normals = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], faces)
    return normals


def _joined(prisms: Iterable[Prism]) -> Manifold:
    return Manifold.batch_boolean([*map(_prism, prisms)], OpType.Add)


def _prism(prism: Prism) -> Manifold:
    rings = [ring for polygon in polygon_rings(prism.area) for ring in polygon]
    height = prism.top_mm - prism.bottom_mm
    if not prism.flare_mm:
        return Manifold.extrude(CrossSection(rings), height).translate((0, 0, prism.bottom_mm))
    low, high = np.reshape(prism.area.bounds, (2, 2))
    middle, grown = (low + high) / 2, 1 + 2 * prism.flare_mm / (high - low)
    rings = [ring - middle for ring in rings]
    solid = Manifold.extrude(CrossSection(rings), height, scale_top=(float(grown[0]), float(grown[1])))
    return solid.translate((float(middle[0]), float(middle[1]), prism.bottom_mm))


Numbers = NDArray[np.int64]

MAX_COORDINATE_MM = 1e6
"""Greatest coordinate of a vertex, by amount."""
MAX_BYTES = 2**27
"""Unpacked; a model of a million triangles takes half of it."""
MAX_COPIES = 1000
"""Objects that are built, each counted as often as it is used."""
MAX_DEPTH = 16
"""Objects within objects within objects."""


def write_stl(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Write a binary STL, mm: vertices (n, 3), triangles (m, 3) vertex numbers."""
    corners = vertices[triangles].astype("<f4")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    records = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    records["corners"] = corners
    header = b"padforge, mm".ljust(80)
    path.write_bytes(header + np.uint32(len(records)).astype("<u4").tobytes() + records.tobytes())


def write_3mf(path: Path, vertices: np.ndarray, triangles: np.ndarray, *, name: str, title: str, material: str) -> None:
    """Write a 3MF, mm, as slicers take it: one object by its name, of one material in the colour of the body.

    Args:
        vertices: (n, 3); same digits as the STL's floats.
        triangles: (m, 3) vertex numbers.
        name: of the body, one of `COLOURS`.
        title: of the file, for people.
        material: what to print it in.
    """
    points = "".join(f'<vertex x="{x:.9g}" y="{y:.9g}" z="{z:.9g}"/>' for x, y, z in vertices.tolist())
    faces = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in triangles.tolist())
    package = "http://schemas.openxmlformats.org/package/2006"
    core = "http://schemas.microsoft.com/3dmanufacturing"
    declaration = '<?xml version="1.0" encoding="UTF-8"?>\n'
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Id="model" Target="/3D/3dmodel.model" Type="{core}/2013/01/3dmodel"/></Relationships>',
        "3D/3dmodel.model": f'<model unit="millimeter" xml:lang="en" xmlns="{core}/core/2015/02">'
        f'<metadata name="Title">{escape(title)}</metadata>'
        f'<metadata name="Application">padforge {version("padforge")}</metadata><resources>'
        f'<basematerials id="1"><base name={quoteattr(material)} displaycolor="{COLOURS[name]}"/></basematerials>'
        f'<object id="2" type="model" name={quoteattr(name)} pid="1" pindex="0">'
        f"<mesh><vertices>{points}</vertices><triangles>{faces}</triangles></mesh></object>"
        '</resources><build><item objectid="2"/></build></model>',
    }
    content = BytesIO()
    archive = zipfile.ZipFile(content, "w")  # nothing closes it after a Ctrl-C, of which that would make an error
    for part, text in parts.items():
        entry = zipfile.ZipInfo(part)  # a fixed date, unlike what writestr makes of a name
        archive.writestr(entry, declaration + text, zipfile.ZIP_DEFLATED)
    archive.close()
    path.write_bytes(content.getvalue())


def write_utf8(path: Path, text: str) -> None:
    """Write text; line ends as they are, so that the bytes do not depend on the system."""
    path.write_bytes(text.encode("utf-8"))


def read_mesh(path: Path) -> tuple[Array, Numbers]:
    """Vertices (n, 3) mm and triangles (m, 3), m > 0, of a mesh file (.stl, .3mf), all objects of a 3MF together.

    Args:
        path: an STL counts as mm; a 3MF says its unit.

    Raises:
        InputError: the file is missing or holds no triangles.
    """
    import trimesh

    path = check_file(as_path("path", path))
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # what it says on top of raising
    try:
        if path.suffix.lower() == ".3mf":
            check_3mf_size(path)
        with np.errstate(all="ignore"):
            scene = trimesh.load_scene(path, process=False)  # which would drop triangles with NaN
            if scene.units:
                scene = scene.convert_units("millimeters")
            mesh = scene.to_mesh()
        vertices, triangles = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # readers of broken files raise whatever comes
        missing = isinstance(error, KeyError)
        reason = f"{error} is missing in it" if missing else " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not a mesh that can be read ({reason})") from error
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(f"{path}: holds no triangles that can be read, or is torn")
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > MAX_COORDINATE_MM:
        raise InputError(f"{path}: vertices hold NaN, infinity or more than {MAX_COORDINATE_MM:g}")
    return vertices, triangles


def check_3mf_size(path: Path) -> None:
    """Refuse a 3MF that unpacks to too much, or whose objects are made of too many objects, or of themselves.

    Raises:
        ValueError: says what there is too much of. zipfile.BadZipFile, expat.ExpatError: no such file.
    """
    built: list[str] = []
    parts: dict[str, list[str]] = {}
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            raise ValueError(f"it unpacks to {size} bytes, allowed are {MAX_BYTES}")
        for name in archive.namelist():
            if name.lower().endswith(".model"):
                _read_parts(archive.read(name), built, parts)

    @cache
    def copies(name: str, depth: int) -> int:
        if depth > MAX_DEPTH:
            raise ValueError(f"its objects are made of others more than {MAX_DEPTH} deep, or of themselves")
        return 1 + sum(copies(part, depth + 1) for part in parts.get(name, []))

    count = sum(copies(name, 0) for name in built)
    if count > MAX_COPIES:
        raise ValueError(f"it is built of {count} objects, allowed are {MAX_COPIES}")


def _read_parts(content: bytes, built: list[str], parts: dict[str, list[str]]) -> None:
    """Add the objects that a model builds, and those that each of its objects is made of."""
    within = ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal within
        match tag.rpartition(":")[2]:
            case "object":
                within = attributes.get("id", "")
            case "component":
                parts.setdefault(within, []).append(attributes.get("objectid", ""))
            case "item":
                built.append(attributes.get("objectid", ""))

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.Parse(content, True)
