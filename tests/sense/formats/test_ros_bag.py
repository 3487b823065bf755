"""Bags that are torn or not as rosbag2 writes them: one line each."""

import json
import resource
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from padforge.design.common.validation import InputError
from padforge.sense import Recorder, Recording, import_bag
from padforge.sense.formats.ros_writer import McapFollower

from .foreign import STORE, array, channel, chunk, make, mcap_file, message, write_bag

FLOATS = "std_msgs/msg/Float64MultiArray"


def refusal_of(path: Path, columns: str = "fibres=/f") -> str:
    """Return the one line that a bag is refused with."""
    with pytest.raises(InputError) as refusal:
        import_bag(path, columns)
    line = str(refusal.value)
    assert path.name in line
    assert "\n" not in line
    assert len(line) < 400 + len(str(path))
    return line


def test_import_bag_refuses_chunks_that_lie(tmp_path: Path) -> None:
    content = channel(1, "/f", FLOATS)
    for name, made, reason in (
        ("checksum", chunk(content, "", checksum=1), "checksum mismatch"),
        ("noise", chunk(b"no such thing", "zstd", 50), "cut off or damaged"),
        ("json", channel(1, "/f", FLOATS, "json"), "is written as 'json', expected 'cdr'"),
        ("twice", channel(1, "/f", FLOATS) + channel(2, "/f", "std_msgs/msg/Bool"), "and of 'std_msgs/msg/Bool'"),
    ):
        assert reason in refusal_of(mcap_file(tmp_path / f"{name}.mcap", [made]))


def test_import_bag_refuses_a_record_beyond_its_chunk(tmp_path: Path) -> None:
    """Also where the library would end without an error, and without the messages that follow."""
    readings = [("/f", 0.1 * i, array("Float64MultiArray", np.arange(4.0) + i)) for i in range(40)]
    content = bytearray(write_bag(tmp_path / "bag", readings).read_bytes())
    body = bytes(STORE.serialize_cdr(readings[20][2], FLOATS))
    start = content.index(body) - 31  # of the record
    content[start : start + 9] = struct.pack("<BQ", 127, 2**20)
    (tmp_path / "long.mcap").write_bytes(content)
    assert "20 of 40 messages can be read" in refusal_of(tmp_path / "long.mcap")


def cdr(*parts: bytes) -> bytes:
    return b"\0\1\0\0" + b"".join(parts)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (cdr(struct.pack("<III", 0, 0, 2**32 - 1), bytes(8)), "message 0 of .* is damaged"),
        (cdr(struct.pack("<III", 0, 0, 1), bytes(4), struct.pack("<d", np.inf)), "readings hold infinity"),
        (cdr(struct.pack("<III", 0, 0, 600), bytes(4), bytes(4800)), r"expected \(R, C\), R >= 2, C = 1 to 512"),
    ],
)
def test_import_bag_refuses_messages_that_lie(tmp_path: Path, body: bytes, reason: str) -> None:
    messages = [message(1, 10**9 * step, body) for step in range(1, 9)]
    path = mcap_file(tmp_path / "lies.mcap", [channel(1, "/f", FLOATS), chunk(b"".join(messages))])
    with pytest.raises(InputError, match=reason):
        import_bag(path, "fibres=/f")
    refusal_of(path)


def test_import_bag_refuses_stamps_beyond_the_limits(tmp_path: Path) -> None:
    body = bytes(STORE.serialize_cdr(array("Float64MultiArray", np.ones(2)), FLOATS))
    for stamps, reason in (([1, 2**64 - 1], "1 of 2 messages"), ([5, 5, 5], "do not ascend"), ([1, 2**62], "")):
        path = mcap_file(tmp_path / "r.mcap", [channel(1, "/f", FLOATS), *(message(1, each, body) for each in stamps)])
        assert reason in refusal_of(path)


DOCUMENTS = {
    "deep": "[" * 10**5,
    "bare": '{"format": "padforge-ros/2"}',
    "wrong": json.dumps(
        {"format": "padforge-ros/2", "digest": "", "epoch_s": float("nan"), "source": {}, "times_s": [1e400]}
        | {key: [{}] for key in ("presses_mm", "depths_mm", "down_command", "up_command")}
    ),
}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_import_bag_ignores_a_text_that_does_not_fit_the_messages(
    tmp_path: Path, eight: Recording, document: str
) -> None:
    messages = [
        ("/pad/recording", 0.0, make("String", DOCUMENTS[document])),
        *(
            ("/pad/readings", time, array("Float64MultiArray", row))
            for time, row in zip(eight.times_s[:99], eight.readings[:99], strict=True)
        ),
        ("/pad/pressed", 2.0, make("Bool", True)),
        ("/pad/pressed", 4.0, make("Bool", False)),
    ]
    recording = import_bag(write_bag(tmp_path / "bag", messages))
    assert len(recording.down_command) == 1
    assert "was changed" in recording.source["note"]


TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
ROW = f"INSERT INTO topics VALUES (1, '/f', '{FLOATS}', 'cdr');"
PLAIN = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"


def test_import_bag_refuses_sqlite_messages_that_are_no_bytes(tmp_path: Path) -> None:
    path = tmp_path / "text.db3"
    with sqlite3.connect(path) as file:
        file.executescript(f"{TOPICS}{ROW}{PLAIN}INSERT INTO messages VALUES (1, 1, 5, 'text')")
    file.close()
    assert "has a str where rosbag2 has bytes" in refusal_of(path)


def test_import_bag_writes_nothing_beside_sqlite_without_an_index(tmp_path: Path) -> None:
    body = bytes(STORE.serialize_cdr(array("Float64MultiArray", np.zeros(400)), FLOATS))
    path = tmp_path / "100%25?.db3"
    with sqlite3.connect(path) as file:
        file.executescript(TOPICS + ROW + PLAIN)
        rows = ((step, 1, (9000 - step) * 10**8, body) for step in range(2000))
        file.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    file.close()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, before[1]))
    try:
        assert "has no press" in refusal_of(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def recording_cut_at(content: bytes, size: int, path: Path) -> Recording | None:
    """Import what is left of a bag; None where that is refused, since it has no press yet."""
    path.write_bytes(content[:size])
    recording, refusal = None, ""
    try:
        recording = import_bag(path)
    except InputError as error:
        refusal = str(error)
    assert (recording is None) == bool(refusal)
    assert "\n" not in refusal
    assert recording is None or "is cut off" in recording.source["note"]
    return recording


def test_import_bag_recovers_a_file_cut_anywhere(tmp_path: Path) -> None:
    """Each of its chunks has the 20 readings of a press."""
    with Recorder(tmp_path / "run", 2, {}, {}) as recorder:
        recorder.attach(McapFollower(tmp_path / "run.mcap"))
        for press in range(5):
            recorder.append(2 * press + np.arange(20) / 10, 20.0 * press + np.arange(40).reshape(20, 2) / 2)
            recorder.begin((press, 0), recorder.n_readings - 10, press)
            recorder.finish(recorder.n_readings - 1)
            recorder.sync()
    content = (tmp_path / "run.mcap").read_bytes()
    ends = [index.chunk_start_offset + index.chunk_length for index in chunk_indexes(tmp_path / "run.mcap")]
    assert len(ends) == 5
    counts = []
    for size in sorted({*range(0, 60, 3), *np.linspace(60, len(content) - 1, 40).astype(int), *ends, ends[2] - 1}):
        recording = recording_cut_at(content, size, tmp_path / "cut.mcap")
        n_whole = sum(end <= size for end in ends)
        if recording is None or not recording.has_position.any():  # without the end of a press they are detected
            assert n_whole == 0
            continue
        n_presses, n_readings = len(recording.presses_mm), len(recording.readings)
        counts.append(n_readings)
        assert n_presses - n_whole in (0, 1)  # a chunk may have ended soon after its press
        assert 20 * n_presses <= n_readings <= 20 * n_whole + 20
        np.testing.assert_array_equal(recording.readings[:, 0], np.arange(n_readings))
        np.testing.assert_allclose(recording.presses_mm[:, 0], np.arange(n_presses))
    assert counts == sorted(counts)
    assert len(set(counts)) > 12


def chunk_indexes(path: Path) -> list[ChunkIndex]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary
    return summary.chunk_indexes


def test_import_bag_recovers_an_exported_bag(bag: Path, eight: Recording, tmp_path: Path) -> None:
    content = bag.read_bytes()
    assert recording_cut_at(content, len(content) - 1, tmp_path / "cut.mcap") == eight
    (index,) = chunk_indexes(bag)
    recording = recording_cut_at(content, index.chunk_start_offset + index.chunk_length // 2, tmp_path / "cut.mcap")
    assert recording
    assert 2 <= len(recording.presses_mm) < 8
    np.testing.assert_array_equal(recording.readings, eight.readings[: len(recording.readings)])


def test_import_bag_recovers_packed_files_of_a_folder(tmp_path: Path) -> None:
    messages = [("/f", 0.1 * i, array("Float64MultiArray", np.arange(500.0) + i / 4)) for i in range(1000)]
    down = [("/down", 0.1 * i, make("Bool", i % 20 < 10)) for i in range(10, 1000, 10)]
    file = write_bag(tmp_path / "bag", sorted([*messages, *down], key=lambda each: each[1]), packed=True)
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    recording = import_bag(tmp_path / "bag", "fibres=/f,press=/down")
    n_readings = len(recording.readings)
    assert 200 < n_readings < 600
    np.testing.assert_array_equal(recording.readings, [message.data for _, _, message in messages[:n_readings]])
    assert recording.source["note"].startswith("is cut off; read are ")
