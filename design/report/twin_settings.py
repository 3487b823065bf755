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

SEARCH = {"knots": 8, "starts": 2}
"""How a twin is designed for: more knots than these, or more steps, do not find better pads of four fibres a family."""


KEYS = ("grid", "horizontals", "verticals", "pitch_mm")
"""Of `[pad]`, that say where fibres end."""


def settings_for_twin(spec: "Spec", path: Path, pad: Morphology | None = None) -> "Spec":
    """The settings of `spec`, with the reach, the noise and the sensed rectangle of the `twin.json` at `path`.

    Its fibres and pitch are the pad's as well, where `spec` states none, or those of `pad`, if one is given. Reach and
    rectangle stay as they are in mm on a pad of another pitch; of the rectangle what lies beyond a pad is left out.

    Raises:
        InputError: no valid twin; `spec` states another contact, or other fibres than the twin's.
    """
    twin = Twin.load(path)
    if spec.given(Contact) and spec.section(Contact) != Contact():
        raise InputError(f"{spec.source}: [contact] is given beside {path}, which has one of its own; leave one out")
    given = spec.given(SearchSettings)
    own = twin.morphology.layout
    stated = {**own.settings, **{key: spec.given(PadSettings)[key] for key in KEYS if key in spec.given(PadSettings)}}
    if pad is not None:
        stated = {**pad.layout.settings}
    size = spec.section(PadSettings, **stated, sensed_mm="beyond").layout
    if pad is None and size.counts != own.counts:
        raise InputError(f"{spec.source}: [pad] asks for {size}, but {path} is of a pad of {own}")
    return spec.replaced(
        {
            "pad": stated | {"sensed_mm": [min(pair) for pair in zip(twin.sensed_mm, size.size_mm, strict=True)]},
            "contact": twin.contact().model_dump(),
            "search": {**SEARCH, **given, "noise": _noise(twin)},
        }
    )


def _noise(twin: Twin) -> float:
    """What blurs a place by all that is read of a press: its onset and release tell of it besides how it is held."""
    return twin.noise / math.sqrt(twin.readings.looks) if twin.readings else twin.noise
