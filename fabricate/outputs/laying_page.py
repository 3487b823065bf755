"""Sections of `fabrication.json` on casting and laying, and `laying.md`, the same as a page for the bench.

Positions are in the frame of the plan, also on the page.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from padforge.design.settings import is_hole
from padforge.fabricate.materials import PLASTICS, PRODUCTS, divider_ohm
from padforge.fabricate.outputs.drawings import CROSSING_LINK, MIRRORED, ORIENTATION_LINK, orientation_sentence
from padforge.fabricate.plan import Plan, fibre_layers, overlap
from padforge.fabricate.settings import MouldSettings, PrinterSettings

Document = Mapping[str, Any]

MAX_SOURCE_OHM = 10_000  # resistance of a fibre above which an input needs a capacitor
SURPLUS_PERCENT = 10  # silicone that stays in the cup and on the stick
WASTE_PERCENT = 20  # fibre that breaks or is cut too short
PRINT_MM_S = 50.0  # mean speed along lines of filament, a rule of thumb
RESIN_LAYER_S = 12.0  # time for a layer of resin, a rule of thumb
STIR_MIN, DEGAS_MIN = 3.0, 3.0  # as the makers of silicones advise
LAY_MIN_PER_M = 60.0  # time to lay and seal a metre of fibre by hand, an estimate
LAY_MIN_PER_CROSSING = 2.0  # additional time for every crossing, an estimate
PRINT_SETTINGS_HEAD = ("PrusaSlicer", "OrcaSlicer, Bambu Studio", "Cura", "because")
_PRINT_SETTINGS = """\
Layer height: {layer} | Layer height: {layer} | Layer Height: {layer} \
| floor and ridges are checked to be whole multiples of it
First layer height: {first} | First (Initial) layer height: {first} | Initial Layer Height: {first} \
| the rest of the floor, {floor:g} mm in all, is whole layers, so that ridges begin with one
Extrusion width, External perimeters: {line} | Line width, Outer wall: {line} | Outer Wall Line Width: {line} \
| a ridge {ridge:g} mm wide is {ridge_lines}
Perimeter generator: Arachne | Wall generator: Arachne | (no other) \
| its lines are as wide as the ridge; Classic drops what is narrower than its line
Classic only: Detect thin walls on, Fill gaps off \
| Classic only: Detect thin wall on; in OrcaSlicer Apply gap fill: Nowhere | Print Thin Walls: on \
| a thin ridge is printed in one stroke, not left out or filled with dots
Perimeters: {walls} | Wall loops: {walls} | Wall Line Count: {walls} \
| the walls are tight, and do not give as the casting is pulled out
Solid layers, Top: {solid}; Top fill pattern: Monotonic; Fill density: 20 % \
| Top shell layers: {solid}; Top surface pattern: Monotonic; Sparse infill density: 20 % \
| Top Layers: {solid}; Monotonic Top/Bottom Order: on; Infill Density: 20 % \
| the pad takes on the face of the floor: even, without a print of the infill
Generate support material: off | Enable support: off | Generate Support: off \
| no face needs supports, and their traces show in the pad
Brim type: Outer brim only; Brim width: 5 mm | Brim type: Outer brim only; Brim width: 5 mm \
| Build Plate Adhesion Type: Brim; Brim Location: Outside Only \
| a floor whose corners lift makes a warped pad, and a brim outside touches nothing that is cast
Seam position: Aligned | Seam position: Aligned | Z Seam Alignment: Sharpest Corner \
| at random, its lumps would narrow tracks everywhere
XY Size Compensation: 0 | X-Y contour compensation and X-Y hole compensation: 0 | Horizontal Expansion: 0 \
| it would be added to both sides of every ridge
Elephant foot compensation: 0.1 to 0.2 mm | Elephant foot compensation: 0.1 to 0.2 mm \
| Initial Layer Horizontal Expansion: -0.1 to -0.2 mm | {foot}; no ridge is in that layer"""
_RESIN_SETTINGS = """\
- Slice it in layers of {layer:g} mm, flat on the plate: tilted, the floor comes out in steps, and the pad takes on \
its face.
- Turn anti-aliasing, blur and compensation of sizes off. A ridge is {pixels} wide: grey ones make its sides soft, and \
what is added on either side narrows the silicone between two.
- Let the bottom layers, which are exposed longer and grow sideways, end below the ridges: the floor is {floor:g} mm, \
{layers:.3g} layers.
- Calibrate the exposure: a wall that is {ridge:g} mm wide in the file must be so on the plate.
- Wash and cure it well. Traces of resin can keep silicone from curing: try a drop on a scrap first."""
_MIN_LINE = 0.85  # minimum width of a line, in nozzle diameters
_MAX_ROWS = 24  # maximum rows of a table of crossings on a page


def laying_document(plan: Plan, mould_mm3: float) -> dict[str, Any]:
    """Build the sections of the fabrication document on casting and laying, which `Build` describes.

    `mould_mm3` is the volume of the mould without its pins.
    """
    document = {
        "silicone": _silicone(plan, mould_mm3),
        "adhesive": _adhesive(plan),
        "order": _order(plan, mould_mm3),
        "fibre": asdict(plan.settings.fibre.material),
        "fibres": _fibres(plan),
        "laying_order": [[fibre + 1 for fibre in layer.fibres] for layer in fibre_layers(plan)],
        "crossings": _crossings(plan),
        "common_tracks": _common_tracks(plan),
    }
    if plan.settings.pad.leads == "one side":
        ends = [(lead.turned_mm[0], number) for number, pair in enumerate(plan.leads.pairs, 1) for lead in pair]
        document["exits"] = [number for _, number in sorted(ends, reverse=True)]
    return document


def pad_document(plan: Plan) -> dict[str, Any]:
    """Return the settings of `[pad]` for fabrication, with the numbers of fibres."""
    fields = {"deep_family", "leads", "keep_out_mm", "bent_radius_mm"}
    counts = {"horizontals": plan.pad.layout.horizontals, "verticals": plan.pad.layout.verticals}
    return plan.settings.pad.model_dump(mode="json", include=fields) | counts


def _silicone(plan: Plan, mould_mm3: float) -> dict[str, Any]:
    # The silicone fills the mould to the top of its walls: the bounding box less the volume of plastic.
    printed, material = plan.shrinkage_compensated, plan.settings.silicone.material
    volume_ml = (printed.tray.area * (plan.settings.mould.floor_mm + printed.silicone_mm) - mould_mm3) / 1000
    mass_g = volume_ml * material.density_g_per_ml * (1 + SURPLUS_PERCENT / 100)
    part_a_g, part_b_g = (round(mass_g * part / sum(material.parts), 2) for part in material.parts)
    return {
        **asdict(material),
        "parts": list(material.parts),
        "thickness_mm": plan.thickness_mm,
        "volume_ml": round(volume_ml, 4),
        "surplus_percent": SURPLUS_PERCENT,
        "mass_g": round(part_a_g + part_b_g, 2),
        "part_a_g": part_a_g,
        "part_b_g": part_b_g,
    }


def _adhesive(plan: Plan) -> dict[str, Any]:
    # An upper bound: it includes the fibres, and counts the volume at crossings twice.
    steps = []
    for layer in fibre_layers(plan):
        tapered = layer.depth_mm / 2 if plan.settings.ridge_slope else 0
        outline = plan.outline(layer.fibres, tapered) if tapered else plan.ridges[layer.index]
        steps.append(overlap(outline, plan.silicone).area * layer.depth_mm / 1000)
    return {"name": "silicone adhesive", "volume_ml": round(sum(steps), 4), "steps_ml": [round(ml, 4) for ml in steps]}


def _fibres(plan: Plan) -> list[dict[str, Any]]:
    ohm_per_mm, entries = plan.settings.fibre.material.ohm_per_mm, []
    for fibre, (layer, length_mm) in enumerate(zip(plan.layer_indices, plan.lengths_mm.tolist(), strict=True)):
        cut_mm = length_mm + 2 * plan.settings.mould.lead_mm
        ohm = None if ohm_per_mm is None else ohm_per_mm * cut_mm
        entries.append({
            "number": fibre + 1,
            "fibre": plan.pad.layout.fibre_name(fibre),
            "level": layer,
            "ridge_mm": plan.shrinkage_compensated.heights_mm[layer],
            "depth_mm": plan.depths_mm[layer],
            "in_pad_mm": round(length_mm, 2),
            "cut_mm": round(cut_mm, 2),
            "resistance_ohm": None if ohm is None else round(ohm, 2),
            "divider_ohm": None if ohm is None else divider_ohm(ohm),
        })  # fmt: skip
    return entries


def _order(plan: Plan, mould_mm3: float) -> dict[str, Any]:
    printer, mould = plan.settings.printer, plan.settings.mould
    fibre_m = float(plan.lengths_mm.sum() + 2 * mould.lead_mm * plan.pad.layout.fibres) / 1000
    minutes = LAY_MIN_PER_M * plan.lengths_mm.sum() / 1000 + LAY_MIN_PER_CROSSING * len(plan.crossings)
    if printer.resin:
        seconds = RESIN_LAYER_S * (mould.floor_mm + plan.shrinkage_compensated.silicone_mm) / printer.layer_mm
    else:
        seconds = mould_mm3 / (printer.nozzle_mm * printer.layer_mm * PRINT_MM_S)
    return {
        "fibre_m": round(fibre_m * (1 + WASTE_PERCENT / 100), 3),
        "waste_percent": WASTE_PERCENT,
        "plastic_g": round(mould_mm3 / 1000 * PLASTICS[printer.resin][1], 1),
        "print_h": round(seconds / 3600, 2),
        "laying_h": round(float(minutes) / 60, 2),
    }


def _crossings(plan: Plan) -> dict[str, Any]:
    table: list[list[Any]] = []
    for crossing in plan.crossings:
        pair = crossing.first, crossing.second
        depths = [plan.depths_mm[plan.layer_indices[fibre]] for fibre in pair]
        # Fibres lie at the bottom of their tracks, so that the gap is the difference of depths less one diameter.
        gap = abs(depths[0] - depths[1]) - plan.settings.fibre.material.diameter_mm
        position = [round(x, 3) for x in plan.pad.to_mm(crossing.position).tolist()]
        table.append([*map(plan.pad.layout.fibre_name, pair), *position, *depths, round(gap, 3)])
    return {
        "total": len(table),
        "same_family": len(plan.clashes),
        "gap_mm": min((row[-1] for row in table), default=None),
        "columns": ["first", "second", "x_mm", "y_mm", "depth_first_mm", "depth_second_mm", "gap_mm"],
        "table": table,
    }


def _common_tracks(plan: Plan) -> list[dict[str, Any]]:
    """Return the long common stretches, the longest first; a crossing at a right angle has a length of two widths."""
    min_mm = 4 * plan.settings.mould.ridge_width_mm
    return [
        {
            "shallow": track.shallow + 1,
            "deep": track.deep + 1,
            "length_mm": round(track.length_mm, 3),
            "position_mm": [round(x, 3) for x in track.position_mm],
        }
        for track in sorted(plan.common_tracks, key=lambda track: -track.length_mm)
        if track.length_mm > min_mm
    ]


def laying_page(document: Document) -> str:
    """Return `laying.md`, a page to print for the bench, from a fabrication document."""
    sections = {
        "Pad": _pad_lines(document),
        "Order": _order_lines(document),
        "Print": _print_lines(document),
        "Mix": _mix_lines(document["silicone"]),
        "Cast": _cast_lines(document),
        "Orientation": _orientation_lines(document),
        "Lay": _lay_lines(document),
        "Wire": _wire_lines(document),
        "Crossings": _crossing_lines(document),
        "Checks": _check_lines(document["findings"]),
    }
    lines = [line for title, lines in sections.items() for line in ("", f"## {title}", "", *lines)]
    return "\n".join(["# How to make the pad", *lines, ""])


def _table_lines(head: Sequence[object], rows: Sequence[Sequence[object]]) -> Iterator[str]:
    for row in (head, ["---"] * len(head), *rows):
        yield f"| {' | '.join(map(str, row))} |"


def _pad_lines(document: Document) -> Iterator[str]:
    thickness_mm, n_fibres = document["silicone"]["thickness_mm"], len(document["fibres"])
    width, height = np.broadcast_to(document["sizes"]["pad_mm"], 2)
    yield f"The pad is {width:.5g} x {height:.5g} mm, {thickness_mm:.3g} mm thick, with {n_fibres} fibres."
    keep_outs = document["settings"]["pad"]["keep_out_mm"]
    if holes := [keep_out for keep_out in keep_outs if is_hole(tuple(keep_out))]:
        yield "\nIt has these holes:\n"
        rows = []
        for x, y, diameter, *heads in holes:
            sunk = [f"{head:g} mm, {thickness_mm / 2:.3g} mm deep" for head in heads] or ["-"]
            rows.append((f"{x:g} mm", f"{y:g} mm", f"{diameter:g} mm", *sunk))
        yield from _table_lines(("x", "y", "diameter", "screw's head"), rows)
        yield """
