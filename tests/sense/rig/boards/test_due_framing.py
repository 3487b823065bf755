"""The Due's wire format: what is sent comes back, and damage costs the frames it touches and never gives a wrong one.

And the samples that are put together of its blocks.
"""

import pickle
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.rig.boards import due as framing
from padforge.sense.rig.boards.due import (
    Ack,
    BoardSettings,
    DueAssembler,
    DueBlock,
    DueDecoder,
    Identity,
    Kind,
    Request,
)
from padforge.sense.rig.devices import RigFault

U8, U16, U32 = st.integers(0, 2**8 - 1), st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1)
NAMES = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=16)
SETTINGS = st.builds(BoardSettings, U32, U16, U8)


@st.composite
def blocks(draw: st.DrawFn) -> DueBlock:
    mask = draw(st.integers(1, 2**framing.MAX_CHANNELS - 1))
    samples, averaging = draw(st.integers(1, framing.MAX_SAMPLES)), draw(st.integers(1, framing.MAX_AVERAGING))
    least = draw(st.sampled_from([0, 0, 255, framing.FULL_SCALE]))  # zeros and full scale are the hard cases of COBS
    most = draw(st.sampled_from([least, averaging * framing.FULL_SCALE]))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    counts = rng.integers(min(least, most), most + 1, (samples, mask.bit_count())).astype(np.uint16)
    return DueBlock(counts, averaging, mask, draw(U16), draw(U32), draw(U32), draw(U32))


def largest(averaging: int) -> DueBlock:
    """Every count at its limit and no number with a zero byte, so that COBS has most to add."""
    counts = np.full((framing.MAX_SAMPLES, framing.MAX_CHANNELS), averaging * framing.FULL_SCALE, np.uint16)
    return DueBlock(counts, averaging, 2**framing.MAX_CHANNELS - 1, 0x0101, 0x01010101, 0x01010101, 0x01010101)


FRAMES = st.one_of(
    st.sampled_from([Request(Kind.IDENTIFY), Request(Kind.START), Request(Kind.STOP)]),
    SETTINGS,
    st.builds(Identity, st.tuples(U8, U8, U8), U8, U8, NAMES, st.binary(min_size=16, max_size=16)),
    st.builds(Ack, U8, U8, SETTINGS),
    blocks(),
    st.builds(largest, st.sampled_from([1, 2, framing.MAX_AVERAGING])),
)


def payloads(frames: list[framing.DueMessage]) -> list[bytes]:
    return [frame.pack() for frame in frames]


def stream(count: int) -> list[bytes]:
    """Frames of blocks as a board sends them, 8 channels with noise on a rest."""
    rng = np.random.default_rng(count)
    counts = (2000 + rng.integers(-300, 300, (count, framing.MAX_SAMPLES, 8))).astype(np.uint16)
    counts[:, :, 3] = 0  # a dead channel: COBS has much to do
    return [framing.encode(DueBlock(c, 1, 0xFF, i, 16 * i, 16_000 * i, 0)) for i, c in enumerate(counts)]


def cobs_byte_by_byte(payload: bytes) -> bytes:
    """Consistent overhead byte stuffing as a board does it: a run is closed by a zero, or as soon as it has 254."""
    coded, run = bytearray(), bytearray()
    for byte in payload:
        if byte:
            run.append(byte)
        if not byte or len(run) == 254:
            coded += bytes([255 if byte else len(run) + 1]) + run
            run.clear()
    return bytes(coded + bytes([len(run) + 1]) + run)


LONG_RUNS = st.builds(
    lambda before, length, after: before + bytes(1 + k % 255 for k in range(length)) + after,
    st.sampled_from([b"", b"\0", b"\x07\0"]),
    st.sampled_from([253, 254, 255, 507, 508, 509]),
    st.sampled_from([b"", b"\0", b"\0\x07", b"\0\0"]),
)
"""Runs about the longest that a count can tell."""


@given(st.binary(max_size=800) | LONG_RUNS)
def test_cobs_encode_matches_byte_by_byte_encoding_and_decode_inverts_it(payload: bytes) -> None:
    coded = framing.cobs_encode(payload)
    assert coded == cobs_byte_by_byte(payload)
    assert 0 not in coded
    assert framing.cobs_decode(coded) == payload


