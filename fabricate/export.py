"""Making a mould and writing it: meshes, CAD, drawings, the fabrication document and the page for the bench.

The same inputs give the same bytes. Everything is built and checked before the first file is written.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from design.common import profiling
from design.common.errors import InputError, instance, path, shown
from design.common.files import atomic, provenance, require_file, write_json, write_text
from design.pad.morphology import Morphology
from fabricate.checks.findings import Finding
from fabricate.checks.mesh_checks import SOUND, sound
from fabricate.checks.plan_checks import inspect
from fabricate.mould.assembly import (
    bed_frame,
    conductive_body,
    conductive_plan,
    holder_body,
    lid_body,
    lid_holes,
    mould_body,
    sizes,
    valid_solid,
)
from fabricate.mould.plan import Plan
from fabricate.mould.prisms import Body
from fabricate.report.laying import guide
from fabricate.report.pictures import draw_mould, draw_tracks
from fabricate.report.track_drawings import tracks_dxf, tracks_svg

from .mesh_files import write_3mf, write_step, write_stl, write_utf8
from .settings import DEFAULTS, FabricationSettings

if TYPE_CHECKING:
    from manifold3d import Manifold

FORMAT = "padforge-fabrication/1"
FORMATS = ("stl", "3mf", "step", "svg", "dxf", "png")

Write = tuple[str, Callable[[Path], None]]
"""A file's name and what writes it to a path."""

_VOLUME_RATIO = 1e-3
"""How far the volumes of mesh and solid may lie apart."""


@dataclass(frozen=True)
class Printed:
    """A body as it is printed: vertices (n, 3) mm in the precision of an STL and triangles (m, 3) vertex numbers."""

    name: str
    mesh: "Manifold"
    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]


def build(
    pad: Morphology,
    out: str | Path,
    formats: Sequence[str] = ("stl", "step", "svg", "png"),
    settings: FabricationSettings = DEFAULTS,
    inputs: Sequence[Path] = (),
) -> dict[str, Any]:
    """Make the mould of a pad and write it, with the lid and the second mould the settings ask for.

    Args:
        pad: the fibres.
        out: folder that takes the files; made if missing.
        formats: which of `FORMATS` to write; `fabrication.json` and `laying.md` always are.
        settings: tray, ridges, printer, fibre and rules.
        inputs: files the work came from, for the provenance.

    Returns:
        The fabrication document, as written to `fabrication.json`.

    Raises:
        InputError: an unknown format, an input that is no file, settings that contradict each other or refuse this
            pad, or a mould that is no closed solid; nothing has been written then.
    """
    out = path("out", out)
    for name in instance("formats", formats, Sequence):
        if not isinstance(name, str) or name not in FORMATS:
            raise InputError(f"formats: got {shown(name)}, allowed are {', '.join(FORMATS)}")
    inputs = [path("inputs", given) for given in instance("inputs", inputs, Sequence)]
    for given in inputs:
        require_file(given)
    profiling.looked_at("formats", len(set(formats)), len(FORMATS))
    with profiling.stage("mesh"):
        plan = Plan(pad, settings)
        plan.require_levels()
        printed = [_meshed(name, body) for name, body in _bodies(plan)]
    with profiling.stage("checks"):
        findings = inspect(plan, printed[0].vertices, printed[0].triangles)
        _require_sound(printed[0], findings)
        for body in printed[1:]:
            holes = lid_holes(plan) if body.name == "lid" else 0
            _require_sound(body, sound(body.vertices, body.triangles, genus=holes))
    writes = [*(write for body in printed for write in _solids(body, formats)), *_drawings(plan, findings, formats)]
    document = _document(plan, printed, findings, [name for name, _ in writes], formats, inputs)
    for name, write in writes:
        with profiling.stage(f"write {name}"), atomic(out / name) as temporary:
            write(temporary)
    write_text(out / "laying.md", guide.laying_page(document))
    write_json(out / "fabrication.json", document)
    return document


