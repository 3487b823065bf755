"""`health.json` and the arrays beside it: what they may hold, so that nothing else gets past their reading."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, JsonValue

from padforge.design.common.settings import Settings
from padforge.sense.recordings.processing.limits import MAX_FIBRES, MAX_RATE_HZ, MIN_RATE_HZ

from padforge.sense.health.fault_likelihoods import HYPOTHESES, LIBRARY, STEPS
from padforge.sense.health.fibre_prediction import COMPONENTS, HIDDEN, INPUTS, MEMBERS, TARGETS, TRACE

FORMAT = "padforge-health/1"
MAX_FALSE_ALARMS = 0.1
"""Greatest rate of false alarms a press: above it every press is one."""
MOST_LOST = 2
"""What is chance is learnt for no to this many fibres left out."""
LEAST_PRESSES = 300
"""Fewest presses that health is learnt from."""
WEAK_PRESSES = 850
"""Presses from which a fibre that answers by half is told from one pressed where it seldom was; from 680, simulated
pads gave a false alarm in every other recording, from 850 none in 12."""
POSITIVE = (
    *("shapes.inputs", "shapes.targets", "evidence.scale", "evidence.other_spread", "evidence.noise"),
    *("evidence.noise_spread", "evidence.constant", "evidence.innovation", "tail.slope"),
)
"""Arrays that are divided by, or whose logarithm is taken."""
MAX_VALUE = 1e6
"""Greatest number of a sound model, by amount."""


class HealthDocument(Settings):
    """The whole of `health.json`, see `HealthModel`."""

    format: Literal["padforge-health/1"] = FORMAT
    fibres: int = Field(ge=1, le=MAX_FIBRES)
    dead: list[Annotated[int, Field(ge=0, lt=MAX_FIBRES)]]
    rate_hz: float = Field(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)
    false_alarms: float = Field(gt=0, le=MAX_FALSE_ALARMS)
    presses: int = Field(ge=LEAST_PRESSES)
    weights_sha256: str = Field(pattern="^[0-9a-f]{64}$")
    provenance: dict[str, JsonValue]


def refuse_unsound(arrays: Mapping[str, NDArray[Any]], fibres: int) -> None:
    """Raise ValueError unless `arrays` are those of a model of so many living fibres, and all of them sane."""
    hypotheses, targets, members, losses = len(HYPOTHESES), TARGETS, MEMBERS, min(MOST_LOST, fibres - 1) + 1
    numbers = {
        "shapes.basis": (fibres, TRACE, COMPONENTS),
        "shapes.inputs": (fibres, INPUTS),
        **dict.fromkeys(("shapes.targets", "evidence.scale", "evidence.extra"), (fibres, targets)),
        "evidence.floor": (fibres, COMPONENTS),
        **dict.fromkeys(("evidence.other_mean", "evidence.other_spread"), (LIBRARY, fibres, COMPONENTS)),
        **{f"evidence.{name}": (fibres,) for name in ("noise", "noise_centre", "noise_spread", "constant")},
        "evidence.filters": (fibres, len(STEPS), TRACE),
        **dict.fromkeys(("evidence.persistence", "evidence.innovation"), (1,)),
        **dict.fromkeys(("tail.level", "tail.slope"), (losses, hypotheses)),
        "rests": (2, fibres),
    }
    weights = {
        "weights.first.w": (members, fibres, INPUTS, HIDDEN),
        "weights.first.alive": (members, fibres, HIDDEN),
        "weights.first.b": (members, HIDDEN),
        "weights.hidden.w": (members, HIDDEN, HIDDEN),
        "weights.hidden.b": (members, HIDDEN),
        "weights.last.w": (members, fibres, HIDDEN, 2 * targets),
        "weights.last.b": (members, fibres, 2 * targets),
    }
    expected_arrays = {name: (shape, np.float64) for name, shape in numbers.items()}
    expected_arrays |= {name: (shape, np.float32) for name, shape in weights.items()}
    found = {name: (array.shape, array.dtype.type) for name, array in arrays.items()}
    if found != expected_arrays:
        wrong = min(name for name in found.keys() | expected_arrays if found.get(name) != expected_arrays.get(name))
        raise ValueError(f"{wrong} is {found.get(wrong)}, expected {expected_arrays.get(wrong)}")
    for name, array in arrays.items():
        if not np.abs(array).max(initial=0) <= MAX_VALUE:
            raise ValueError(f"{name} goes up to {np.abs(array).max():g}, allowed is {MAX_VALUE:g}")
    for name in POSITIVE:
        if not (arrays[name] > 0).all():
            raise ValueError(f"{name} is {arrays[name].min():g} at least, allowed is above 0")