Positions are from the centre of the pad. As it lies to be used, tracks up, x runs to the left and y away from you. \
The heads of screws sink into the face with the tracks."""


def _order_lines(document: Document) -> Iterator[str]:
    order, fibre, silicone = document["order"], document["fibre"], document["silicone"]
    n_fibres, resin = len(document["fibres"]), document["settings"]["printer"]["resin"]
    dividers = Counter(entry["divider_ohm"] for entry in document["fibres"] if entry["divider_ohm"] is not None)
    values = ", ".join(f"{count} of {_ohms(ohm)}" for ohm, count in sorted(dividers.items()))
    resistances = [entry["resistance_ohm"] or 0.0 for entry in document["fibres"]]
    diameter = f"{fibre['diameter_mm']:g} mm"
    amounts = {
        "fibre": f"{order['fibre_m']:.2f} m of {fibre['name']}" + f", {diameter}" * (diameter not in fibre["name"]),
        "silicone": f"{silicone['mass_g']:.0f} g of {silicone['name']}",
        "adhesive": f"up to {sum(document['adhesive']['steps_ml']):.2f} ml in the tracks",
        "resin" if resin else "filament": f"{order['plastic_g']:.0f} g of {PLASTICS[resin][0]}",
        "connectors": f"{2 * n_fibres}",
        "wire": f"{2 * n_fibres} pieces, from the pad to the board",
        "resistors": values or f"{n_fibres}, of values by the resistance of the fibre",
        "capacitors": f"{n_fibres}" if max(resistances) > MAX_SOURCE_OHM else "",
        "board": f"for {n_fibres} fibres",
    }
    rows = [(kind, amount, *PRODUCTS[kind]) for kind, amount in amounts.items() if amount]
    yield from _table_lines(("kind", "amount", "properties", "for example"), rows)
    yield f"""
