"""What the person at the bench needs: silicone to mix, fibres to cut, the order to lay them in, and a page of it all.

Places are those of the plan, on the page too.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from padforge.fabricate.materials import PLASTICS
from padforge.fabricate.mould.plan import Plan, overlap
from padforge.fabricate.report.fibre_layers import fibre_name, layers
from padforge.fabricate.settings import MouldSettings, PrinterSettings

from . import casting, print_settings, wiring
from .orientation import LINK, sentence
from .tables import table

_LONGEST_TABLE = 24
"""More crossings than this leave no room for them on a page."""


def document(plan: Plan, mould_mm3: float) -> dict[str, Any]:
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
        "silicone": casting.silicone(plan, mould_mm3),
        "adhesive": _adhesive(plan),
        "fibre": asdict(plan.settings.fibre.material),
        "fibres": _fibres(plan),
        "laying_order": [[fibre + 1 for fibre in layer.fibres] for layer in layers(plan)],
        "crossings": _crossings(plan),
        "common_tracks": _common_tracks(plan),
        **({"exits": [number for _, number in sorted(ends, reverse=True)]} if one_side else {}),
    }


def pad_settings(plan: Plan) -> dict[str, Any]:
    """What `[pad]` says of a mould and of the way its fibres lie, with how many they are."""
    said = plan.settings.pad.model_dump(mode="json", include={"deep_family", "leads", "keep_out_mm", "bent_radius_mm"})
    return {**said, "horizontals": plan.pad.layout.horizontals, "verticals": plan.pad.layout.verticals}


def _adhesive(plan: Plan) -> dict[str, Any]:
    """The volume of the tracks of every step; the fibres in them, and what crossing tracks share, are left in."""
    steps = []
    for layer in layers(plan):
        tapered = layer.depth_mm / 2 if plan.settings.ridge_slope else 0
        outline = plan.outline(layer.level, tapered) if tapered else plan.ridges[layer.level]
        steps.append(overlap(outline, plan.silicone).area * layer.depth_mm / 1000)
    return {"name": "silicone adhesive", "volume_ml": round(sum(steps), 4), "steps_ml": [round(ml, 4) for ml in steps]}


def _fibres(plan: Plan) -> list[dict[str, Any]]:
    mould, courses = plan.settings.mould, plan.lengths_mm
    return [
        {
            "number": fibre + 1,
            "fibre": fibre_name(plan, fibre),
            "level": level,
            "ridge_mm": plan.enlarged.heights_mm[level],
            "depth_mm": plan.depths_mm[level],
            "in_pad_mm": round(course, 2),
            "cut_mm": round(course + 2 * mould.lead_mm, 2),
            **wiring.resistances(plan, course + 2 * mould.lead_mm),
        }
        for fibre, (level, course) in enumerate(zip(plan.levels, courses.tolist(), strict=True))
    ]


def _crossings(plan: Plan) -> dict[str, Any]:
    """A fibre lies on the bottom of its track: between two is what lies between the bottoms, less a fibre."""
    table: list[list[Any]] = []
    for crossing in plan.crossings:
        pair = crossing.first, crossing.second
        depths = [plan.depths_mm[plan.levels[fibre]] for fibre in pair]
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
            "place_mm": [round(x, 3) for x in each.place_mm],
        }
        for each in sorted(long, key=lambda each: -each.length_mm)
    ]


def laying_page(document: Mapping[str, Any]) -> str:
    """`laying.md` from a whole fabrication document: a page to print and take to the bench."""
    sections = {
        "Print": _printing(document),
        "Mix": casting.mixing(document["silicone"]),
        "Cast": casting.casting(document),
        "Which way round": _way_round(document),
        "Lay": _laying(document),
        "Wire": wiring.wiring(document),
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
        yield from print_settings.for_resin(*settings)
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
        yield from table(print_settings.HEAD, list(print_settings.rows(*settings)))


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
    yield sentence(counts, pad["leads"]) + (f" {numbers}" if all(counts) else "")
    for finding in document["findings"]:
        if finding["name"] == "fibre_strain":
            yield ""
            yield (
                "The pad is worn on a cylinder whose axis runs along y, the face with the tracks outwards:"
                f" {finding['message']}."
            )
    yield ""
    yield LINK


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
    yield from table(("step", "number", "fibre", "depth", "in the pad", "cut to", "then seal with"), rows)
    if programs := [f"`{name}`" for name in document["files"] if name.startswith("laying.")]:
        yield ""
        yield (
            f"Or let a machine lay them in this order, on the pad turned over: its ways are in {' and '.join(programs)}"
            " and drawn in `dispensing.svg`. It waits while you fasten and cut each fibre and seal each step."
        )


def _handling(fibre: Mapping[str, Any]) -> str:
    """What a fibre bears, as far as it is known, as a sentence."""
    limits = []
    if fibre["largest_stretch"] is not None:
        limits.append(f"{100 * fibre['largest_stretch']:.3g} % of stretch at most")
    if fibre["least_bend_mm"] is not None:
        limits.append(f"bends of no less than {fibre['least_bend_mm']:g} mm radius")
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
        yield from table(("fibres", "x", "y", "depths", "between them"), rows)
        return
    counts = Counter((max(a, b), min(a, b), gap) for *_, a, b, gap in crossings["table"])
    rows = [(_depths(a, b), f"{gap:g} mm", count) for (a, b, gap), count in sorted(counts.items())[::-1]]
    yield from table(("depths", "between the fibres", "crossings"), rows)
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
            *(f"{x:.1f} mm" for x in each["place_mm"]),
            f"{each['length_mm']:.1f} mm",
        )
        for each in shared
    ]
    yield from table(("tracks", "x", "y", "in common"), rows[:_LONGEST_TABLE])
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
        count = len(finding["places_mm"])
        places = f" ({count} {'place' if count == 1 else 'places'}, see `fabrication.json`)" if count else ""
        yield f"- **{finding['status']}** {finding['name']}: {finding['message']}{places}"


def _depths(first_mm: float, second_mm: float) -> str:
    return f"{first_mm:.3g} and {second_mm:.3g} mm"


def _span(first: int, last: int) -> str:
    return f"{first} to {last}" if last > first else f"{first}"