@settings(max_examples=60)
@given(st.lists(FRAMES, max_size=8), st.data())
def test_decode_returns_messages_in_any_portions(frames: list[framing.DueMessage], data: st.DataObject) -> None:
    sent = b"".join(map(framing.encode, frames))
    edges = [0, *sorted(data.draw(st.lists(st.integers(0, len(sent)), max_size=20))), len(sent)]
    decoder = DueDecoder()
    decoded = [frame for a, b in pairwise(edges) for frame in decoder.decode(sent[a:b])]
    assert payloads(decoded) == payloads(frames)


def damage_in_one_place(sent: bytes) -> Iterator[bytes]:
    for i in range(len(sent)):
        yield from (sent[:i] + bytes([sent[i] ^ 1 << bit]) + sent[i + 1 :] for bit in range(8))
        yield sent[:i] + sent[i + 1 :]
        yield from (sent[:i] + bytes([value]) + sent[i:] for value in (0x00, 0x01, 0x80, 0xFF, sent[i]))


def test_decode_loses_at_most_one_block_per_damaged_byte() -> None:
    frames = stream(3)
    expected = payloads(DueDecoder().decode(b"".join(frames)))
    for damaged in damage_in_one_place(frames[1]):
        decoded = payloads(DueDecoder().decode(frames[0] + damaged + frames[2]))
        assert decoded in (expected, [expected[0], expected[2]])


@settings(max_examples=20)
@given(st.sampled_from([1e-3, 1e-2, 0.1]), st.integers(0, 10**6))
def test_decode_never_returns_wrong_message(share: float, seed: int) -> None:
    frames = stream(60)
    expected = payloads(DueDecoder().decode(b"".join(frames)))
    rng = np.random.default_rng(seed)
    data = np.frombuffer(b"".join(frames), np.uint8).copy()
    hit = rng.random(len(data)) < share
    data[hit] = rng.integers(0, 256, hit.sum())
    data = np.delete(data, np.flatnonzero(rng.random(len(data)) < share / 2))
    remaining = iter(expected)
    # a subsequence: right, in order, none twice
    assert all(payload in remaining for payload in payloads(DueDecoder().decode(data.tobytes())))


def test_decode_bounds_memory_of_endless_noise() -> None:
    decoder = DueDecoder()
    for _ in range(1000):
        assert decoder.decode(b"\x55" * 1000) == []
    assert len(pickle.dumps(decoder)) < 1000
    (frame,) = stream(1)
    assert len(decoder.decode(frame)) == 1


def of_counts(counts: object, averaging: int = 1) -> bytes:
    return DueBlock(np.array(counts, np.uint16), averaging, 0xFF, 0, 0, 0, 0).pack()


@pytest.mark.parametrize(
    "payload",
    [
        *(b"", b"\x01\x00", b"\x77", b"\x02\x00", b"\x90\x01"),
        of_counts([[0] * 7 + [4096]]),
        of_counts([[0] * 8], 17),
        of_counts(np.zeros((2, 8)))[:-1],
    ],
)
def test_decode_skips_impossible_payload(payload: bytes) -> None:
    class Forged(Request):
        def pack(self) -> bytes:
            return payload

    assert DueDecoder().decode(framing.encode(Forged(Kind.STOP))) == []


def check_bytes(coded: bytes) -> bytes:
    """CRC-16/CCITT-FALSE bit by bit, in 2, 7 and 7 bits with the top bit set."""
    crc = 0xFFFF
    for byte in coded:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return bytes([0x80 | crc >> 14, 0x80 | crc >> 7 & 0x7F, 0x80 | crc & 0x7F])


