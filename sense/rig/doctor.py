"""What to know of a rig before a long run: whether it answers, how fast, and which channels are alive."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.rig.devices import Arm, Board, RigFault
from padforge.sense.rig.safety import require_tool
from padforge.sense.settings import RigSettings

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


def examine_converter(converter: Board, clock: Callable[[], float], sleep: Callable[[float], None]) -> list[Diagnosis]:
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
        Diagnosis("board", "warn" if "warning" in info else "ok", _said(info)),
        Diagnosis("rate", "ok" if abs(rate / wanted - 1) < 0.01 else "fail", f"{rate:.1f} Hz of {wanted:g}"),
        Diagnosis("samples", "fail" if missing else "ok", f"{missing} of {len(times) + missing} lost"),
        Diagnosis("latency", "ok" if delay < _LATE_S else "warn", f"{1e3 * delay:.1f} ms from sample to program"),
        *(_channel(k + 1, info["inputs"][k], column, info["supply_v"]) for k, column in enumerate(volts.T)),
    ]


def examine_arm(
    arm: Arm, rig: RigSettings, clock: Callable[[], float], sleep: Callable[[float], None]
) -> list[Diagnosis]:
    """Whether an arm answers, how often it tells its state, and whether anything has stopped it. It is not moved.

    What of `[rig]` would keep `record` from moving it fails here, too: its tool, and a force that nobody can watch.
    """
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
        *_tip(info, rig),
        _force(state.force_n, rig.max_force_n),
    ]


def _tip(info: Mapping[str, Any], rig: RigSettings) -> list[Diagnosis]:
    """Whether the arm and `[rig]` agree where the tip is; nothing of an arm that keeps no such place."""
    try:
        require_tool(rig.tcp_mm, info)
    except RigFault as fault:
        return [Diagnosis("tcp", "fail", str(fault))]
    return [Diagnosis("tcp", "ok", f"{list(rig.tcp_mm or ())} mm, as the controller says")] if "tcp" in info else []


def _force(force_n: float | None, max_force_n: float | None) -> Diagnosis:
    """Whether the force is watched."""
    told = "the arm tells no force" if force_n is None else f"{force_n:.1f} N"
    if max_force_n is None:
        return Diagnosis("force", "warn", f'{told}; [rig] max_force_n is "unwatched": no force stops the arm')
    if force_n is None:
        return Diagnosis("force", "fail", f'{told}; [rig] max_force_n is {max_force_n:g}, allowed is "unwatched"')
    return Diagnosis("force", "ok", f"{told}, stopped beyond {max_force_n:g} N")


def _samples(converter: Board, clock: Callable[[], float], sleep: Callable[[float], None]) -> tuple[Array, Array, int]:
    end, pieces = clock() + LOOK_S, []
    while clock() < end:
        pieces.append(converter.read())
        sleep(0.01)
    times = np.concatenate([piece.times_s for piece in pieces])
    volts = np.vstack([piece.volts for piece in pieces if len(piece.times_s)] or [np.empty((0, 0))])
    return times, volts, int(sum(piece.missing.sum() for piece in pieces))


def _channel(number: int, board_input: int, volts: Array, supply_v: float) -> Diagnosis:
    """Whether a channel looks like one with a fibre on it."""
    rest, noise = float(np.median(volts)), float(volts.std())
    text = f"input {board_input} rests at {rest:.3f} V, noise {1e3 * noise:.2f} mV"
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
