"""Diagnosis of a rig before a long run: response and rates of the devices, and the state of each channel."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.rig import clock
from padforge.sense.rig.devices import Arm, Board, RigFault
from padforge.sense.rig.safety import check_tcp
from padforge.sense.settings import RigSettings

Status = Literal["ok", "warn", "fail"]

OBSERVE_S = 2.0  # time for which each device is observed
_DEAD_V = 0.02  # a channel closer than this to either end of the range is open, shorted or saturated
_LATE_S = 0.1  # latency of samples, age or gap of states from which on they are late


@dataclass(frozen=True)
class Diagnosis:
    """Result of one check: its subject, its status, and the measurement in one line."""

    name: str
    status: Status
    message: str


def examine_board(board: Board) -> list[Diagnosis]:
    """Connect, check and close a board: its identity, rate, lost samples, latency, and each of its channels."""
    try:
        identity = board.connect()
        times_s, volts, n_missing = _read_samples(board)
        delay_s = clock.now() - times_s[-1] if len(times_s) else np.inf
    except RigFault as fault:
        return [Diagnosis("board", "fail", str(fault))]
    finally:
        board.close()
    rate_hz = (len(times_s) - 1) / (times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0
    nominal_hz = float(identity["rate_hz"])
    is_on_rate = abs(rate_hz / nominal_hz - 1) < 0.01
    inputs, supply_v = identity["inputs"], identity.get("supply_v", np.inf)
    return [
        Diagnosis("board", "warn" if "warning" in identity else "ok", _identity_text(identity)),
        Diagnosis("rate", "ok" if is_on_rate else "fail", f"{rate_hz:.1f} Hz of {nominal_hz:g}"),
        Diagnosis("samples", "fail" if n_missing else "ok", f"{n_missing} of {len(times_s) + n_missing} lost"),
        Diagnosis("latency", "ok" if delay_s < _LATE_S else "warn", f"{1e3 * delay_s:.1f} ms from sample to program"),
        *(_examine_channel(k + 1, inputs[k], column, supply_v) for k, column in enumerate(volts.T)),
    ]


def examine_arm(arm: Arm, rig: RigSettings) -> list[Diagnosis]:
    """Connect, check and close an arm without moving it; a check fails if `record` would refuse to move the arm."""
    try:
        identity = arm.connect()
        arm.drain()
        clock.sleep(OBSERVE_S)
        states, state, now_s = arm.drain(), arm.state(), clock.now()
    except RigFault as fault:
        return [Diagnosis("arm", "fail", str(fault))]
    finally:
        arm.close()
    gaps_s = np.diff(states[:, 0])
    is_stopped = state.protective_stop or state.emergency_stop
    safety = "emergency stop" if state.emergency_stop else "protective stop" if is_stopped else "normal"
    gap_s = float(gaps_s.max()) if len(gaps_s) else np.inf
    rhythm = f"{len(states)} within {OBSERVE_S:g} s"
    if len(gaps_s):
        rhythm = f"{1 / float(np.median(gaps_s)):.0f} Hz, longest gap {1e3 * gap_s:.0f} ms"
    age_s = now_s - state.time_s
    position = ", ".join(f"{value:.1f}" for value in state.pose[:3])
    return [
        Diagnosis("arm", "ok", _identity_text(identity)),
        Diagnosis("safety", "fail" if is_stopped else "ok", safety),
        Diagnosis("states", "ok" if gap_s < _LATE_S else "warn", rhythm),
        Diagnosis("age", "ok" if age_s < _LATE_S else "warn", f"{1e3 * age_s:.1f} ms"),
        Diagnosis("tool", "ok", f"at {position} mm"),
        *_examine_tcp(identity, rig),
        _examine_force(state.force_n, rig.max_force_n),
    ]


def _examine_tcp(identity: Mapping[str, Any], rig: RigSettings) -> list[Diagnosis]:
    """Check that `[rig]` agrees with the arm's tool centre point; [] if the arm stores none."""
    if "tcp" not in identity:
        return []
    try:
        check_tcp(rig.tcp_mm, identity)
    except RigFault as fault:
        return [Diagnosis("tcp", "fail", str(fault))]
    return [Diagnosis("tcp", "ok", f"{list(rig.tcp_mm or ())} mm, as the controller says")]


def _examine_force(force_n: float | None, max_force_n: float | None) -> Diagnosis:
    """Check that the force is measured and limited."""
    measured = "the arm measures no force" if force_n is None else f"{force_n:.1f} N"
    if max_force_n is None:
        return Diagnosis("force", "warn", f'{measured}; [rig] max_force_n is "unwatched": no force stops the arm')
    if force_n is None:
        return Diagnosis("force", "fail", f'{measured}; [rig] max_force_n is {max_force_n:g}, allowed is "unwatched"')
    return Diagnosis("force", "ok", f"{measured}, stopped beyond {max_force_n:g} N")


def _read_samples(board: Board) -> tuple[Array, Array, int]:
    end_s, blocks = clock.now() + OBSERVE_S, []
    while clock.now() < end_s:
        blocks.append(board.read())
        clock.sleep(0.01)
    times_s = np.concatenate([block.times_s for block in blocks])
    volts = np.vstack([block.volts for block in blocks if len(block.times_s)] or [np.empty((0, 0))])
    return times_s, volts, int(sum(block.missing.sum() for block in blocks))


def _examine_channel(number: int, board_input: int, volts: Array, supply_v: float) -> Diagnosis:
    """Check that the readings (n,) of a channel look like those of a fibre."""
    name, baseline, noise = f"channel {number}", float(np.median(volts)), float(volts.std())
    text = f"input {board_input} rests at {baseline:.3f} V, noise {1e3 * noise:.2f} mV"
    if baseline < _DEAD_V:
        return Diagnosis(name, "fail", f"{text}: dead, open or shorted to ground")
    if baseline > supply_v - _DEAD_V:
        return Diagnosis(name, "fail", f"{text}: saturated, or shorted to the supply")
    if noise < 1e-6:  # an ADC that reads a fibre shows some noise
        return Diagnosis(name, "warn", f"{text}: never changes")
    if noise > 0.02:
        return Diagnosis(name, "warn", f"{text}: noisy, look at its contacts")
    return Diagnosis(name, "ok", text)


def _identity_text(identity: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in identity.items())
