"""What ur-rtde receives of the arm, on the host's clock; and one program at a time that moves it."""

import sys
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, call

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.rig.arms import rtde_worker
from padforge.sense.rig.arms.rtde import HostClock, RtdeReader, major_version
from padforge.sense.rig.arms.rtde_worker import CommandRejected, UrRtdeControl, lock_arm

POSE, SPEED, FORCE = (-0.5, -0.3, 0.1, 0.1, 3.0, 0.5), (0.3, 0.0, 0.4, 9.0, 9.0, 9.0), (6.0, 8.0, -25.0, 9.0, 9.0, 9.0)


@settings(max_examples=15)
@given(st.lists(st.floats(0, 0.5), min_size=50, max_size=50))
def test_host_clock_ignores_late_arrivals(delays: list[float]) -> None:
    clock, delays = HostClock(), [0.0, *delays]
    times = [clock.host_time(0.008 * i, 100 + 0.008 * i + delay) for i, delay in enumerate(delays)]
    np.testing.assert_allclose(times, 100 + 0.008 * np.arange(len(delays)), atol=1e-3)
    assert (np.diff(times) > 0).all()


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """Its interface to an arm whose state never changes."""
    state = {"Timestamp": 1.0, "ActualTCPPose": POSE, "ActualTCPSpeed": SPEED, "ActualTCPForce": FORCE}
    state |= {"RobotMode": 7, "RuntimeState": 1, "SafetyStatusBits": 1}
    interface = MagicMock(**{f"get{name}.return_value": value for name, value in state.items()})

    def connect(host: str, rate_hz: float, variables: list[str]) -> MagicMock:
        interface.rate_hz = rate_hz
        return interface

    monkeypatch.setitem(sys.modules, "rtde_receive", SimpleNamespace(RTDEReceiveInterface=connect))
    return interface


def test_reader_converts_state(library: MagicMock) -> None:
    state = RtdeReader("arm", 5).read(1.0)
    assert library.rate_hz == 500
    assert state.pose == pytest.approx((-500, -300, 100, 0.1, 3.0, 0.5))
    assert (state.speed_mm_s, state.force_n, state.sideways_n) == pytest.approx((500, -25.0, 10.0))
    assert (state.mode, state.runtime) == (7, 1)
    assert (state.protective_stop, state.emergency_stop) == (False, False)
    without = RtdeReader("arm", 3).read(1.0)
    assert library.rate_hz == 125
    assert (without.force_n, without.sideways_n) == (None, 0)


def test_reader_returns_each_state_once_and_as_a_whole(library: MagicMock) -> None:
    reader = RtdeReader("arm", 3)
    reader.read(0.0)
    with pytest.raises(TimeoutError, match=r"no new state for 0\.002 s"):
        reader.read(0.002)
    # another state arrives while the first is read
    library.getTimestamp.side_effect = [2.0, 3.0, 3.0, 3.0]
    library.getActualTCPPose.side_effect = [(2.0,) * 6, (3.0,) * 6]
    assert reader.read(1.0).pose[0] == 3000
    library.isConnected.return_value = False
    with pytest.raises(ConnectionError):
        reader.read(1.0)


@pytest.mark.parametrize("spoilt", ["Timestamp", "ActualTCPPose", "ActualTCPSpeed", "ActualTCPForce"])
def test_reader_refuses_impossible_state(library: MagicMock, spoilt: str) -> None:
    value: Any = np.inf if spoilt == "Timestamp" else (np.inf,) * 6
    getattr(library, f"get{spoilt}").return_value = value
    with pytest.raises(ValueError, match="NaN or infinity"):
        RtdeReader("arm", 5).read(1.0)


def test_major_version_of_polyscope() -> None:
    assert major_version("5.12.2.1101534 (Jan 01 2024)") == 5
    with pytest.raises(ValueError, match=r"'could not understand', expected a version such as 5\.12"):
        major_version("could not understand")


ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="names of local sockets are locks on Linux alone")


@ON_LINUX
def test_lock_admits_one_program_until_that_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtde_worker, "SESSION_END_S", 0.05)
    lock, another = lock_arm("192.0.2.1"), lock_arm("192.0.2.2")
    with pytest.raises(CommandRejected) as refused:
        lock_arm("192.0.2.1")
    cause, message, _ = refused.value.args
    assert (cause, message) == ("refused", "another program on this computer uses the arm 192.0.2.1")
    lock.close()
    lock_arm("192.0.2.1").close()
    another.close()


@pytest.fixture
def control_library(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """Its interface to an arm that takes everything."""
    interface = MagicMock()
    monkeypatch.setitem(sys.modules, "rtde_control", SimpleNamespace(RTDEControlInterface=lambda host: interface))
    monkeypatch.setattr(rtde_worker, "version", lambda name: "1.6.0")
    return interface


@ON_LINUX
def test_stops_and_moves_are_asked_of_the_library(control_library: MagicMock) -> None:
    control = UrRtdeControl("host")
    assert control.identity == {"driver": "ur-rtde 1.6.0"}
    pose = (0.1, 0.2, 0.3, 0.0, 3.0, 0.0)
    assert control.move(pose, 0.05, 0.5)
    assert control_library.moveL.call_args == call(list(pose), 0.05, 0.5, True)  # and returns at once
    assert control.moving
    control.stop()
    assert control_library.stopL.call_args == call(5.0)  # m/s²: from 0.25 m/s at rest within 50 ms
    assert not control.moving
    control.kick()
    assert control_library.setWatchdog.call_args == call(4.0)  # Hz: the arm stops 0.25 s after the last kick
    control.end()
    assert [each[0] for each in control_library.method_calls[-2:]] == ["stopL", "stopScript"]
    control_library.setWatchdog.return_value = False
    with pytest.raises(RuntimeError, match="watchdog"):
        UrRtdeControl("host")


@pytest.mark.parametrize("number", [3, 4], ids=["of the move before", "of this move"])
@pytest.mark.parametrize("running", [False, True])
@ON_LINUX
def test_a_move_is_over_once_another_operation_ends(control_library: MagicMock, number: int, running: bool) -> None:
    control, status = UrRtdeControl("host"), control_library.getAsyncOperationProgressEx.return_value
    status.operationId.return_value, status.isAsyncOperationRunning.return_value = 3, False
    control.move((0.0,) * 6, 0.05, 0.5)
    status.operationId.return_value, status.isAsyncOperationRunning.return_value = number, running
    assert control.has_arrived() == (number == 4 and not running)