The fibre includes {order["waste_percent"]:g} % for waste. The mould prints in about {order["print_h"]:.1f} h, by \
rules of thumb; a slicer knows better. Laying and sealing by hand takes about {order["laying_h"]:.1f} h, an estimate \
of {LAY_MIN_PER_M:g} minutes a metre and {LAY_MIN_PER_CROSSING:g} minutes a crossing, without the time in which \
silicone and adhesive cure."""


def _print_lines(document: Document) -> Iterator[str]:
    size = " x ".join(f"{side:.2f}".rstrip("0").rstrip(".") for side in document["size_mm"])
    volume_ml, settings = document["mould_volume_ml"], document["settings"]
    mould, printer = MouldSettings(**settings["mould"]), PrinterSettings(**settings["printer"])
    plastic, density = PLASTICS[printer.resin]
    yield f"- The mould is {size} mm and takes {volume_ml:.1f} ml, {volume_ml * density:.0f} g of {plastic} if solid."
    yield "- Print it as it lies, open side up, without supports."
    if mould.number_mm:
        yield f"- {MIRRORED}"
    if printer.resin:
        pixels = mould.ridge_width_mm / printer.nozzle_mm
        yield _RESIN_SETTINGS.format(
            layer=printer.layer_mm,
            pixels=f"{pixels:.3g} pixel{'s' * (pixels != 1)}",
            floor=mould.floor_mm,
            layers=mould.floor_mm / printer.layer_mm,
            ridge=mould.ridge_width_mm,
        )
    if mould.lid:
        yield "- Print the lid as well."
    if mould.holder:
        yield f"""\
