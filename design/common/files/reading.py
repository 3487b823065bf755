"""Reading what stages have written: documents that say what they are, digests, and where a result came from."""

import hashlib
import json
import platform
import stat
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from padforge.design.common.errors import InputError, shown

from .folders import resolve_exchange

_PACKAGES = ("padforge", "numpy", "scipy")

MOST_BYTES = 2**28
"""A file of more is none that padforge has written, but for recordings."""


def require_file(path: Path, most: int = MOST_BYTES) -> Path:
    """Refuse what may never end, such as pipes and devices, and what is too large to be looked at.

    Returns:
        Where to read it, see `resolve_exchange`.

    Raises:
        InputError: nothing there, no file, or one of more than `most` bytes.
    """
    valid = resolve_exchange(path)
    try:
        about = valid.stat()
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error
    if stat.S_ISDIR(about.st_mode):
        raise InputError(f"{path}: cannot be read (Is a directory)")
    if not stat.S_ISREG(about.st_mode):
        raise InputError(f"{path}: cannot be read (a pipe or device, expected a file)")
    if about.st_size > most:
        raise InputError(f"{path}: cannot be read (it has {about.st_size} bytes, allowed are {most})")
    return valid


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The content of a file.

    Raises:
        InputError: it cannot be read, or see `require_file`.
    """
    valid = require_file(path, most)
    try:
        return valid.read_bytes()
    except OSError as error:
        if isinstance(error, FileNotFoundError) and valid != path:  # a run has put it in place meanwhile
            return read_bytes(path, most)
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def read_json(path: Path, *kinds: str) -> dict[str, Any]:
    """Read a JSON document whose `format` is one of `kinds`, e.g. "padforge-morphology/1".

    Raises:
        InputError: the file is missing, is no JSON, or says another format.
    """
    content = read_bytes(path)
    try:
        document = json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON file ({error})") from error
    found = document.get("format") if isinstance(document, dict) else None
    if found not in kinds:
        raise InputError(f"{path}: format is {shown(found)}, expected {' or '.join(map(repr, kinds))}")
    return document


def sha256(path: Path) -> str:
    """Hex digest of a file; of a directory, the digest of its files' names and digests in sorted order.

    Raises:
        InputError: nothing there, or no file, such as a pipe or device that never ends.
    """
    if path.is_dir():
        lines = [f"{sha256(child)}  {child.name}" for child in sorted(path.iterdir()) if child.is_file()]
        return hashlib.sha256("\n".join(lines).encode(errors="surrogateescape")).hexdigest()
    with require_file(path, sys.maxsize).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def unchanged(folder: Path, digests: Mapping[str, object]) -> set[str]:
    """Names of the files in a folder, and of no other one, whose content still has the digest noted for the name."""

    def same(name: str) -> bool:
        try:
            require_file(folder / name)
            return Path(name).name == name and sha256(folder / name) == digests[name]
        except (InputError, OSError):
            return False

    return set(filter(same, digests))


def provenance(
    command: str, seed: int | None = None, inputs: Sequence[Path] = (), packages: Sequence[str] = ()
) -> dict[str, Any]:
    """Where a result came from: command, seed, versions of what made it and digests of its inputs.

    Neither time nor output folder enters, so the same work gives the same bytes wherever and whenever it is done.
    """
    return {
        "command": command,
        "seed": seed,
        "versions": {"python": platform.python_version()}
        | {name: metadata.version(name) for name in (*_PACKAGES, *packages)},
        "inputs": {path.name: sha256(path) for path in inputs},
    }
