"""What a person is told where the tool cannot be lifted off after a fault."""

import pytest

from sense.rig.devices.protocols import RigFault
from tests.sense.rig.session.test_press_loop import broken_at, rig, run


def test_a_tool_that_stays_on_the_pad_is_told_whatever_the_fault(tmp_path):
    arm, converter, options = rig(tmp_path)

    def both_go(arm):
        converter.lost = arm.time() > 101.1
        arm.lost = arm.stops > 0

    arm.hook = both_go
    with pytest.raises(RigFault, match="the board is gone; the tool was not lifted off: the arm is gone") as fault:
        run(tmp_path, arm, converter, options)
    assert fault.value.cause == "lost"


def test_an_arm_that_does_not_confirm_its_stop_is_told(tmp_path):
    arm, converter, options = rig(tmp_path)

    def stop():
        raise RigFault("lost", "the arm did not confirm the stop", "look at it")

    arm.stop = stop
    arm.hook = broken_at(1.1, "lost")
    with pytest.raises(
        RigFault, match="the arm is gone; the tool was not lifted off: the arm did not confirm the stop"
    ):
        run(tmp_path, arm, converter, options)


def test_ctrl_c_says_that_the_tool_stays_on_the_pad(tmp_path):
    arm, converter, options = rig(tmp_path)

    def interrupt(arm):
        arm.protective_stop = arm.stops > 0
        if arm.pose[2] < 48 and not arm.stops:
            raise KeyboardInterrupt

    arm.hook = interrupt
    with pytest.raises(KeyboardInterrupt, match="the tool was not lifted off: the arm is in a protective stop"):
        run(tmp_path, arm, converter, options)
