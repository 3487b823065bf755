"""What ur-rtde receives of the arm, on the host's clock; and one program at a time that moves it."""

import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.rig.arms import rtde_worker
from padforge.sense.rig.arms.rtde import HostClock, RtdeReader, major_version
from padforge.sense.rig.arms.rtde_worker import UrRtdeControl

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
    getattr(library, f"get{spoilt}").return_value = np.inf if spoilt == "Timestamp" else (np.inf,) * 6
    with pytest.raises(ValueError, match="NaN or infinity"):
        RtdeReader("arm", 5).read(1.0)


def test_major_version_of_polyscope() -> None:
    assert major_version("5.12.2.1101534 (Jan 01 2024)") == 5
    with pytest.raises(ValueError, match=r"'could not understand', expected a version such as 5\.12"):
        major_version("could not understand")


ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="names of local sockets are locks on Linux alone")


@pytest.fixture
def control_library(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """Its interface to an arm that takes everything."""
    interface = MagicMock()
    monkeypatch.setitem(sys.modules, "rtde_control", SimpleNamespace(RTDEControlInterface=lambda host: interface))
    monkeypatch.setattr(rtde_worker, "version", lambda name: "1.6.0")
    return interface


@ON_LINUX
def test_a_watchdog_that_is_not_set_moves_nothing(control_library: MagicMock) -> None:
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
