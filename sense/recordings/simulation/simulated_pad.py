"""What the channels of a simulated pad answer to a press: as the contact model has it, or as a twin was measured."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from padforge.design import Contact, Morphology, Twin
from padforge.design.common.validation import InputError
from padforge.design.contact import relative_stretch
from padforge.design.settings import PadSettings
from padforge.design.twin import TwinChannel
from padforge.sense.recordings.press_plan import Free, free_of, size_of, told_pad
from padforge.sense.recordings.processing.limits import Array

LEAST_APART = 0.3
"""Of what a pad spans that lies askew by more than some 28 degrees, both sides are taken to be alike."""


@dataclass(frozen=True)
class SimulatedPad:
    """A pad of C channels.

    Attributes:
        channels: C. pressed_mm: (2, 2) low and high corner of where it is pressed, as the arm counts. free: which
            places there are.
        answers: (Q, 2) mm as the arm counts to (Q, C) answers of presses at full depth, relative stretch, or V.
        noise_v: (C,) V, standard deviation of an answer that no place explains; None where answers are stretches.
        strengths: of the settings of `[rig]`, those that were measured.
        source: what a recording says of the pad, JSON.
    """

    channels: int
    pressed_mm: Array
    free: Free
    answers: Callable[[Array], Array]
    noise_v: Array | None
    strengths: dict[str, float]
    source: dict[str, Any]


def planned(pad: Morphology, contact: Contact, size: PadSettings | None = None) -> SimulatedPad:
    """A pad as it is planned; `size` says where it is pressed.

    Raises:
        InputError: as `size_of`.
    """
    size = size_of(pad, size)
    told = size.model_dump(mode="json")
    source = {
        "contact": contact.model_dump(mode="json"),
        "sensed_mm": told["sensed_mm"],
        "morphology": told_pad(pad),
    }
    return SimulatedPad(
        len(pad.knots),
        pad.to_mm(size.sensed),
        free_of(pad, size),
        lambda places_mm: relative_stretch(pad, pad.to_grid(places_mm), contact),
        None,
        {},
        source | ({"keep_out_mm": told["keep_out_mm"]} if size.keep_out_mm else {}),
    )


def measured(twin: Twin, size: PadSettings | None = None) -> SimulatedPad:
    """The twin's own pad: fibres as laid and wired, pressed where the arm pressed; a dead channel stays at rest.

    Raises:
        InputError: no channel of the twin reads a fibre; or as `size_of`.
    """
    live = _live(twin)
    columns = [twin.channels.index(channel) for channel in live]
    fibres = np.array([channel.fibre for channel in live])
    gains_v = np.array([channel.gain_v for channel in live])
    noise_v = np.zeros(len(twin.channels))
    noise_v[columns] = [channel.noise_v for channel in live]

    def answers(places_mm: Array) -> Array:
        out = np.zeros((len(places_mm), len(twin.channels)))
        out[:, columns] = gains_v * twin.as_built_stretch(places_mm)[:, fibres]
        return out

    half_mm = _sides_mm(twin) / 2
    plan = planned(twin.morphology, twin.contact(), size)
    source = plan.source | {"sensed_mm": (2 * half_mm).tolist()}
    return SimulatedPad(
        len(twin.channels),
        np.array([-half_mm, half_mm]),
        lambda places_mm: plan.free(twin.frame.to_plan(places_mm)),
        answers,
        *_told(twin, noise_v, source),
    )


def _sides_mm(twin: Twin) -> Array:
    """(2,) sides of what the arm pressed along its own axes: such that it spans `sensed_mm` along those of the plan."""
    spans = np.abs(twin.frame.rotate(np.eye(2))).T
    sides, *_ = np.linalg.lstsq(spans, np.array(twin.sensed_mm) / twin.frame.scale, rcond=LEAST_APART)
    return np.maximum(sides, 0)


def measured_alike(pad: Morphology, twin: Twin, size: PadSettings | None = None) -> SimulatedPad:
    """Another pad as planned, in its own frame, with the reach of the twin, and its median gain and noise.

    How its channels will differ nobody knows before it is laid: fibre i is on channel i, all alike.

    Raises:
        InputError: no channel of the twin reads a fibre; or as `size_of`.
    """
    gains_v, noises_v = np.array([(channel.gain_v, channel.noise_v) for channel in _live(twin)]).T
    gain_v = np.copysign(np.median(np.abs(gains_v)), gains_v.sum())
    plan = planned(pad, twin.contact(), size)
    noise_v = np.full(plan.channels, np.median(noises_v))
    return SimulatedPad(
        plan.channels,
        plan.pressed_mm,
        plan.free,
        lambda places_mm: gain_v * plan.answers(places_mm),
        *_told(twin, noise_v, plan.source),
    )


def _live(twin: Twin) -> list[TwinChannel]:
    live = [channel for channel in twin.channels if channel.fibre is not None]
    if not live:
        raise InputError("twin: none of its channels reads a fibre, expected one that does")
    return live


def _told(twin: Twin, noise_v: Array, source: dict[str, Any]) -> tuple[Array, dict[str, float], dict[str, Any]]:
    """The noise, strengths and source of a pad that is like a twin.

    A simulated press deviates in all its readings by the same, so by less than a measured one while it is held: as
    much as blurs the place where all that was read of a press counts.
    """
    strengths = asdict(twin.readings) if twin.readings else {}
    information_gain = strengths.pop("information_gain", 1.0)
    strengths |= {"scatter": twin.scatter.share / np.sqrt(information_gain), "scatter_common": twin.scatter.common}
    said = {
        "presses": twin.presses,
        "noise": twin.noise,
        "information_gain": information_gain,
        "provenance": dict(twin.provenance),
    }
    return twin.scatter.floor * noise_v / np.sqrt(information_gain), strengths, source | {"twin": said}
