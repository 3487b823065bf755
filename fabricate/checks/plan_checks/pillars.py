"""Whether the pillars that leave holes print, and keep off the fibres."""

import shapely

from padforge.fabricate.checks.findings import Finding, Place, Status, as_places, verdict
from padforge.fabricate.mould.plan import Plan, overlap

from .tracks import thinner

_LINES = 2
"""Lines side by side that make a pillar stand."""


def pillars(plan: Plan) -> list[Finding]:
    """The checks of `[pad] keep_out_mm`, none without: of the mould as printed, and of its tracks."""
    if not plan.settings.pad.keep_out_mm:
        return []
    return [_fibres(plan), _width(plan.enlarged), _one_piece(plan)]


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
    return verdict("keep_out", not names, len(names), 0, message, places)


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
    return verdict("one_piece", len(parts) == 1, len(parts), 1, message, places)
