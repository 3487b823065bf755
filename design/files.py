"""Files as every stage writes and reads them: atomic, self-describing JSON."""

import hashlib
import json
import os
import platform
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from .errors import InputError

_PACKAGES = ("padforge", "numpy", "scipy")


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it takes `path`'s place, on failure it vanishes.

    The temporary name keeps the suffix, because many writers choose their format by it.
    A reader never sees half a file, and an interrupted write leaves the old one as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        _widen_permissions(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _widen_permissions(path: Path) -> None:
    """Give `path` the permissions an ordinary new file has; `mkstemp` makes it private to its owner."""
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(0o666 & ~mask)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` as UTF-8, atomically; what UTF-8 has not, as in names of files, is written as \\udc80."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document` to `path` atomically; NaN and infinities are refused, since JSON has none."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def read_json(path: Path, kind: str) -> dict[str, Any]:
    """Read a JSON document whose `format` is `kind`, e.g. "padforge-morphology/1".

    Raises:
        InputError: the file is missing, is no JSON, or says another format.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON file ({error})") from error
    found = document.get("format") if isinstance(document, dict) else None
    if found != kind:
        raise InputError(f"{path}: format is {found!r}, expected {kind!r}")
    return document


def sha256(path: Path) -> str:
    """Hex digest of a file; of a directory, the digest of its files' names and digests in sorted order."""
    if path.is_dir():
        lines = [f"{sha256(child)}  {child.name}" for child in sorted(path.iterdir()) if child.is_file()]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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
