"""Draw the plan of a pad, and write the sections of a report on its design and its contact."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.common.page import PageSection, collapsible, columns, figures, heading, paragraph, table
from padforge.common.plotting import (
    ALARM,
    FAINT,
    FAMILY_COLOURS,
    HORIZONTAL,
    INK,
    PAPER,
    VERTICAL,
    add_caption,
    save_figure,
    style_axes,
)
from padforge.design.contact import (
    FIBRE_BLUR_MM,
    contact_press,
    fibre_strains,
    half_width_mm,
    half_widths_mm,
    profile_weights,
)
from padforge.design.layer import MODULUS_KPA, SILICONE, LayerPress, reduced_modulus_kpa
from padforge.design.morphology import Array, Morphology
from padforge.design.paths.curves import crossings, flatten
from padforge.design.settings import FAMILIES, Contact, Corners, PadSettings, RulesSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Polygon

    from padforge.design.objectives.rules import Violation

FORMAT = "padforge-design/1"  # format of design.json
TOLERANCE = 1e-3  # deviation of drawn curves from exact ones, grid units


def draw_plan(
    pad: Morphology, contact: Contact, violations: "Sequence[Violation]" = (), keep_out_mm: Sequence[Corners] = ()
) -> "Figure":
    """Draw the plan of a pad, with axes in mm from its centre.

    Crossings within a family are ringed, broken rules marked with a red cross, keep-outs hatched; the contact is drawn
    at the centre. Fibres are numbered from 1 at their starts, as in the mould. An SVG holds their names, so that it can
    be imported again.

    Args:
        pad: the pad.
        contact: the contact.
        violations: broken rules, as `check_rules` returns them.
        keep_out_mm: polygons that fibres must avoid, mm from the centre of the pad.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon, Rectangle

    width, height = (side / 2 for side in pad.layout.size_mm)
    half, scale = max(width, height), 6.4 / max(width, height)
    figure = Figure(figsize=(max(scale * width, 4.8), max(scale * height, 2.4)), layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    axes.add_patch(Rectangle((-width, -height), 2 * width, 2 * height, facecolor=PAPER, edgecolor=FAINT, gid="pad"))
    for polygon in keep_out_mm:
        axes.add_patch(Polygon(polygon, facecolor="white", edgecolor=INK, hatch="///", linewidth=0.8))
    for fibre, points in enumerate(flatten(pad, TOLERANCE)):
        family = pad.layout.family(fibre)
        x, y = pad.to_mm(points).T
        color = FAMILY_COLOURS[family]
        gid = pad.layout.fibre_name(fibre).replace(" ", "-")  # import_plan reads these names
        (line,) = axes.plot(x, y, color=color, linewidth=1.6, solid_capstyle="round", gid=gid)
        line.get_path().should_simplify = False
        ha, va, dx, dy = (("right", "center", 0.02, 0), ("center", "top", 0, 0.02))[family]
        axes.text(x[0] - dx * half, y[0] - dy * half, str(fibre + 1), color=color, fontsize=9, ha=ha, va=va)

    across, same = [], []  # positions of crossings of the families, and of crossings within one
    for c in crossings(pad):
        (same if pad.layout.family(c.first) == pad.layout.family(c.second) else across).append(pad.to_mm(c.position))
    for positions, size, face, edge in ((across, 10, INK, INK), (same, 40, "none", ALARM)):
        points = np.array(positions).reshape(-1, 2)
        axes.scatter(*points.T, s=size, facecolor=face, edgecolor=edge, linewidth=0.8, zorder=3)
    axes.add_patch(_contact_patch(contact, pad.unit_mm))
    points = np.array([v.place_mm for v in violations if v.place_mm is not None]).reshape(-1, 2)
    axes.scatter(*points.T, marker="x", s=50, color=ALARM, linewidth=1.8, zorder=4)

    x_limit, y_limit = width + 0.08 * half, height + 0.08 * half
    axes.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(-x_limit, x_limit), ylim=(-y_limit, y_limit))
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(
        f"{pad.layout}, {len(across) + len(same)} crossings"
        + (f", {len(same)} within a family" if same else "")
        + (f", {len(violations)} violation{'s' * (len(violations) > 1)} of rules" if violations else ""),
        fontsize=10,
        color=ALARM if violations else INK,
    )
    return figure


