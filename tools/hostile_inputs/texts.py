"""What happens to the content of files: bytes, numbers, lines and places of documents that change."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from tests.stress.sense.spoiling import NUMBERS, TEXTS, dumped, edited, flipped

Rng = np.random.Generator
_STRANGE = ("[" * 10**5, '{"a":' * 10**5, "[]", "{}", "null", "1", '"a"', "NaN", f"[{'0,' * 10**6}0]")
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?")
FLOATS = tuple(np.array([value], "<f4").tobytes() for value in (np.nan, np.inf, -np.inf, 3e38, 1e-45, -1.0))
"""Numbers of a binary file that hardly anybody means."""


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
