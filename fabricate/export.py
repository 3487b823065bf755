"""Making a mould and writing it: meshes, CAD, drawings, the fabrication document and the page for the bench.

The same inputs give the same bytes. Everything is built and checked before the first file is written, and the files
appear together or not at all.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common import profiling
from padforge.design.common.files import (
    atomic_files,
    check_file,
    find_unchanged,
    provenance,
    read_json,
    reraise_write_error,
    sha256,
    write_json,
)
from padforge.design.common.validation import InputError, check_path, check_type, short_repr
from padforge.design.morphology import Morphology
from padforge.fabricate.checks import Finding, check_result
from padforge.fabricate.checks.mesh_checks import SOLID_CHECKS, check_solid, check_triangles
from padforge.fabricate.checks.plan_checks import check_plan
from padforge.fabricate.checks.surface import TriangleMesh
from padforge.fabricate.fibre_placement.gcode import gcode
from padforge.fabricate.fibre_placement.toolpath import check_course, instructions, laying_steps, summary_lines
from padforge.fabricate.fibre_placement.urscript import urscript
from padforge.fabricate.materials import PLASTICS
from padforge.fabricate.mesh import write_3mf, write_stl, write_utf8
from padforge.fabricate.mould import (
    Body,
    bed_frame,
    conductive_body,
    conductive_plan,
    holder_body,
    lid_body,
    lid_holes,
    mould_body,
    sizes,
)
from padforge.fabricate.outputs.drawings import ORIENTATION_FILE as ORIENTATION_FILE
from padforge.fabricate.outputs.drawings import orientation_svg, toolpath_svg, tracks_dxf, tracks_svg
from padforge.fabricate.outputs.laying_page import laying_document as laying_document
from padforge.fabricate.outputs.laying_page import laying_page
from padforge.fabricate.outputs.laying_page import pad_document as pad_document
from padforge.fabricate.outputs.pictures import draw_mould, draw_tracks
from padforge.fabricate.plan import Plan
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

if TYPE_CHECKING:
    from manifold3d import Manifold

LANGUAGES = {"gcode": ("laying.gcode", gcode), "urscript": ("laying.script", urscript)}
"""The file of each language, and what writes it."""


@dataclass(frozen=True)
class FibrePlacement:
    """Texts by the names of their files, programs first, and findings; both empty where no language is asked for."""

    texts: dict[str, str]
    findings: list[Finding]


def place_fibres(plan: Plan, languages: Collection[str]) -> FibrePlacement:
    """The programs in the `LANGUAGES` wanted, with a picture of the ways; other names are for others to read."""
    wanted = [name for name in LANGUAGES if name in languages]
    if not wanted:
        return FibrePlacement({}, [])
    fibre = plan.settings.fibre.material
    steps = laying_steps(plan, fibre.diameter_mm, fibre.max_strain or math.inf)
    work, summary, dispenser = (
        list(instructions(plan, steps)),
        list(summary_lines(plan, steps)),
        plan.settings.dispenser,
    )
    texts = {name: write(work, summary, dispenser) for name, write in map(LANGUAGES.__getitem__, wanted)}
    return FibrePlacement(texts | {"toolpath.svg": toolpath_svg(plan, steps)}, check_course(plan, steps))


FORMAT = "padforge-fabrication/2"
FORMATS = ("stl", "3mf", "step", "svg", "dxf", "png", *LANGUAGES)

Write = tuple[str, Callable[[Path], None]]
"""A file's name and what writes it to a path."""

