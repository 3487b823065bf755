"""Ctrl-C at an arm in motion is never missed, and a second one does not leave the tool on the pad."""

import contextlib
import signal
from pathlib import Path

import pytest

from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense.rig import operation
from padforge.sense.rig.config import RigConfig
from padforge.sense.rig.devices import RigFault
from tests.sense.rig.fakes import PAD, RIG, FakeArm, FakeConverter, Time
from tests.sense.rig.test_press_loop import FOUR, run


def interrupted(arm: FakeArm, path: Path, raises: type[BaseException]) -> None:
    """Record until that is raised, and see that the tool is lifted off the pad and signals are as before."""
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises((RigFault, KeyboardInterrupt)) as caught:
        run(path, arm, FakeConverter(arm), RIG, FOUR)
    assert caught.type is raises
    assert arm.pose[2] == 50 + 10
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_an_interrupt_that_was_lost_is_heard_all_the_same(tmp_path: Path, name: str) -> None:
    def lost_once(arm: FakeArm) -> None:
        if arm.pose[2] < 48 and not came:
            came.append(arm.time())
            with contextlib.suppress(KeyboardInterrupt):  # as a callback of C code does
                signal.raise_signal(signal.Signals[name])

    arm, came = FakeArm(Time()), []
    arm.hook = lost_once
    ends = {name: signal.signal(signal.Signals[name], signal.default_int_handler) for name in ("SIGTERM", "SIGHUP")}
    try:
        interrupted(arm, tmp_path / "run", KeyboardInterrupt)
    finally:
        for other, handler in ends.items():
            signal.signal(signal.Signals[other], handler)
    assert arm.time() - came[0] < 2


@pytest.mark.parametrize("fault", [KeyboardInterrupt, RigFault])
def test_more_interrupts_do_not_keep_the_tool_on_the_pad(tmp_path: Path, fault: type[BaseException]) -> None:
    def impatient(arm: FakeArm) -> None:
        if arm.pose[2] < 48 and not arm.stops and fault is RigFault:
            arm.force_n = 80.0
        elif arm.pose[2] < 48 or arm.stops:
            arm.force_n = 0.0
            signal.raise_signal(signal.SIGINT)

    arm = FakeArm(Time())
    arm.hook = impatient
    interrupted(arm, tmp_path / "run", fault)


def test_a_second_ctrl_c_is_heard_where_the_session_has_done_its_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the disk hangs, which nobody else could end then."""
    heard = []

    class Interrupted:
        def __init__(self, *devices: object, **more: object) -> None:
            pass

        def run(self, *plan: object) -> None:
            for _ in range(2):
                try:
                    signal.raise_signal(signal.SIGINT)
                except KeyboardInterrupt:
                    heard.append(signal.SIGINT)
            raise KeyboardInterrupt

    arm = FakeArm(Time())
    rig = contextlib.nullcontext((arm, FakeConverter(arm), RIG))
    monkeypatch.setattr(operation, "opened_rig", lambda *setup: rig)
    monkeypatch.setattr(operation, "Session", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        operation.record("ur5", RigConfig(PAD, PUBLISHED_CONTACT, RIG, tmp_path / "run", "test"))
    assert heard == [signal.SIGINT] * 2
