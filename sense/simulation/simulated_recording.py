"""What the channels of a simulated pad answer to a press: as the contact model has it, or as a twin was measured.

The simulated rig: the published protocol on the simulated pad.

How strongly a recorded pad drifts, and what its silicone keeps of a press: what a simulated pad is told in `[rig]`.
A press leaves a share of its answer behind, the other way round, which goes by and by: so rests differ from press to
press. How much they do by the time between them, their variogram, tells what goes within some presses from what
drifts over minutes; how far a fibre comes back beyond its rest, set against its answer, tells the share.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import nnls

from padforge.design import Contact, Morphology, Twin
from padforge.design.common.settings import or_default
from padforge.design.common.validation import MAX_VALUES, InputError, check_int, check_type
from padforge.design.contact import relative_stretch
from padforge.design.settings import PadSettings
from padforge.design.twin import TwinChannel
from padforge.sense.arrays import MAX_FIBRES, MIN_SCALE_V, Array, Indices
from padforge.sense.recording.press_plan import (
    PositionTest,
    fit_pad_settings,
    make_plan_in,
    pad_source,
    pressable_test,
    sample_uniform,
)
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import DELAY_S, DRIFT_S, TRAVEL_S, Cycle, read_pad

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
    free: PositionTest
    answers: Callable[[Array], Array]
    noise_v: Array | None
    strengths: dict[str, float]
    source: dict[str, Any]


def planned(pad: Morphology, contact: Contact, size: PadSettings | None = None) -> SimulatedPad:
    """A pad as it is planned; `size` says where it is pressed.

    Raises:
        InputError: as `fit_pad_settings`.
    """
    size = fit_pad_settings(pad, size)
    told = size.model_dump(mode="json")
    source = {
        "contact": contact.model_dump(mode="json"),
        "sensed_mm": told["sensed_mm"],
        "morphology": pad_source(pad),
    }
    return SimulatedPad(
        len(pad.knots),
        pad.to_mm(size.sensed),
        pressable_test(pad, size),
        lambda positions_mm: relative_stretch(pad, pad.to_grid(positions_mm), contact),
        None,
        {},
        source | ({"keep_out_mm": told["keep_out_mm"]} if size.keep_out_mm else {}),
    )


def measured(twin: Twin, size: PadSettings | None = None) -> SimulatedPad:
    """The twin's own pad: fibres as laid and wired, pressed where the arm pressed; a dead channel stays at rest.

    Raises:
        InputError: no channel of the twin reads a fibre; or as `fit_pad_settings`.
    """
    live = _live(twin)
    columns = [twin.channels.index(channel) for channel in live]
    fibres = np.array([channel.fibre for channel in live])
    gains_v = np.array([channel.gain_v for channel in live])
    noise_v = np.zeros(len(twin.channels))
    noise_v[columns] = [channel.noise_v for channel in live]

    def answers(positions_mm: Array) -> Array:
        out = np.zeros((len(positions_mm), len(twin.channels)))
        out[:, columns] = gains_v * twin.as_built_stretch(positions_mm)[:, fibres]
        return out

    half_mm = _sides_mm(twin) / 2
    plan = planned(twin.morphology, twin.contact(), size)
    source = plan.source | {"sensed_mm": (2 * half_mm).tolist()}
    return SimulatedPad(
        len(twin.channels),
        np.array([-half_mm, half_mm]),
        lambda positions_mm: plan.free(twin.frame.to_plan(positions_mm)),
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
        InputError: no channel of the twin reads a fibre; or as `fit_pad_settings`.
    """
    gains_v, noises_v = np.array([(channel.gain_v, channel.noise_v) for channel in _live(twin)]).T
    gain_v = np.copysign(np.median(np.abs(gains_v)), gains_v.sum())
    plan = planned(pad, twin.contact(), size)
    noise_v = np.full(plan.channels, np.median(noises_v))
    return SimulatedPad(
        plan.channels,
        plan.pressed_mm,
        plan.free,
        lambda positions_mm: gain_v * plan.answers(positions_mm),
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
            "simulated at once are uniform, grid, serpentine or a .csv file"
        )
    model = _modelled(pad, contact, size, like)
    rig = rig.model_copy(update=model.strengths)
    rng = np.random.default_rng(rig.seed)
    plan = make_plan_in(model.pressed_mm, rig, rng, model.free)
    values = len(plan) * rig.readings_per_press * channels
    if values > MAX_VALUES:
        raise InputError(
            f"[rig] presses is {len(plan)}: with {rig.readings_per_press} readings each of {channels} fibres "
            f"{values} values, allowed are {MAX_VALUES}"
        )
    cycle = Cycle(rig.readings_per_press, rig.rate_hz)
    readings = read_pad(model.answers(plan.positions_mm), plan.depths_mm, cycle, rig, rng, model.noise_v)
    intervals_s = (1 + JITTER * np.clip(rng.standard_normal(len(readings)), -3, 3)) / rig.rate_hz
    first = cycle.readings * np.arange(len(plan))
    return Recording(
        readings,
        np.cumsum(intervals_s),
        plan.positions_mm,
        down_command=first + cycle.down_at,
        up_command=first + cycle.readings,
        depths_mm=plan.depths_mm,
        source={"kind": "simulated", "rig": rig.model_dump(mode="json"), **model.source},
    )


