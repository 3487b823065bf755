"""The files for a machine that lays the fibres, and what the checks say of its ways."""

import math
from collections.abc import Collection
from dataclasses import dataclass

from padforge.fabricate.checks.findings import Finding
from padforge.fabricate.mould.plan import Plan

from .clearance import check_course
from .course import laying_steps
from .gcode import gcode
from .picture import ways_svg
from .program import instructions, summary_lines
from .urscript import urscript

LANGUAGES = {"gcode": ("laying.gcode", gcode), "urscript": ("laying.script", urscript)}
"""The file of each language, and what writes it."""


@dataclass(frozen=True)
class Dispensing:
    """Texts by the names of their files, programs first, and findings; both empty where no language is asked for."""

    texts: dict[str, str]
    findings: list[Finding]


def dispensing(plan: Plan, languages: Collection[str]) -> Dispensing:
    """The programs in the `LANGUAGES` wanted, with a picture of the ways; other names are for others to read."""
    wanted = [name for name in LANGUAGES if name in languages]
    if not wanted:
        return Dispensing({}, [])
    fibre = plan.settings.fibre.material
    steps = laying_steps(plan, fibre.diameter_mm, fibre.largest_stretch or math.inf)
    work, summary, dispenser = (
        list(instructions(plan, steps)),
        list(summary_lines(plan, steps)),
        plan.settings.dispenser,
    )
    texts = {name: write(work, summary, dispenser) for name, write in map(LANGUAGES.__getitem__, wanted)}
    return Dispensing(texts | {"dispensing.svg": ways_svg(plan, steps)}, check_course(plan, steps))
