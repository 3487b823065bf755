"""Building a mould and writing its files: meshes, CAD, drawings, G-code, laying page and fabrication document.

The same inputs give the same bytes. Everything is built and checked before the first file is written, and the files
appear together or not at all. Nothing is written for a body that is not a closed solid; other failed checks are only
reported. A new export format needs a writer and a line in `FORMATS`; one for CAD also the checks of "step" in `build`.
"""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.common import files, profiling
from padforge.common.validation import InputError, check_path, check_type, short_repr
from padforge.design.morphology import Morphology
from padforge.fabricate.checks import Finding, check_result
from padforge.fabricate.checks.mesh_checks import SOLID_CHECKS, check_solid, check_triangles
from padforge.fabricate.checks.plan_checks import check_plan
from padforge.fabricate.checks.surface import TriangleMesh
from padforge.fabricate.fibre_placement import Step, check_toolpath, gcode, plan_toolpath
from padforge.fabricate.materials import PLASTICS
from padforge.fabricate.mesh import build_mesh, mesh_arrays, write_3mf, write_stl
from padforge.fabricate.mould import Body, bed_frame, lid_holes, printed_bodies, sizes
from padforge.fabricate.outputs.drawings import CROSSING_FILE, ORIENTATION_FILE, tracks_dxf, tracks_svg
from padforge.fabricate.outputs.laying_page import laying_document, laying_page, pad_document
from padforge.fabricate.outputs.pictures import draw_crossing, draw_mould, draw_orientation, draw_toolpath, draw_tracks
from padforge.fabricate.plan import Plan
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

if TYPE_CHECKING:
    from manifold3d import Manifold

    from padforge.fabricate.cad.model import CadPart

_log = logging.getLogger(__name__)

FORMAT = "padforge-fabrication/1"


class PrintedBody(NamedTuple):
    """A body to print, with its mesh: vertices (n, 3), mm, in single precision, and triangles (m, 3)."""

    name: str
    body: Body
    mesh: "Manifold"
    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]


@dataclass(frozen=True)
class Fabrication:
    """The contents of a mould's files; toolpath and CAD models are built on first use."""

    plan: Plan  # of the finished pad
    bodies: list[PrintedBody]  # the mould first
    findings: list[Finding]  # results of the checks so far

    @cached_property
    def toolpath(self) -> list[Step]:
        """The toolpath of the fibres, layer by layer."""
        fibre = self.plan.settings.fibre.material
        return plan_toolpath(self.plan, fibre.diameter_mm, fibre.max_strain or math.inf)

    @cached_property
    def cad_parts(self) -> "dict[str, list[CadPart]]":
        """The parts of the CAD models, by the name of the body."""
        from padforge.fabricate.cad.model import build_parts

        with profiling.stage("CAD solids"):
            return build_parts(self.plan, {body.name: body.body for body in self.bodies})


@dataclass(frozen=True, kw_only=True)
class Build:
    """A mould with everything that a lab needs to print it, to cast, and to cut and place fibres.

    Attributes:
        files: names of the exported files.
        size_mm: size of the mould along x, y and z.
        sizes: sizes of tray, cavity and pad, mm.
        mould_volume_ml: volume of plastic.
        silicone_volume_ml: volume of silicone that fills the mould.
        findings: results of all checks.
        silicone: material and amounts to mix.
        adhesive: volume of adhesive that seals the tracks, for each step of laying.
        order: amounts to order, and estimated hours of work.
        fibre: material of the fibres.
        fibres: one entry per fibre, in the order of their numbers.
        laying_order: numbers of the fibres laid in each step.
        crossings: all crossings, with the thickness of silicone between the fibres.
        common_tracks: stretches of tracks over deeper ones.
        exits: fibres along the side of the leads; None unless all leads are on one side.
        frame: frame of the pad on the bed; None without a holder.
        settings: settings that the files depend on.
        provenance: provenance of the files.
        sha256: digests of the files.
    """

    files: list[str]
    size_mm: list[float]
    sizes: dict[str, Any]
    mould_volume_ml: float
    silicone_volume_ml: float
    findings: list[Finding]
    silicone: dict[str, Any]
    adhesive: dict[str, Any]
    order: dict[str, Any]
    fibre: dict[str, Any]
    fibres: list[dict[str, Any]]
    laying_order: list[list[int]]
    crossings: dict[str, Any]
    common_tracks: list[dict[str, Any]]
    exits: list[int] | None = None
    frame: dict[str, Any] | None
    settings: dict[str, Any]
    provenance: dict[str, Any]
    sha256: dict[str, str]

    def to_dict(self) -> dict[str, Any]:
        """Return the fabrication document, as in `fabrication.json`."""
        document = {"format": FORMAT} | {name: value for name, value in vars(self).items() if value is not None}
        return document | {"findings": [finding.to_dict() for finding in self.findings]}


def _write_utf8(path: Path, text: str) -> None:
    path.write_bytes(text.encode("utf-8"))  # `write_text` would convert line ends on Windows


