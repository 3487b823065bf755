"""What the person at the bench needs: silicone to mix, fibres to cut, the order to lay them in, and a page of it all.

Places are those of the plan, on the page too.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from padforge.fabricate.materials import PLASTICS, divider_ohm
from padforge.fabricate.outputs.drawings import ORIENTATION_LINK, orientation_sentence
from padforge.fabricate.plan import Plan, fibre_layers, fibre_name, overlap
from padforge.fabricate.settings import MouldSettings, PrinterSettings


def markdown_table(head: Sequence[object], rows: Sequence[Sequence[object]]) -> Iterator[str]:
    """The lines of a Markdown table."""
    for row in (head, ["---"] * len(head), *rows):
        yield f"| {' | '.join(map(str, row))} |"


SURPLUS_PERCENT = 10
"""What sticks to the cup and the stick."""


def silicone_document(plan: Plan, mould_mm3: float) -> dict[str, Any]:
    """What fills the mould to the top of its walls: the box around it without the mould itself."""
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


def mixing_lines(silicone: Mapping[str, Any]) -> Iterator[str]:
    """What to weigh, from what `silicone_document` says."""
    parts = [round(silicone[key], 1) for key in ("part_a_g", "part_b_g")]
    masses = [f"{mass:.1f} g" for mass in (*parts, sum(parts))]
    yield from markdown_table((silicone["name"], "part A", "part B", "together"), [("mass", *masses)])
    yield ""
    yield (
        f"The mould holds {silicone['volume_ml']:.1f} ml, the pad is {silicone['thickness_mm']:.3g} mm thick."
        f" The masses include {silicone['surplus_percent']:g} % for what stays in the cup."
    )
    if silicone["shrinkage"]:
        yield (
            f"The silicone shrinks by {100 * silicone['shrinkage']:.3g} % as it cures, and the mould is larger by that."
            " Lengths and places below are those of the pad."
        )


def casting_lines(document: Mapping[str, Any]) -> Iterator[str]:
    """How to cast, in steps, from a whole fabrication document."""
    mould, silicone = document["settings"]["mould"], document["silicone"]
    pour = "Pour it slowly into one corner of the level mould, up to the top of the walls."
    if mould["spout"]:
        pour = "Lay the lid on the level mould and pour through its spout until silicone rises in the vents."
    elif mould["lid"]:
        pour += " Lay the lid on: air and surplus leave by its vents."
    pot_life = _duration(silicone["pot_life_min"])
    yield f"1. Stir part A and part B together. The pot life is {pot_life}: be done with pouring by then."
    yield "2. Degas the mix in a vacuum until its bubbles have burst."
    yield f"3. {pour}"
    yield f"4. Leave it for {_duration(60 * silicone['cure_h'])} at room temperature."
    around = " and around every pillar" if document["settings"]["pad"]["keep_out_mm"] else ""
    yield f"5. Free the casting all along the walls{around}, then pull it out from a corner."


def _duration(minutes: float) -> str:
    """Minutes up to an hour and a half, else hours."""
    return f"{minutes:g} minutes" if minutes <= 90 else f"{minutes / 60:.3g} hours"


def fibre_resistances(plan: Plan, length_mm: float) -> dict[str, float | None]:
    """Of a fibre from end to end, leads included, and of the fixed resistor of its divider; None where unknown."""
    ohm_per_mm = plan.settings.fibre.material.ohm_per_mm
    if ohm_per_mm is None:
        return {"resistance_ohm": None, "divider_ohm": None}
    ohm = ohm_per_mm * length_mm
    return {"resistance_ohm": round(ohm, 2), "divider_ohm": divider_ohm(ohm)}


def wiring_lines(document: Mapping[str, Any]) -> Iterator[str]:
    """What every fibre should have, and the resistor to wire it to, from a whole fabrication document."""
    fibres, ohm_per_mm = document["fibres"], document["fibre"]["ohm_per_mm"]
    if "exits" in document:
        numbers = ", ".join(map(str, document["exits"]))
        yield f"Along the near side, from left to right as the pad lies for laying, these fibres end: {numbers}."
        yield ""
    if ohm_per_mm is None:
        yield (
            f"The resistance of the fibre, {document['fibre']['name']}, is unknown: measure 100 mm of it and set"
            " `[fibre] ohm_per_mm`. What each fibre then has, and the fixed resistor that goes with it, stand here."
        )
        return
    yield (
        f"At {ohm_per_mm:.3g} Ohm per mm the fibres should have these resistances from end to end, leads included. A"
        " divider shows a change by the most if its fixed resistor is as large as the fibre at rest: here the nearest"
        " of the E24 series. 1 % more in the fibre then is 1/400 of the supply, 8 mV of 3.3 V."
    )
    yield ""
    rows = [(f["number"], f["fibre"], *(_ohms(f[key]) for key in ("resistance_ohm", "divider_ohm"))) for f in fibres]
    yield from markdown_table(("number", "fibre", "resistance", "fixed resistor"), rows)


def _ohms(ohm: float) -> str:
    """A resistance to three digits, as it is said at the bench."""
    factor, unit = next(pair for pair in ((1e6, "MOhm"), (1e3, "kOhm"), (1.0, "Ohm")) if ohm >= pair[0] or pair[0] == 1)
    return f"{float(f'{ohm / factor:.3g}'):g} {unit}"


PRINT_SETTINGS_HEAD = ("PrusaSlicer", "OrcaSlicer, Bambu Studio", "Cura", "because")
_SOLID_MM = 0.8
"""Of so much plastic above it, infill does not show."""
_MOST_WALLS = 4
_LEAST_LINE = 0.85
"""Width of a line at least, in nozzles."""


def print_settings_rows(mould: MouldSettings, printer: PrinterSettings) -> Iterator[tuple[str, ...]]:
    """What to set for a printer of filament: rows below `PRINT_SETTINGS_HEAD`."""
    layer, first = f"{printer.layer_mm:g} mm", f"{_first_layer_mm(mould, printer):g} mm"
    width, lines = _line(mould, printer)
    line = f"{width:.3g} mm"
    walls = min(_MOST_WALLS, max(2, math.ceil(mould.wall_mm / 2 / width - 1e-6)))
    solid = math.ceil(_SOLID_MM / printer.layer_mm - 1e-6)
    ridge = f"a ridge {mould.ridge_width_mm:g} mm wide is {'one line' if lines == 1 else f'{lines} lines'}"
    if mould.ridge_width_mm < printer.nozzle_mm - 1e-9:
        ridge = f"a ridge {mould.ridge_width_mm:g} mm wide is narrower than the nozzle: see the checks"
    yield (
        f"Layer height: {layer}",
        f"Layer height: {layer}",
        f"Layer Height: {layer}",
        "floor and ridges are checked to be so many of these",
    )
    yield (
        f"First layer height: {first}",
        f"First (Initial) layer height: {first}",
        f"Initial Layer Height: {first}",
        f"whole layers are left of the floor, {mould.floor_mm:g} mm, so that ridges begin with one",
    )
    yield (
        f"Extrusion width, External perimeters: {line}",
        f"Line width, Outer wall: {line}",
        f"Outer Wall Line Width: {line}",
        ridge,
    )
    yield (
        "Perimeter generator: Arachne",
        "Wall generator: Arachne",
        "(no other)",
        "its lines are as wide as the ridge; Classic drops what is narrower than its line",
    )
    yield (
        "Classic only: Detect thin walls on, Fill gaps off",
        "Classic only: Detect thin wall on; in OrcaSlicer Apply gap fill: Nowhere",
        "Print Thin Walls: on",
        "a thin ridge is drawn in one go, not left out or dabbed together",
    )
    yield (
        f"Perimeters: {walls}",
        f"Wall loops: {walls}",
        f"Wall Line Count: {walls}",
        "the walls are tight, and do not give as the casting is pulled out",
    )
    yield (
        f"Solid layers, Top: {solid}; Top fill pattern: Monotonic; Fill density: 20 %",
        f"Top shell layers: {solid}; Top surface pattern: Monotonic; Sparse infill density: 20 %",
        f"Top Layers: {solid}; Monotonic Top/Bottom Order: on; Infill Density: 20 %",
        "the pad takes on the face of the floor: even, without a print of the infill",
    )
    yield from _FIXED
    yield (
        "Elephant foot compensation: 0.1 to 0.2 mm",
        "Elephant foot compensation: 0.1 to 0.2 mm",
        "Initial Layer Horizontal Expansion: -0.1 to -0.2 mm",
        ("the holes of the lid stay open" if mould.lid else "the mould stands flat") + "; no ridge is in that layer",
    )


def resin_settings_lines(mould: MouldSettings, printer: PrinterSettings) -> Iterator[str]:
    """What to set for a printer of resin: items of a list."""
    ridge, pixels = mould.ridge_width_mm, mould.ridge_width_mm / printer.nozzle_mm
    yield (
        f"- Slice it in layers of {printer.layer_mm:g} mm, flat on the plate: tilted, the floor comes out in steps, and"
        " the pad takes on its face."
    )
    yield (
        "- Turn anti-aliasing, blur and compensation of sizes off. A ridge is"
        f" {pixels:.3g} pixel{'s' * (pixels != 1)} wide: grey ones make its sides soft, and what is added on either"
        " side narrows the silicone between two."
    )
    yield (
        f"- Let the bottom layers, which are exposed longer and grow sideways, end below the ridges: the floor is"
        f" {mould.floor_mm:g} mm, {mould.floor_mm / printer.layer_mm:.3g} layers."
    )
    yield f"- Find the exposure by a trial: a wall that is {ridge:g} mm wide in the file must be so on the plate."


_FIXED = (
    (
        "Generate support material: off",
        "Enable support: off",
        "Generate Support: off",
        "no face needs them, and what is left of them shows in the pad",
    ),
    (
        "Brim type: Outer brim only; Brim width: 5 mm",
        "Brim type: Outer brim only; Brim width: 5 mm",
        "Build Plate Adhesion Type: Brim; Brim Location: Outside Only",
        "a floor whose corners lift makes a warped pad, and a brim outside touches nothing that is cast",
    ),
    (
        "Seam position: Aligned",
        "Seam position: Aligned",
        "Z Seam Alignment: Sharpest Corner",
        "at random, its lumps would narrow tracks everywhere",
    ),
    (
        "XY Size Compensation: 0",
        "X-Y contour compensation and X-Y hole compensation: 0",
        "Horizontal Expansion: 0",
        "it would be added to both sides of every ridge",
    ),
)


def _first_layer_mm(mould: MouldSettings, printer: PrinterSettings) -> float:
    """What leaves whole layers of the floor: half a nozzle at most, or else a layer and a half."""
    layers = mould.floor_mm / printer.layer_mm
    part = max(0.0, layers - math.floor(layers + 1e-6))
    most = min(max(1.5, printer.nozzle_mm / 2 / printer.layer_mm), layers)
    return round((part + math.floor(most - part + 1e-6)) * printer.layer_mm, 6)


def _line(mould: MouldSettings, printer: PrinterSettings) -> tuple[float, int]:
    """Width of a line, mm, and how many make a ridge."""
    lines = max(1, int(mould.ridge_width_mm / (_LEAST_LINE * printer.nozzle_mm) + 1e-6))
    return max(mould.ridge_width_mm / lines, _LEAST_LINE * printer.nozzle_mm), lines


_LONGEST_TABLE = 24
"""More crossings than this leave no room for them on a page."""


def laying_document(plan: Plan, mould_mm3: float) -> dict[str, Any]:
    """The sections of the fabrication document that are about casting and laying, as JSON.

    Args:
        plan: of the mould.
        mould_mm3: volume of the mould without its pins.

    Returns:
        "silicone": to mix. "adhesive": volume of the tracks that it seals, by step of laying.
        "fibre": what they are of. "fibres": one each, in the order of their numbers.
        "laying_order": the numbers laid in each step, deep first.
        "crossings": all of them, with the silicone left between the fibres.
        "common_tracks": where a track lies over a deeper one for longer than at two crossings at right angles.
        "exits": of leads to one side, the numbers along it from left to right as the pad lies turned over.
    """
    ends = [(lead.turned_mm[0], number) for number, pair in enumerate(plan.leads.pairs, 1) for lead in pair]
    one_side = plan.settings.pad.leads == "one side"
    return {
        "silicone": silicone_document(plan, mould_mm3),
        "adhesive": _adhesive(plan),
        "fibre": asdict(plan.settings.fibre.material),
        "fibres": _fibres(plan),
        "laying_order": [[fibre + 1 for fibre in layer.fibres] for layer in fibre_layers(plan)],
        "crossings": _crossings(plan),
        "common_tracks": _common_tracks(plan),
        **({"exits": [number for _, number in sorted(ends, reverse=True)]} if one_side else {}),
    }


def pad_document(plan: Plan) -> dict[str, Any]:
    """What `[pad]` says of a mould and of the way its fibres lie, with how many they are."""
    said = plan.settings.pad.model_dump(mode="json", include={"deep_family", "leads", "keep_out_mm", "bent_radius_mm"})
    return {**said, "horizontals": plan.pad.layout.horizontals, "verticals": plan.pad.layout.verticals}


def _adhesive(plan: Plan) -> dict[str, Any]:
    """The volume of the tracks of every step; the fibres in them, and what crossing tracks share, are left in."""
    steps = []
    for layer in fibre_layers(plan):
        tapered = layer.depth_mm / 2 if plan.settings.ridge_slope else 0
        outline = plan.outline(layer.index, tapered) if tapered else plan.ridges[layer.index]
        steps.append(overlap(outline, plan.silicone).area * layer.depth_mm / 1000)
    return {"name": "silicone adhesive", "volume_ml": round(sum(steps), 4), "steps_ml": [round(ml, 4) for ml in steps]}


def _fibres(plan: Plan) -> list[dict[str, Any]]:
    mould, courses = plan.settings.mould, plan.lengths_mm
    return [
        {
            "number": fibre + 1,
            "fibre": fibre_name(plan, fibre),
            "level": level,
            "ridge_mm": plan.shrinkage_compensated.heights_mm[level],
            "depth_mm": plan.depths_mm[level],
            "in_pad_mm": round(course, 2),
            "cut_mm": round(course + 2 * mould.lead_mm, 2),
            **fibre_resistances(plan, course + 2 * mould.lead_mm),
        }
        for fibre, (level, course) in enumerate(zip(plan.layer_indices, courses.tolist(), strict=True))
    ]


def _crossings(plan: Plan) -> dict[str, Any]:
    """A fibre lies on the bottom of its track: between two is what lies between the bottoms, less a fibre."""
    table: list[list[Any]] = []
    for crossing in plan.crossings:
        pair = crossing.first, crossing.second
        depths = [plan.depths_mm[plan.layer_indices[fibre]] for fibre in pair]
        gap = abs(depths[0] - depths[1]) - plan.settings.fibre.material.diameter_mm
        place = [round(x, 3) for x in plan.pad.to_mm(crossing.position).tolist()]
        table.append([*(fibre_name(plan, fibre) for fibre in pair), *place, *depths, round(gap, 3)])
    return {
        "total": len(table),
        "same_family": len(plan.clashes),
        "gap_mm": min((row[-1] for row in table), default=None),
        "columns": ["first", "second", "x_mm", "y_mm", "depth_first_mm", "depth_second_mm", "gap_mm"],
        "table": table,
    }


def _common_tracks(plan: Plan) -> list[dict[str, Any]]:
    """At a right angle tracks have two widths in common; the longest stretches first."""
    least = 4 * plan.settings.mould.ridge_width_mm
    long = [each for each in plan.common_tracks if each.length_mm > least]
    return [
        {
            "shallow": each.shallow + 1,
            "deep": each.deep + 1,
            "length_mm": round(each.length_mm, 3),
            "position_mm": [round(x, 3) for x in each.position_mm],
        }
        for each in sorted(long, key=lambda each: -each.length_mm)
    ]


def laying_page(document: Mapping[str, Any]) -> str:
    """`laying.md` from a whole fabrication document: a page to print and take to the bench."""
    sections = {
        "Print": _printing(document),
        "Mix": mixing_lines(document["silicone"]),
        "Cast": casting_lines(document),
        "Which way round": _way_round(document),
        "Lay": _laying(document),
        "Wire": wiring_lines(document),
        "Crossings": _crossing_places(document),
        "Checks": _remarks(document["findings"]),
    }
    lines = [line for title, lines in sections.items() for line in ("", f"## {title}", "", *lines)]
    return "\n".join(["# How to make the pad", *lines, ""])


def _printing(document: Mapping[str, Any]) -> Iterator[str]:
    size = " x ".join(f"{side:.2f}".rstrip("0").rstrip(".") for side in document["size_mm"])
    volume_ml, mould = document["mould_volume_ml"], document["settings"]["mould"]
    settings = MouldSettings(**mould), PrinterSettings(**document["settings"]["printer"])
    resin = settings[1].resin
    plastic, density = PLASTICS[resin]
    yield f"- The mould is {size} mm and takes {volume_ml:.1f} ml, {volume_ml * density:.0f} g of {plastic} if solid."
    yield "- Print it as it lies, open side up, without supports."
    if resin:
        yield from resin_settings_lines(*settings)
        yield "- Wash and cure it well. Traces of resin can keep silicone from curing: try a drop on a scrap first."
    if mould["lid"]:
        yield "- Print the lid as well."
    if mould["holder"]:
        yield (
            "- Print the holder last, in the middle of the bed, and leave it there. The finished pad lies in it with"
            f" its tracks up; {_at_corner(document['settings']['pad'])} the cut corner."
        )
    if mould["conductive"]:
        yield "- The mould called `conductive` is for casting a conductive material in place of fibres."
    if not resin:
        yield from ("", "What to set in the slicer, by the names it has there:", "")
        yield from markdown_table(PRINT_SETTINGS_HEAD, list(print_settings_rows(*settings)))


def _at_corner(pad: Mapping[str, Any]) -> str:
    """What begins at the corner of the holder that is cut."""
    if pad["leads"] == "one side":
        return "its leads are at the side of"
    first = [first for first, count in ((1, pad["horizontals"]), (pad["horizontals"] + 1, pad["verticals"])) if count]
    return f"fibres {first[0]} and {first[1]} start at" if len(first) > 1 else f"fibre {first[0]} starts at"


def _way_round(document: Mapping[str, Any]) -> Iterator[str]:
    pad = document["settings"]["pad"]
    horizontals, verticals = counts = pad["horizontals"], pad["verticals"]
    numbers = f"Horizontal fibres are {_span(1, horizontals)}, vertical ones"
    numbers += f" {_span(horizontals + 1, horizontals + verticals)}."
    yield orientation_sentence(counts, pad["leads"]) + (f" {numbers}" if all(counts) else "")
    for finding in document["findings"]:
        if finding["name"] == "fibre_strain":
            yield ""
            yield (
                "The pad is worn on a cylinder whose axis runs along y, the face with the tracks outwards:"
                f" {finding['message']}."
            )
    yield ""
    yield ORIENTATION_LINK


def _laying(document: Mapping[str, Any]) -> Iterator[str]:
    mould, adhesive, fibres = document["settings"]["mould"], document["adhesive"], document["fibres"]
    read = " The numbers on it read the right way now." if mould["number_mm"] else ""
    yield f"1. Turn the casting over, as drawn above: the tracks lie on top.{read}"
    yield (
        "2. Cut the fibres and lay them in steps, the deepest first. Press each down to the bottom of its track, with"
        f" {mould['lead_mm']:g} mm out at both ends.{_handling(document['fibre'])}"
    )
    yield (
        f"3. After each step, fill the tracks over the fibres with {adhesive['name']}. Keep the tracks that cross above"
        " clear. Let it cure before the next step."
    )
    yield ""
    rows = []
    for step, (numbers, volume_ml) in enumerate(zip(document["laying_order"], adhesive["steps_ml"], strict=True), 1):
        for fibre in (fibres[number - 1] for number in numbers):
            lengths_mm = (f"{fibre[key]:.1f} mm" for key in ("in_pad_mm", "cut_mm"))
            sealed = f"{volume_ml:.2f} ml" if fibre["number"] == numbers[-1] else ""
            rows.append((step, fibre["number"], fibre["fibre"], f"{fibre['depth_mm']:.3g} mm", *lengths_mm, sealed))
    yield from markdown_table(("step", "number", "fibre", "depth", "in the pad", "cut to", "then seal with"), rows)
    if programs := [f"`{name}`" for name in document["files"] if name.startswith("laying.")]:
        yield ""
        yield (
            f"Or let a machine lay them in this order, on the pad turned over: its ways are in {' and '.join(programs)}"
            " and drawn in `toolpath.svg`. It waits while you fasten and cut each fibre and seal each step."
        )


def _handling(fibre: Mapping[str, Any]) -> str:
    """What a fibre bears, as far as it is known, as a sentence."""
    limits = []
    if fibre["max_strain"] is not None:
        limits.append(f"{100 * fibre['max_strain']:.3g} % of stretch at most")
    if fibre["min_bend_radius_mm"] is not None:
        limits.append(f"bends of no less than {fibre['min_bend_radius_mm']:g} mm radius")
    return f" Lay them unstretched: {fibre['name']} bears {' and '.join(limits)}." if limits else ""


def _crossing_places(document: Mapping[str, Any]) -> Iterator[str]:
    crossings = document["crossings"]
    if not crossings["total"]:
        yield "No two fibres cross."
        return
    number = {fibre["fibre"]: fibre["number"] for fibre in document["fibres"]}
    least = f"At least {crossings['gap_mm']:g} mm lie between two fibres." if crossings["gap_mm"] > 0 else "Some touch."
    yield f"{crossings['total']} crossings, {crossings['same_family']} of them within a family. {least}"
    yield ""
    if crossings["total"] <= _LONGEST_TABLE or document["common_tracks"]:
        yield "Places are from the middle of the pad. As it lies, x runs to the left and y away from you."
        yield ""
    yield from _shared_places(document["common_tracks"])
    if crossings["total"] <= _LONGEST_TABLE:
        rows = [
            (f"{number[one]} and {number[two]}", f"{x:.1f} mm", f"{y:.1f} mm", _depths(a, b), f"{gap:g} mm")
            for one, two, x, y, a, b, gap in crossings["table"]
        ]
        yield from markdown_table(("fibres", "x", "y", "depths", "between them"), rows)
        return
    counts = Counter((max(a, b), min(a, b), gap) for *_, a, b, gap in crossings["table"])
    rows = [(_depths(a, b), f"{gap:g} mm", count) for (a, b, gap), count in sorted(counts.items())[::-1]]
    yield from markdown_table(("depths", "between the fibres", "crossings"), rows)
    yield ""
    yield "`fabrication.json` has the place of each."


def _shared_places(shared: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Where the adhesive alone keeps fibres apart."""
    if not shared:
        return
    yield (
        "Here a track lies over a deeper one for longer than at two crossings at right angles. It has no floor of"
        " silicone there: let the adhesive over the deeper fibre cure, and see that it covers it, before you lay the"
        " upper one."
    )
    yield ""
    rows = [
        (
            f"{each['shallow']} over {each['deep']}",
            *(f"{x:.1f} mm" for x in each["position_mm"]),
            f"{each['length_mm']:.1f} mm",
        )
        for each in shared
    ]
    yield from markdown_table(("tracks", "x", "y", "in common"), rows[:_LONGEST_TABLE])
    if len(rows) > _LONGEST_TABLE:
        yield ""
        yield f"These are the {_LONGEST_TABLE} longest of {len(rows)}; `fabrication.json` has them all."
    yield ""


def _remarks(findings: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    remarks = [finding for finding in findings if finding["status"] != "pass"]
    yield f"{len(findings) - len(remarks)} of {len(findings)} checks pass." + (
        " Look at the others:" if remarks else ""
    )
    if remarks:
        yield ""
    for finding in sorted(remarks, key=lambda finding: finding["status"]):
        count = len(finding["positions_mm"])
        places = f" ({count} {'place' if count == 1 else 'places'}, see `fabrication.json`)" if count else ""
        yield f"- **{finding['status']}** {finding['name']}: {finding['message']}{places}"


def _depths(first_mm: float, second_mm: float) -> str:
    return f"{first_mm:.3g} and {second_mm:.3g} mm"


def _span(first: int, last: int) -> str:
    return f"{first} to {last}" if last > first else f"{first}"