- Print the holder last, in the middle of the bed, and leave it there. The finished pad lies in it with its tracks up; \
{_cut_corner(settings["pad"])} the cut corner."""
    if mould.conductive:
        yield "- The mould called `conductive` is for casting a conductive material in place of fibres."
    if not printer.resin:
        yield "\nSlicer settings, by the names they have there:\n"
        yield from _table_lines(PRINT_SETTINGS_HEAD, print_settings_rows(mould, printer))


def print_settings_rows(mould: MouldSettings, printer: PrinterSettings) -> list[tuple[str, ...]]:
    """Return the slicer settings for a filament printer, rows below `PRINT_SETTINGS_HEAD`."""
    ridge, layer = mould.ridge_width_mm, printer.layer_mm
    n_lines = max(1, int(ridge / (_MIN_LINE * printer.nozzle_mm) + 1e-6))
    line = max(ridge / n_lines, _MIN_LINE * printer.nozzle_mm)
    ridge_lines = "one line" if n_lines == 1 else f"{n_lines} lines"
    if ridge < printer.nozzle_mm - 1e-9:
        ridge_lines = "narrower than the nozzle: see the checks"
    # The first layer takes up the floor's excess over whole layers; it is at most half a nozzle, or 1.5 layers, high.
    layers = mould.floor_mm / layer
    fraction = max(0.0, layers - math.floor(layers + 1e-6))
    max_first = min(max(1.5, printer.nozzle_mm / 2 / layer), layers)
    first = round((fraction + math.floor(max_first - fraction + 1e-6)) * layer, 6)
    settings = _PRINT_SETTINGS.format(
        layer=f"{layer:g} mm",
        first=f"{first:g} mm",
        floor=mould.floor_mm,
        line=f"{line:.3g} mm",
        ridge=ridge,
        ridge_lines=ridge_lines,
        walls=min(4, max(2, math.ceil(mould.wall_mm / 2 / line - 1e-6))),
        solid=math.ceil(0.8 / layer - 1e-6),  # 0.8 mm of solid plastic hide the infill
        foot="the holes of the lid stay open" if mould.lid else "the mould stands flat",
    )
    return [tuple(row.split(" | ")) for row in settings.splitlines()]


def _cut_corner(pad: Document) -> str:
    """Return the start of the sentence on the holder's cut corner."""
    if pad["leads"] == "one side":
        return "its leads are at the side of"
    first = [first for first, count in ((1, pad["horizontals"]), (pad["horizontals"] + 1, pad["verticals"])) if count]
    return f"fibres {first[0]} and {first[1]} start at" if len(first) > 1 else f"fibre {first[0]} starts at"