def _write_body_3mf(fabrication: Fabrication, body: PrintedBody, path: Path) -> None:
    layout, (material, _) = fabrication.plan.pad.layout, PLASTICS[fabrication.plan.settings.printer.resin]
    pitches = " and ".join(f"{pitch:g}" for pitch in dict.fromkeys((layout.pitch_x_mm, layout.pitch_y_mm)))
    title = f"{body.name}, for a pad of {layout.horizontals} + {layout.verticals} fibres {pitches} mm apart"
    write_3mf(path, body.vertices, body.triangles, name=body.name, title=title, material=material)


def _draw_mould_png(fabrication: Fabrication, path: Path) -> None:
    mould = fabrication.bodies[0]
    draw_mould(fabrication.plan.shrinkage_compensated, mould.vertices, mould.triangles, fabrication.findings, path)


def _write_cad(fabrication: Fabrication, path: Path) -> None:
    from padforge.fabricate.cad.model import assemble
    from padforge.fabricate.cad.step_file import write_step

    write_step(path, assemble(fabrication.cad_parts, fabrication.plan.shrinkage_compensated))


def _describe_cad(fabrication: Fabrication) -> Finding:
    """Build all CAD solids and return the finding on their deviation from the mesh."""
    from padforge.fabricate.cad.model import MAX_DEVIATION

    parts = [part for parts in fabrication.cad_parts.values() for part in parts]
    deviation = max(part.deviation for part in parts)
    n_solids, fit_um = sum(len(part.shape.solids()) for part in parts), 1000 * max(part.fit_mm for part in parts)
    volumes = f"their volumes within {100 * deviation:.3f} % of the mesh's"
    message = f"{n_solids} solids, {volumes}, curves within {fit_um:g} µm"
    return check_result("cad_solid", True, round(deviation, 6), MAX_DEVIATION, message)


FORMATS: dict[str, Mapping[str, Callable[..., None]]] = {
    "stl": {"*.stl": lambda _, body, path: write_stl(path, body.vertices, body.triangles)},
    "3mf": {"*.3mf": _write_body_3mf},
    "step": {"mould.step": _write_cad},
    # Drawings and pictures show the tray, which is compensated for shrinkage.
    "svg": {"tracks.svg": lambda f, path: _write_utf8(path, tracks_svg(f.plan.shrinkage_compensated))},
    "dxf": {"tracks.dxf": lambda f, path: _write_utf8(path, tracks_dxf(f.plan.shrinkage_compensated))},
    "png": {
        "figures/mould.png": _draw_mould_png,
        "figures/tracks.png": lambda f, path: draw_tracks(f.plan.shrinkage_compensated, path),
    },
    "gcode": {
        "laying.gcode": lambda f, path: _write_utf8(path, gcode(f.plan, f.toolpath)),
        "figures/toolpath.svg": lambda f, path: draw_toolpath(f.plan, f.toolpath, path),
    },
}
"""Writers of files by format and name; arguments: the fabrication, the body if the name has "*", and the path."""


def require_formats(formats: Sequence[str]) -> None:
    """Raise InputError for a format that is not in `FORMATS`."""
    for name in check_type("formats", formats, Sequence):
        if not isinstance(name, str) or name not in FORMATS:
            raise InputError(f"formats: got {short_repr(name)}, allowed are {', '.join(FORMATS)}")


def build(
    pad: Morphology,
    out: str | Path,
    formats: Sequence[str] = ("stl", "step", "svg", "png"),
    settings: FabricationSettings = DEFAULTS,
    inputs: Sequence[Path] = (),
) -> Build:
    """Build the mould of a pad, and the further bodies of the settings, and write their files.

    Files of an earlier mould in `out` that are not overwritten are deleted, unless they have changed since.

    Args:
        pad: morphology of the pad.
        out: folder for the files; created if missing.
        formats: formats, of `FORMATS`, to write besides `fabrication.json` and `laying.md`.
        settings: tray, ridges, printer, fibre, rules and dispenser.
        inputs: input files, for the provenance.

    Returns:
        The contents of `fabrication.json`.

    Raises:
        InputError: a format is unknown, an input is not a file, settings contradict each other or do not allow this
            pad, a body is not a closed solid, or files cannot be written; `out` is unchanged then.
    """
    out = check_path("out", out)
    require_formats(formats)
    inputs = [files.check_file(check_path("inputs", path)) for path in check_type("inputs", inputs, Sequence)]
    packages = ("shapely", "manifold3d", "trimesh", *(["build123d"] if "step" in formats else []))
    origin = files.provenance("fabricate", inputs=inputs, packages=packages)  # before inputs can change
    profiling.add_count("formats", len(set(formats)), len(FORMATS))
    with profiling.stage("mesh"):
        plan = Plan(pad, settings)
        plan.require_levels()
        meshes = [(name, body, build_mesh(body)) for name, body in printed_bodies(plan).items()]
        bodies = [PrintedBody(name, body, mesh, *mesh_arrays(mesh)) for name, body, mesh in meshes]
    with profiling.stage("checks"):
        fabrication = Fabrication(plan, bodies, _check_bodies(plan, bodies))
    writers = _choose_writers(fabrication, formats)
    with profiling.stage("checks"):
        if "figures/toolpath.svg" in writers:
            fabrication.findings.extend(check_toolpath(plan, fabrication.toolpath))
        if "mould.step" in writers:
            fabrication.findings.append(_describe_cad(fabrication))
    result = _compile_build(fabrication, list(writers), origin)
    writers[ORIENTATION_FILE] = partial(draw_orientation, plan)
    if plan.crossings:
        writers[CROSSING_FILE] = partial(draw_crossing, plan)
    writers["laying.md"] = partial(_write_utf8, text=laying_page(result.to_dict()))
    return _write_files(out, writers, result)


