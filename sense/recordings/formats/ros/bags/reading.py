"""Messages out of bags of anyone, read with care: MCAP and SQLite files, and folders of such.

Files are gone through from their begin to their end, and nothing is unpacked or kept beyond what `bag` states.
"""

import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from padforge.design.common.files import check_file, read_bytes
from padforge.design.common.validation import InputError

from padforge.sense.recordings.formats.ros.bags.bag import CUT, Bag, Topic
from padforge.sense.recordings.formats.ros.bags.mcap_files import read_mcap

MOST_FILE_BYTES = 2**33
"""Size of the largest file that is looked at."""
MOST_METADATA_BYTES = 2**24
SUFFIXES = (".mcap", ".db3")
METADATA = "metadata.yaml"
"""What a folder that is a bag holds beside its files."""


def read_bag(path: Path, wanted: Callable[[str], bool]) -> tuple[dict[str, Topic], dict[str, str]]:
    """Messages of a bag: an .mcap or .db3, or a folder with `METADATA` and such.

    Args:
        wanted: whether messages of a topic of this name are asked for.

    Returns:
        The topics asked for that have messages, and the types of all topics, by their names.

    Raises:
        InputError: nothing there, another kind of file, one that is cut off or damaged, or more than is allowed.
    """
    bag = Bag(wanted)
    for file in _files(path):
        file = check_file(file, MOST_FILE_BYTES)
        with _blamed(file):
            if file.suffix.lower() == ".mcap":
                with file.open("rb") as stream:
                    read_mcap(stream, file.stat().st_size, bag)
            else:
                from padforge.sense.recordings.formats.ros.bags.sqlite_files import read_sqlite  # SQLite's library is loaded for its own files only

                read_sqlite(file, bag)
    return {name: topic for name, topic in bag.topics.items() if len(topic)}, bag.kinds


@contextmanager
def _blamed(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (struct.error, ValueError, OverflowError) as error:
        raise InputError(f"{path}: {CUT} ({error})") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def _files(path: Path) -> list[Path]:
    """The files of a bag in the order in which they were recorded."""
    if not path.is_dir():
        return [path]
    about = read_bytes(path / METADATA, MOST_METADATA_BYTES).decode(errors="replace")
    mode = re.search(r"^[ \t]*compression_mode:[ \t]*[\"']?(file|message)\b", about, re.IGNORECASE | re.MULTILINE)
    if mode:
        raise InputError(f"{path}: is compressed by {mode[1]}, expected none or by chunk (ros2 bag convert)")

    def number(file: Path) -> tuple[int, str]:
        end = re.search(r"_(\d{1,9})$", file.stem)
        return (int(end[1]) if end else -1, file.name)

    files = sorted((file for file in path.iterdir() if file.suffix.lower() in SUFFIXES), key=number)
    if not files:
        raise InputError(f"{path}: has {METADATA}, but no file that ends in {' or '.join(SUFFIXES)}")
    return files