def test_encode_writes_documented_bytes() -> None:
    """A board of another make relies on them. CRC-16/CCITT-FALSE of "123456789" is 29B1."""
    assert framing.encode(Request(Kind.START)) == b"\0\x02\x03" + check_bytes(b"\x02\x03") + b"\0"
    for period in range(1, 4000, 7):
        coded = framing.cobs_encode(BoardSettings(period, 0x0FF, 4).pack())
        assert framing.encode(BoardSettings(period, 0x0FF, 4)) == b"\0" + coded + check_bytes(coded) + b"\0"
    assert check_bytes(b"123456789") == bytes([0x80, 0x80 | 0x29B1 >> 7 & 0x7F, 0x80 | 0x29B1 & 0x7F])
    assert BoardSettings(1_000_000, 0x0FF, 4).pack() == bytes.fromhex("02 40420f00 ff00 04")
    assert Ack(3, 1, BoardSettings(1, 2, 3)).pack() == bytes.fromhex("82 03 01 01000000 0200 03")
    head = bytes.fromhex("90 02 05 1100 0600 07000000 08000000 09000000")
    sent = DueBlock(np.array([[1, 2], [3, 4]], np.uint16), 5, 0x0011, 6, 7, 8, 9)
    assert sent.pack() == head + bytes.fromhex("0100 0200 0300 0400")
    identity = Identity((1, 2, 3), 12, 8, "pad", bytes(range(16)))
    assert identity.pack() == b"\x81\x01\x02\x03\x0c\x08pad" + bytes(13) + bytes(range(16))


STEP_V = 3.3 / 4095


def block(first: int, time_us: int | None = None, samples: int = 16) -> DueBlock:
    counts = np.full((samples, 8), first % 4096, np.uint16)
    time_us = (first + samples) * 1000 if time_us is None else time_us
    return DueBlock(counts, 1, 0xFF, first // 16 % 2**16, first % 2**32, time_us % 2**32, 0)


def assembler(inputs: tuple[int, ...] = (0, 1, 2, 3, 4, 5, 6, 7), averaging: int = 1) -> DueAssembler:
    return DueAssembler(BoardSettings(1_000_000, sum(1 << i for i in inputs), averaging), inputs)


def test_assemble_unwraps_indices_in_bounded_memory() -> None:
    count = 70_000
    start = 2**32 - count // 32 * 16
    decoder, due, before = DueDecoder(), assembler(), -np.inf
    for first in range(start, start + count, 400):
        sent = [framing.encode(block(index)) for index in range(first, first + 400, 16)]
        frames = [frame for frame in decoder.decode(b"".join(sent)) if isinstance(frame, DueBlock)]
        samples = due.assemble(((first + 16 * i) * 1e-3, frame) for i, frame in enumerate(frames))
        assert samples.times_s[0] > before
        before = samples.times_s[-1]
        assert samples.missing.sum() == (start if first == start else 0)  # none but those before the first block
        assert samples.volts[0, 0] == pytest.approx(first % 4096 * STEP_V)
    assert len(pickle.dumps(due)) < 10_000


@pytest.mark.parametrize(
    "second",
    [block(0), block(64, 17_000), block(16, 90_000), block(2**31)],
    ids=["again", "too early", "too late", "far away"],
)
def test_assemble_raises_for_impossible_block(second: DueBlock) -> None:
    due = assembler()
    due.assemble([(1.0, block(0))])
    with pytest.raises(RigFault, match="off its time") as caught:
        due.assemble([(1.1, second)])
    assert caught.value.cause == "data"
    for other in (assembler((0, 1, 2, 3)), assembler(averaging=2)):
        with pytest.raises(RigFault, match="other channels"):
            other.assemble([(1.0, block(0))])


def test_assemble_gives_volts_of_the_inputs_asked_for_in_their_order() -> None:
    """Blocks hold the inputs in ascending order; full scale is the supply, whatever is summed."""
    counts = np.array([[0, 4 * 4095, 4095], [4, 8, 12]], np.uint16)
    mask = 1 << 2 | 1 << 5 | 1 << 7
    due = DueAssembler(BoardSettings(500_000, mask, 4), (7, 2, 5, 2))
    samples = due.assemble([(1.0, DueBlock(counts, 4, mask, 0, 3, 3000, 0))])
    expected = np.array([[4095 / 4, 0, 4095, 0], [3, 1, 2, 1]]) * STEP_V
    np.testing.assert_allclose(samples.volts, expected)
    assert samples.missing.tolist() == [3, 0]
    assert np.diff(samples.times_s) == pytest.approx([0.5e-3], rel=1e-3)