def _check_bodies(plan: Plan, bodies: Sequence[PrintedBody]) -> list[Finding]:
    """Check the mould; raise InputError if a body is not a closed solid."""
    mould, *others = bodies
    by_body = [check_triangles(mould.vertices, mould.triangles, plan.settings.printer, genus=0, has_plan=True)]
    for body in others:
        genus = lid_holes(plan) if body.name == "lid" else 0
        by_body.append(check_solid(TriangleMesh.weld(body.vertices, body.triangles), genus))
    for body, findings in zip(bodies, by_body, strict=True):
        if broken := [f.message for f in findings if f.name in SOLID_CHECKS and f.status == "fail"]:
            raise InputError(f"{body.name}: not a closed solid ({'; '.join(broken)}); nothing was written")
    return by_body[0] + check_plan(plan)


def _choose_writers(fabrication: Fabrication, formats: Sequence[str]) -> dict[str, Callable[[Path], None]]:
    """Return the writers by the name of the file, those of the bodies first."""
    chosen = [item for name, writers in FORMATS.items() if name in formats for item in writers.items()]
    by_body = {
        name.replace("*", body.name): partial(write, fabrication, body)
        for body, (name, write) in product(fabrication.bodies, chosen)
        if "*" in name
    }
    return by_body | {name: partial(write, fabrication) for name, write in chosen if "*" not in name}


def _compile_build(fabrication: Fabrication, names: list[str], origin: Mapping[str, Any]) -> Build:
    """Return the fabrication document, without the digests of its files."""
    plan, settings, mould = fabrication.plan, fabrication.plan.settings, fabrication.bodies[0]
    rim = settings.mould.floor_mm + plan.shrinkage_compensated.silicone_mm
    pins_mm3 = mould.mesh.trim_by_plane((0, 0, 1), rim).volume()
    laying = laying_document(plan, mould.mesh.volume() - pins_mm3)
    return Build(
        files=names,
        size_mm=[round(side, 6) for side in np.ptp(mould.vertices.astype(float), axis=0).tolist()],
        sizes=sizes(plan),
        mould_volume_ml=round(mould.mesh.volume() / 1000, 4),
        silicone_volume_ml=laying["silicone"]["volume_ml"],
        findings=fabrication.findings,
        **laying,
        frame=bed_frame(plan) if settings.mould.holder else None,
        settings={
            "pitch_mm": plan.pad.pitch_mm,
            "mould": settings.mould.model_dump(),
            "printer": settings.printer.model_dump(),
            "pad": pad_document(plan),
            "rules": settings.rules.model_dump(include={"min_mean_bend_radius_mm"}),
            "silicone": settings.silicone.model_dump(mode="json"),
            "fibre": settings.fibre.model_dump(),
            **({"dispenser": settings.dispenser.model_dump(mode="json")} if "figures/toolpath.svg" in names else {}),
        },
        provenance=dict(origin),
        sha256={},
    )


def _write_files(out: Path, writers: Mapping[str, Callable[[Path], None]], result: Build) -> Build:
    """Write the files of a mould and their digests atomically, and delete those of an earlier mould."""
    try:
        earlier = files.read_json(out / "fabrication.json", FORMAT).get("sha256", {})
    except InputError:
        earlier = {}
    deleted = files.find_unchanged(out, earlier) - writers.keys()
    with files.atomic_files(out, without=deleted) as folder:
        for name, write in writers.items():
            with profiling.stage(f"write {name}"), files.reraise_write_error(out / name):
                (folder / name).parent.mkdir(exist_ok=True)
                write(folder / name)
        result = replace(result, sha256={name: files.sha256(folder / name) for name in writers})
        files.write_json(folder / "fabrication.json", result.to_dict())
    for name in sorted(deleted):
        _log.info("%s: deleted, it belonged to the previous mould", out / name)
    for name in sorted(earlier.keys() - writers.keys()):
        if files.is_local(name) and (out / name).exists():
            _log.warning("%s: kept, it belongs to the previous mould but was changed since", out / name)
    return result
