"""Bags that are torn, lie, or were made to do harm: each is one line, in little memory."""

import json
import resource
import sqlite3
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from padforge.design.common.validation import InputError
from padforge.sense import Recording, import_bag
from padforge.sense.formats import ros_bag as limits

from .foreign import STORE, array, channel, chunk, make, mcap_file, message, record, text, write_bag

FLOATS = "std_msgs/msg/Float64MultiArray"
MOST_BYTES = 2**30


def refused(path: Path, mapping: str = "fibres=/f") -> str:
    """The one line that a bag is refused with, within a GiB."""
    before = peak_bytes()
    with pytest.raises(InputError) as refusal:
        import_bag(path, mapping)
    line = str(refusal.value)
    assert path.name in line
    assert "\n" not in line
    assert len(line) < 400 + len(str(path))
    assert peak_bytes() - before < MOST_BYTES
    return line


def peak_bytes() -> int:
    """Most memory that the process ever took."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def test_a_bag_that_is_cut_anywhere_is_one_line(bag: Path, tmp_path: Path) -> None:
    content = bag.read_bytes()
    cut = tmp_path / "cut.mcap"
    for keep in sorted({*range(0, 200, 9), *np.linspace(200, len(content) - 1, 30).astype(int), len(content) - 1}):
        cut.write_bytes(content[:keep])
        refused(cut, "")


@pytest.mark.parametrize("form", ["lz4", "zstd"])
@pytest.mark.parametrize("claim", ["the truth", "less", "an exabyte"])
def test_a_chunk_that_unpacks_to_gigabytes_does_not(tmp_path: Path, form: str, claim: str) -> None:
    pack: Callable[[bytes], bytes] = lz4.frame.compress if form == "lz4" else zstandard.ZstdCompressor(1).compress
    packed = pack(bytes(2**27))
    size = {"the truth": 2**27, "less": 1000, "an exabyte": 2**60}[claim]
    path = mcap_file(tmp_path / "bomb.mcap", [chunk(packed, form, size)] * 3)
    tracemalloc.start()
    assert ("a chunk of 1000 bytes has more" if claim == "less" else "its chunks claim") in refused(path)
    assert tracemalloc.get_traced_memory()[1] < 2**25
    tracemalloc.stop()


def test_what_chunks_and_messages_say_of_themselves_has_to_be_so(tmp_path: Path) -> None:
    content = channel(1, "/f", FLOATS)
    untold = record(4, struct.pack("<HH", 1, 9) + text("/f") + text("cdr") + bytes(4))
    for name, made, reason in (
        ("packing", chunk(content, "brotli"), "packed by 'brotli', expected lz4, zstd or nothing"),
        ("checksum", chunk(content, "", checksum=1), "the checksum of a chunk is wrong"),
        ("short", chunk(content[:-9]), "ends beyond its chunk"),
        ("noise", chunk(b"no such thing", "zstd", 50), "a chunk of zstd"),
        ("noise4", chunk(b"no such thing", "lz4", 50), "a chunk of lz4"),
        ("record", record(6, b"short"), "is cut off or damaged"),
        ("untold", chunk(message(7, 1, bytes(8))), "of a topic that is not told"),
        ("schema", untold, "a type that is not told"),
        ("json", channel(1, "/f", FLOATS, "json"), "is written as 'json', expected 'cdr'"),
        ("twice", channel(1, "/f", FLOATS) + channel(2, "/f", "std_msgs/msg/Bool"), "and of 'std_msgs/msg/Bool'"),
        ("letters", record(3, struct.pack("<H", 1) + struct.pack("<I", 2) + b"\xff\xfe"), "is cut off or damaged"),
        ("long", record(3, bytes(2) + struct.pack("<I", 2**31)), "a record ends before its content"),
    ):
        assert reason in refused(mcap_file(tmp_path / f"{name}.mcap", [made]))
    for body, reason in (
        (cdr(struct.pack("<III", 0, 0, 2**32 - 1), bytes(8)), "ends before data does"),
        (cdr(struct.pack("<I", 2**32 - 1), bytes(400)), "ends before"),
        (cdr(struct.pack("<I", 10**5), bytes(2**20)), "more than 1000 fields"),
        (cdr(struct.pack("<II", 1, 2**31)), "ends before layout.dim.0.label does"),
        (b"\0\7\0\0" + bytes(20), "does not begin as plain CDR"),
        (cdr(struct.pack("<III", 0, 0, 1), bytes(4), struct.pack("<d", np.inf)), "readings hold infinity"),
        (cdr(struct.pack("<III", 0, 0, 600), bytes(4), bytes(4800)), r"expected (R, C), R >= 2, C = 1 to 512"),
        (b"", "has 0 bytes"),
        (cdr(bytes(3)), "ends before"),
    ):
        said = [message(1, 10**9 * step, body) for step in range(1, 9)]
        path = mcap_file(tmp_path / "lies.mcap", [channel(1, "/f", FLOATS), chunk(b"".join(said))])
        assert reason in refused(path)
    shapes = [
        message(1, step, cdr(struct.pack("<III", 0, 0, 1 + step), bytes(4), bytes(8 * 300))) for step in range(300)
    ]
    path = mcap_file(tmp_path / "shapes.mcap", [channel(1, "/f", FLOATS), chunk(b"".join(shapes))])
    assert "messages are of more than 256 shapes" in refused(path)


def cdr(*parts: bytes) -> bytes:
    return b"\0\1\0\0" + b"".join(parts)


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


DOCUMENTS = {
    "null": "null",
    "deep": "[" * 10**5,
    "wide": "[" + "[]," * 2**22 + "[]]",
    "bare": '{"format": "padforge-ros/2"}',
    "zero": "\x00",
    "wrong": json.dumps(
        {"format": "padforge-ros/2", "digest": "", "epoch_s": float("nan"), "source": {}, "times_s": [1e400]}
        | {key: [{}] for key in ("presses_mm", "depths_mm", "down_command", "up_command")}
    ),
}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_what_stands_beside_the_messages_is_used_only_where_it_goes_with_them(
    tmp_path: Path, eight: Recording, document: str
) -> None:
    told = [
        ("/pad/recording", 0.0, make("String", DOCUMENTS[document])),
        *(
            ("/pad/readings", time, array("Float64MultiArray", row))
            for time, row in zip(eight.times_s[:99], eight.readings[:99], strict=True)
        ),
        ("/pad/pressed", 2.0, make("Bool", True)),
        ("/pad/pressed", 4.0, make("Bool", False)),
    ]
    before = peak_bytes()
    found = import_bag(write_bag(tmp_path / "bag", told))
    assert peak_bytes() - before < 2**28
    assert len(found.down_command) == 1
    assert "was changed" in found.source["note"]


TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
ROW = f"INSERT INTO topics VALUES (1, '/f', '{FLOATS}', 'cdr');"
PLAIN = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
ENDLESS = (
    "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
)


def test_sqlite_files_that_compute_or_lie_are_refused_and_no_copy_is_kept_of_what_is_passed_over(
    tmp_path: Path,
) -> None:
    computed = PLAIN.replace("data BLOB", "data BLOB AS (zeroblob(1000000000))")
    value = "INSERT INTO messages VALUES (1, 1,"
    for name, script, reason in (
        ("view", TOPICS + ROW + ENDLESS, "no table messages"),
        ("computed", TOPICS + ROW + computed, "has no table messages"),
        ("column", f"{TOPICS}{ROW}CREATE TABLE messages(id INTEGER, topic_id INTEGER)", "has no table messages"),
        ("text", f"{TOPICS}{ROW}{PLAIN}{value} 5, 'text')", "has a str where rosbag2 has a by"),
        ("stamp", f"{TOPICS}{ROW}{PLAIN}{value} -5, x'0001000000')", "is cut off or damaged"),
        ("name", f"{TOPICS}{PLAIN}INSERT INTO topics VALUES (1, NULL, NULL, NULL)", "a NoneType where rosbag2 has a"),
    ):
        path = tmp_path / f"{name}.db3"
        with sqlite3.connect(path) as file:
            file.executescript(script)
        file.close()
        assert reason in refused(path)
    # rows may lack a column whose default is long: a small file is hundreds of MB, which took as much disk to sort
    path = tmp_path / "long.db3"
    told = array("Float64MultiArray", np.arange(4.0))
    body = bytes(STORE.serialize_cdr(told, told.__msgtype__))
    press = [bytes(STORE.serialize_cdr(each, each.__msgtype__)) for each in (make("Bool", True), make("Bool", False))]
    with sqlite3.connect(path) as file:
        file.executescript(TOPICS)
        kinds = ((1, "/f", FLOATS), (2, "/long", FLOATS), (3, "/down", "std_msgs/msg/Bool"))
        file.executemany("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", kinds)
        file.execute("CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER)")
        file.executemany("INSERT INTO messages VALUES (?, 2, 5)", ((number,) for number in range(600)))
        file.execute(f"ALTER TABLE messages ADD COLUMN data BLOB DEFAULT x'{'00' * 480_000}'")
        rows = [(step, 1, step * 10**8, body) for step in range(40)]
        rows += [(40, 3, 2 * 10**9, press[0]), (41, 3, 3 * 10**9, press[1])]
        file.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    file.close()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, before[1]))
    try:
        assert len(import_bag(path, "fibres=/f,press=/down").readings) == 40
        assert "more than 4194304 messages or 268435456 bytes" in refused(path, "fibres=/long")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
