"""Settings to design by what presses have shown of a printed pad."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from design.common.errors import InputError
from design.pad.morphology import Morphology
from design.pad.twin import Twin
from design.settings import Contact, PadSettings, SearchSettings

if TYPE_CHECKING:
    from design.common.settings import Spec

SEARCH = {"method": "error", "knots": 8, "starts": 2}
"""How a twin is designed for: more knots than these, or more steps, do not find better pads of four fibres a family."""


def settings_for_twin(spec: "Spec", path: Path, pad: Morphology | None = None) -> "Spec":
    """The settings of `spec`, with the reach, the noise and the sensed rectangle of the `twin.json` at `path`.

    What a press does and how noisy it is being known, the search is for the least expected error, unless `spec` states
    another method.

    Its grid and pitch are the pad's as well, where `spec` states none, or those of `pad`, if one is given. Reach and
    rectangle stay as they are in mm on a pad of another pitch; of the rectangle what lies beyond a pad is left out.

    Raises:
        InputError: no valid twin; `spec` states another contact, or a grid that is not the twin's.
    """
    twin = Twin.load(path)
    if spec.given(Contact) and spec.section(Contact) != Contact():
        raise InputError(f"{spec.source}: [contact] is given beside {path}, which has one of its own; leave one out")
    given = spec.given(SearchSettings)
    method = given.get("method", SEARCH["method"])
    own = {"grid": twin.morphology.grid, "pitch_mm": twin.morphology.pitch_mm}
    stated = {name: value for name, value in spec.given(PadSettings).items() if name in own}
    if pad is not None:
        stated = {"grid": pad.grid, "pitch_mm": pad.pitch_mm}
    elif stated.get("grid", own["grid"]) != own["grid"]:
        raise InputError(f"{spec.source}: [pad] grid: got {stated['grid']}, but {path} is of grid {own['grid']}")
    size = spec.section(PadSettings, **own | stated, sensed_mm="beyond")
    most = (size.grid + 1) * size.pitch_mm
    return spec.replaced(
        {
            "pad": own | stated | {"sensed_mm": [min(side, most) for side in twin.sensed_mm]},
            "contact": twin.contact(size.pitch_mm).model_dump(),
            "search": {**(SEARCH if method == SEARCH["method"] else {}), **given, "noise": _noise(twin)},
        }
    )


def _noise(twin: Twin) -> float:
    """What blurs a place by all that is read of a press: its onset and release tell of it besides how it is held."""
    return twin.noise / math.sqrt(twin.readings.looks) if twin.readings else twin.noise