def _mix_lines(silicone: Document) -> Iterator[str]:
    parts = [round(silicone[key], 1) for key in ("part_a_g", "part_b_g")]
    masses = [f"{mass:.1f} g" for mass in (*parts, sum(parts))]
    yield from _table_lines((silicone["name"], "part A", "part B", "together"), [("mass", *masses)])
    yield f"""
The mould holds {silicone["volume_ml"]:.1f} ml, the pad is {silicone["thickness_mm"]:.3g} mm thick. The masses include \
{silicone["surplus_percent"]:g} % for what stays in the cup."""
    if silicone["shrinkage"]:
        yield f"""\
The silicone shrinks by {100 * silicone["shrinkage"]:.3g} % as it cures, and the mould is larger by that. Lengths and \
positions below are those of the pad."""


def _cast_lines(document: Document) -> Iterator[str]:
    mould, silicone = document["settings"]["mould"], document["silicone"]
    minutes = (silicone["pot_life_min"], 60 * silicone["cure_h"])
    pot_life, cure = (f"{time:g} minutes" if time <= 90 else f"{time / 60:.3g} hours" for time in minutes)
    pour = "Pour it slowly into one corner of the level mould, up to the top of the walls."
    if mould["spout"]:
        pour = "Lay the lid on the level mould and pour through its spout until silicone rises in the vents."
    elif mould["lid"]:
        pour += " Lay the lid on: air and surplus leave by its vents."
    around = " and around every pillar" if document["settings"]["pad"]["keep_out_mm"] else ""
    yield f"""\
1. Stir part A and part B together for {STIR_MIN:g} minutes, with the sides of the cup. The pot life is {pot_life}: \
finish pouring within it.
2. Degas the mix in a vacuum until it has risen, to three or four times its height, and fallen again: {DEGAS_MIN:g} \
minutes or so.
3. {pour}
4. Leave it for {cure} at room temperature.
5. Free the casting all along the walls{around}, then pull it out from a corner."""


