"""One program at a time moves an arm, by ur-rtde: what its library is asked, and when a move is over."""

import sys
from types import SimpleNamespace
from unittest.mock import MagicMock, call

import pytest

if sys.platform != "linux":
    pytest.skip("names of local sockets are locks on Linux alone", allow_module_level=True)
from padforge.sense.rig.arms import rtde_worker
from padforge.sense.rig.arms.rtde_worker import CommandRejected, UrRtdeControl, lock_arm


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
def library(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """Its interface to an arm that takes everything."""
    interface = MagicMock()
    monkeypatch.setitem(sys.modules, "rtde_control", SimpleNamespace(RTDEControlInterface=lambda host: interface))
    monkeypatch.setattr(rtde_worker, "version", lambda name: "1.6.0")
    return interface


def test_stops_and_moves_are_asked_of_the_library(library: MagicMock) -> None:
    control = UrRtdeControl("host")
    assert control.identity == {"driver": "ur-rtde 1.6.0"}
    pose = (0.1, 0.2, 0.3, 0.0, 3.0, 0.0)
    assert control.move(pose, 0.05, 0.5)
    assert library.moveL.call_args == call(list(pose), 0.05, 0.5, True)  # and returns at once
    assert control.moving
    control.stop()
    assert library.stopL.call_args == call(5.0)  # m/s²: from 0.25 m/s at rest within 50 ms
    assert not control.moving
    control.kick()
    assert library.setWatchdog.call_args == call(4.0)  # Hz: the arm stops 0.25 s after the last kick
    control.end()
    assert [each[0] for each in library.method_calls[-2:]] == ["stopL", "stopScript"]
    library.setWatchdog.return_value = False
    with pytest.raises(RuntimeError, match="watchdog"):
        UrRtdeControl("host")


@pytest.mark.parametrize("number", [3, 4], ids=["of the move before", "of this move"])
@pytest.mark.parametrize("running", [False, True])
def test_a_move_is_over_once_another_operation_has_ended(library: MagicMock, number: int, running: bool) -> None:
    control, status = UrRtdeControl("host"), library.getAsyncOperationProgressEx.return_value
    status.operationId.return_value, status.isAsyncOperationRunning.return_value = 3, False
    control.move((0.0,) * 6, 0.05, 0.5)
    status.operationId.return_value, status.isAsyncOperationRunning.return_value = number, running
    assert control.has_arrived() == (number == 4 and not running)