def _modelled(pad: Morphology | Twin, contact: Contact, size: PadSettings | None, like: Twin | None) -> SimulatedPad:
    if isinstance(pad, Twin):
        return measured(pad, size)
    return planned(pad, contact, size) if like is None else measured_alike(pad, check_type("like", like, Twin), size)


def random_places(pad: Morphology, presses: int, rng: np.random.Generator, size: PadSettings | None = None) -> Array:
    """(Q, 2) places in mm, uniform over what is pressed of the pad, see `fit_pad_settings`."""
    size = fit_pad_settings(pad, size)
    return sample_uniform(pad.to_mm(size.sensed), presses, rng, pressable_test(pad, size))


LEAST_PRESSES = 100
"""Presses that can tell."""
REST_S, LEFT_S = 0.7, (0.7, 1.4)
"""Time before a press, and range of times after it, in which fibres are at rest and show what it left behind."""
LASTING_S = np.geomspace(1.0, 100.0, 41)
"""Times in which that may go."""


def strengths(recording: Recording) -> dict[str, float]:
    """Values for `noise_mv`, `drift_mv`, `hysteresis` and `hysteresis_s` of `[rig]` by which a simulated pad is alike.

    Channels that miss readings or never change are left out; places need not be known.

    Returns:
        None of them where fewer than LEAST_PRESSES, or no channel, can tell.
    """
    down_command, up_command, rate_hz = recording.down_command[:-1], recording.up_command[:-1], recording.rate_hz
    whole = np.isfinite(recording.readings).all(axis=0) & (np.ptp(recording.readings, axis=0) > MIN_SCALE_V)
    if len(down_command) < LEAST_PRESSES or not whole.any():
        return {}
    readings, after = recording.readings[:, whole], recording.down_command[1:]
    settled, rested, first, last = np.ceil(np.array([DELAY_S[1] + TRAVEL_S, REST_S, *LEFT_S]) * rate_hz).astype(int)
    rest = _means(readings, np.maximum(down_command - rested, np.append(0, up_command[:-1])), down_command)
    answer = _means(readings, np.minimum(down_command + settled, up_command - 1), up_command) - rest
    left = _means(readings, np.minimum(up_command + first, after - 1), np.minimum(up_command + last, after)) - rest
    lasting_s, drift_v = _memory(rest, float(np.median(np.diff(recording.times_s[down_command]))))
    answer, left = answer - answer.mean(axis=0), left - left.mean(axis=0)
    share = -float((answer * left).sum() / (answer**2).sum()) * np.exp(np.mean(LEFT_S) / lasting_s)
    middle = (down_command + up_command) // 2
    bends = readings[middle - 1] - 2 * readings[middle] + readings[middle + 1]
    return {
        "noise_mv": 1e3 * float(np.sqrt((bends**2).mean() / 6)),  # white noise bends by six times its variance
        "drift_mv": 1e3 * drift_v,
        "hysteresis": float(np.clip(share, 0, 0.99)),
        "hysteresis_s": lasting_s,
    }


def _means(readings: Array, first: Indices, end: Indices) -> Array:
    """(Q, C) means of the readings from first (Q,) to before end (Q,), of one at least."""
    return np.array([readings[a : max(b, a + 1)].mean(axis=0) for a, b in zip(first, end, strict=True)])


def _memory(rest: Array, apart_s: float) -> tuple[float, float]:
    """In which time what presses leave behind goes, s, and the standard deviation of the drift, V."""
    lags = np.unique(np.geomspace(1, len(rest) // 2, 24).astype(int))
    seen = np.array([((rest[lag:] - rest[:-lag]) ** 2).mean() / 2 for lag in lags])
    found: list[tuple[float, float, float]] = []
    for lasting_s in LASTING_S.tolist():
        shapes = 1 - np.exp(-lags[:, None] * apart_s / np.array([lasting_s, DRIFT_S]))
        (_, drift), misfit = nnls(shapes / np.maximum(seen, MIN_SCALE_V**2)[:, None], np.ones(len(lags)))
        found.append((float(misfit), lasting_s, float(np.sqrt(drift))))
    return min(found)[1:]