def _orientation_lines(document: Document) -> Iterator[str]:
    pad = document["settings"]["pad"]
    horizontals, verticals = counts = pad["horizontals"], pad["verticals"]
    first, second = (
        f"{start} to {end}" if end > start else f"{start}"
        for start, end in ((1, horizontals), (horizontals + 1, horizontals + verticals))
    )
    numbers = f" Horizontal fibres are {first}, vertical ones {second}." if all(counts) else ""
    yield orientation_sentence(counts, pad["leads"]) + numbers
    for finding in document["findings"]:
        if finding["name"] == "fibre_strain":
            worn = "The pad is worn on a cylinder whose axis runs along y, the face with the tracks outwards"
            yield f"\n{worn}: {finding['message']}."
    yield f"\n{ORIENTATION_LINK}"


def _lay_lines(document: Document) -> Iterator[str]:
    mould, adhesive, fibre = document["settings"]["mould"], document["adhesive"], document["fibre"]
    legible = " The numbers on it read the right way now." if mould["number_mm"] else ""
    limits = []
    if fibre["max_strain"] is not None:
        limits.append(f"{100 * fibre['max_strain']:.3g} % of stretch at most")
    if fibre["min_bend_radius_mm"] is not None:
        limits.append(f"bends of no less than {fibre['min_bend_radius_mm']:g} mm radius")
    handling = f" Lay them unstretched: {fibre['name']} bears {' and '.join(limits)}." if limits else ""
    yield f"""\
1. Turn the casting over, as drawn above: the tracks lie on top.{legible}
2. Cut the fibres and lay them in steps, the deepest first. Press each down to the bottom of its track, with \
{mould["lead_mm"]:g} mm out at both ends.{handling} Measure its resistance: one that is broken is laid again now.
3. After each step, fill the tracks over the fibres with {adhesive["name"]}. Keep the tracks that cross above clear. \
Let it cure before the next step, a day if in doubt.
4. Measure the resistance of every fibre again, write it down, and measure between all fibres: no two may be in \
contact. Then crimp a wire to each end, and pull gently: the resistance must not change.
"""
    rows = []
    for step, (numbers, volume_ml) in enumerate(zip(document["laying_order"], adhesive["steps_ml"], strict=True), 1):
        for entry in (document["fibres"][number - 1] for number in numbers):
            lengths_mm = (f"{entry[key]:.1f} mm" for key in ("in_pad_mm", "cut_mm"))
            sealed = f"{volume_ml:.2f} ml" if entry["number"] == numbers[-1] else ""
            rows.append((step, entry["number"], entry["fibre"], f"{entry['depth_mm']:.3g} mm", *lengths_mm, sealed))
    yield from _table_lines(
        ("step", "number", "fibre", "track depth", "in the pad", "cut to", "then seal with up to"), rows
    )
    if "laying.gcode" in document["files"]:
        yield """
Or let a machine lay them in this order, on the pad turned over: its toolpath is in `laying.gcode` and drawn in \
`figures/toolpath.svg`. It waits while you fasten and cut each fibre and seal each step."""


