"""The simulated rig: the published protocol on the simulated pad."""

import numpy as np

from design import Contact, Morphology, signals
from design.common.errors import MOST_VALUES, InputError, instance, whole
from design.common.settings import or_default
from design.settings import PadSettings, Sensed, sensed_rectangle
from sense.recordings.processing.limits import MAX_FIBRES, Array
from sense.recordings.recording import Recording
from sense.settings import RigSettings

from .pad_model import Cycle, read_pad

JITTER = 0.1
"""Spread of the interval between readings, share of its mean: the loop of the recording is no clock."""


def simulate(
    pad: Morphology, rig: RigSettings | None = None, contact: Contact | None = None, sensed_mm: Sensed = "beyond"
) -> Recording:
    """Record presses at random places on a simulated pad.

    A press takes a cycle of readings: the probe goes down in its middle and up at its end.

    Args:
        pad: course of the fibres. rig: length, rate, seed and strengths. contact: what a press deforms.
        sensed_mm: where it is pressed (`PadSettings`).

    Returns:
        The recording, the same for the same arguments.

    Raises:
        InputError: more fibres or readings than a recording may hold, or presses beyond the pad.
    """
    instance("pad", pad, Morphology)
    rig, contact = or_default("rig", rig, RigSettings), or_default("contact", contact, Contact)
    whole("fibres of the pad", 2 * pad.grid, 2, MAX_FIBRES)
    size = PadSettings(grid=pad.grid, pitch_mm=pad.pitch_mm, sensed_mm=sensed_mm)
    values = rig.presses * rig.readings_per_press * 2 * pad.grid
    if values > MOST_VALUES:
        raise InputError(
            f"[rig] presses is {rig.presses}: with {rig.readings_per_press} readings each of {2 * pad.grid} fibres "
            f"{values} values, allowed are {MOST_VALUES}"
        )
    rng = np.random.default_rng(rig.seed)
    cycle = Cycle(rig.readings_per_press, rig.rate_hz)
    places_mm = random_places(pad, rig.presses, rng, sensed_mm)
    readings = read_pad(signals(pad, pad.to_grid(places_mm), contact), cycle, rig, rng)
    intervals_s = (1 + JITTER * np.clip(rng.standard_normal(len(readings)), -3, 3)) / rig.rate_hz
    first = cycle.readings * np.arange(rig.presses)
    return Recording(
        readings,
        np.cumsum(intervals_s),
        places_mm,
        begun=first + cycle.down_at,
        lifted=first + cycle.readings,
        source={
            "kind": "simulated",
            "rig": rig.model_dump(mode="json"),
            "contact": contact.model_dump(mode="json"),
            "sensed_mm": size.model_dump(mode="json")["sensed_mm"],
            "morphology": {"pitch_mm": pad.pitch_mm, "knots": pad.knots.tolist()},
        },
    )


def random_places(pad: Morphology, presses: int, rng: np.random.Generator, sensed_mm: Sensed = "beyond") -> Array:
    """(Q, 2) places in mm, uniform over what is pressed of the pad (`PadSettings`)."""
    low, high = pad.to_mm(sensed_rectangle(pad.grid, pad.pitch_mm, sensed_mm))
    return rng.uniform(low, high, (presses, 2))
