"""The plan of a pad as a picture: fibres, crossings, broken rules and the contact, to scale in mm."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import NDArray

from padforge.design.common.plotting import ALARM, FAINT, HORIZONTAL, INK, PAPER, VERTICAL
from padforge.design.common.validation import InputError, check_array, check_type, short_repr
from padforge.design.morphology import Morphology
from padforge.design.objectives.rules import Violation
from padforge.design.paths.curves import crossings, flatten
from padforge.design.settings import Contact, Corners


def draw_plan(
    pad: Morphology, contact: Contact, violations: Sequence[Violation] = (), keep_out_mm: Sequence[Corners] = ()
) -> Figure:
    """The plan as a matplotlib figure; axes in mm from the pad's centre.

    Same-family crossings are ringed, places of broken rules crossed out in red, keep-outs hatched, the contact drawn
    at the centre.
    """
    pad, contact = check_type("pad", pad, Morphology), check_type("contact", contact, Contact)
    holes = _polygons(keep_out_mm)
    if not isinstance(violations, Sequence) or not all(isinstance(found, Violation) for found in violations):
        raise InputError(f"violations is {short_repr(violations)}, expected what check_rules found")
    width, height = (side / 2 for side in pad.layout.size_mm)
    half, longer = max(width, height), 6.4 / max(width, height)
    figure = Figure(figsize=(max(longer * width, 4.8), max(longer * height, 2.4)), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    axes.add_patch(Rectangle((-width, -height), 2 * width, 2 * height, facecolor=PAPER, edgecolor=FAINT, gid="pad"))
    for corners in holes:
        axes.add_patch(Polygon(corners, facecolor="white", edgecolor=INK, hatch="///", linewidth=0.8))
    for fibre, points in enumerate(flatten(pad, 1e-3)):
        horizontal = not pad.layout.family(fibre)
        x, y = pad.to_mm(points).T
        color, gid = (HORIZONTAL, "horizontal") if horizontal else (VERTICAL, "vertical")
        gid += f"-{fibre + 1 - pad.layout.families[not horizontal].start}"  # so that a drawing can be read again
        (line,) = axes.plot(x, y, color=color, linewidth=1.6, solid_capstyle="round", gid=gid)
        line.get_path().should_simplify = False
        ha, va, dx, dy = ("left", "center", 0.02, 0) if horizontal else ("center", "bottom", 0, 0.02)
        axes.text(x[-1] + dx * half, y[-1] + dy * half, str(fibre + 1), color=color, fontsize=9, ha=ha, va=va)
    places = [(pad.to_mm(c.place), pad.layout.family(c.first) == pad.layout.family(c.second)) for c in crossings(pad)]
    for same, size, color in ((False, 10, INK), (True, 40, ALARM)):
        chosen = np.array([place for place, family in places if family == same]).reshape(-1, 2)
        axes.scatter(*chosen.T, s=size, facecolor="none" if same else color, edgecolor=color, linewidth=0.8, zorder=3)
    axes.add_patch(_contact_shape(contact, pad.unit_mm))
    broken = np.array([v.place_mm for v in violations if v.place_mm is not None]).reshape(-1, 2)
    axes.scatter(*broken.T, marker="x", s=50, color=ALARM, linewidth=1.8, zorder=4)
    beside = 0.08 * half
    limits = {"xlim": (-width - beside, width + beside), "ylim": (-height - beside, height + beside)}
    axes.set(xlabel="x (mm)", ylabel="y (mm)", **limits)
    axes.spines[["top", "right"]].set_visible(False)
    across = sum(not family for _, family in places)
    axes.set_title(
        f"{pad.layout}, {len(places)} crossings"
        + (f", {len(places) - across} within a family" if len(places) > across else "")
        + (f", {len(violations)} rules broken" if violations else ""),
        fontsize=10,
        color=ALARM if violations else INK,
    )
    return figure


def _contact_shape(contact: Contact, unit_mm: float) -> Circle | Polygon:
    radius = _half_width(contact.sensitivity_profile) if contact.sensitivity_profile else contact.radius * unit_mm
    if contact.sensitivity_profile or contact.sides is None:
        return Circle((0, 0), radius, color=INK, alpha=0.15, linewidth=0)
    angle = 2 * np.pi * np.arange(contact.sides) / contact.sides
    return Polygon(radius * np.column_stack([np.cos(angle), np.sin(angle)]), color=INK, alpha=0.15, linewidth=0)


def _half_width(reach: Sequence[tuple[float, float]]) -> float:
    """The greatest distance at which a measured weight is half of its largest, along straight lines, mm."""
    distance, weight = np.abs(np.array(reach)).T
    half = weight.max() / 2
    last = int(np.flatnonzero(weight >= half)[-1])  # the last point of all is 0
    share = (weight[last] - half) / (weight[last] - weight[last + 1])
    return float(distance[last] + share * (distance[last + 1] - distance[last]))


def _polygons(keep_out_mm: object) -> list[NDArray[np.float64]]:
    """Polygons (n, 2) in mm, of one corner or more."""
    if not isinstance(keep_out_mm, Sequence):
        raise InputError(f"keep_out_mm is {short_repr(keep_out_mm)}, expected polygons as [pad] has them")
    found = [check_array("keep_out_mm", corners) for corners in keep_out_mm]
    for corners in found:
        if corners.ndim != 2 or corners.shape[1] != 2 or not len(corners):
            raise InputError(f"keep_out_mm has a polygon of shape {corners.shape}, expected (n, 2)")
    return found
