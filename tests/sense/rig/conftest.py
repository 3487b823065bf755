"""The emulated arm's ports are fixed, so only one test process at a time may have them."""

import fcntl
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sense.rig.emulators.ur import UrEmulator
from sense.rig.emulators.ur_controller import Series
from sense.rig.ur5.driver import UR5
from tests.sense.rig.ur5.arms import HOST, Robots

WAIT_S = 180.0


@pytest.fixture(scope="module")
def ports() -> Iterator[None]:
    """Held by one module of one test process at a time."""
    with (Path(tempfile.gettempdir()) / "padforge-ur-ports.lock").open("w") as lock:
        end = time.monotonic() + WAIT_S
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > end:
                    pytest.fail(f"another process has had the emulator's ports for {WAIT_S} s")
                time.sleep(0.1)
        yield


@pytest.fixture(scope="module")
def robots(ports: None) -> Iterator[Robots]:
    robots = Robots()
    yield robots
    robots.free()


@pytest.fixture
def series() -> Series:
    return "cb3"


@pytest.fixture
def robot(robots: Robots, series: Series) -> UrEmulator:
    return robots.get(series)


@pytest.fixture
def arm(robot: UrEmulator) -> Iterator[UR5]:
    arm = UR5(HOST)
    arm.connect()
    yield arm
    arm.close()
