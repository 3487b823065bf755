"""Draw the plan of a pad, to scale in mm: fibres, crossings, broken rules, keep-outs and the contact."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle

from padforge.design.common.plotting import ALARM, FAINT, HORIZONTAL, INK, PAPER, VERTICAL
from padforge.design.common.validation import InputError, check_array, check_type, short_repr
from padforge.design.morphology import Morphology
from padforge.design.objectives.rules import Violation
from padforge.design.paths.curves import crossings, flatten
from padforge.design.settings import Contact, Corners

TOLERANCE = 1e-3
"""Deviation of drawn curves from exact ones, grid units."""


def draw_plan(
    pad: Morphology, contact: Contact, violations: Sequence[Violation] = (), keep_out_mm: Sequence[Corners] = ()
) -> Figure:
    """Draw the plan of a pad.

    Crossings within a family are ringed, broken rules marked with a red cross, keep-outs hatched; the contact is drawn
    at the centre. Fibres are numbered from 1 at their ends, and named in an SVG so that it can be imported again.

    Args:
        pad: the pad.
        contact: the contact.
        violations: broken rules, as `check_rules` returns them.
        keep_out_mm: polygons that fibres must avoid, mm from the centre of the pad.

    Returns:
        A matplotlib figure with axes in mm from the centre of the pad.

    Raises:
        InputError: an argument of the wrong type, or a polygon of the wrong shape.
    """
    pad, contact = check_type("pad", pad, Morphology), check_type("contact", contact, Contact)
    for name, items in (("violations", violations), ("keep_out_mm", keep_out_mm)):
        if not isinstance(items, Sequence):
            raise InputError(f"{name} is {short_repr(items)}, expected a list")
    if not all(isinstance(violation, Violation) for violation in violations):
        raise InputError(f"violations is {short_repr(violations)}, expected the result of check_rules")
    polygons = [check_array("keep_out_mm", corners) for corners in keep_out_mm]
    for polygon in polygons:
        if polygon.ndim != 2 or polygon.shape[1] != 2 or not len(polygon):
            raise InputError(f"keep_out_mm has a polygon of shape {polygon.shape}, expected (n, 2)")

    width, height = (side / 2 for side in pad.layout.size_mm)
    half, scale = max(width, height), 6.4 / max(width, height)
    figure = Figure(figsize=(max(scale * width, 4.8), max(scale * height, 2.4)), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    axes.add_patch(Rectangle((-width, -height), 2 * width, 2 * height, facecolor=PAPER, edgecolor=FAINT, gid="pad"))
    for polygon in polygons:
        axes.add_patch(Polygon(polygon, facecolor="white", edgecolor=INK, hatch="///", linewidth=0.8))
    for fibre, points in enumerate(flatten(pad, TOLERANCE)):
        family = pad.layout.family(fibre)
        x, y = pad.to_mm(points).T
        color, name = ((HORIZONTAL, "horizontal"), (VERTICAL, "vertical"))[family]
        gid = f"{name}-{fibre + 1 - pad.layout.families[family].start}"  # import_plan reads these names
        (line,) = axes.plot(x, y, color=color, linewidth=1.6, solid_capstyle="round", gid=gid)
        line.get_path().should_simplify = False
        ha, va, dx, dy = (("left", "center", 0.02, 0), ("center", "bottom", 0, 0.02))[family]
        axes.text(x[-1] + dx * half, y[-1] + dy * half, str(fibre + 1), color=color, fontsize=9, ha=ha, va=va)

    markers = [
        (pad.to_mm(c.position), pad.layout.family(c.first) == pad.layout.family(c.second)) for c in crossings(pad)
    ]
    for same, size, color in ((False, 10, INK), (True, 40, ALARM)):
        points = np.array([position for position, is_same in markers if is_same == same]).reshape(-1, 2)
        axes.scatter(*points.T, s=size, facecolor="none" if same else color, edgecolor=color, linewidth=0.8, zorder=3)
    axes.add_patch(_contact_patch(contact, pad.unit_mm))
    points = np.array([v.place_mm for v in violations if v.place_mm is not None]).reshape(-1, 2)
    axes.scatter(*points.T, marker="x", s=50, color=ALARM, linewidth=1.8, zorder=4)

    x_limit, y_limit = width + 0.08 * half, height + 0.08 * half
    axes.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(-x_limit, x_limit), ylim=(-y_limit, y_limit))
    axes.spines[["top", "right"]].set_visible(False)
    n_same = sum(same for _, same in markers)
    axes.set_title(
        f"{pad.layout}, {len(markers)} crossings"
        + (f", {n_same} within a family" if n_same else "")
        + (f", {len(violations)} rules broken" if violations else ""),
        fontsize=10,
        color=ALARM if violations else INK,
    )
    return figure


def _contact_patch(contact: Contact, unit_mm: float) -> Circle | Polygon:
    """Return the outline of a contact, or the circle at half of the largest weight of a measured profile."""
    style = {"color": INK, "alpha": 0.15, "linewidth": 0}
    if contact.sensitivity_profile:
        return Circle((0, 0), _half_width_mm(contact.sensitivity_profile), **style)
    radius = contact.radius * unit_mm
    if contact.sides is None:
        return Circle((0, 0), radius, **style)
    angle = 2 * np.pi * np.arange(contact.sides) / contact.sides
    return Polygon(radius * np.column_stack([np.cos(angle), np.sin(angle)]), **style)


def _half_width_mm(profile: Sequence[tuple[float, float]]) -> float:
    """Return the largest distance at which a profile is half of its maximum, by linear interpolation, mm."""
    distance, weight = np.abs(np.array(profile)).T
    half = weight.max() / 2
    last = int(np.flatnonzero(weight >= half)[-1])  # never the last point, whose weight is 0
    share = (weight[last] - half) / (weight[last] - weight[last + 1])
    return float(distance[last] + share * (distance[last + 1] - distance[last]))
