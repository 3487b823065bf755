"""Files of a solid: STL, 3MF and STEP, the same bytes for the same solid."""

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from design.errors import InputError

if TYPE_CHECKING:
    from build123d import Solid

_EPOCH = "2000-01-01T00:00:00"
"""The time written into STEP files, which must carry one."""


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


def write_3mf(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Write a 3MF, mm: vertices (n, 3), triangles (m, 3) vertex numbers; same digits as the STL's floats."""
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
        "3D/3dmodel.model": f'<model unit="millimeter" xmlns="{core}/core/2015/02"><resources>'
        f'<object id="1" type="model"><mesh><vertices>{points}</vertices><triangles>{faces}</triangles></mesh></object>'
        '</resources><build><item objectid="1"/></build></model>',
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in parts.items():
            entry = zipfile.ZipInfo(name)  # a fixed date, unlike what writestr makes of a name
            archive.writestr(entry, declaration + text, zipfile.ZIP_DEFLATED)


def write_step(path: Path, solid: "Solid") -> None:
    """Write a STEP file; its faces are plane, so the curves in face coordinates would only treble its size."""
    from build123d import export_step

    if not export_step(solid, path, write_pcurves=False, timestamp=_EPOCH):
        raise InputError(f"{path}: the CAD kernel could not write it")


def write_utf8(path: Path, text: str) -> None:
    """Write text; line ends as they are, so that the bytes do not depend on the system."""
    path.write_bytes(text.encode("utf-8"))
