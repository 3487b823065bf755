"""Bytes at random on the wires of board and arm: parsers raise what they promise, and take no damaged frame."""

import json
import struct
from binascii import crc_hqx
from itertools import pairwise
from unittest import mock

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sense.rig.arms.ur5 import messages as ur5_wire
from sense.rig.arms.ur5 import rtde_frames as ur_frames
from sense.rig.arms.ur5.rtde_reader import VARIABLES, RtdeReader
from sense.rig.boards.due import framing
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.sense.cases import seeds

SETTINGS = framing.BoardSettings(1_000_000, 0b1111, 4)
FRAMES = (
    framing.Request(framing.Kind.START),
    SETTINGS,
    framing.Identity((1, 2, 3), 12, 8, "board", bytes(16)),
    framing.Ack(3, 0, SETTINGS),
    framing.Block(np.full((16, 4), 900, np.uint16), 4, 0b1111, 7, 112, 5_000, 0),
)


def noisy(rng: np.random.Generator, stream: bytes) -> bytes:
    """`stream` with bits flipped, bytes lost and others in between."""
    data = bytearray(stream)
    for place in rng.integers(len(data), size=rng.integers(12)):
        kind = rng.integers(3)
        if kind == 0:
            data[min(place, len(data) - 1)] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del data[place : place + int(rng.integers(1, 40))]
        else:
            data[place:place] = rng.bytes(int(rng.integers(1, 40)))
    return bytes(data)


def portions(rng: np.random.Generator, data: bytes) -> list[bytes]:
    edges = [0, *np.sort(rng.integers(len(data) + 1, size=rng.integers(9))).tolist(), len(data)]
    return [data[first:end] for first, end in pairwise(edges)]


@few(200)
@given(seed=seeds)
def test_a_noisy_line_gives_only_frames_whose_check_fits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sent = [FRAMES[k] for k in rng.integers(len(FRAMES), size=9)]
    stream = noisy(rng, b"".join(map(framing.encode, sent)))
    if rng.random() < 0.2:
        stream = rng.bytes(2000)
    decoder = framing.Decoder()
    with ends_in_time(5):
        found = [frame for part in portions(rng, stream) for frame in decoder.feed(part)]
    pieces = stream.split(b"\0")
    assert len(found) + decoder.damaged <= len(pieces)
    checked = {piece for piece in pieces if piece[-3:] == _check(piece[:-3])}
    for frame in found:
        assert framing.encode(frame)[1:-1] in checked
    # A frame whose bytes are all there is found, whatever lies around it.
    whole = [frame for frame in sent if b"\0" + framing.encode(frame)[1:-1] + b"\0" in b"\0" + stream]
    assert len(found) >= len({framing.encode(frame) for frame in whole})


def _check(coded: bytes) -> bytes:
    crc = crc_hqx(coded, 0xFFFF)
    return bytes([0x80 | crc >> 14, 0x80 | crc >> 7 & 0x7F, 0x80 | crc & 0x7F])


@few(200)
@given(payload=st.binary(max_size=500))
def test_any_payload_is_a_frame_or_a_value_error(payload: bytes) -> None:
    assert framing.cobs_decode(framing.cobs_encode(payload)) == payload
    try:
        frame = framing.unpack(payload)
    except ValueError:
        return
    assert framing.unpack(frame.pack()).pack() == frame.pack()


@few(200)
@given(seed=seeds)
def test_frames_of_the_controller_are_cut_the_same_in_any_portions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stream = b"".join(ur_frames.frame(int(rng.integers(256)), rng.bytes(int(rng.integers(60)))) for _ in range(8))
    stream = noisy(rng, stream) if rng.random() < 0.7 else stream

    def cut(parts: list[bytes]) -> list[tuple[int, bytes] | str]:
        splitter, out = ur_frames.Splitter(), []
        try:
            for part in parts:
                for kind_and_payload in splitter.feed(part):
                    out.append(kind_and_payload)
        except ValueError:
            out.append("damaged")
        return out

    with ends_in_time(5):
        assert cut(portions(rng, stream)) == cut([stream])


@few(200)
@given(seed=seeds)
def test_what_the_child_of_the_arm_writes_is_read_up_to_where_it_is_damaged(seed: int) -> None:
    rng = np.random.default_rng(seed)
    row = ur5_wire.Row._make(rng.standard_normal(len(ur5_wire.Row._fields)).tolist())
    parts = [ur5_wire.pack_row(row), ur5_wire.pack_answer({"id": 1, "is": [1.5, "a"]})]
    stream = b"".join(parts[k] for k in rng.integers(2, size=6))
    stream = noisy(rng, stream) if rng.random() < 0.7 else stream
    at = 0

    def source(count: int) -> bytes:
        nonlocal at
        taken, at = stream[at : at + count], at + count
        return taken

    with ends_in_time(5):
        for found in ur5_wire.read(source):
            assert isinstance(found, ur5_wire.Row) or json.dumps(found)


class Link:
    """A socket that a controller has filled beforehand."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def recv(self, most: int) -> bytes:
        taken, self._content = self._content[: min(most, 97)], self._content[min(most, 97) :]
        return taken

    def settimeout(self, seconds: float) -> None: ...

    def setsockopt(self, *option: int) -> None: ...

    def sendall(self, data: bytes) -> None: ...

    def close(self) -> None: ...


@few(200)
@given(seed=seeds)
def test_a_controller_that_talks_nonsense_is_an_os_or_value_error(seed: int) -> None:
    """The two that whoever uses the reader is prepared for."""
    rng = np.random.default_rng(seed)
    types = [ur_frames.type_of(name) for name in VARIABLES]
    state = struct.pack(">B", 1) + ur_frames.layout(types).pack(*rng.standard_normal(19), 7, 1, 1, 0)
    stream = b"".join(
        [
            ur_frames.frame(ur_frames.VERSION, b"\x01"),
            ur_frames.frame(ur_frames.CONTROLLER, struct.pack(">4I", 5, 11, 0, 0)),
            ur_frames.frame(ur_frames.OUTPUTS, b"\x01" + ",".join(types).encode()),
            ur_frames.frame(ur_frames.START, b"\x01"),
            *(ur_frames.frame(ur_frames.DATA, state) for _ in range(5)),
        ]
    )
    stream = noisy(rng, stream) if rng.random() < 0.9 else stream
    with mock.patch("socket.create_connection", return_value=Link(stream)), ends_in_time(5):
        try:
            reader = RtdeReader("arm", 1.0)
            for _ in range(6):
                reading = reader.read(1.0)
                assert len(reading.pose) == 6
                assert reading.skipped >= 0
        except (OSError, ValueError):
            return
