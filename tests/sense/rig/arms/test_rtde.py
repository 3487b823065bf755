"""What comes over the wires of the arm: states, states that are none, and times on the host's clock."""

import io
import struct
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.rig.arms import rtde
from padforge.sense.rig.arms.rtde import VARIABLES, HostClock, RtdeReader

TYPES = list(VARIABLES.values())
VALUES = (1.0, *np.linspace(-0.5, 0.5, 6), 0.3, 0.0, 0.4, 0.0, 0.0, 0.0, 6.0, 8.0, -25.0, 0.0, 0.0, 0.0, 7, 1, 1, 5)
"""Of a state: stamp, pose, speed, force, mode, runtime, safety and progress."""


@settings(max_examples=15)
@given(st.lists(st.floats(0, 0.5), min_size=50, max_size=50))
def test_host_clock_ignores_late_arrivals(delays: list[float]) -> None:
    clock, delays = HostClock(), [0.0, *delays]
    times = [clock.host_time(0.008 * i, 100 + 0.008 * i + delay) for i, delay in enumerate(delays)]
    np.testing.assert_allclose(times, 100 + 0.008 * np.arange(len(delays)), atol=1e-3)
    assert (np.diff(times) > 0).all()


def state(*values: float) -> bytes:
    return rtde.pack_frame(rtde.DATA, b"\x01" + struct.pack(">19diIIi", *values))


def stream(*states: bytes, major: int = 5, version: bytes = b"\x01", types: list[str] = TYPES) -> list[bytes]:
    """What a controller sends to a reader that connects."""
    answers = (
        (rtde.VERSION, version),
        (rtde.CONTROLLER, struct.pack(">4I", major, 11, 0, 0)),
        (rtde.OUTPUTS, b"\x01" + ",".join(types).encode()),
        (rtde.START, b"\x01"),
    )
    return [*(rtde.pack_frame(*answer) for answer in answers), *states]


def reader(sent: list[bytes]) -> RtdeReader:
    """One that connects to a controller which sends that, frame by frame, and then no more."""
    link = mock.Mock(makefile=lambda mode: io.BytesIO(b"".join(sent)))
    with mock.patch("socket.create_connection", return_value=link):
        return RtdeReader("arm", 1.0)


def test_reader_converts_state() -> None:
    link = reader(stream(state(*VALUES)))
    first = link.read(1.0)
    assert (link.version, link.rate_hz) == ((5, 11, 0, 0), 500)
    assert first.pose == pytest.approx([*(1000 * np.array(VALUES[1:4])), *VALUES[4:7]])
    assert (first.speed_mm_s, first.force_n, first.sideways_n) == pytest.approx((500, -25.0, 10.0))
    assert (first.mode, first.runtime, first.progress) == (7, 1, 5)
    assert (first.protective_stop, first.emergency_stop) == (False, False)
    without = reader(stream(state(*VALUES), major=3)).read(1.0)
    assert (without.force_n, without.sideways_n) == (None, 0)


@pytest.mark.parametrize(
    ("sent", "match"),
    [
        (stream(version=b"\x00"), "does not speak RTDE 2"),
        (stream(types=["NOT_FOUND", *TYPES[1:]]), "the controller has no timestamp"),
        (stream(types=TYPES[::-1]), "the controller would send"),
        (stream(rtde.pack_frame(rtde.DATA, b"\x01" + b"x" * 10)), "sent 10 bytes, expected 168"),
        (stream(b"\x00\x02U"), "a frame of 2 bytes"),
        (stream(state(*VALUES[:15], np.inf, *VALUES[16:])), "NaN"),
    ],
    ids=range(6),
)
def test_reader_refuses_other_controller_and_impossible_state(sent: list[bytes], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        reader(sent).read(1.0)
