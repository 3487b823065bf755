"""What Marlin is told and what it says, line by line: numbered lines out, answers, places and limits in."""

import re
from dataclasses import dataclass, field
from functools import reduce
from operator import xor

from padforge.sense.rig.arms.printer.motion import Place

FIRMWARE = "Marlin"
HALTED = ("halted", "kill()", "STOP called", "stopped")
"""Words of errors after which the firmware takes no further moves; other errors are of a damaged line."""

_NUMBER = r"(-?\d+(?:\.\d+)?)"
_PLACE = re.compile(rf"^X:{_NUMBER} Y:{_NUMBER} Z:{_NUMBER}(?: |$)")
_RESEND = re.compile(r"^(?:Resend:|rs) ?N?(\d+)$")


def numbered(number: int, command: str) -> bytes:
    """A command as a line with its number and the exclusive or of all bytes before the star."""
    text = f"N{number} {command}".encode("ascii")
    return b"%s*%d\n" % (text, reduce(xor, text))


def move(end: Place, speed_mm_s: float) -> str:
    """A straight move of the nozzle."""
    x, y, z = end
    return f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f} F{60 * speed_mm_s:.1f}"


def resend(line: str) -> int | None:
    """The number of the line that is asked for again; None where the line says something else."""
    found = _RESEND.match(line)
    return int(found[1]) if found else None


def place(line: str) -> Place | None:
    """The nozzle's place in an answer to M114; None where the line is none."""
    found = _PLACE.match(line)
    return (float(found[1]), float(found[2]), float(found[3])) if found else None


def waits_for_moves(name: str) -> bool:
    """Whether a firmware of this name answers M114 only once all moves are over, as Marlin did before 2."""
    return re.match(r"Marlin (bugfix-)?1\.", name) is not None


def halts(line: str) -> bool:
    """Whether the line says that the firmware has stopped for good."""
    return line.startswith("Error:") and any(words in line for words in HALTED)


@dataclass(frozen=True)
class PrinterDialect:
    """What a printer says of itself in answer to M115.

    Attributes:
        name: of the firmware, with its version. machine: of the printer.
        capabilities: those it has, such as EMERGENCY_PARSER.
    """

    name: str = ""
    machine: str = ""
    capabilities: frozenset[str] = field(default_factory=frozenset)

    @classmethod
    def of(cls, lines: list[str]) -> "PrinterDialect":
        """From the lines of the answer."""
        text = "\n".join(lines)
        name = re.search(r"FIRMWARE_NAME:(.*?)(?: [A-Z_]+:|$)", text, re.MULTILINE)
        machine = re.search(r"MACHINE_TYPE:(.*?)(?: [A-Z_]+:|$)", text, re.MULTILINE)
        able = re.findall(r"^Cap:([A-Z0-9_]+):1$", text, re.MULTILINE)
        return cls(name[1].strip() if name else "", machine[1].strip() if machine else "", frozenset(able))


def limits(lines: list[str], code: str) -> Place | None:
    """The greatest speeds (code M203, mm/s) or accelerations (M201, mm/s²) of x, y and z in the answer to M503."""
    found = re.search(rf"\b{code} X{_NUMBER} Y{_NUMBER} Z{_NUMBER}", "\n".join(lines))
    values = (float(found[1]), float(found[2]), float(found[3])) if found else None
    return values if values and min(values) > 0 else None
