"""Making a mould and writing it: mesh, CAD, drawings and the fabrication document, each file atomically.

The same inputs give the same bytes. Everything is built and checked before the first file is written.
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from design.curves import lengths
from design.errors import InputError
from design.files import atomic, provenance, write_json, write_text
from design.morphology import Morphology

from .drawings import FAMILIES, draw_mould, tracks_svg
from .findings import Finding
from .mould import build_mould
from .outlines import Plan
from .printability import planned, unsound
from .settings import DEFAULTS, Settings

if TYPE_CHECKING:
    from build123d import Solid

FORMAT = "padforge-fabrication/1"
FILES = {"stl": "mould.stl", "3mf": "mould.3mf", "step": "mould.step", "svg": "tracks.svg", "png": "mould.png"}
"""Every format and the file it becomes."""

_EPOCH = "2000-01-01T00:00:00"
"""The time written into STEP files, which must carry one."""

_VOLUME_RATIO = 1e-3
"""How far the volumes of mesh and solid, made in two ways, may lie apart."""


def build(
    pad: Morphology,
    out: str | Path,
    formats: Sequence[str] = ("stl", "step", "svg", "png"),
    settings: Settings = DEFAULTS,
    inputs: Sequence[Path] = (),
) -> dict[str, Any]:
    """Make the mould of a pad and write it.

    Args:
        pad: the fibres.
        out: folder that takes the files; made if missing.
        formats: which of `FILES` to write; `fabrication.json` always is.
        settings: tray, ridges, printer, fibre and rules.
        inputs: files the work came from, for the provenance.

    Returns:
        The fabrication document, as written to `fabrication.json`.

    Raises:
        InputError: an unknown format, settings that contradict each other, or a mould that is no closed solid;
            nothing has been written then.
    """
    out = Path(out)
    unknown = [name for name in formats if name not in FILES]
    if unknown:
        raise InputError(f"formats: got {unknown[0]!r}, allowed are {', '.join(FILES)}")
    plan, vertices, triangles, findings = planned(pad, settings)
    if broken := [finding.message for finding in unsound(findings)]:
        raise InputError(f"mould: no closed solid ({'; '.join(broken)}); nothing was written")
    volume = next(finding.measured for finding in findings if finding.name == "volume")
    assert isinstance(volume, float)
    solid = build_mould(pad, settings) if "step" in formats else None
    if solid is not None and abs(solid.volume - volume) > _VOLUME_RATIO * volume:
        raise InputError(f"mould: the solid has {solid.volume:.1f} mm³, its mesh {volume:.1f}; nothing was written")
    document = _document(plan, findings, volume, [name for name in FILES if name in formats], inputs)

    if "stl" in formats:
        write_stl(out / FILES["stl"], vertices, triangles)
    if "3mf" in formats:
        write_3mf(out / FILES["3mf"], vertices, triangles)
    if solid is not None:
        _write_step(out / FILES["step"], solid)
    if "svg" in formats:
        write_text(out / FILES["svg"], tracks_svg(plan))
    if "png" in formats:
        with atomic(out / FILES["png"]) as temporary:
            draw_mould(plan, findings, temporary)
    write_json(out / "fabrication.json", document)
    return document


def write_stl(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    """Write a binary STL, mm: vertices (n, 3), triangles (m, 3) vertex numbers."""
    corners = vertices[triangles].astype("<f4")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    records = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["normal"] = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    records["corners"] = corners
    with atomic(path) as temporary:
        header = b"padforge mould, mm".ljust(80)
        temporary.write_bytes(header + np.uint32(len(records)).astype("<u4").tobytes() + records.tobytes())


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
    with atomic(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, text in parts.items():
            entry = zipfile.ZipInfo(name)  # a fixed date, unlike what writestr makes of a name
            archive.writestr(entry, declaration + text, zipfile.ZIP_DEFLATED)


def _write_step(path: Path, solid: "Solid") -> None:
    """Write a STEP file; its faces are plane, so the curves in face coordinates would only treble its size."""
    from build123d import export_step

    with atomic(path) as temporary:
        if not export_step(solid, temporary, write_pcurves=False, timestamp=_EPOCH):
            raise InputError(f"{path}: the CAD kernel could not write it")


def _document(
    plan: Plan, findings: Sequence[Finding], volume_mm3: float, formats: Sequence[str], inputs: Sequence[Path]
) -> dict[str, Any]:
    """The fabrication document; what a lab needs to print, cast, cut and lay."""
    settings, mould = plan.settings, plan.settings.mould
    names = [f"{family} {number}" for family in FAMILIES for number in range(1, plan.pad.grid + 1)]
    courses = lengths(plan.pad) * plan.pad.pitch_mm + 2 * mould.border_mm
    height = mould.floor_mm + mould.silicone_mm
    packages = ("shapely", "manifold3d", "trimesh", *(["build123d"] if "step" in formats else []))
    return {
        "format": FORMAT,
        "files": [FILES[name] for name in formats],
        "size_mm": [*(2 * [round(2 * plan.tray.bounds[2], 6)]), height],
        "mould_volume_ml": round(volume_mm3 / 1000, 4),
        "silicone_volume_ml": round((plan.tray.area * height - volume_mm3) / 1000, 4),
        "findings": [finding.document() for finding in findings],
        "fibres": [
            {"fibre": name, "in_pad_mm": round(course, 2), "cut_mm": round(course + 2 * mould.lead_mm, 2)}
            for name, course in zip(names, courses.tolist(), strict=True)
        ],
        "crossings": {
            "total": len(plan.crossings),
            "same_family": sum(map(plan.same_family, plan.crossings)),
            "table": [
                [names[c.first], names[c.second], *np.round(plan.pad.to_mm(c.place), 3).tolist()]
                for c in plan.crossings
            ],
        },
        "settings": {
            "pitch_mm": plan.pad.pitch_mm,
            "mould": mould.model_dump(),
            "printer": settings.printer.model_dump(),
            "pad": settings.pad.model_dump(include={"fibre_diameter_mm", "deep_family"}),
            "rules": settings.rules.model_dump(include={"same_family_crossings"}),
        },
        "provenance": provenance("fabricate", inputs=inputs, packages=packages),
    }
