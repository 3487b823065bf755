"""What to know of a rig before a long run: whether it answers, how fast, and which channels are alive."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sense.recordings.processing.limits import Array

from .devices.protocols import Arm, Converter, RigFault

Status = Literal["ok", "warn", "fail"]

LOOK_S = 2.0
"""How long channels and states are looked at."""
_DEAD_V = 0.02
"""A channel nearer than this to either end of the range is open, shorted or saturated."""
_STUCK_V = 1e-6
"""An ADC that reads a fibre shows noise; a spread below this is a stuck channel."""
_NOISY_V = 0.02
_LATE_S = 0.1


@dataclass(frozen=True)
class Diagnosis:
    """One thing looked at: its name, whether it is well, and what was found, in one line."""

    name: str
    status: Status
    found: str


def examine_converter(
    converter: Converter, supply_v: float, clock: Callable[[], float], sleep: Callable[[float], None]
) -> list[Diagnosis]:
    """Whether a converter answers, at its rate, without a gap, and each of its channels."""
    try:
        info = converter.connect()
        times, volts, missing = _samples(converter, clock, sleep)
        delay = clock() - times[-1] if len(times) else np.inf
    except RigFault as fault:
        return [Diagnosis("board", "fail", str(fault))]
    finally:
        converter.close()
    rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
    wanted = float(info.get("rate_hz", rate))
    return [
        Diagnosis("board", "ok", _said(info)),
        Diagnosis("rate", "ok" if abs(rate / wanted - 1) < 0.01 else "fail", f"{rate:.1f} Hz of {wanted:g}"),
        Diagnosis("samples", "fail" if missing else "ok", f"{missing} of {len(times) + missing} lost"),
        Diagnosis("latency", "ok" if delay < _LATE_S else "warn", f"{1e3 * delay:.1f} ms from sample to program"),
        *(_channel(number, column, supply_v) for number, column in enumerate(volts.T, start=1)),
    ]


def examine_arm(arm: Arm, clock: Callable[[], float], sleep: Callable[[float], None]) -> list[Diagnosis]:
    """Whether an arm answers, how often it tells its state, and whether anything has stopped it. It is not moved."""
    try:
        info = arm.connect()
        arm.drain()
        sleep(LOOK_S)
        states, state, now = arm.drain(), arm.state(), clock()
    except RigFault as fault:
        return [Diagnosis("arm", "fail", str(fault))]
    finally:
        arm.close()
    gaps = np.diff(states[:, 0])
    stopped = state.protective_stop or state.emergency_stop
    what = "emergency stop" if state.emergency_stop else "protective stop" if stopped else "normal"
    rate = 1 / float(np.median(gaps)) if len(gaps) else 0.0
    worst = float(gaps.max()) if len(gaps) else np.inf
    pose = ", ".join(f"{value:.1f}" for value in state.pose[:3])
    return [
        Diagnosis("arm", "ok", _said(info)),
        Diagnosis("safety", "fail" if stopped else "ok", what),
        Diagnosis("states", "ok" if worst < _LATE_S else "warn", f"{rate:.0f} Hz, longest gap {1e3 * worst:.0f} ms"),
        Diagnosis("age", "ok" if now - state.time_s < _LATE_S else "warn", f"{1e3 * (now - state.time_s):.1f} ms"),
        Diagnosis("tool", "ok", f"at {pose} mm"),
    ]


def _samples(
    converter: Converter, clock: Callable[[], float], sleep: Callable[[float], None]
) -> tuple[Array, Array, int]:
    end, pieces = clock() + LOOK_S, []
    while clock() < end:
        pieces.append(converter.read())
        sleep(0.01)
    times = np.concatenate([piece.times_s for piece in pieces])
    volts = np.vstack([piece.volts for piece in pieces if len(piece.times_s)] or [np.empty((0, 0))])
    return times, volts, int(sum(piece.missing.sum() for piece in pieces))


def _channel(number: int, volts: Array, supply_v: float) -> Diagnosis:
    """Whether a channel looks like one with a fibre on it."""
    rest, noise = float(np.median(volts)), float(volts.std())
    text = f"rests at {rest:.3f} V, noise {1e3 * noise:.2f} mV"
    if rest < _DEAD_V:
        return Diagnosis(f"channel {number}", "fail", f"{text}: dead, open or shorted to ground")
    if rest > supply_v - _DEAD_V:
        return Diagnosis(f"channel {number}", "fail", f"{text}: saturated, or shorted to the supply")
    if noise < _STUCK_V:
        return Diagnosis(f"channel {number}", "warn", f"{text}: never changes")
    if noise > _NOISY_V:
        return Diagnosis(f"channel {number}", "warn", f"{text}: noisy, look at its contacts")
    return Diagnosis(f"channel {number}", "ok", text)


def _said(info: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in info.items())