def _bodies(plan: Plan) -> list[tuple[str, Body]]:
    """What is printed, the mould first."""
    bodies = [("mould", mould_body(plan))]
    if plan.settings.mould.lid:
        bodies.append(("lid", lid_body(plan)))
    if plan.settings.mould.conductive:
        bodies.append(("conductive", conductive_body(conductive_plan(plan))))
    if plan.settings.mould.holder:
        wide = conductive_plan(plan) if plan.settings.mould.conductive else plan  # so that either pad fits
        bodies.append(("holder", holder_body(wide)))
    return bodies


def _meshed(name: str, body: Body) -> Printed:
    from fabricate.mould.mesh import arrays, mesh

    solid = mesh(body)
    return Printed(name, solid, *arrays(solid))


def _require_sound(body: Printed, findings: Sequence[Finding]) -> None:
    broken = [f.message for f in findings if f.name in SOUND and f.status == "fail"]
    if broken:
        raise InputError(f"{body.name}: no closed solid ({'; '.join(broken)}); nothing was written")


def _solids(body: Printed, formats: Sequence[str]) -> Iterator[Write]:
    """The wanted files of a body; its CAD solid is made and checked here, before anything is written."""
    if "stl" in formats:
        yield f"{body.name}.stl", partial(write_stl, vertices=body.vertices, triangles=body.triangles)
    if "3mf" in formats:
        yield f"{body.name}.3mf", partial(write_3mf, vertices=body.vertices, triangles=body.triangles)
    if "step" in formats:
        with profiling.stage("CAD solid"):
            solid, volume = valid_solid(body.mesh, body.name), body.mesh.volume()
        if abs(solid.volume - volume) > _VOLUME_RATIO * volume:
            raise InputError(f"{body.name}: solid {solid.volume:.1f} mm³, mesh {volume:.1f}; nothing was written")
        yield f"{body.name}.step", partial(write_step, solid=solid)


def _drawings(plan: Plan, findings: Sequence[Finding], formats: Sequence[str]) -> Iterator[Write]:
    if "svg" in formats:
        yield "tracks.svg", partial(write_utf8, text=tracks_svg(plan))
    if "dxf" in formats:
        yield "tracks.dxf", partial(write_utf8, text=tracks_dxf(plan))
    if "png" in formats:
        yield "mould.png", lambda path: draw_mould(plan, findings, path)
        yield "tracks.png", lambda path: draw_tracks(plan, path)


def _document(
    plan: Plan,
    printed: Sequence[Printed],
    findings: Sequence[Finding],
    files: Sequence[str],
    formats: Sequence[str],
    inputs: Sequence[Path],
) -> dict[str, Any]:
    """The fabrication document: all a lab needs to print, cast, cut and lay."""
    settings = plan.settings
    packages = ("shapely", "manifold3d", "trimesh", *(["build123d"] if "step" in formats else []))
    size = [round(side, 6) for side in np.ptp(printed[0].vertices.astype(float), axis=0).tolist()]
    rim = settings.mould.floor_mm + plan.silicone_mm
    pins = printed[0].mesh.trim_by_plane((0, 0, 1), rim).volume()
    bench = guide.document(plan, printed[0].mesh.volume() - pins)
    return {
        "format": FORMAT,
        "files": list(files),
        "size_mm": size,
        "sizes": sizes(plan),
        "mould_volume_ml": round(printed[0].mesh.volume() / 1000, 4),
        "silicone_volume_ml": bench["silicone"]["volume_ml"],
        "findings": [finding.document() for finding in findings],
        **bench,
        **({"frame": bed_frame(plan)} if settings.mould.holder else {}),
        "settings": {
            "pitch_mm": plan.pad.pitch_mm,
            "mould": settings.mould.model_dump(),
            "printer": settings.printer.model_dump(),
            "pad": settings.pad.model_dump(include={"fibre_diameter_mm", "deep_family"}),
            "rules": settings.rules.model_dump(include={"min_bend_radius_mm"}),
        },
        "provenance": provenance("fabricate", inputs=inputs, packages=packages),
    }
