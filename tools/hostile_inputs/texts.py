"""What happens to the content of files: bytes, numbers, lines and places of documents that change."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator
_STRANGE = ("[" * 10**5, '{"a":' * 10**5, "[]", "{}", "null", "1", '"a"', "NaN", f"[{'0,' * 10**6}0]")
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?")
FLOATS = tuple(np.array([value], "<f4").tobytes() for value in (np.nan, np.inf, -np.inf, 3e38, 1e-45, -1.0))
"""Numbers of a binary file that hardly anybody means."""
NUMBERS = (
    *("0", "-1", "1e308", "1e999", "-1e999", "nan", "inf", "5e-324", "1" * 400, "0x10", "1_0", "\uff11", "1,5", ""),
)

TEXTS = (
    *("?", "a", "\x00", '"', "\n", "\r", ";", "\ufeff", "\xff", "1 2", "'1'", "--1", "1e", "\t", "\ud7ff", "=1+1"),
)

VALUES = (
    *(None, True, -1, 0, 1e308, 10**400, 2**64, "", "a", "ÿ", []),
    *([[]], {}, [None], [1e400], {"a": {}}, 1.5, "\ud800"),
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


def pick(rng: Rng, choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


def some_bytes(rng: Rng, path: Path) -> str:
    content = path.read_bytes() or b"\0"
    path.write_bytes(flipped(rng, content))
    return "bytes"


def cut(rng: Rng, path: Path) -> str:
    content = path.read_bytes()
    kept = pick(rng, (b"", content[: len(content) // 2], content[:-1], content * 2, b"\xef\xbb\xbf" + content))
    path.write_bytes(kept)
    return f"cut or doubled to {len(kept)} of {len(content)} bytes"


def another_file(rng: Rng, path: Path) -> str:
    names = [each for each in path.parent.iterdir() if each.is_file() and not each.is_symlink() and each != path]
    if names:
        shutil.copyfile(pick(rng, sorted(names)), path)
    return "another file"


def numbers(rng: Rng, path: Path) -> str:
    """Another number or text in the place of some of a text's numbers, or numbers of other digits."""
    content = path.read_bytes()
    found = list(_NUMBER.finditer(content))
    told = []
    for at in sorted(rng.integers(len(found), size=pick(rng, (1, 1, 2, 5))).tolist() if found else (), reverse=True):
        new = pick(rng, (*NUMBERS, *TEXTS, "-0", "٣", "1e5", "4294967297", "NaN", "Infinity")).encode()
        told.append(f"{found[at][0][:20]!r} -> {new[:20]!r}")
        content = content[: found[at].start()] + new + content[found[at].end() :]
    path.write_bytes(content)
    return f"numbers {', '.join(told)}"


def lines(rng: Rng, path: Path) -> str:
    """Lines that are missing, doubled or shuffled."""
    rows = path.read_bytes().splitlines(keepends=True)
    begin, end = sorted(rng.integers(len(rows) + 1, size=2).tolist())
    kind = int(rng.integers(4))
    part = rows[begin:end]
    if kind == 3:
        rng.shuffle(part)
    path.write_bytes(b"".join(rows[:begin] + [[], part * 2, part * 50, part][kind] + rows[end:]))
    return f"lines {begin} to {end} {('gone', 'twice', 'fifty times', 'shuffled')[kind]}"


def document(rng: Rng, path: Path) -> str:
    """A document, or a line of one, with places changed; or deep, long and strange."""
    try:
        rows = path.read_text().splitlines() if path.suffix == ".ndjson" else [path.read_text()]
        at = int(rng.integers(len(rows)))
        found = json.loads(rows[at])
    except (ValueError, OSError):
        return some_bytes(rng, path)
    if rng.random() < 0.1:
        rows[at] = pick(rng, _STRANGE)
    else:
        for _ in range(pick(rng, (1, 1, 2, 4))):
            found = edited(rng, found) if found and isinstance(found, dict | list) else found
        rows[at] = dumped(found).decode()
    path.write_text("\n".join(rows), encoding="utf-8", errors="surrogatepass")
    return "document"


def floats(rng: Rng, path: Path) -> str:
    """Numbers of a binary file that are none, or far away, or very many."""
    content = bytearray(path.read_bytes())
    for _ in range(pick(rng, (1, 3, 50))):
        at = int(rng.integers(max(len(content) - 4, 1)))
        content[at : at + 4] = pick(rng, (*FLOATS, b"\xff\xff\xff\x7f"))
    path.write_bytes(content)
    return "binary numbers"
