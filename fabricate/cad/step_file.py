"""STEP files that say everything once.

The CAD kernel writes a curve anew for every edge on it, with points and directions of its own. Said once, they take
less than half of the file, and whoever reads it finds the same shape.
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING

from padforge.design.common.files import temporary_folder

if TYPE_CHECKING:
    from build123d import Compound

_EPOCH = "2000-01-01T00:00:00"
"""The time written into STEP files, which must carry one."""
_DIGITS = 6
"""Of coordinates in mm, after the point: a nanometre."""
_ROUNDED = ("CARTESIAN_POINT", "B_SPLINE")
_ONCE = frozenset(
    {
        *("CARTESIAN_POINT", "DIRECTION", "VECTOR", "LINE", "CIRCLE", "ELLIPSE", "PLANE", "AXIS2_PLACEMENT_3D"),
        *("CYLINDRICAL_SURFACE", "CONICAL_SURFACE", "B_SPLINE_CURVE_WITH_KNOTS", "B_SPLINE_SURFACE_WITH_KNOTS"),
        *("COLOUR_RGB", "CURVE_STYLE", "DRAUGHTING_PRE_DEFINED_CURVE_FONT", "FILL_AREA_STYLE"),
        *("FILL_AREA_STYLE_COLOUR", "SURFACE_STYLE_FILL_AREA", "SURFACE_SIDE_STYLE", "SURFACE_STYLE_USAGE"),
        "PRESENTATION_STYLE_ASSIGNMENT",
    }
)
"""Geometry and styles; edges and faces stay one each, also where they coincide."""
_OCCURRENCE = "NEXT_ASSEMBLY_USAGE_OCCURRENCE"
_COLOURED = "MECHANICAL_DESIGN_GEOMETRIC_PRESENTATION_REPRESENTATION"
_STYLES = (
    *(_COLOURED, "OVER_RIDING_STYLED_ITEM", "STYLED_ITEM", "CURVE_STYLE", "FILL_AREA_STYLE", "SURFACE_STYLE"),
    *("SURFACE_SIDE_STYLE", "PRESENTATION_STYLE", "COLOUR_", "DRAUGHTING_"),
)
_PLAIN, _WORD = re.compile(r"\w*"), re.compile("\0(\\d+)")
"""Words in quotes that nothing here mistakes for something else, and what stands for the others meanwhile."""
_REFERENCE = re.compile(r"#(\d+)")
_LONG_NUMBER = re.compile(rf"-?\d+\.(?:\d{{{_DIGITS + 1},}}(?:E[-+]?\d+)?|\d*E[-+]?\d+)")


def write_step(path: Path, shape: "Compound") -> None:
    """Write an assembly with its names and colours as a STEP file, mm; the same bytes for the same shape.

    Raises:
        OSError: it cannot be written.
    """
    from build123d import export_step

    with temporary_folder(path.parent) as folder:
        whole = folder / "whole.step"
        try:
            written = export_step(shape, whole, write_pcurves=False, timestamp=_EPOCH)
        except RuntimeError:
            written = False
        if not written:
            raise OSError("the CAD kernel could not write it: is the disk full?")
        text = whole.read_text(encoding="utf-8")
    path.write_bytes(said_once(text).encode("utf-8"))


def said_once(text: str) -> str:
    """A STEP file in which each point, direction, curve, surface and style stands once, in few digits."""
    head, _, rest = text.partition("DATA;")
    data, _, tail = rest.rpartition("ENDSEC;")
    quoted = data.split("'")  # every second part is inside of quotes
    words = quoted[1::2]
    quoted[1::2] = [word if _PLAIN.fullmatch(word) else f"\0{place}" for place, word in enumerate(words)]
    parts = _parts("".join("'".join(quoted).split()))
    geometry = {number for number, own in parts.items() if own[0].partition("(")[0] in _ONCE}
    # the placements of an assembly's parts are told apart by being several
    one = {
        other: other for number in parts.keys() - geometry for other in parts[number][1::2] if _placement(parts[other])
    }
    first: dict[tuple[str, ...], str] = {}

    def settled(number: str) -> str:
        """The entity that stands for one, once the same is known of all it refers to."""
        if number not in one:
            own, one[number] = parts[number], number
            if number in geometry:
                own[1::2] = map(settled, own[1::2])
                one[number] = first.setdefault(tuple(own), number)
        return one[number]

    occurrences = (own for own in parts.values() if own[0].startswith(_OCCURRENCE))
    for place, own in enumerate(occurrences, 1):  # the kernel goes on counting from file to file
        own[0] = re.sub(r"'\d+'", f"'{place}'", own[0], count=1)
    for number in parts:
        parts[number][1::2] = map(settled, parts[number][1::2])
    order = _in_order({number: own for number, own in parts.items() if settled(number) == number})
    places = {number: f"#{place}" for place, number in enumerate(order, 1)}
    lines = []
    for number in order:
        own = parts[number]
        own[1::2] = map(places.__getitem__, own[1::2])
        lines.append(f"{places[number]}={''.join(own)};\n")
    said = _WORD.sub(lambda found: words[int(found.group(1))], "".join(lines))
    return f"{head}DATA;\n{said}ENDSEC;{tail}"


def _parts(data: str) -> dict[str, list[str]]:
    """Every entity by its number: what it says, every second part the number of another one, points in few digits."""
    parts = {}
    short: dict[str, str] = {}
    for entity in data.split(";")[:-1]:
        number, _, content = entity.partition("=")
        if content.startswith(_ROUNDED):
            if content not in short:
                short[content] = _LONG_NUMBER.sub(_rounded, content)
            content = short[content]
        parts[number[1:]] = _REFERENCE.split(content) if "#" in content else [content]
    return parts


def _in_order(parts: dict[str, list[str]]) -> list[str]:
    """The numbers of entities: shapes as they come, then what says their colours in the order of the shapes.

    The kernel writes colours in an order that differs from run to run.
    """
    order = {
        number: place for place, number in enumerate(n for n, own in parts.items() if not own[0].startswith(_STYLES))
    }

    def shown(number: str) -> list[int]:
        """The places of the shapes that a colour is for."""
        return [order[other] for other in parts[number][1::2] if other in order]

    def add(number: str) -> None:
        if number not in order:
            order[number] = len(order)
            for other in parts[number][1::2]:
                add(other)

    groups = [number for number, own in parts.items() if own[0].startswith(_COLOURED)]
    for group in sorted(groups, key=shown):
        *items, context = parts[group][1::2]
        parts[group][1::2] = [*sorted(items, key=lambda item: (parts[item][0], shown(item))), context]
        add(group)
    return list(order)


def _placement(own: list[str]) -> bool:
    return own[0].startswith("AXIS2_PLACEMENT_3D")


def _rounded(found: re.Match[str]) -> str:
    short = f"{float(found.group()):.{_DIGITS}f}".rstrip("0")
    return "0." if short in ("-0.", "0.") else short
