"""Ctrl-C at an arm in motion is never missed, and a second one does not leave the tool on the pad."""

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from design.settings import PUBLISHED_CONTACT
from sense.recordings.press_plan import PressPlan
from sense.recordings.recorder import Recorder
from sense.rig import operation
from sense.rig.devices.protocols import RigFault
from sense.rig.planning.setup import Setup
from sense.rig.session.press_loop import Session
from sense.settings import RigSettings
from tests.sense.rig.devices.fakes import PAD, RIG, FakeArm, FakeConverter, Time

PLAN = PressPlan(np.array([[0, 0], [5, 3], [-5, 4]], float), np.full(3, 4.0))


@pytest.fixture
def arm() -> FakeArm:
    return FakeArm(Time())


def run(arm: FakeArm, path: Path) -> None:
    with Recorder(path, 4, {"kind": "fake"}, {}) as keep:
        Session(arm, FakeConverter(arm), keep, RIG, clock=arm.time, sleep=arm.time.sleep).run(PLAN)


def lifted(arm: FakeArm) -> bool:
    return arm.pose[2] == (RIG.contact_mm or 0.0) + 10


def test_an_interrupt_that_was_lost_is_heard_all_the_same(arm: FakeArm, tmp_path: Path) -> None:
    def lost_once(arm: FakeArm) -> None:
        if arm.pose[2] < 48 and not came:
            came.append(arm.time())
            with contextlib.suppress(KeyboardInterrupt):  # as a callback of C code does
                signal.raise_signal(signal.SIGINT)

    came: list[float] = []
    arm.hook = lost_once
    with pytest.raises(KeyboardInterrupt):
        run(arm, tmp_path / "run")
    assert arm.time() - came[0] < 2
    assert lifted(arm)


@pytest.mark.parametrize("fault", [KeyboardInterrupt, RigFault])
def test_more_interrupts_do_not_keep_the_tool_on_the_pad(
    arm: FakeArm, tmp_path: Path, fault: type[BaseException]
) -> None:
    def impatient(arm: FakeArm) -> None:
        if arm.pose[2] < 48 and not arm.stops and fault is RigFault:
            arm.force_n = 80.0
        elif arm.pose[2] < 48 or arm.stops:
            arm.force_n = 0.0
            signal.raise_signal(signal.SIGINT)

    arm.hook = impatient
    with pytest.raises(fault):
        run(arm, tmp_path / "run")
    assert lifted(arm)


def test_what_was_done_with_a_signal_is_done_again_afterwards(arm: FakeArm, tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    run(arm, tmp_path / "run")
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_ctrl_c_is_heard_where_the_session_has_done_its_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the disk hangs, which nobody else could end then."""
    heard = []

    @contextlib.contextmanager
    def opened(kind: str, setup: Setup, *more: object) -> Iterator[tuple[FakeArm, FakeConverter, RigSettings]]:
        arm = FakeArm(Time())
        yield arm, FakeConverter(arm), setup.rig

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

    monkeypatch.setattr(operation, "opened_rig", opened)
    monkeypatch.setattr(operation, "Session", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        operation.record("ur5", Setup(PAD, PUBLISHED_CONTACT, RIG, tmp_path / "run", "test"))
    assert heard == [signal.SIGINT] * 2
