"""Bags that are torn, lie, or were made to do harm: each is one line, soon and in little memory."""

import json
import resource
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from time import process_time

import lz4.frame
import numpy as np
import pytest
import zstandard

from design.common.errors import InputError
from sense import Recording
from sense.recordings.formats.ros.bags import bag as limits
from sense.recordings.formats.ros.importing import import_bag
from tests.sense.recordings.formats.ros.foreign import (
    MAGIC,
    STORE,
    array,
    channel,
    chunk,
    make,
    mcap_file,
    message,
    record,
    text,
    write_bag,
)

FLOATS = "std_msgs/msg/Float64MultiArray"
MOST_S, MOST_BYTES = 10, 2**30


def refused(path: Path, mapping: str = "fibres=/f") -> str:
    """The one line that a bag is refused with, within ten seconds and a GiB."""
    begun, before = process_time(), peak_bytes()
    with pytest.raises(InputError) as refusal:
        import_bag(path, mapping)
    took_s, more = process_time() - begun, peak_bytes() - before
    line = str(refusal.value)
    assert path.name in line
    assert "\n" not in line
    assert len(line) < 400 + len(str(path))
    assert took_s < MOST_S
    assert more < MOST_BYTES
    return line


def peak_bytes() -> int:
    """Most memory that the process ever took."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def is_recording_or_one_line(path: Path, mapping: str) -> bool:
    try:
        return bool(import_bag(path, mapping))
    except InputError as error:
        return path.name in str(error) and "\n" not in str(error)


def test_a_bag_that_is_cut_anywhere_is_one_line(bag: Path, tmp_path: Path) -> None:
    content = bag.read_bytes()
    cut = tmp_path / "cut.mcap"
    for keep in sorted({*range(0, 200, 7), *np.linspace(200, len(content) - 1, 60).astype(int), len(content) - 1}):
        cut.write_bytes(content[:keep])
        refused(cut, "")


@pytest.mark.parametrize("many", [1, 20])
@pytest.mark.parametrize("form", ["mcap", "packed", "sqlite3"])
def test_bytes_changed_at_random_are_a_recording_or_one_line(tmp_path: Path, bag: Path, form: str, many: int) -> None:
    if form != "mcap":
        bag = write_bag(tmp_path / "bag", readings(300), "mcap" if form == "packed" else form, form == "packed")
    content = np.frombuffer(bag.read_bytes(), np.uint8)
    random = np.random.default_rng(many)
    changed = tmp_path / f"changed{bag.suffix}"
    begun = process_time()
    for _ in range(120):
        harmed = content.copy()
        at = random.integers(len(harmed), size=many) if many > 1 else random.integers(min(4000, len(harmed)), size=1)
        harmed[at] = random.integers(256, size=many)
        changed.write_bytes(harmed.tobytes())
        assert is_recording_or_one_line(changed, "" if form == "mcap" else "fibres=/f,press=/down")
    assert process_time() - begun < 60


def readings(count: int) -> list[tuple[str, float, object]]:
    told = [("/f", 0.1 * step, array("Float64MultiArray", np.arange(4.0) + step)) for step in range(count)]
    return [*told, ("/down", 2.0, make("Bool", True)), ("/down", 4.0, make("Bool", False))]


@pytest.mark.parametrize("form", ["lz4", "zstd"])
@pytest.mark.parametrize("claim", ["the truth", "less", "more", "an exabyte"])
def test_a_chunk_that_unpacks_to_gigabytes_does_not(tmp_path: Path, form: str, claim: str) -> None:
    pack: Callable[[bytes], bytes] = lz4.frame.compress if form == "lz4" else zstandard.ZstdCompressor().compress
    block = pack(bytes(2**26))
    packed = block if form == "lz4" else zstandard.ZstdCompressor(level=1).compress(bytes(2**28))
    size = {"the truth": 2**28, "less": 1000, "more": 2**27, "an exabyte": 2**60}[claim]
    path = mcap_file(tmp_path / "bomb.mcap", [chunk(packed, form, size)] * 3)
    assert "claim" in refused(path) or "a chunk of" in refused(path)


def test_many_small_bombs_are_stopped_together(tmp_path: Path) -> None:
    content = record(200, bytes(2**25))
    packed = zstandard.ZstdCompressor().compress(content)
    path = mcap_file(tmp_path / "bombs.mcap", [chunk(packed, "zstd", len(content))] * 200)
    assert "its chunks claim 268435528 bytes" in refused(path)


def test_what_chunks_say_of_themselves_has_to_be_so(tmp_path: Path) -> None:
    content = channel(1, "/f", FLOATS)
    for name, made, reason in (
        ("packing", chunk(content, "brotli"), "packed by 'brotli', expected lz4, zstd or nothing"),
        ("checksum", chunk(content, "", checksum=1), "the checksum of a chunk is wrong"),
        ("short", chunk(content[:-9]), "ends beyond its chunk"),
        ("noise", chunk(b"no such thing", "zstd", 50), "a chunk of zstd"),
        ("noise4", chunk(b"no such thing", "lz4", 50), "a chunk of lz4"),
        ("record", record(6, b"short"), "is cut off or damaged"),
        ("untold", chunk(message(7, 1, bytes(8))), "of a topic that is not told"),
        (
            "schema",
            record(4, struct.pack("<HH", 1, 9) + text("/f") + text("cdr") + bytes(4)),
            "a type that is not told",
        ),
        ("json", channel(1, "/f", FLOATS, "json"), "is written as 'json', expected 'cdr'"),
        (
            "twice",
            channel(1, "/f", FLOATS) + channel(2, "/f", "std_msgs/msg/Bool"),
            "and of 'std_msgs/msg/Bool'",
        ),
        ("letters", record(3, struct.pack("<H", 1) + struct.pack("<I", 2) + b"\xff\xfe"), "is cut off or damaged"),
        ("long", record(3, bytes(2) + struct.pack("<I", 2**31)), "a record ends before its content"),
    ):
        assert reason in refused(mcap_file(tmp_path / f"{name}.mcap", [made]))


def message_of(*parts: bytes) -> bytes:
    return b"\0\1\0\0" + b"".join(parts)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (message_of(struct.pack("<III", 0, 0, 2**32 - 1), bytes(8)), "ends before data does"),
        (message_of(struct.pack("<I", 2**32 - 1), bytes(400)), "ends before"),
        (message_of(struct.pack("<I", 10**5), bytes(2**20)), "more than 1000 fields"),
        (message_of(struct.pack("<II", 1, 2**31)), "ends before layout.dim.0.label does"),
        (b"\0\7\0\0" + bytes(20), "does not begin as plain CDR"),
        (message_of(struct.pack("<III", 0, 0, 1), bytes(4), struct.pack("<d", np.inf)), "readings hold infinity"),
        (message_of(struct.pack("<III", 0, 0, 600), bytes(4), bytes(4800)), r"expected (R, C), R >= 2, C = 1 to 512"),
        (b"", "has 0 bytes"),
        (message_of(bytes(3)), "ends before"),
    ],
)
def test_messages_that_lie_are_one_line(tmp_path: Path, body: bytes, reason: str) -> None:
    said = [message(1, 10**9 * step, body) for step in range(1, 9)]
    path = mcap_file(tmp_path / "lies.mcap", [channel(1, "/f", FLOATS), chunk(b"".join(said))])
    assert reason in refused(path)


def test_stamps_beyond_all_clocks_and_counts_beyond_all_bags_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = bytes(STORE.serialize_cdr(array("Float64MultiArray", np.ones(2)), FLOATS))
    for stamps, reason in (([1, 2**64 - 1], "a stamp is"), ([5, 5, 5], "do not ascend"), ([1, 2**62, 2**62 + 9], "")):
        path = mcap_file(tmp_path / "r.mcap", [channel(1, "/f", FLOATS), *(message(1, each, body) for each in stamps)])
        assert reason in refused(path)
    many = mcap_file(tmp_path / "many.mcap", [chunk(channel(1, "/f", FLOATS) + message(1, 1, body) * 300)])
    for name, most, reason in (
        ("MOST_RECORDS", 200, "more than 200 records"),
        ("MOST_MESSAGES", 200, "more than 200 messages"),
        ("MOST_BYTES", 5000, "or 5000 bytes"),
        ("MOST_TOPICS", 0, "more than 0 topics"),
        ("MOST_LENGTHS", 0, "more than 0 lengths"),
    ):
        with monkeypatch.context() as less:
            less.setattr(limits, name, most)
            assert reason in refused(many)


def test_messages_of_ever_other_shapes_end_soon(tmp_path: Path) -> None:
    shapes = [
        message(1, step, message_of(struct.pack("<III", 0, 0, 1 + step % 500), bytes(4), bytes(8 * 500)))
        for step in range(10_000)
    ]
    path = mcap_file(tmp_path / "shapes.mcap", [channel(1, "/f", FLOATS), chunk(b"".join(shapes))])
    assert "messages are of more than 256 shapes" in refused(path)


def test_empty_records_without_end_do_not_take_long(tmp_path: Path) -> None:
    content = record(200, b"") * 2**22
    packed = zstandard.ZstdCompressor().compress(content)
    path = mcap_file(tmp_path / "empty.mcap", [chunk(packed, "zstd", len(content))] * 3)
    assert f"more than {limits.MOST_RECORDS} records" in refused(path)


DOCUMENTS = {
    "null": "null",
    "list": "[]",
    "deep": "[" * 10**5,
    "wide": "[" + "[]," * 2**22 + "[]]",
    "bare": '{"format": "padforge-ros/1"}',
    "zero": "\x00",
    "wrong": json.dumps(
        {"format": "padforge-ros/1", "digest": "", "epoch_s": float("nan"), "source": {}, "times_s": [1e400]}
        | {key: [{}] for key in ("presses_mm", "depths_mm", "begun", "lifted")}
    ),
}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_what_stands_beside_the_messages_is_used_only_where_it_goes_with_them(
    tmp_path: Path, eight: Recording, document: str
) -> None:
    told = [
        *(
            ("/pad/readings", time, array("Float64MultiArray", row))
            for time, row in zip(eight.times_s, eight.readings, strict=True)
        ),
        ("/pad/pressed", 2.0, make("Bool", True)),
        ("/pad/pressed", 4.0, make("Bool", False)),
    ]
    path = write_bag(tmp_path / "bag", [("/pad/recording", 0.0, make("String", DOCUMENTS[document])), *told])
    before = peak_bytes()
    found = import_bag(path)
    assert peak_bytes() - before < 2**28
    assert len(found.begun) == 1
    assert "was changed" in found.source["note"]


def test_other_files_are_refused(tmp_path: Path) -> None:
    for name, content in (("empty", b""), ("zeros", bytes(999)), ("magic", MAGIC), ("text", b"dear all,\n" * 50)):
        for end in ("mcap", "db3"):
            path = tmp_path / f"{name}.{end}"
            path.write_bytes(content)
            refused(path)
    refused(tmp_path / "absent.mcap")
    (tmp_path / "folder.mcap").mkdir()
    refused(tmp_path / "folder.mcap")


def test_sqlite_files_that_compute_or_lie_are_refused(tmp_path: Path) -> None:
    topics = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id,"
    rows = f"INSERT INTO topics VALUES (1, '/f', '{FLOATS}', 'cdr');"
    plain = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
    for name, script, reason in (
        (
            "view",
            f"{topics}{rows}CREATE VIEW messages AS {endless} i AS timestamp, x'00' AS data FROM n",
            "no table messages",
        ),
        (
            "computed",
            f"{topics}{rows}" + plain.replace("data BLOB", "data BLOB AS (zeroblob(1000000000))"),
            "has no table messages",
        ),
        ("column", f"{topics}{rows}CREATE TABLE messages(id INTEGER, topic_id INTEGER)", "has no table messages"),
        (
            "text",
            f"{topics}{rows}{plain}INSERT INTO messages VALUES (1, 1, 5, 'text')",
            "has a str where rosbag2 has a by",
        ),
        (
            "stamp",
            f"{topics}{rows}{plain}INSERT INTO messages VALUES (1, 1, -5, x'0001000000')",
            "is cut off or damaged",
        ),
        (
            "name",
            f"{topics}{plain}INSERT INTO topics VALUES (1, NULL, NULL, NULL)",
            "has a NoneType where rosbag2 has a",
        ),
    ):
        path = tmp_path / f"{name}.db3"
        with sqlite3.connect(path) as file:
            file.executescript(script)
        file.close()
        assert reason in refused(path)
