"""Settings to design by what presses have shown of a printed pad."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from padforge.design.common.errors import InputError
from padforge.design.evaluation.expected_error import straight_full_scale
from padforge.design.pad.morphology import Morphology
from padforge.design.pad.twin import Twin
from padforge.design.settings import Contact, Layout, PadSettings, SearchSettings

if TYPE_CHECKING:
    from padforge.design.common.settings import Spec

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
            "search": {**spec.given(SearchSettings), **_scatter(twin, size)},
        }
    )


def _scatter(twin: Twin, layout: Layout) -> dict[str, float]:
    """How the responses of a held press scatter, in `[search]`'s shares of a full scale: that of straight fibres."""
    gains_v, noises_v = np.array([(abs(each.gain_v), each.noise_v) for each in twin.channels if each.gain_v]).T
    scale = straight_full_scale(layout, twin.contact(), "beyond")
    noise = twin.scatter.floor * np.median(noises_v) / (np.median(gains_v) * scale)
    return {
        "noise": float(np.clip(noise, 1e-3, 10)),
        "scatter": twin.scatter.share,
        "scatter_common": twin.scatter.common,
    }
