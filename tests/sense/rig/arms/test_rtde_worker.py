"""One program at a time moves an arm."""

import sys

import pytest

if sys.platform != "linux":
    pytest.skip("names of local sockets are locks on Linux alone", allow_module_level=True)
from padforge.sense.rig.arms import rtde_worker
from padforge.sense.rig.arms.rtde_worker import CommandRejected, lock_arm


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