_CAD_VOLUME, _CAD_SURFACE, _CAD_TOLERANCE_MM = 5e-4, 5e-3, 0.01
"""How far volume and surface of a CAD solid and of its mesh may lie apart, as shares of them, at what tolerance.

The mesh keeps its tolerance, and where it is coarser it is off by more in proportion: chords cut their arcs' segments
off, and a gap between two walls may be there in one of them and not in the other.
"""


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
    *,
    warn: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Make the mould of a pad and write it, with the lid and the second mould the settings ask for.

    Files of an earlier mould in `out` go, also those that are not written anew; unless somebody has changed them.

    Args:
        pad: the fibres.
        out: folder that takes the files; made if missing.
        formats: which of `FORMATS` to write; `fabrication.json` and `laying.md` always are.
        settings: tray, ridges, printer, fibre, rules and dispenser.
        inputs: files the work came from, for the provenance.
        warn: told in a line what is gone of an earlier mould, and what is left of it.

    Returns:
        The fabrication document, as written to `fabrication.json`; "sha256" has the digests of the other files.

    Raises:
        InputError: an unknown format, an input that is no file, settings that contradict each other or refuse this
            pad, a mould that is no closed solid, or files that cannot be written; `out` is as it was then.
    """
    out = check_path("out", out)
    require_formats(formats)
    packages = ("shapely", "manifold3d", "trimesh", *(["build123d"] if "step" in formats else []))
    made_by = provenance("fabricate", inputs=_require_files(inputs), packages=packages)  # minutes later they may differ
    profiling.add_count("formats", len(set(formats)), len(FORMATS))
    with profiling.stage("mesh"):
        plan = Plan(pad, settings)
        plan.require_levels()
        printed = [_meshed(name, body) for name, body in _bodies(plan)]
    with profiling.stage("checks"):
        findings = _checked(plan, printed)
    by_machine = place_fibres(plan, formats)
    findings += by_machine.findings
    cad = []
    if "step" in formats:
        with profiling.stage("CAD solid"):
            file, finding = _cad(plan, printed)
        cad.append(file)
        findings.append(finding)
    writes = [
        *(write for body in printed for write in _solids(plan, body, formats)),
        *cad,
        *_drawings(plan, findings, formats),
        *((name, partial(write_utf8, text=text)) for name, text in by_machine.texts.items()),
    ]
    document = _document(plan, printed, findings, [name for name, _ in writes], formats, made_by)
    writes += [
        (ORIENTATION_FILE, partial(write_utf8, text=orientation_svg(plan))),
        ("laying.md", partial(write_utf8, text=laying_page(document))),
    ]
    _put_in_place(out, writes, document, warn)
    return document


def require_formats(formats: Sequence[str]) -> None:
    """Raise InputError for a format that is none of `FORMATS`."""
    for name in check_type("formats", formats, Sequence):
        if not isinstance(name, str) or name not in FORMATS:
            raise InputError(f"formats: got {short_repr(name)}, allowed are {', '.join(FORMATS)}")


def _require_files(inputs: Sequence[Path]) -> list[Path]:
    inputs = [check_path("inputs", given) for given in check_type("inputs", inputs, Sequence)]
    for given in inputs:
        check_file(given)
    return inputs


def _put_in_place(out: Path, writes: Sequence[Write], document: dict[str, Any], warn: Callable[[str], None]) -> None:
    """Write the files of a mould and their digests at once, and take those of an earlier one out."""
    names = {name for name, _ in writes}
    earlier = _earlier_files(out)
    gone = find_unchanged(out, earlier) - names
    with atomic_files(out, without=gone) as folder:
        for name, write in writes:
            with profiling.stage(f"write {name}"), reraise_write_error(out / name):
                write(folder / name)
        document["sha256"] = {name: sha256(folder / name) for name, _ in writes}
        write_json(folder / "fabrication.json", document)
    for name in sorted(gone):
        warn(f"{out / name} is gone: it was of the mould before this one")
    for file in sorted(out.iterdir()):
        if file.name in earlier.keys() - names:
            warn(f"{file} is left from the mould before this one: it is not as it was written")


def _earlier_files(out: Path) -> dict[str, str]:
    """The digest of every file that was written with the fabrication document in a folder, if there is one."""
    try:
        digests = read_json(out / "fabrication.json", FORMAT).get("sha256")
    except InputError:
        return {}
    return digests if isinstance(digests, dict) else {}


def _bodies(plan: Plan) -> list[tuple[str, Body]]:
    """What is printed, the mould first: all but the holder larger than the pad by what the silicone shrinks."""
    bodies = [("mould", mould_body(plan.shrinkage_compensated))]
    if plan.settings.mould.lid:
        bodies.append(("lid", lid_body(plan.shrinkage_compensated)))
    if plan.settings.mould.conductive:
        bodies.append(("conductive", conductive_body(conductive_plan(plan).shrinkage_compensated)))
    if plan.settings.mould.holder:
        wide = conductive_plan(plan) if plan.settings.mould.conductive else plan  # so that either pad fits
        bodies.append(("holder", holder_body(wide)))
    return bodies


def _meshed(name: str, body: Body) -> Printed:
    from padforge.fabricate.mesh import build_mesh, mesh_arrays

    solid = build_mesh(body)
    return Printed(name, solid, *mesh_arrays(solid))


def _checked(plan: Plan, printed: Sequence[Printed]) -> list[Finding]:
    findings = check_triangles(printed[0].vertices, printed[0].triangles, plan.settings.printer, genus=0, has_plan=True)
    findings += check_plan(plan)
    _require_sound(printed[0], findings)
    for body in printed[1:]:
        holes = lid_holes(plan) if body.name == "lid" else 0
        _require_sound(body, check_solid(TriangleMesh.weld(body.vertices, body.triangles), holes))
    return findings


def _require_sound(body: Printed, findings: Sequence[Finding]) -> None:
    broken = [f.message for f in findings if f.name in SOLID_CHECKS and f.status == "fail"]
    if broken:
        raise InputError(f"{body.name}: no closed solid ({'; '.join(broken)}); nothing was written")


def _solids(plan: Plan, body: Printed, formats: Sequence[str]) -> Iterator[Write]:
    """The wanted mesh files of a body."""
    if "stl" in formats:
        yield f"{body.name}.stl", partial(write_stl, vertices=body.vertices, triangles=body.triangles)
    if "3mf" in formats:
        layout = plan.pad.layout
        apart = " and ".join(f"{pitch:g}" for pitch in dict.fromkeys((layout.pitch_x_mm, layout.pitch_y_mm)))
        title = f"{body.name}, for a pad of {layout.horizontals} + {layout.verticals} fibres {apart} mm apart"
        material, _ = PLASTICS[plan.settings.printer.resin]
        label = {"name": body.name, "title": title, "material": material}
        yield f"{body.name}.3mf", partial(write_3mf, vertices=body.vertices, triangles=body.triangles, **label)


def _cad(plan: Plan, printed: Sequence[Printed]) -> tuple[Write, Finding]:
    """The STEP file of all bodies, made and judged by their meshes before anything is written.

    Raises:
        InputError: a CAD solid is not valid, or not of its mesh.
    """
    from padforge.fabricate.cad.model import assemble, build_models
    from padforge.fabricate.cad.step_file import write_step

    made = build_models(plan, dict(_bodies(plan)))
    apart = [model.compare(body.mesh) for model, body in zip(made, printed, strict=True)]
    coarse = max(1.0, plan.settings.mould.tolerance_mm / _CAD_TOLERANCE_MM)
    most_volume, most_surface = coarse * _CAD_VOLUME, coarse * _CAD_SURFACE
    for body, (volume, surface) in zip(printed, apart, strict=True):
        if volume > most_volume or surface > most_surface:
            shares = f"volume {100 * volume:.3g} %, surface {100 * surface:.3g} %"
            raise InputError(f"{body.name}: the CAD solid is not of its mesh ({shares} off); nothing was written")
    volume, surface = (max(shares) for shares in zip(*apart, strict=True))
    message = f"volume and surface are within {100 * volume:.3f} % and {100 * surface:.3f} % of the mesh's"
    message += f", curves within {1000 * max(model.fit_mm for model in made):g} µm"
    measured = [round(volume, 6), round(surface, 6)]
    found = check_result("cad_solid", True, measured, [round(most_volume, 6), round(most_surface, 6)], message)
    return ("mould.step", partial(write_step, part=assemble(made, plan.shrinkage_compensated))), found


def _drawings(plan: Plan, findings: Sequence[Finding], formats: Sequence[str]) -> Iterator[Write]:
    plan = plan.shrinkage_compensated  # they show the tray
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
    made_by: Mapping[str, Any],
) -> dict[str, Any]:
    """The fabrication document: all a lab needs to print, cast, cut and lay."""
    settings = plan.settings
    size = [round(side, 6) for side in np.ptp(printed[0].vertices.astype(float), axis=0).tolist()]
    rim = settings.mould.floor_mm + plan.shrinkage_compensated.silicone_mm
    pins = printed[0].mesh.trim_by_plane((0, 0, 1), rim).volume()
    bench = laying_document(plan, printed[0].mesh.volume() - pins)
    return {
        "format": FORMAT,
        "files": list(files),
        "size_mm": size,
        "sizes": sizes(plan),
        "mould_volume_ml": round(printed[0].mesh.volume() / 1000, 4),
        "silicone_volume_ml": bench["silicone"]["volume_ml"],
        "findings": [finding.to_dict() for finding in findings],
        **bench,
        **({"frame": bed_frame(plan)} if settings.mould.holder else {}),
        "settings": {
            "pitch_mm": plan.pad.pitch_mm,
            "mould": settings.mould.model_dump(),
            "printer": settings.printer.model_dump(),
            "pad": pad_document(plan),
            "rules": settings.rules.model_dump(include={"min_bend_radius_mm"}),
            "silicone": settings.silicone.model_dump(mode="json"),
            "fibre": settings.fibre.model_dump(),
            **({"dispenser": settings.dispenser.model_dump(mode="json")} if {*LANGUAGES} & {*formats} else {}),
        },
        "provenance": dict(made_by),
    }