def _contact_patch(contact: Contact, unit_mm: float) -> "Circle | Polygon":
    """Return the outline of a shape, or the circle at half of the largest weight of a layer or a profile."""
    from matplotlib.patches import Circle, Polygon

    style = {"color": INK, "alpha": 0.15, "linewidth": 0}
    if contact.model != "shape":
        return Circle((0, 0), half_width_mm(contact), **style)
    radius = contact.radius * unit_mm
    if contact.sides is None:
        return Circle((0, 0), radius, **style)
    angle = 2 * np.pi * np.arange(contact.sides) / contact.sides
    return Polygon(radius * np.column_stack([np.cos(angle), np.sin(angle)]), **style)


def design_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Write the section on the fibres of a folder and its `design.json`: plan, expected errors, rules, objective.

    A damaged document raises any of the built-in errors.
    """
    terms, violations, settings = document["terms"], document["violations"], document["provenance"]["settings"]
    enforced, search = settings["rules"]["enforce"], settings["search"]
    pad = PadSettings(**settings["pad"])
    layout, (low, high) = pad.layout, pad.sensed
    size, sensed = _size_text(layout.size_mm), _size_text(layout.unit_mm * np.subtract(high, low))
    errors = [
        [name[-1], *(f"{float(errors_mm[name]):#.3g}" for errors_mm in (terms, document["straight"]))]
        for name in sorted(terms)
        if name.startswith("expected_error")
    ]
    check = f"{len(violations)} broken" if violations else "all hold" if enforced else "not enforced"
    plan = (
        f"Plan of the pad, {size}, of which {sensed} are sensed: horizontal and vertical fibres, their crossings, and"
        " the contact at the centre."
    )
    error_text = (
        "Expected error of a localizer in mm, averaged over all sets of failed fibres of a size. It is computed before"
        " anything is built, by a formula that agrees with the errors of trained networks within about 5%. Responses"
        f" to a press vary by {float(search['scatter']):.0%} of their value from press to press, plus"
        f" {float(search['noise']):.1%} of full scale."
    )
    broken, rules = {violation["rule"] for violation in violations}, []
    for name, limit in settings["rules"].items():
        if name != "enforce":
            result = "fail" if name in broken else "pass" if enforced else "not enforced"
            field = RulesSettings.model_fields.get(name)
            rules.append([field.description if field else name, limit, result, name])
    body = [
        columns(
            [figures([(folder / "figures/design.svg", plan)])],
            [
                heading("Errors by failed fibres"),
                paragraph(error_text),
                table(["failed fibres", "expected error (mm)", "straight fibres (mm)"], errors),
            ],
        ),
        heading("Design rules"),
        paragraph(f"Checked on the exact curves: {check}."),
        table(["rule", "limit", "result", "setting"], rules),
    ]
    if violations:
        rows = []
        for violation in violations:
            fibres, position_mm = ", ".join(map(str, violation["fibres"])), violation["place_mm"]
            position = "-" if position_mm is None else "({:.1f}, {:.1f})".format(*position_mm)
            rows.append([violation["rule"], fibres or "pad", position, violation["measured"], violation["limit"]])
        body.append(table(["broken rule", "fibres", "position (mm)", "measured", "limit"], rows))
    rows = [[name, value, document["descriptions"].get(name, "")] for name, value in terms.items()]
    body.append(collapsible("All terms of the objective", [table(["term", "value", "meaning"], rows)]))
    key_figures = [
        (f"{layout.horizontals} + {layout.verticals}", f"fibres on {size}"),
        (check, "design rules"),
        (f"{errors[0][1]} mm", "expected error of the design"),
    ]
    return [PageSection("Fibres", body, key_figures)]


def _size_text(sides_mm: Iterable[float]) -> str:
    return " x ".join(f"{round(float(side), 6):g}" for side in sides_mm) + " mm"


def draw_press(contact: Contact, pitch_mm: float) -> "Figure":
    """Draw the section of a layer under a press, and the weight of a fibre element over its distance from the press.

    Vertical fibres, `pitch_mm` apart, cross the section.
    """
    from matplotlib.figure import Figure

    press, families = contact_press(contact), profile_weights(contact)
    thickness, scale = contact.thickness_mm, contact.scale
    far = max(1.2 * pitch_mm, 2.2 * scale * press.contact_radius_mm)
    x = np.linspace(-far, far, 151)
    face = thickness - press.deflection(np.abs(x) / scale)
    top = thickness + 0.8 * contact.depth_mm

    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    section, weights = figure.subplots(1, 2)
    for axes in (section, weights):
        style_axes(axes)
    section.fill_between(x, 0, face, color=PAPER, linewidth=0)
    section.plot(x, face, color=INK, linewidth=1)
    tool = np.maximum(_tool_surface(contact, x / scale), face)
    section.fill_between(x, tool, top, where=tool < top, color=FAINT, linewidth=0)
    section.axhline(0, color=INK, linewidth=3)
    section.text(-far, 0.04 * thickness, f" {contact.base} base", color=INK, fontsize=8, va="bottom")
    horizontal, vertical = (thickness - depth for depth in contact.fibre_depths_mm)
    section.plot(x, horizontal - _sink(press, np.abs(x) / scale, horizontal), color=HORIZONTAL, linewidth=1.6)
    ends = np.arange(-(far // pitch_mm), far // pitch_mm + 1) * pitch_mm
    section.plot(ends, vertical - _sink(press, np.abs(ends) / scale, vertical), "o", color=VERTICAL, markersize=4)
    section.set(xlabel="x (mm)", ylabel="height (mm)", xlim=(-far, far), ylim=(-0.05 * thickness, top), aspect="equal")
    add_caption(section, f"{contact.tool} of {contact.tool_radius_mm:g} mm, {contact.depth_mm:g} mm deep")

    for name, color, (distance, plain, directed) in zip(FAMILIES, FAMILY_COLOURS, families, strict=True):
        weights.plot(distance, plain + directed, color=color, label=f"{name}, lengthwise")
        weights.plot(distance, plain, "--", color=color, label=f"{name}, crosswise")
    weights.axhline(0, color=FAINT, linewidth=0.8)
    weights.set(xlabel="distance from the press (mm)", ylabel="weight of an element", xlim=(0, 1.5 * far))
    weights.legend(frameon=False, fontsize=8)
    add_caption(weights, "fibres that point to the press, or pass it")
    return figure


def _tool_surface(contact: Contact, x: Array) -> Array:
    """Return the height of the undeformed tool over the base; infinite beside it."""
    radius, tip = contact.tool_radius_mm, contact.thickness_mm - contact.depth_mm
    if contact.tool == "flat":
        return np.where(np.abs(x) <= radius, tip, np.inf)
    if contact.tool == "ball":
        return np.where(np.abs(x) <= radius, tip + radius - np.sqrt(np.maximum(radius**2 - x**2, 0)), np.inf)
    return tip + x**2 / (2 * radius)


def _sink(press: LayerPress, r: Array, height_mm: float) -> Array:
    """Return the downward displacement of the silicone at a height, mm: the integral of its strain from the base."""
    heights = (np.arange(6) + 0.5) / 6 * height_mm
    return np.sum([press.strains(r, z, FIBRE_BLUR_MM).compressive for z in heights], axis=0) * height_mm / 6


def press_sections(
    document: Mapping[str, Any], max_strain: float | None, silicone: tuple[str, float] | None = None
) -> list[PageSection]:
    """Return the section on the press that a pad is designed for, with its picture; none if it has no layer.

    Args:
        document: `design.json` of the pad; a damaged one raises any of the built-in errors.
        max_strain: maximum strain of the fibres; None if unknown.
        silicone: name and Young's modulus, kPa; None for Ecoflex 00-20.
    """
    settings = document["provenance"]["settings"]
    contact = Contact(**settings["contact"])
    if contact.model != "layer":
        return []
    press = contact_press(contact)
    silicone_name, modulus_kpa = silicone or (SILICONE, MODULUS_KPA)
    force_n = press.force_n(reduced_modulus_kpa(modulus_kpa))
    rows = []
    families = zip(FAMILIES, contact.fibre_depths_mm, half_widths_mm(contact), fibre_strains(contact), strict=True)
    for name, depth, width, (squeeze, stretch) in families:
        result = "-" if max_strain is None else "pass" if stretch <= max_strain else "warn"
        allowed = "-" if max_strain is None else f"{max_strain:.0%}"
        rows.append([name, depth, f"{width:.1f}", f"{squeeze:.0%}", f"{stretch:.0%}", allowed, result])
    lead = (
        f"A {contact.tool} of {contact.tool_radius_mm:g} mm, pressed {contact.depth_mm:g} mm deep into silicone of"
        f" {contact.thickness_mm:g} mm, touches it within {press.contact_radius_mm:.1f} mm and takes"
        f" {force_n:.1f} N on {silicone_name}. Fibres respond to being pressed flat and stretched. The strains are"
        " those of a linear elastic layer, which holds for small strains only."
    )
    caption = "The press in section, true to scale, and the weight of an element of a fibre by its distance from it."
    head = ["fibres", "depth (mm)", "half width (mm)", "pressed flat by", "stretched by", "maximum strain", "result"]
    with TemporaryDirectory() as temporary:
        path = Path(temporary) / "press.png"
        save_figure(draw_press(contact, PadSettings(**settings["pad"]).layout.pitch_x_mm), path)
        picture = figures([(path, caption)])
    return [PageSection("Press", [paragraph(lead), picture, table(head, rows)])]


def contact_lines(document: Mapping[str, Any]) -> list[str]:
    """Summarise a `contacts.json`: errors with all fibres by contact, and contacts under which straight fibres win."""
    parts = []
    for pad in ("designed", "straight"):
        assumed, *others = [row["errors_mm"][0] for row in document["rows"] if row["pad"] == pad]
        parts.append(f"{assumed:.2f} mm under the assumed contact, {min(others):.2f} to {max(others):.2f} mm otherwise")
    lines = [f"contact: expected error {parts[0]}; of straight fibres {parts[1]}"]
    cases = [
        f"{contact} with {' and '.join(map(str, levels))} failed"
        for contact, shares in _shares_of_straight(document).items()
        if (levels := [n_failed for n_failed, share in enumerate(shares) if share >= 1])
    ]
    return lines + [f"  straight fibres are as good or better: {'; '.join(cases)}"] * bool(cases)


def _shares_of_straight(document: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the ratios of the errors of the designed pad to those of straight fibres, by contact."""
    errors = {(row["contact"], row["pad"]): row["errors_mm"] for row in document["rows"]}
    return {
        contact: [a / b for a, b in zip(errors[contact, "designed"], errors[contact, "straight"], strict=True)]
        for contact in dict.fromkeys(contact for contact, _ in errors)
    }


def contact_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Return the section on how the errors in a `contacts.json` depend on the contact model; see `design_sections`."""
    rows, scatter = document["rows"], document["scatter"]
    levels = range(max(len(row["errors_mm"]) for row in rows))
    lead = (
        "The contact is assumed until a printed pad is identified. Here the pad, and straight fibres of the same pad,"
        " are judged under other contacts as well: expected error in mm of a localizer that is trained under each, by"
        f" one reading of each fibre with a scatter of {float(scatter['share']):.0%} of the response and"
        f" {float(scatter['floor']):.1%} of full scale. Where rows differ, errors depend on the contact as"
        " much as on the pad; where straight fibres are better, optimising has not paid off."
    )
    head = ["contact", "fibres", *(f"{n_failed} failed" for n_failed in levels)]
    body = [[row["contact"], row["pad"], *(f"{error:.2f}" for error in row["errors_mm"])] for row in rows]
    for row, shares in enumerate(_shares_of_straight(document).values(), 1):  # after the two rows of each contact
        body.insert(3 * row - 1, ["", "designed / straight", *(f"{share:.0%}" for share in shares)])
    return [PageSection("Contact model", [paragraph(lead), table(head, body)])]
