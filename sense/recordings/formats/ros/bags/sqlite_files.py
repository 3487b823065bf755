"""The messages of a rosbag2 file of SQLite."""

import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from padforge.design.common.validation import InputError

from padforge.sense.recordings.formats.ros.bags.bag import MOST_BYTES, Bag

MOST_STEPS = 2**27
"""Most steps of SQLite's machine; a million messages take some ten million."""
_COLUMNS = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("id", "topic_id", "timestamp", "data"),
}


def read_sqlite(path: Path, bag: Bag) -> None:
    """Go through the messages of a file.

    Raises:
        InputError: no such file, or one that is beyond the limits of `bag`.
        ValueError: damaged, or no SQLite at all.
    """
    try:
        _go_through(path, bag)
    except sqlite3.Error as error:
        raise ValueError(str(error)) from error


def _go_through(path: Path, bag: Bag) -> None:
    with closing(sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)) as file:
        file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_BYTES)
        file.execute("PRAGMA trusted_schema = OFF")
        steps = 0

        def stop() -> bool:
            nonlocal steps
            steps += 2**16
            return steps > MOST_STEPS

        file.set_progress_handler(stop, 2**16)
        for table, columns in _COLUMNS.items():
            _refuse_strange(file, table, columns)
        topics = {
            number: bag.open(name, kind, encoding)
            for number, name, kind, encoding in file.execute("SELECT id, name, type, serialization_format FROM topics")
            if _is(number, int) and _is(name, str) and _is(kind, str) and _is(encoding, str)
        }
        wanted = ", ".join(str(number) for number, topic in topics.items() if topic is not None)
        # Row by row as they lie: to bring them into an order, or to skip others, SQLite would unpack and keep all.
        rows = f"SELECT topic_id, timestamp, data FROM messages NOT INDEXED WHERE topic_id IN ({wanted})"
        for number, stamp, message in file.execute(rows):
            bag.count()
            topic = topics.get(number) if _is(stamp, int) and _is(message, bytes) else None
            if topic is not None:
                bag.keep(topic, stamp, message)


def _is(value: object, kind: type) -> bool:
    if not isinstance(value, kind):
        raise InputError(f"it has a {type(value).__name__} where rosbag2 has a {kind.__name__}")
    return True


def _refuse_strange(file: sqlite3.Connection, table: str, columns: tuple[str, ...]) -> None:
    """Refuse what is no table of stored values: views and columns that are computed may take any time."""
    found = file.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchall()
    plain = len(found) == 1 and found[0][0] == "table" and str(found[0][1]).upper().startswith("CREATE TABLE")
    about = file.execute(f"PRAGMA table_xinfo({table})").fetchall() if plain else []
    hidden = {name: hidden for _, name, _, _, _, _, hidden in about}
    if any(hidden.get(column) != 0 for column in columns):
        raise InputError(f"has no table {table} with {', '.join(columns)}, expected a rosbag2 file")
