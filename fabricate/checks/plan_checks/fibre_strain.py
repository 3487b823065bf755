"""By how much a pad that is worn on a cylinder stretches its fibres."""

from typing import NamedTuple

import numpy as np
import shapely

from padforge.design.morphology import Array
from padforge.fabricate.checks.findings import Finding, Status, as_places
from padforge.fabricate.mould.plan import Plan

_EASY = 0.5
"""Share of what the fibre bears up to which bending may use it: pressing takes the rest."""


class Strain(NamedTuple):
    """The greatest share of its length by which a fibre of a depth is stretched, less than 0 where it is pressed."""

    depth_mm: float
    most: float
    place_mm: tuple[float, float]


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
        lines = [line for line, own in zip(plan.lines, plan.levels, strict=True) if own == level]
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
    limit, radius = plan.settings.fibre.material.largest_stretch, plan.settings.pad.bent_radius_mm
    status: Status = "pass"
    if worst.most > 0 and (limit is None or worst.most > _EASY * limit):
        status = "warn" if limit is None or worst.most <= limit else "fail"
    depths = ", ".join(f"{100 * each.most:.3g} % at {each.depth_mm:.3g} mm" for each in by_depth)
    bears = f"they bear {100 * limit:.3g} %" if limit is not None else "what they bear is unknown"
    message = f"bent to {radius:g} mm, fibres are stretched by up to {depths} deep; {bears}"
    return [Finding("fibre_strain", status, worst.most, limit or 0.0, message, as_places([worst.place_mm]))]
