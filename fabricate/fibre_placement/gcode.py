"""Toolpaths as G-code for both Marlin and GRBL: G1 in mm and mm/min, M0 to wait, nothing else.

G0 is avoided: GRBL executes it at the machine's maximum speed whatever the feed, and hands are near.
"""

from collections.abc import Iterator, Sequence

from padforge.fabricate.fibre_placement.toolpath import (
    Instruction,
    LinearMove,
    Pause,
    Step,
    build_instructions,
    format_mm,
    summary_lines,
)
from padforge.fabricate.plan import Plan


def gcode(plan: Plan, steps: Sequence[Step]) -> str:
    """Write the program of a toolpath, in the machine's coordinates with the pad's middle at the dispenser's origin.

    M0 waits until all moves are done, then for the operator.
    """
    dispenser = plan.settings.dispenser
    x, y = dispenser.origin_mm
    lines = [
        *(f"; {line}" for line in summary_lines(plan, steps)),
        f"; the pad's middle is at X{format_mm(x)} Y{format_mm(y)};"
        " set zero of z by G92 Z0 (Marlin), G10 L20 P1 Z0 (GRBL)",
        "G21",
        "G90",
        "M0 (needle over the pad, zero of z is set)",
        f"G1 Z{format_mm(dispenser.travel_height_mm)} F{_format_feed(dispenser.travel_mm_s)}",
    ]
    words: dict[str, str] = {}
    for instruction in build_instructions(plan, steps):
        if isinstance(instruction, Pause):
            lines.append(f"M0 ({instruction.message})")
            continue
        for (u, v, z), speed in _moves(instruction):
            axes = {"X": format_mm(x + u), "Y": format_mm(y + v), "Z": format_mm(z)}
            target = axes | {"F": _format_feed(speed)}
            changed = [letter + number for letter, number in target.items() if words.get(letter) != number]
            if any(word[0] != "F" for word in changed):  # else the needle is there already
                lines.append(" ".join(["G1", *changed]))
                words = target
    return "\n".join([*lines, ""])


def _moves(instruction: Instruction) -> Iterator[tuple[tuple[float, float, float], float]]:
    """Yield the target positions and speeds of a move or a stroke."""
    if isinstance(instruction, LinearMove):
        yield instruction.position_mm, instruction.speed_mm_s
    elif not isinstance(instruction, Pause):
        feeds = instruction.feeds_mm_s.tolist()
        for (x, y), feed in zip(instruction.positions_mm[1:].tolist(), feeds, strict=True):
            yield (x, y, instruction.z_mm), feed


def _format_feed(speed_mm_s: float) -> str:
    return f"{max(1, round(60 * speed_mm_s))}"  # mm/min; firmwares ignore a feed of 0
