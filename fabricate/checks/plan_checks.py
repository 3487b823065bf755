"""Checks on the plan of a mould: whether it can be printed, releases its casting, and fits the fibres."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import ops

from padforge.common.validation import InputError
from padforge.design.morphology import Array, Morphology
from padforge.design.paths.curves import bend_radius, beziers, flatten, slope_beziers, trace_curve
from padforge.design.settings import CAST_SHARE, FAMILIES, contact_designed_for
from padforge.fabricate.checks import Finding, Position, Status, check_result, grade
from padforge.fabricate.checks.mesh_checks import check_triangles
from padforge.fabricate.checks.surface import find_thin_patches
from padforge.fabricate.mesh import mesh_arrays, mould_mesh, read_mesh
from padforge.fabricate.plan import COVER_MM, INTO_WALL_MM, Plan, overlap, without
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

CheckedMesh = tuple[NDArray[np.floating], NDArray[np.integer], list[Finding]]
"""Vertices (n, 3) mm, triangles (m, 3) vertex indices, and findings."""


def check(pad: Morphology, settings: FabricationSettings = DEFAULTS) -> list[Finding]:
    """Run all checks on the mould of a pad.

    Args:
        pad: morphology of the pad.
        settings: settings of fabrication.

    Raises:
        InputError: settings contradict each other.
    """
    return check_mould(Plan(pad, settings))[-1]


def check_file(source: Path, settings: FabricationSettings = DEFAULTS) -> CheckedMesh:
    """Run all checks on a mesh (.stl, .3mf), or on the mould of a morphology (.json, .mat)."""
    kind = source.suffix.lower()
    if kind not in (".stl", ".3mf", ".json", ".mat"):
        raise InputError(f"{source}: no file to check, allowed are a mesh .stl or .3mf, a morphology .json or .mat")
    if kind in (".json", ".mat"):
        return check_mould(Plan(Morphology.load(source), settings))
    vertices, triangles = read_mesh(source)
    return vertices, triangles, check_triangles(vertices, triangles, settings.printer, settings.mould.min_silicone_mm)


def check_mould(plan: Plan) -> CheckedMesh:
    """Build the mesh of a mould, and run all checks on plan and mesh."""
    vertices, triangles = mesh_arrays(mould_mesh(plan.shrinkage_compensated))
    findings = check_triangles(vertices, triangles, plan.settings.printer, genus=0, has_plan=True)
    return vertices, triangles, [*findings, *check_plan(plan)]


def check_plan(plan: Plan) -> list[Finding]:
    """Run the checks that need no mesh, on the printed mould and on the finished pad.

    Common tracks, keep-outs and bending are checked only if the settings mention them; thickness and depths only if the
    design of the pad assumes a layer.
    """
    mould = plan.shrinkage_compensated
    findings = [
        _check_ridge_width(mould),
        _check_track_size(plan),
        _check_layers(mould),
        _check_slenderness(mould),
        _check_crossing_gap(plan),
        _check_same_family_crossings(plan),
        *_check_common_tracks(plan),
        _check_silicone_wall(plan),
        _check_tray_wall(plan),
        _check_cover(plan),
        _check_fibre_bend(plan),
        _check_folds(mould),
        _check_numbers(mould),
    ]
    findings += _check_assumed_layer(plan)
    if plan.settings.pad.keep_out_mm:
        findings += _check_keep_outs(plan)
    return findings + _check_fibre_strain(plan)


_SLENDER = 5.0  # ratio of height to width above which ridges may break
_MAX_SLENDERNESS = 10.0  # ratio above which they cannot be printed
_BEND_TOLERANCE = 1e-3  # relative, of bend radii, since leads bend as tightly as allowed
_PILLAR_LINES = 2  # minimum width of a stable pillar, in printed lines
_STRAIN_SHARE = 0.5  # fraction of a fibre's maximum strain that bending may use; presses need the remainder


def _list_fibres(noun: str, numbers: Sequence[int]) -> str:
    plural = noun if len(numbers) == 1 else f"{noun}s"
    return f"{plural} {', '.join(map(str, numbers))}" if len(numbers) <= 8 else f"{len(numbers)} {plural}"


def _points_in(polygons: Iterable[Any]) -> list[Position]:
    return [polygon.representative_point().coords[0] for polygon in polygons]


def _ridge_middles(plan: Plan, fibres: Iterable[int]) -> list[tuple[float, ...]]:
    """Return the middle of the ridge of every fibre, along its centre line."""
    return [plan.lines[fibre].interpolate(0.5, normalized=True).coords[0] for fibre in fibres]


def _check_ridge_width(plan: Plan) -> Finding:
    """Check that ridges are at least as wide as the nozzle, or as two pixels of a resin printer."""
    width, limit = plan.settings.mould.ridge_width_mm, plan.settings.printer.line_mm
    name = "two pixels" if plan.settings.printer.resin else "the nozzle"
    passed = width >= limit - 1e-9
    positions = [] if passed else _ridge_middles(plan, chain(*plan.layers))
    message = f"ridges are {width:g} mm wide, {name} {limit:g} mm"
    return check_result("ridge_width", passed, width, limit, message, positions)


def _check_track_size(plan: Plan) -> Finding:
    """Check that a fibre fits into its track."""
    size = min(plan.settings.mould.ridge_width_mm, plan.depths_mm[0])
    fibre = plan.settings.fibre.material.diameter_mm
    message = f"the tightest track is {size:g} mm, the fibre {fibre:g} mm"
    return check_result("track_size", size >= fibre, size, fibre, message)


def _check_layers(plan: Plan) -> Finding:
    """Check that floor and ridges have two printed layers or more; slicers round fractions."""
    printer, mould = plan.settings.printer, plan.settings.mould
    layer = printer.layer_mm
    steps = {key: getattr(mould, key) for key in ("floor_mm", "shallow_ridge_height_mm", "deep_ridge_height_mm")}
    uneven = [key for key, height in steps.items() if not printer.is_whole_layers(height)]
    count = min(steps.values()) / layer
    status: Status = "fail" if count < 2 - 1e-6 else "warn" if uneven else "pass"
    message = {
        "fail": f"the lowest step has {count:.2f} layers of {layer:g} mm",
        "warn": f"{', '.join(uneven)}: not a whole number of {layer:g} mm layers",
        "pass": f"every step is a whole number of {layer:g} mm layers",
    }[status]
    return Finding("layers", status, count, 2.0, message)


def _check_slenderness(plan: Plan) -> Finding:
    """Check that ridges are not so slender that they bend in printing or break in demoulding."""
    height = plan.heights_mm[-1]
    ratio = height / plan.settings.mould.ridge_width_mm
    status: Status = "pass" if ratio <= _SLENDER + 1e-9 else "warn" if ratio <= _MAX_SLENDERNESS + 1e-9 else "fail"
    message = f"the tallest ridges, {height:g} mm, are {ratio:.1f} times as tall as wide"
    positions = [] if status == "pass" else _ridge_middles(plan, plan.layers[-1])
    return check_result("slenderness", status, ratio, _SLENDER, message, positions)


def _check_crossing_gap(plan: Plan) -> Finding:
    """Check that silicone or adhesive insulates crossing fibres."""
    limit = plan.settings.mould.min_silicone_mm
    if len(plan.depths_mm) < 2:
        return Finding("crossing_gap", "pass", 0.0, limit, "no two fibres cross: all lie at one depth")
    gap = plan.depths_mm[1] - plan.depths_mm[0] - plan.settings.fibre.material.diameter_mm
    message = f"{gap:.3f} mm lie between fibres of neighbouring depths where they cross"
    return Finding("crossing_gap", grade(gap, limit), gap, limit, message)


def _check_same_family_crossings(plan: Plan) -> Finding:
    """Check crossings within a family: at one depth tracks merge and fibres touch; further depths are more work."""
    positions, two = plan.clash_positions_mm, plan.settings.mould.levels == "two"
    count = len(positions)
    message = f"{count} crossings of fibres of one family"
    if count:
        message += ", whose tracks merge" if two else f", kept apart by {len(plan.heights_mm)} depths instead of 2"
    status: Status = "pass" if not count else "fail" if two else "warn"
    return check_result("same_family_crossings", status, count, 0, message, positions)


def _check_common_tracks(plan: Plan) -> list[Finding]:
    """Check the length of tracks over deeper ones, where only adhesive separates the fibres."""
    limit, tracks = plan.settings.rules.max_common_track_mm, plan.common_tracks
    if limit is None:
        return []
    if not tracks:
        return [Finding("common_tracks", "pass", 0.0, limit, "no track lies over a deeper one")]
    worst = max(tracks, key=lambda track: track.length_mm)
    positions = [track.position_mm for track in tracks if track.length_mm > limit]
    message = (
        f"tracks lie over deeper ones for {worst.length_mm:.2f} mm at most, fibre {worst.shallow + 1} over"
        f" {worst.deep + 1} at ({worst.position_mm[0]:z.1f}, {worst.position_mm[1]:z.1f}) mm"
    )
    return [check_result("common_tracks", "warn" if positions else "pass", worst.length_mm, limit, message, positions)]


def _check_silicone_wall(plan: Plan) -> Finding:
    """Check the silicone between tracks of one depth (of two fibres or one), and beside keep-outs.

    `_check_tray_wall` checks the silicone beside the walls. The minimum width is found by bisection to 2 % or 10 µm.
    """
    layout, limit = plan.pad.layout, plan.settings.mould.min_silicone_mm
    pitch = max(layout.pitch_x_mm, layout.pitch_y_mm)
    around = plan.cavity.buffer(2 * pitch, join_style="mitre")
    if plan.feet.area:
        around = without(around, plan.feet)
    silicones = [
        without(around, plan.outline(fibres, height))
        for fibres, height in zip(plan.layers, plan.heights_mm, strict=True)
    ]
    patches = [find_thin_patches(silicone, limit, plan.cavity) for silicone in silicones]
    positions = _points_in(chain(*patches))
    low, high, searched = limit, pitch, [(silicone, plan.cavity) for silicone in silicones]  # areas, and where in them
    if positions:  # the minimum width is in one of the patches: search their surroundings only
        thin = [(area, shapely.union_all(parts)) for area, parts in zip(silicones, patches, strict=True) if len(parts)]
        low, high, searched = 0.0, limit, [(overlap(area, patch.buffer(2 * limit)), patch) for area, patch in thin]
    while high - low > max(0.01, 0.02 * low):
        middle = (low + high) / 2
        is_thin = any(len(find_thin_patches(area, middle, within)) for area, within in searched)
        low, high = (low, middle) if is_thin else (middle, high)
    message = f"the thinnest silicone between tracks of one depth is {high:.2f} mm"
    return check_result("silicone_wall", grade(low, limit) if positions else "pass", high, limit, message, positions)


def _check_tray_wall(plan: Plan) -> Finding:
    """Check the distance of fibres from the tray's wall, since a track that meets the wall opens to the pad's side.

    The ends are excluded, over a length that suffices for fibres that leave the wall at 30 degrees or more.
    """
    half, limit = plan.settings.mould.ridge_width_mm / 2, plan.settings.mould.min_silicone_mm
    reach, wall = half + limit, plan.cavity.boundary
    border = plan.cavity.difference(plan.cavity.buffer(-reach, join_style="mitre"))
    end = INTO_WALL_MM + plan.settings.mould.exit_mm + 2 * reach
    middles = [ops.substring(line, end, line.length - end) for line in plan.lines]
    pieces = chain(*(shapely.get_parts(middle.intersection(border)) for middle in middles))
    close = [piece for piece in pieces if piece.length]
    gap = min(piece.distance(wall) - half for piece in close or middles)
    positions = [ops.nearest_points(piece, wall)[0].coords[0] for piece in close]
    message = f"ridges between their ends come within {gap:.2f} mm of the tray's wall"
    if gap <= 0:
        message = f"ridges run into the tray's wall between their ends, by {-gap:.2f} mm"
    return check_result("tray_wall", grade(gap, limit), gap, limit, message, positions)


def _check_cover(plan: Plan) -> Finding:
    """Check the thickness of silicone over the deepest tracks, which holds the pad together."""
    thickness, nominal = plan.silicone_mm, plan.settings.mould.silicone_mm
    cover = thickness - plan.heights_mm[-1]
    message = f"{cover:g} mm of silicone lie beyond the deepest tracks"
    if thickness > nominal:
        message += f"; for {len(plan.heights_mm)} depths the pad is {thickness:g} mm thick, not {nominal:g}"
    status: Status = "warn" if cover < COVER_MM - 1e-9 or thickness > nominal else "pass"
    return Finding("cover", status, cover, COVER_MM, message)


def _check_assumed_layer(plan: Plan) -> Iterator[Finding]:
    """Check the thickness of the pad and the depths of its fibres against those assumed by its design.

    The pressed face may be either one, but the same for all fibres.
    """
    contact = contact_designed_for(plan.pad.provenance) or plan.settings.contact
    if contact is None or contact.model != "layer":
        return
    thickness, assumed = plan.thickness_mm, contact.thickness_mm
    tolerance = CAST_SHARE * assumed
    fits = abs(thickness - assumed) <= tolerance
    message = f"silicone is {thickness:.4g} mm thick, the design assumes {assumed:.4g}"
    yield Finding("silicone_thickness", "pass" if fits else "warn", thickness, assumed, message)

    radius = plan.settings.fibre.material.diameter_mm / 2
    from_tracks = np.array([plan.depths_mm[layer] - radius for layer in plan.layer_indices])
    expected = np.repeat(contact.fibre_depths_mm, plan.pad.layout.counts)
    depths = min(from_tracks, thickness - from_tracks, key=lambda depths: float(np.abs(depths - expected).max()))
    errors = np.abs(depths - expected)
    families = [rows for rows in plan.pad.layout.families if len(errors[rows])]
    worst = [rows.start + int(errors[rows].argmax()) for rows in families]
    measured, limits = depths[worst].tolist(), expected[worst].tolist()
    parts = [
        f"{FAMILIES[plan.family(fibre)]} fibres lie {depth:.3g} mm deep, the design assumes {limit:.3g}"
        for fibre, depth, limit in zip(worst, measured, limits, strict=True)
    ]
    fits = errors.max() <= tolerance
    yield Finding("fibre_depths", "pass" if fits else "warn", measured, limits, "; ".join(parts))


def _check_fibre_bend(plan: Plan) -> Finding:
    """Check the bend radii of fibres and leads, as measured by the design rules; a tighter fibre lifts out or breaks.

    A corner between a fibre and its lead counts as a bend; up to half a radian passes.
    """
    limit = plan.settings.min_bend_radius_mm
    bends = [bend_radius(*path, limit / 2) for path in plan.trace(step=2.5e-3, past_mm=limit / 2)] if limit else []
    tight = [(fibre, *bend) for fibre, bend in enumerate(bends, 1) if bend[0] < limit * (1 - _BEND_TOLERANCE)]
    radius = min((radius for _, radius, _ in tight), default=limit)
    names = _list_fibres("fibre", [fibre for fibre, _, _ in tight])
    bent = f"{names} bent as tightly as {radius:.2f} mm" if tight else f"no fibre bends below {limit:g} mm"
    message = f"{bent}, in the mean over {limit / 2:g} mm" if limit else bent
    return check_result("fibre_bend", not tight, radius, limit, message, [position for _, _, position in tight])


def _check_folds(plan: Plan) -> Finding:
    """Check for bends tighter than half a track's width, whose inner wall would intersect itself and is cut.

    The ends of fibres, where tracks turn into their leads, are excluded.
    """
    pad, mould = plan.pad, plan.settings.mould
    folds: list[Array] = []
    max_cut = 0.0
    curves = zip(beziers(pad), slope_beziers(pad), flatten(pad, 3e-4 / pad.unit_mm), strict=True)  # tolerance 3e-4 mm
    for fibre, (spans, slopes, line) in enumerate(curves):
        half = mould.ridge_width_mm / 2 + plan.heights_mm[plan.layer_indices[fibre]] * plan.settings.ridge_slope
        points, headings = trace_curve(spans, slopes, 0.05)  # maximum turn between points, rad
        axes = slice(None, None, -1 if plan.family(fibre) else 1)  # order of coordinates: along the fibre, then across
        positions, walls = _find_tight_bends(pad.to_mm(points)[:, axes], headings, half)
        cuts = half - shapely.distance(shapely.LineString(pad.to_mm(line)), shapely.points(walls[:, axes]))
        folds += list(positions[cuts > mould.tolerance_mm][:, axes])
        max_cut = float(cuts.max(initial=max_cut))
    noun = "1 bend is" if len(folds) == 1 else f"{len(folds)} bends are"
    message = f"no bend cuts a track's inner wall by more than {mould.tolerance_mm:g} mm"
    if folds:
        message = f"{noun} tighter than half the track's width, which cuts its inner wall by up to {max_cut:.2f} mm"
    return check_result("folds", "warn" if folds else "pass", len(folds), 0, message, folds)


def _find_tight_bends(points: Array, headings: Array, half: float) -> Array:
    """Return the middles of bends with a radius below `half`, and the points `half` inwards of these; (2, k, 2)."""
    turns = np.diff(headings)
    tight = np.flatnonzero(np.abs(turns) * half > np.hypot(*np.diff(points, axis=0).T))
    starts = np.flatnonzero((np.diff(tight) > 1) | (np.diff(np.sign(turns[tight])) != 0)) + 1
    bends = [bend for bend in np.split(tight, starts) if len(bend)]
    ends = np.array([(headings[bend[0]], headings[bend[-1] + 1]) for bend in bends]).reshape(-1, 2)
    mean = ends.mean(axis=1)
    middles = [bend[np.abs(headings[bend] - heading).argmin()] for bend, heading in zip(bends, mean, strict=True)]
    inward = np.sign(np.diff(ends)) * np.stack([-np.sin(mean), np.cos(mean)], axis=1)
    positions = points[np.array(middles, dtype=int)]
    return np.stack([positions, positions + half * inward])


def _check_numbers(plan: Plan) -> Finding:
    """Check that every fibre has its number, without which tracks are easily confused."""
    missing = [fibre for fibre, number in enumerate(plan.numbers) if number is None]
    names = _list_fibres("number", [fibre + 1 for fibre in missing])
    message = f"no room beside the fibre's start for {names}" if missing else "every number has room"
    positions = [plan.lines[fibre].coords[0] for fibre in missing]
    total = len(plan.numbers)
    return check_result("numbers", "warn" if missing else "pass", total - len(missing), total, message, positions)


def _check_keep_outs(plan: Plan) -> Iterator[Finding]:
    """Check that no track runs into a pillar, and that pillars are stable and leave the pad in one piece."""
    half = plan.settings.mould.ridge_width_mm / 2 + plan.heights_mm[-1] * plan.settings.ridge_slope
    shared = {fibre: line.buffer(half, cap_style="flat") & plan.feet for fibre, line in enumerate(plan.lines, 1)}
    blocked = [fibre for fibre, area in shared.items() if area.area > 0]
    message = (
        f"tracks of {_list_fibres('fibre', blocked)} run into keep-outs" if blocked else "no track runs into a keep-out"
    )
    overlaps = [area for fibre in blocked for area in shapely.get_parts(shared[fibre]) if area.area > 0]
    yield check_result("keep_out", not blocked, len(blocked), 0, message, _points_in(overlaps))

    mould = plan.shrinkage_compensated  # a pillar of one printed line bends; a thinner one cannot be printed
    line, region = mould.settings.printer.line_mm, overlap(mould.pillars, mould.cavity)
    thin, weak = (find_thin_patches(mould.pillars, lines * line, region) for lines in (1, _PILLAR_LINES))
    status: Status = "fail" if len(thin) else "warn" if len(weak) else "pass"
    positions = _points_in(thin if len(thin) else weak)
    subject = "pillars are" if positions else "no pillar is"
    limit, capability = (line, "prints") if len(thin) else (_PILLAR_LINES * line, "is stable")
    message = f"{subject} thinner than {limit:g} mm, the least that {capability}"
    yield check_result("pillars", status, len(positions), 0, message, positions)

    pieces = sorted(shapely.get_parts(plan.silicone), key=lambda piece: piece.area)
    count = len(pieces)
    message = "keep-outs leave the pad in one piece" if count == 1 else f"keep-outs leave {count} pieces"
    yield check_result("one_piece", count == 1, count, 1, message, _points_in(pieces[:-1]))


def compute_bending_strains(plan: Plan) -> list[tuple[float, float, Position]]:
    """Compute the maximum strain of the fibres of every layer of a pad bent to `[pad] bent_radius_mm`; [] if flat.

    The axis of bending is y, and the pressed face, with the tracks, is outside. The neutral surface of a plate of
    thickness t with an inner radius R has the radius R + t / 2. At a distance z outside of it, lengths along x grow by
    the factor 1 + z / (R + t / 2), and lengths along y are constant. To first order, the strain of an element at an
    angle a to x is cos(a)^2 z / (R + t / 2). The axis of a fibre is half a diameter above the bottom of its track.
    For each layer, the shallowest first, depth, strain (negative if compressive) and its position are returned.
    """
    radius = plan.settings.pad.bent_radius_mm
    if radius is None:
        return []
    neutral = plan.thickness_mm / 2
    strains = []
    for fibres, depth in zip(plan.layers, plan.depths_mm, strict=True):
        z = neutral - depth + plan.settings.fibre.material.diameter_mm / 2
        paths = [shapely.get_coordinates(plan.lines[fibre]) for fibre in fibres]
        segments = np.concatenate([np.stack([xy[:-1], xy[1:]]) for xy in paths], axis=1)
        steps = segments[1] - segments[0]
        squares = steps[:, 0] ** 2 / (steps**2).sum(axis=1)  # cos(a)^2
        worst = int(squares.argmin() if z < 0 else squares.argmax())
        x, y = segments[:, worst].mean(axis=0).tolist()
        strains.append((depth, float(squares[worst]) * z / (radius + neutral), (x, y)))
    return strains


def _check_fibre_strain(plan: Plan) -> list[Finding]:
    """Check the strain of fibres in a bent pad; no finding for a flat one."""
    strains = compute_bending_strains(plan)
    if not strains:
        return []
    _, strain, position = max(strains, key=itemgetter(1))
    limit, radius = plan.settings.fibre.material.max_strain, plan.settings.pad.bent_radius_mm
    status: Status = "pass"
    if strain > 0 and (limit is None or strain > _STRAIN_SHARE * limit):
        status = "warn" if limit is None or strain <= limit else "fail"
    depths = ", ".join(f"{100 * value:.3g} % at {depth:.3g} mm" for depth, value, _ in strains)
    capacity = f"they bear {100 * limit:.3g} %" if limit is not None else "what they bear is unknown"
    message = f"bent to {radius:g} mm, fibres are stretched by up to {depths} deep; {capacity}"
    return [check_result("fibre_strain", status, strain, limit or 0.0, message, [position])]
