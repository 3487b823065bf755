"""What an input may end with: results, or one line and nothing changed; no traceback, litter, torn file or excess."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from .limited import MIB, Ended
from .workplace import require_whole_file

MOST_MEMORY, MOST_CPU_S = 1024 * MIB, 40.0
"""Bytes that a process may have resident, and seconds that it may compute."""
SUSPECT_MEMORY = 450 * MIB
"""A copy of a process that has all imports done may have so much more, before a fresh one is asked."""
_ENDS = {0: "done", 1: "a check fails", 2: "refused", 130: "interrupted", -2: "interrupted"}
"""What an exit code means; a program that is interrupted while it begins or ends dies of the signal."""
_REFUSED = ("padforge: ", "Usage: ")
_TOO_MUCH = "this takes more memory than there is"
_OF_ANY_NAME = (b"press,", b"# padf", b'{\n "fo')
"""What tables of places and settings begin with, which are written to whatever name is asked for, as pictures are."""
_BEGIN = {".json": b"{[", ".png": b"\x89", ".svg": b"<", ".html": b"<"}
"""Bytes that a file of a kind begins with, one of them; with another one it is no part of such a file."""


def outcome(ended: Ended) -> str:
    """How a process ended, in a word or two."""
    if ended.hung:
        return "hung"
    return _ENDS.get(ended.code, f"exit {ended.code}")


def violations(ended: Ended, changed: Sequence[Path], temporary: Sequence[Path]) -> list[str]:
    """What of it may not be, a line each.

    Args:
        changed: what is in the folder and was not, or is other than it was, or is there no more. temporary: what is
            left of temporary files.
    """
    found = []
    if ended.code not in _ENDS or ended.hung:
        found.append(f"ended with {ended.code}" + " after its time" * ended.hung)
    ignored = outcome(ended) == "interrupted" and "Exception ignored in" in ended.err  # of Python, in a destructor
    if "Traceback (most recent call last)" in ended.err + ended.out and not ignored:
        found.append(f"traceback: {(ended.err + ended.out).strip().splitlines()[-1][:300]}")
    if re.search(r"^\S*:\d+: \w*Warning: ", ended.err, re.MULTILINE):
        found.append("warns of its own code")
    if ended.code == 2:
        said = [line for line in ended.err.splitlines() if line.startswith(_REFUSED)]
        if len(said) != 1:
            found.append(f"refused in {len(said)} lines: {ended.err[-300:]!r}")
        changed = [path for path in changed if "search" not in path.parts]  # found for nobody, kept to be gone on with
        if changed:
            found.append(f"refused, and changed {', '.join(map(_name, changed[:5]))}")
    found += [f"left {_name(path)}" for path in changed if path.name.startswith(".") and os.path.lexists(path)]
    found += [f"left the temporary {_name(path)}" for path in temporary]
    found += [f"torn: {_name(path)}" for path in changed if path.is_file() and not _whole(path)]
    if ended.cpu_s > MOST_CPU_S:
        found.append(f"computed {ended.cpu_s:.1f} s")
    return found


def suspect(ended: Ended) -> bool:
    """Whether a fresh process should be asked how much memory the input takes."""
    return ended.memory > SUSPECT_MEMORY or _TOO_MUCH in ended.err or "MemoryError" in ended.err


def _whole(path: Path) -> bool:
    with path.open("rb") as file:
        begin = file.read(6)
    if begin in _OF_ANY_NAME or begin[:1] not in _BEGIN.get(path.suffix, begin[:1]):
        return True
    try:
        require_whole_file(path)
    except Exception:  # whatever a reader raises for a torn file
        return False
    return True


def _name(path: Path) -> str:
    return ascii(str(path)[-80:])
