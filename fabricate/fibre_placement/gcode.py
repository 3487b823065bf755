"""The work as G-code that Marlin and GRBL both read: G1 in mm and mm/min, M0 to wait, nothing else.

G0 is left out: GRBL goes it as fast as the machine can, whatever speed is said, and hands are near.
"""

from collections.abc import Iterable, Iterator

from padforge.fabricate.fibre_placement.toolpath import Go, Instruction, Lay, Pause, Place
from padforge.fabricate.settings import DispenserSettings

_DIGITS = 3
"""To the micrometre."""


def gcode(work: Iterable[Instruction], summary: Iterable[str], dispenser: DispenserSettings) -> str:
    """The program: axes as the machine counts them, with the pad's middle at the dispenser's origin.

    M0 waits until all ways are gone, then for the person.
    """
    x, y = dispenser.origin_mm
    head = [
        *(f"; {line}" for line in summary),
        f"; the pad's middle is at X{_number(x)} Y{_number(y)}; set zero of z by G92 Z0 (Marlin), G10 L20 P1 Z0 (GRBL)",
        "G21",
        "G90",
        "M0 (needle over the pad, zero of z is set)",
        f"G1 Z{_number(dispenser.travel_height_mm)} F{_per_minute(dispenser.travel_mm_s)}",
    ]
    return "\n".join([*head, *_body(work, dispenser), ""])


def _body(work: Iterable[Instruction], dispenser: DispenserSettings) -> Iterator[str]:
    last: dict[str, str] = {}
    for told in work:
        if isinstance(told, Pause):
            yield f"M0 ({told.message})"
            continue
        for place, speed in _corners(told):
            words = _words(place, speed, dispenser)
            changed = [letter + word for letter, word in words.items() if last.get(letter) != word]
            if any(word[0] != "F" for word in changed):  # else it stands there already
                yield " ".join(["G1", *changed])
                last = words


def _corners(told: Go | Lay) -> Iterator[tuple[Place, float]]:
    """Where to, and how fast, one after the other."""
    if isinstance(told, Go):
        yield told.place, told.speed_mm_s
        return
    stroke = told.stroke
    for (x, y), feed in zip(stroke.positions_mm[1:].tolist(), stroke.feeds_mm_s.tolist(), strict=True):
        yield (x, y, stroke.z_mm), feed


def _words(place: Place, speed_mm_s: float, dispenser: DispenserSettings) -> dict[str, str]:
    x, y = dispenser.origin_mm
    axes = {"X": _number(x + place[0]), "Y": _number(y + place[1]), "Z": _number(place[2])}
    return {**axes, "F": _per_minute(speed_mm_s)}


def _number(value: float) -> str:
    return f"{round(value, _DIGITS) + 0.0:.10g}"


def _per_minute(speed_mm_s: float) -> str:
    """At least 1: a feed of 0 is none."""
    return f"{max(1, round(60 * speed_mm_s))}"
