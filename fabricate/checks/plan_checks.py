"""Whether a mould prints, demoulds and lets the fibres be laid, as far as its plan tells."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import ops
from shapely.geometry.base import BaseGeometry

from padforge.design.morphology import Array, Morphology
from padforge.design.paths.curves import bend_radius, beziers, flatten, slope_beziers, trace_curve
from padforge.fabricate.checks import Finding, Place, Status, as_places, check_result, grade
from padforge.fabricate.checks.mesh_checks import inspect_mesh
from padforge.fabricate.mesh import mould_mesh, read_mesh
from padforge.fabricate.plan import COVER_MM, INTO_WALL_MM, Plan, areas, overlap, without
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

_EASY = 0.5
"""Share of what the fibre bears up to which bending may use it: pressing takes the rest."""


class Strain(NamedTuple):
    """The greatest share of its length by which a fibre of a depth is stretched, less than 0 where it is pressed."""

    depth_mm: float
    most: float
    position_mm: tuple[float, float]


def strains(plan: Plan) -> list[Strain]:
    """Of every depth of a pad that is bent to `[pad] bent_radius_mm`, the shallowest first.

    Its axis runs along y, and the tracks, on the face that is pressed, lie outwards. A plate of thickness t whose inner
    face lies on radius R keeps its length half way through, on radius R + t / 2. What lies z further out is on radius
    R + t / 2 + z: a way dx along x becomes dx (1 + z / (R + t / 2)), one along y stays. An element at angle a to x is
    (cos a, sin a) ds, and to first order longer by the share cos(a)^2 z / (R + t / 2). A fibre lies on the bottom of
    its track, its middle half a diameter above that.
    """
    radius_mm = plan.settings.pad.bent_radius_mm
    if radius_mm is None:
        return []
    neutral = plan.thickness_mm / 2
    found = []
    for level, depth in enumerate(plan.depths_mm):
        out = neutral - depth + plan.settings.fibre.material.diameter_mm / 2
        lines = [line for line, own in zip(plan.lines, plan.layer_indices, strict=True) if own == level]
        share, place = max((_along(shapely.get_coordinates(line), out < 0) for line in lines), key=lambda each: each[0])
        found.append(Strain(depth, abs(share) * out / (radius_mm + neutral), place))
    return found


def _along(course: Array, least: bool) -> tuple[float, tuple[float, float]]:
    """The greatest cos(a)^2 along a course (n, 2), or less the least, and where that is."""
    steps = np.diff(course, axis=0)
    shares = steps[:, 0] ** 2 / (steps**2).sum(axis=1) * (-1 if least else 1)
    worst = int(shares.argmax())
    x, y = course[worst : worst + 2].mean(axis=0).tolist()
    return float(shares[worst]), (x, y)


def fibre_strain(plan: Plan) -> list[Finding]:
    """Whether the fibres bear to be bent, by depth; none of a flat pad."""
    by_depth = strains(plan)
    if not by_depth:
        return []
    worst = max(by_depth, key=lambda each: each.most)
    limit, radius = plan.settings.fibre.material.max_strain, plan.settings.pad.bent_radius_mm
    status: Status = "pass"
    if worst.most > 0 and (limit is None or worst.most > _EASY * limit):
        status = "warn" if limit is None or worst.most <= limit else "fail"
    depths = ", ".join(f"{100 * each.most:.3g} % at {each.depth_mm:.3g} mm" for each in by_depth)
    bears = f"they bear {100 * limit:.3g} %" if limit is not None else "what they bear is unknown"
    message = f"bent to {radius:g} mm, fibres are stretched by up to {depths} deep; {bears}"
    return [Finding("fibre_strain", status, worst.most, limit or 0.0, message, as_places([worst.position_mm]))]


_SPECK_MM2 = 0.01
"""Silicone too thin over less than this area is a corner, not a wall."""
_SLENDER, _TOO_SLENDER = 5.0, 10.0
"""Ridges taller than so many times their width may break off in demoulding, or do not print upright at all."""
_FINE_MM, _TURN = 3e-4, 0.05
"""Folds are looked for along fibres drawn so finely, at points between which they turn by so many radians at most."""
_BEND_TURN, _BEND_SLACK = 2.5e-3, 1e-3
"""Radians that fibres turn by at most between points at which bends are looked at; leads bend as tightly as allowed."""
_KINK = 0.5
"""Radians by which a fibre may turn in one place, as the rule for bends has it."""
_NAMED = 8
"""More fibres than this are counted instead of named."""


def check_tracks(plan: Plan) -> list[Finding]:
    """The checks of ridges and tracks: of the mould as it is printed, and of the pad as it is used.

    What tracks have in common is only looked at where the rules have a limit.
    """
    mould = plan.shrinkage_compensated
    return [
        _ridge_width(mould),
        _track_size(plan),
        _layers(mould),
        _slenderness(mould),
        _crossing_gap(plan),
        _same_family_crossings(plan),
        *_common_tracks(plan),
        _silicone_wall(plan),
        _tray_wall(plan),
        _cover(plan),
        _fibre_bend(plan),
        _lead_kinks(plan),
        _folds(mould),
        _numbers(mould),
    ]


def _ridge_width(plan: Plan) -> Finding:
    """A printer draws nothing narrower than its nozzle, or than two pixels of its screen."""
    width, least = plan.settings.mould.ridge_width_mm, plan.settings.printer.line_mm
    reason = "two pixels" if plan.settings.printer.resin else "the nozzle"
    message = f"ridges are {width:g} mm wide, {reason} {least:g} mm"
    wide = width >= least - 1e-9
    places = [] if wide else [place for level in range(len(plan.heights_mm)) for place in _middles(plan, level)]
    return check_result("ridge_width", wide, width, least, message, places)


def _track_size(plan: Plan) -> Finding:
    """A fibre must lie within its track, neither pinched nor standing out."""
    room = min(plan.settings.mould.ridge_width_mm, plan.depths_mm[0])
    fibre = plan.settings.fibre.material.diameter_mm
    message = f"the tightest track is {room:g} mm, the fibre {fibre:g} mm"
    return check_result("track_size", room >= fibre, room, fibre, message)


def _layers(plan: Plan) -> Finding:
    """Ridges of less than two layers do not print; heights between layers come out rounded."""
    printer, mould = plan.settings.printer, plan.settings.mould
    layer = printer.layer_mm
    heights = {
        "floor_mm": mould.floor_mm,
        "shallow_ridge_height_mm": mould.shallow_ridge_height_mm,
        "deep_ridge_height_mm": mould.deep_ridge_height_mm,
    }
    uneven = [key for key, height in heights.items() if not printer.is_whole_layers(height)]
    least = min(heights.values()) / layer
    if least < 2 - 1e-6:
        return Finding("layers", "fail", least, 2.0, f"the lowest step has {least:.2f} layers of {layer:g} mm")
    if uneven:
        return Finding("layers", "warn", least, 2.0, f"{', '.join(uneven)}: not a whole number of {layer:g} mm layers")
    return Finding("layers", "pass", least, 2.0, f"every step is a whole number of {layer:g} mm layers")


def _slenderness(plan: Plan) -> Finding:
    """A thin and tall ridge bends when it is printed and breaks when the casting is pulled off."""
    tallest, width = plan.heights_mm[-1], plan.settings.mould.ridge_width_mm
    ratio = tallest / width
    status: Status = "pass" if ratio <= _SLENDER + 1e-9 else "warn" if ratio <= _TOO_SLENDER + 1e-9 else "fail"
    message = f"the tallest ridges, {tallest:g} mm, are {ratio:.1f} times as tall as wide"
    places = [] if status == "pass" else _middles(plan, len(plan.heights_mm) - 1)
    return Finding("slenderness", status, ratio, _SLENDER, message, as_places(places))


def _crossing_gap(plan: Plan) -> Finding:
    """Where fibres cross, silicone or adhesive between them keeps them from shorting."""
    mould = plan.settings.mould
    if len(plan.depths_mm) < 2:
        return Finding("crossing_gap", "pass", 0.0, mould.min_silicone_mm, "no two fibres cross: all lie at one depth")
    gap = plan.depths_mm[1] - plan.depths_mm[0] - plan.settings.fibre.material.diameter_mm
    message = f"{gap:.3f} mm lie between fibres of neighbouring depths where they cross"
    return Finding("crossing_gap", grade(gap, mould.min_silicone_mm), gap, mould.min_silicone_mm, message)


def _same_family_crossings(plan: Plan) -> Finding:
    """Tracks of one depth that cross become one, and the fibres in them touch; each further depth is more work."""
    places = plan.clash_positions_mm
    message = f"{len(places)} crossings of fibres of one family"
    if plan.settings.mould.levels == "two":
        status: Status = "fail" if len(places) else "pass"
        message += ", whose tracks merge" if len(places) else ""
    else:
        status = "warn" if len(places) else "pass"
        message += f", kept apart by {len(plan.heights_mm)} depths instead of 2" if len(places) else ""
    return Finding("same_family_crossings", status, len(places), 0, message, as_places(places))


def _common_tracks(plan: Plan) -> list[Finding]:
    """Where a track lies over a deeper one it has no floor: the adhesive alone keeps the fibres apart."""
    limit = plan.settings.rules.max_common_track_mm
    if limit is None:
        return []
    worst = max(plan.common_tracks, key=lambda each: each.length_mm, default=None)
    if worst is None:
        return [Finding("common_tracks", "pass", 0.0, limit, "no track lies over a deeper one")]
    long = [each for each in plan.common_tracks if each.length_mm > limit]
    message = (
        f"tracks lie over deeper ones for {worst.length_mm:.2f} mm at most, fibre {worst.shallow + 1} over"
        f" {worst.deep + 1} at ({worst.position_mm[0]:.1f}, {worst.position_mm[1]:.1f}) mm"
    )
    places = as_places(each.position_mm for each in long)
    return [Finding("common_tracks", "warn" if long else "pass", worst.length_mm, limit, message, places)]


def _silicone_wall(plan: Plan) -> Finding:
    """The thinnest silicone between tracks of equal depth, of two fibres or of one that turns back, and keep-outs.

    Silicone beside the tray's walls is left to the check of those. Found by bisection to 2 % or 10 µm.
    """
    layout, limit = plan.pad.layout, plan.settings.mould.min_silicone_mm
    pitch = max(layout.pitch_x_mm, layout.pitch_y_mm)
    around = plan.cavity.buffer(2 * pitch, join_style="mitre")
    if plan.pillars.area:
        around = without(around, plan.pillars)
    silicones = [without(around, plan.outline(level, foot)) for level, foot in enumerate(plan.heights_mm)]
    patches = [thinner(silicone, limit, plan.cavity) for silicone in silicones]
    within: list[BaseGeometry] = [plan.cavity] * len(silicones)
    low, high = limit, pitch
    if any(patches):  # the thinnest place lies in one of them: look no further than their surroundings
        low, high = 0.0, limit
        thin = [level for level, found in enumerate(patches) if found]
        within = [shapely.union_all(patches[level]) for level in thin]
        silicones = [overlap(silicones[level], own.buffer(2 * limit)) for level, own in zip(thin, within, strict=True)]
    while high - low > max(0.01, 0.02 * low):
        middle = (low + high) / 2
        narrow = any(thinner(silicone, middle, own) for silicone, own in zip(silicones, within, strict=True))
        low, high = (low, middle) if narrow else (middle, high)
    message = f"the thinnest silicone between tracks of one depth is {high:.2f} mm"
    places = [patch.representative_point().coords[0] for found in patches for patch in found]
    status = grade(low, limit) if places else "pass"
    return Finding("silicone_wall", status, high, limit, message, as_places(places))


def thinner(area: BaseGeometry, width: float, within: BaseGeometry) -> list[BaseGeometry]:
    """Patches of `area` that vanish when it shrinks and grows again by half of `width`, corners kept sharp."""
    opened = area.buffer(-width / 2, join_style="mitre").buffer(width / 2, join_style="mitre")
    if not opened.is_valid:  # sharp corners that grow past each other
        opened = areas(shapely.make_valid(opened))
    lost = overlap(without(area, opened), within)
    return [patch for patch in shapely.get_parts(lost) if patch.area > _SPECK_MM2]


def _tray_wall(plan: Plan) -> Finding:
    """Between its ends a fibre must keep off the tray's wall, or its track opens to the pad's side.

    The first stretch at each end is left out: long enough for fibres that leave the wall at 30 degrees or more.
    """
    half, limit = plan.settings.mould.ridge_width_mm / 2, plan.settings.mould.min_silicone_mm
    reach, wall = half + limit, plan.cavity.boundary
    beside = plan.cavity.difference(plan.cavity.buffer(-reach, join_style="mitre"))
    end = INTO_WALL_MM + plan.settings.mould.exit_mm + 2 * reach
    middles = [ops.substring(line, end, line.length - end) for line in plan.lines]
    near = [part for middle in middles for part in shapely.get_parts(middle.intersection(beside)) if part.length]
    gaps = [part.distance(wall) - half for part in near]
    least = min(gaps, default=min(middle.distance(wall) - half for middle in middles))
    places = [ops.nearest_points(part, wall)[0].coords[0] for part in near]
    message = f"ridges between their ends come within {least:.2f} mm of the tray's wall"
    return Finding("tray_wall", grade(least, limit), least, limit, message, as_places(places))


def _cover(plan: Plan) -> Finding:
    """The silicone that is left beyond the deepest tracks carries the pad."""
    thickness, wanted = plan.silicone_mm, plan.settings.mould.silicone_mm
    cover = thickness - plan.heights_mm[-1]
    message = f"{cover:g} mm of silicone lie beyond the deepest tracks"
    if thickness > wanted:
        message += f"; for {len(plan.heights_mm)} depths the pad is {thickness:g} mm thick, not {wanted:g}"
    thin = cover < COVER_MM - 1e-9
    return Finding("cover", "warn" if thin or thickness > wanted else "pass", cover, COVER_MM, message)


def _fibre_bend(plan: Plan) -> Finding:
    """A fibre cannot follow a bend tighter than it bears, or than the rules: it lifts out of its track or breaks.

    Bends are measured as by the rules (`bend_radius`), on fibres with their leads.
    """
    limit = plan.settings.min_bend_radius_mm
    bends = [bend_radius(*traced, limit / 2) for traced in plan.trace(_BEND_TURN, limit / 2)] if limit else []
    tight = [(fibre, *bend) for fibre, bend in enumerate(bends, 1) if bend[0] < limit * (1 - _BEND_SLACK)]
    least = min((radius for _, radius, _ in tight), default=limit)
    names = _listed("fibre", [fibre for fibre, _, _ in tight])
    message = f"{names} bent as tightly as {least:.2f} mm" if tight else f"no fibre bends below {limit:g} mm"
    return check_result("fibre_bend", not tight, least, limit, message, [place for _, _, place in tight])


def _lead_kinks(plan: Plan) -> Finding:
    """A fibre may meet its lead at a corner, of half a radian at most: what the rule for bends lets pass."""
    limit = math.degrees(_KINK)
    slopes = slope_beziers(plan.pad)
    kinks = np.degrees(np.arctan(np.abs(np.stack([slopes[:, 0, 0], slopes[:, -1, -1]], axis=1))))
    sharp = [(fibre, end) for fibre, end in zip(*np.nonzero(kinks > limit + 1e-9), strict=True)]
    worst = float(kinks.max())
    fibre = int(kinks.max(axis=1).argmax()) + 1
    message = (
        f"fibres meet their leads at corners of {worst:.1f} degrees at most, allowed are {limit:.1f}; fibre {fibre}"
    )
    places = as_places(plan.leads.pairs[fibre][end].end_mm for fibre, end in sharp)
    return check_result("lead_kinks", not sharp, worst, limit, message, places)


def _folds(plan: Plan) -> Finding:
    """In a bend tighter than half its width, a track's inner wall would run back through itself: it is cut there.

    Ends of fibres, where every track turns as it leaves the pad, are left out.
    """
    pad, mould = plan.pad, plan.settings.mould
    found: list[tuple[float, NDArray[np.floating]]] = []
    curves = zip(beziers(pad), slope_beziers(pad), flatten(pad, _FINE_MM / pad.unit_mm), strict=True)
    for fibre, (spans, slopes, line) in enumerate(curves):
        half = mould.ridge_width_mm / 2 + plan.heights_mm[plan.layer_indices[fibre]] * plan.settings.ridge_slope
        points, headings = trace_curve(spans, slopes, _TURN)
        aside = -1 if plan.family(fibre) else 1
        places, walls = _inner_walls(pad.to_mm(points)[:, ::aside], headings, half)
        cuts = half - shapely.distance(shapely.LineString(pad.to_mm(line)), shapely.points(walls[:, ::aside]))
        found += zip(cuts.tolist(), places[:, ::aside], strict=True)
    folds = [place for cut, place in found if cut > mould.tolerance_mm]
    most = max((cut for cut, _ in found), default=0.0)
    bends = "1 bend is" if len(folds) == 1 else f"{len(folds)} bends are"
    message = f"no bend cuts a track's inner wall by more than {mould.tolerance_mm:g} mm"
    if folds:
        message = f"{bends} tighter than half the track's width, which cuts its inner wall by up to {most:.2f} mm"
    return Finding("folds", "warn" if folds else "pass", len(folds), 0, message, as_places(folds))


def _inner_walls(points: NDArray[np.float64], headings: NDArray[np.float64], half: float) -> NDArray[np.float64]:
    """(2, k, 2) the middle of every bend whose radius is below `half`, and the place so far beside it, inwards."""
    turns = np.diff(headings)
    tight = np.flatnonzero(np.abs(turns) * half > np.hypot(*np.diff(points, axis=0).T))
    others = np.flatnonzero((np.diff(tight) > 1) | (np.diff(np.sign(turns[tight])) != 0)) + 1
    bends = [bend for bend in np.split(tight, others) if len(bend)]
    ends = np.array([(headings[bend[0]], headings[bend[-1] + 1]) for bend in bends]).reshape(-1, 2)
    along = ends.mean(axis=1)
    middle = [bend[np.abs(headings[bend] - at).argmin()] for bend, at in zip(bends, along, strict=True)]
    inward = np.sign(np.diff(ends)) * np.stack([-np.sin(along), np.cos(along)], axis=1)
    places = points[np.array(middle, dtype=int)]
    return np.stack([places, places + half * inward])


def _numbers(plan: Plan) -> Finding:
    """A track without its number is easily taken for another."""
    missing = [fibre for fibre, number in enumerate(plan.numbers) if number is None]
    names = _listed("number", [fibre + 1 for fibre in missing])
    message = f"no room beside the fibre's start for {names}" if missing else "every number has room"
    places = [plan.lines[fibre].coords[0] for fibre in missing]
    count = len(plan.numbers) - len(missing)
    return Finding("numbers", "warn" if missing else "pass", count, len(plan.numbers), message, as_places(places))


def _listed(noun: str, numbers: Sequence[int]) -> str:
    """The numbers by name, or how many they are."""
    plural = noun if len(numbers) == 1 else f"{noun}s"
    return f"{plural} {', '.join(map(str, numbers))}" if len(numbers) <= _NAMED else f"{len(numbers)} {plural}"


def _middles(plan: Plan, level: int) -> list[tuple[float, ...]]:
    """The middle of the course of every ridge of a level."""
    lines = [line for line, own in zip(plan.lines, plan.layer_indices, strict=True) if own == level]
    return [line.interpolate(0.5, normalized=True).coords[0] for line in lines]


_LINES = 2
"""Lines side by side that make a pillar stand."""


def pillars(plan: Plan) -> list[Finding]:
    """The checks of `[pad] keep_out_mm`, none without: of the mould as printed, and of its tracks."""
    if not plan.settings.pad.keep_out_mm:
        return []
    return [_fibres(plan), _width(plan.shrinkage_compensated), _one_piece(plan)]


def _fibres(plan: Plan) -> Finding:
    """A track that runs into a pillar ends there, and so does what lies in it."""
    half = plan.settings.mould.ridge_width_mm / 2 + plan.heights_mm[-1] * plan.settings.ridge_slope
    places: list[Place] = []
    names = []
    for number, line in enumerate(plan.lines, 1):
        through = shapely.get_parts(line.buffer(half, cap_style="flat").intersection(plan.pillars))
        if found := [part for part in through if part.area > 0]:
            names.append(str(number))
            places += as_places(part.representative_point().coords[0] for part in found)
    message = "no track runs into a keep-out"
    if names:
        message = f"tracks of fibre{'s' * (len(names) > 1)} {', '.join(names)} run into keep-outs"
    return check_result("keep_out", not names, len(names), 0, message, places)


def _width(plan: Plan) -> Finding:
    """A pillar of one line bends, one of less does not print."""
    line = plan.settings.printer.line_mm
    own = overlap(plan.pillars, plan.cavity)
    thin = {lines: thinner(plan.pillars, lines * line, own) for lines in (1, _LINES)}
    status: Status = "fail" if thin[1] else "warn" if thin[_LINES] else "pass"
    places = as_places(part.representative_point().coords[0] for part in thin[1] or thin[_LINES])
    says = {"pass": "no pillar is thinner than", "warn": "pillars are thinner than", "fail": "pillars are thinner than"}
    limit = line if thin[1] else _LINES * line
    return Finding("pillars", status, len(places), 0, f"{says[status]} {limit:g} mm, which a printer can make", places)


def _one_piece(plan: Plan) -> Finding:
    """Keep-outs that reach from wall to wall cut the pad in two."""
    parts = sorted(shapely.get_parts(plan.silicone), key=lambda part: part.area)
    places = [part.representative_point().coords[0] for part in parts[:-1]]
    message = "keep-outs leave the pad in one piece" if len(parts) == 1 else f"keep-outs leave {len(parts)} pieces"
    return check_result("one_piece", len(parts) == 1, len(parts), 1, message, places)


Inspected = tuple[NDArray[np.floating], NDArray[np.integer], list[Finding]]
"""Vertices (n, 3) mm, triangles (m, 3) vertex numbers, and what the checks found."""


def check(pad: Morphology, settings: FabricationSettings = DEFAULTS) -> list[Finding]:
    """Every check on the mould of a pad.

    Raises:
        InputError: settings that contradict each other.
    """
    return meshed(Plan(pad, settings))[-1]


def inspect_file(source: Path, settings: FabricationSettings = DEFAULTS) -> Inspected:
    """The mesh in a .stl or .3mf, or of the mould of the morphology in any other file, and every check on it.

    Raises:
        InputError: the file cannot be read, or settings contradict each other.
    """
    if source.suffix.lower() not in (".stl", ".3mf"):
        return meshed(Plan(Morphology.load(source), settings))
    vertices, triangles = read_mesh(source)
    return vertices, triangles, inspect_mesh(vertices, triangles, settings.printer, settings.mould.min_silicone_mm)


def meshed(plan: Plan) -> Inspected:
    """The mesh of a plan, and every check on both."""
    from padforge.fabricate.mesh import mesh_arrays

    vertices, triangles = mesh_arrays(mould_mesh(plan.shrinkage_compensated))
    return vertices, triangles, inspect(plan, vertices, triangles)


def inspect(plan: Plan, vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> list[Finding]:
    """Every check on a plan and its mesh: vertices (n, 3) mm, triangles (m, 3) vertex numbers."""
    of_mesh = inspect_mesh(vertices, triangles, plan.settings.printer, genus=0, unplanned=False)
    return [*of_mesh, *check_plan(plan)]


def check_plan(plan: Plan) -> list[Finding]:
    """The checks that need no mesh; of keep-outs and of bending only where there are any."""
    return [*check_tracks(plan), *pillars(plan), *fibre_strain(plan)]
