"""Files that sense reads, and ways to spoil them."""

import json
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.stress.sense.cases import made

SMALL = made(3, presses=12)
NUMBERS = (
    *("0", "-1", "1e308", "1e999", "-1e999", "nan", "inf", "5e-324", "1" * 400, "0x10", "1_0", "\uff11", "1,5", ""),
)
TEXTS = (
    *("?", "a", "\x00", '"', "\n", "\r", ";", "\ufeff", "\xff", "1 2", "'1'", "--1", "1e", "\t", "\ud7ff", "=1+1"),
)
VALUES = (
    None,
    True,
    -1,
    0,
    1e308,
    10**400,
    2**64,
    "",
    "a",
    "ÿ",
    [],
    [[]],
    {},
    [None],
    [1e400],
    {"a": {}},
    1.5,
    "\ud800",
)
"""What a place in a JSON document may hold in place of what is right."""


def flipped(rng: np.random.Generator, content: bytes) -> bytes:
    """`content` with bytes changed, lost, added, doubled, or with its end torn off."""
    data, kind = bytearray(content), rng.integers(6)
    at = int(rng.integers(len(data) + 1))
    if kind == 0:
        for place in rng.integers(len(data), size=rng.integers(1, 9)):
            data[place] ^= int(rng.integers(1, 256))
    elif kind == 1:
        del data[at:]
    elif kind == 2:
        del data[at : at + int(rng.integers(1, 300))]
    elif kind == 3:
        data[at:at] = rng.bytes(int(rng.integers(1, 300)))
    elif kind == 4:
        data[at:at] = data[at : at + int(rng.integers(1, 3000))]
    else:  # a number of the format itself, as large as it may be
        data[at : at + 8] = [b"\xff" * 8, b"\x7f" + b"\xff" * 7, bytes(8), b"\xff\xff\xff\x7f"][rng.integers(4)]
    return bytes(data)


def edited(rng: np.random.Generator, document: Any) -> Any:
    """A JSON document with one place of it changed, lost or doubled."""
    document = json.loads(json.dumps(document))
    parent: Any = None
    node, key = document, 0
    while isinstance(node, dict | list) and node and (parent is None or rng.random() < 0.8):
        parent = node
        key: Any = list(node)[rng.integers(len(node))] if isinstance(node, dict) else int(rng.integers(len(node)))
        node = parent[key]
    kind = rng.integers(4)
    if kind == 0:
        del parent[key]
    elif kind == 1 and isinstance(parent, list):
        parent *= 2
    elif kind == 2 and isinstance(node, int | float):
        parent[key] = [-node, node * 1e300 if abs(node) < 1e300 else 0, node + 1, 10**30, -1e-300][rng.integers(5)]
    else:
        parent[key] = VALUES[rng.integers(len(VALUES))]
    return document


def dumped(document: Any) -> bytes:
    return json.dumps(document).encode("utf-8", "surrogatepass")


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


@cache
def run_directory(tmp: Path) -> dict[str, bytes]:
    SMALL.save(tmp / "rec", {"seed": 1})
    return files_of(tmp / "rec")


def put(folder: Path, files: dict[str, bytes]) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def _cell(rng: np.random.Generator) -> str:
    return [*NUMBERS, *TEXTS][rng.integers(len(NUMBERS) + len(TEXTS))]


def _table(rng: np.random.Generator, text: str) -> bytes:
    """A CSV with cells, lines, its header or its coding spoiled."""
    lines = text.splitlines()
    kind = rng.integers(9)
    at = int(rng.integers(len(lines)))
    if kind in (0, 1):
        cells = lines[at].split(",")
        cells[rng.integers(len(cells))] = _cell(rng)
        lines[at] = ",".join(cells)
    elif kind == 2:  # a column is missing, or there twice
        column = int(rng.integers(lines[0].count(",") + 1))
        rows = [line.split(",") for line in lines]
        twice = rng.random() < 0.5
        lines = [",".join(row[: column + twice] + row[column + 1 - twice :]) for row in rows]
    elif kind == 3:
        lines = lines[: rng.integers(3)]
    elif kind == 4:
        other = int(rng.integers(len(lines)))
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == 5:
        lines.insert(at, lines[int(rng.integers(len(lines)))])
    elif kind == 6:
        lines.insert(at, "")
    text = ["\n", "\r\n", "\r"][rng.integers(3)].join(lines) + "\n" * int(rng.integers(3))
    coding = ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-32"][rng.integers(5)]
    content = text.encode(coding, "ignore")
    return flipped(rng, content) if content and kind == 7 else content
