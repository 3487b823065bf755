"""A rig at work: who hears a person that wants it to end."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from design.settings import PUBLISHED_CONTACT
from sense.rig import operation
from sense.rig.planning.setup import Setup
from sense.settings import RigSettings
from tests.sense.rig.devices.fakes import PAD, RIG, FakeArm, FakeConverter, Time


def test_a_second_ctrl_c_is_heard_where_the_session_has_done_its_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the disk hangs, which nobody else could end then."""
    heard = []

    @contextmanager
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
