"""The simulated rig: the published protocol on the simulated pad."""

import numpy as np

from padforge.design import Contact, Morphology, Twin
from padforge.design.common.settings import or_default
from padforge.design.common.validation import MAX_VALUES, InputError, check_int, check_type
from padforge.design.settings import PadSettings
from padforge.sense.recordings.press_plan import free_of, planned_in, size_of, uniform
from padforge.sense.recordings.processing.limits import MAX_FIBRES, Array
from padforge.sense.recordings.recording import Recording
from padforge.sense.settings import RigSettings

from padforge.sense.recordings.simulation.pad_model import Cycle, read_pad
from padforge.sense.recordings.simulation.simulated_pad import SimulatedPad, measured, measured_alike, planned

JITTER = 0.1
"""Spread of the interval between readings, share of its mean: the loop of the recording is no clock."""


def simulate(
    pad: Morphology | Twin,
    rig: RigSettings | None = None,
    contact: Contact | None = None,
    size: PadSettings | None = None,
    like: Twin | None = None,
) -> Recording:
    """Record presses on a simulated pad, where and as deep as `[rig]` plans them.

    A press takes a cycle of readings: the probe goes down in its middle and up at its end.

    Args:
        pad: course of the fibres; or a twin, which answers, and is pressed, as the pad it was measured on.
        rig: plan, depths, rate, seed and strengths. contact: what a press deforms. What a twin has measured goes
            before both.
        size: where it is pressed, and where it is not; of a twin the latter.
        like: a twin of another pad, which `pad` is to answer like.

    Returns:
        The recording, the same for the same arguments.

    Raises:
        InputError: more fibres or readings than a recording may hold, presses beyond the pad or in its holes, a plan
            that is adaptive or no file of places, or a twin of which no channel reads a fibre.
    """
    contact, rig = or_default("contact", contact, Contact), or_default("rig", rig, RigSettings)
    channels = len(pad.channels) if isinstance(pad, Twin) else len(check_type("pad", pad, Morphology).knots)
    check_int("fibres of the pad", channels, 1, MAX_FIBRES)
    if rig.plan == "adaptive":
        raise InputError(
            "[rig] plan is adaptive, which only a recording in real time is steered by; allowed where presses are "
            "simulated at once are uniform, grid, boustrophedon or a .csv file"
        )
    model = _modelled(pad, contact, size, like)
    rig = rig.model_copy(update=model.strengths)
    rng = np.random.default_rng(rig.seed)
    plan = planned_in(model.pressed_mm, rig, rng, model.free)
    values = len(plan) * rig.readings_per_press * channels
    if values > MAX_VALUES:
        raise InputError(
            f"[rig] presses is {len(plan)}: with {rig.readings_per_press} readings each of {channels} fibres "
            f"{values} values, allowed are {MAX_VALUES}"
        )
    cycle = Cycle(rig.readings_per_press, rig.rate_hz)
    readings = read_pad(model.answers(plan.places_mm), plan.depths_mm, cycle, rig, rng, model.noise_v)
    intervals_s = (1 + JITTER * np.clip(rng.standard_normal(len(readings)), -3, 3)) / rig.rate_hz
    first = cycle.readings * np.arange(len(plan))
    return Recording(
        readings,
        np.cumsum(intervals_s),
        plan.places_mm,
        begun=first + cycle.down_at,
        lifted=first + cycle.readings,
        depths_mm=plan.depths_mm,
        source={"kind": "simulated", "rig": rig.model_dump(mode="json"), **model.source},
    )


def _modelled(pad: Morphology | Twin, contact: Contact, size: PadSettings | None, like: Twin | None) -> SimulatedPad:
    if isinstance(pad, Twin):
        return measured(pad, size)
    return planned(pad, contact, size) if like is None else measured_alike(pad, check_type("like", like, Twin), size)


def random_places(pad: Morphology, presses: int, rng: np.random.Generator, size: PadSettings | None = None) -> Array:
    """(Q, 2) places in mm, uniform over what is pressed of the pad, see `size_of`."""
    size = size_of(pad, size)
    return uniform(pad.to_mm(size.sensed), presses, rng, free_of(pad, size))
