"""The emulated arm's ports are fixed, so every test process takes an address of this machine of its own."""

import fcntl
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from sense.rig.arms.ur5.driver import UR5
from sense.rig.emulators import whole_rig
from sense.rig.emulators.ur.controller import Series
from sense.rig.emulators.ur.emulator import UrEmulator
from tests.sense.rig.arms.ur5.arms import Robots

WAIT_S = 180.0
ADDRESSES = [f"127.0.0.{last}" for last in range(1, 33 if sys.platform == "linux" else 2)]
"""Of this machine: on Linux all that begin with 127, elsewhere the first alone."""


def taken(address: str) -> IO[str] | None:
    """The lock on an address; None where another process has it."""
    lock = (Path(tempfile.gettempdir()) / f"padforge-ur-{address}.lock").open("w")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        return None
    return lock


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """An address whose ports are held by one module of one test process at a time."""
    end = time.monotonic() + WAIT_S
    while True:
        for address in ADDRESSES:
            if lock := taken(address):
                with lock:
                    yield address
                return
        if time.monotonic() > end:
            pytest.fail(f"other processes have had the emulator's ports for {WAIT_S} s")
        time.sleep(0.1)


@pytest.fixture(scope="module")
def own_address(address: str) -> Iterator[None]:
    """Whole rigs are emulated at the address."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole_rig, "HOST", address)
        yield


@pytest.fixture(scope="module")
def host(address: str) -> str:
    """The address by a name for which ur-rtde asks whether the arm is in remote control."""
    return address.replace("127.0.0.", "127.")


@pytest.fixture(scope="module")
def robots(address: str) -> Iterator[Robots]:
    robots = Robots(address)
    yield robots
    robots.free()


@pytest.fixture
def series() -> Series:
    return "cb3"


@pytest.fixture
def robot(robots: Robots, series: Series) -> UrEmulator:
    return robots.get(series)


@pytest.fixture
def arm(robots: Robots, robot: UrEmulator, host: str) -> UR5:
    return robots.connected(host)
