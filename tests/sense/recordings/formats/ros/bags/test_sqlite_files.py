"""Bags of SQLite that were made to fill memory or disk."""

import resource
import sqlite3
from pathlib import Path
from time import process_time

import numpy as np
import pytest

from design.common.errors import InputError
from sense.recordings.formats.ros.importing import import_bag
from tests.sense.recordings.formats.ros.foreign import STORE, array, make

FLOATS = "std_msgs/msg/Float64MultiArray"
MOST_S = 10


def test_sqlite_keeps_no_copy_of_what_is_read_or_passed_over(tmp_path: Path) -> None:
    """Rows may lack a column whose default is long: 20 MB of them are 10 GB, which took as much disk in an order."""
    path = tmp_path / "long.db3"
    told = array("Float64MultiArray", np.arange(4.0))
    body = bytes(STORE.serialize_cdr(told, told.__msgtype__))
    press = [bytes(STORE.serialize_cdr(each, each.__msgtype__)) for each in (make("Bool", True), make("Bool", False))]
    with sqlite3.connect(path) as file:
        file.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        kinds = ((1, "/f", FLOATS), (2, "/long", FLOATS), (3, "/down", "std_msgs/msg/Bool"))
        file.executemany("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", kinds)
        file.execute("CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER)")
        file.executemany("INSERT INTO messages VALUES (?, 2, 5)", ((number,) for number in range(20_000)))
        file.execute(f"ALTER TABLE messages ADD COLUMN data BLOB DEFAULT x'{'00' * 480_000}'")
        rows = [(step, 1, step * 10**8, body) for step in range(40)]
        rows += [(40, 3, 2 * 10**9, press[0]), (41, 3, 3 * 10**9, press[1])]
        file.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    file.close()
    limits_before, begun = resource.getrlimit(resource.RLIMIT_FSIZE), process_time()
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, limits_before[1]))
    try:
        assert len(import_bag(path, "fibres=/f,press=/down").readings) == 40
        with pytest.raises(InputError, match="more than 4194304 messages or 268435456 bytes"):
            import_bag(path, "fibres=/long")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits_before)
    assert process_time() - begun < MOST_S