def _wire_lines(document: Document) -> Iterator[str]:
    fibres, ohm_per_mm = document["fibres"], document["fibre"]["ohm_per_mm"]
    if "exits" in document:
        numbers = ", ".join(map(str, document["exits"]))
        yield f"Along the near side, from left to right as the pad lies for laying, these fibres end: {numbers}.\n"
    if ohm_per_mm is None:
        yield f"""\
The resistance of the fibre, {document["fibre"]["name"]}, is unknown: measure 100 mm of it and set `[fibre] \
ohm_per_mm`. The resistances of all fibres and their fixed resistors are then listed here."""
        return
    yield f"""\
At {ohm_per_mm:.3g} Ohm per mm the fibres should have these resistances from end to end, leads included. A voltage \
divider is most sensitive if its fixed resistor is as large as the fibre at rest: here the nearest of the E24 series. \
1 % more in the fibre then is 1/400 of the supply, 8 mV of 3.3 V.
"""
    rows = [(f["number"], f["fibre"], *(_ohms(f[key]) for key in ("resistance_ohm", "divider_ohm"))) for f in fibres]
    yield from _table_lines(("number", "fibre", "resistance", "fixed resistor"), rows)


def _ohms(ohm: float) -> str:
    """Format a resistance to three digits."""
    factor, unit = next(pair for pair in ((1e6, "MOhm"), (1e3, "kOhm"), (1.0, "Ohm")) if ohm >= pair[0] or pair[0] == 1)
    return f"{float(f'{ohm / factor:.3g}'):g} {unit}"


def _crossing_lines(document: Document) -> Iterator[str]:
    crossings = document["crossings"]
    if not crossings["total"]:
        yield "No two fibres cross."
        return
    gap_mm, is_short = crossings["gap_mm"], crossings["total"] <= _MAX_ROWS
    gaps = f"At least {gap_mm:g} mm lie between two fibres." if gap_mm > 0 else "Some touch."
    yield f"{crossings['total']} crossings, {crossings['same_family']} of them within a family. {gaps}"
    yield f"\n{CROSSING_LINK}\n"
    if is_short or document["common_tracks"]:
        yield "Positions are from the centre of the pad. As it lies, x runs to the left and y away from you.\n"
    if tracks := document["common_tracks"]:
        yield """\
Here a track lies over a deeper one for longer than at two crossings at right angles. It has no floor of silicone \
there: let the adhesive over the deeper fibre cure, and check that it covers it, before you lay the upper one.
"""
        rows = []
        for track in tracks[:_MAX_ROWS]:
            lengths_mm = (f"{mm:z.1f} mm" for mm in (*track["position_mm"], track["length_mm"]))
            rows.append((f"{track['shallow']} over {track['deep']}", *lengths_mm))
        yield from _table_lines(("tracks", "x", "y", "in common"), rows)
        if len(tracks) > _MAX_ROWS:
            yield f"\nThese are the {_MAX_ROWS} longest of {len(tracks)}; `fabrication.json` has them all."
        yield ""
    if is_short:
        number = {fibre["fibre"]: fibre["number"] for fibre in document["fibres"]}
        rows = [
            (f"{number[one]} and {number[two]}", f"{x:z.1f} mm", f"{y:z.1f} mm", _depths(a, b), f"{gap:g} mm")
            for one, two, x, y, a, b, gap in crossings["table"]
        ]
        yield from _table_lines(("fibres", "x", "y", "depths", "between them"), rows)
        return
    counts = Counter((max(a, b), min(a, b), gap) for *_, a, b, gap in crossings["table"])
    rows = [(_depths(a, b), f"{gap:g} mm", count) for (a, b, gap), count in sorted(counts.items(), reverse=True)]
    yield from _table_lines(("depths", "between the fibres", "crossings"), rows)
    yield "\n`fabrication.json` has the position of each."


def _depths(first_mm: float, second_mm: float) -> str:
    return f"{first_mm:.3g} and {second_mm:.3g} mm"


def _check_lines(findings: Sequence[Document]) -> Iterator[str]:
    remarks = sorted((f for f in findings if f["status"] != "pass"), key=lambda finding: finding["status"])
    passed = f"{len(findings) - len(remarks)} of {len(findings)} checks passed."
    yield from (passed + " Look at the others:", "") if remarks else (passed,)
    for finding in remarks:
        count = len(finding["positions_mm"])
        positions = f" ({count} position{'s' * (count > 1)}, see `fabrication.json`)" if count else ""
        yield f"- **{finding['status']}** {finding['name']}: {finding['message']}{positions}"
