"""Files of all stages: atomic writes, replacement of sets of files, locks, self-describing JSON and provenance.

A set of files (a pad, a mould, a localizer) is written into a temporary folder at its destination. Then the JSON
documents of the old set are removed, the other files replaced, and the new documents added last. A run that is killed
in between leaves files without a document, which readers refuse, and never a mixture of two sets.
"""

import errno
import hashlib
import json
import os
import platform
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from padforge.common.validation import InputError, short_repr

UNFINISHED = ".unfinished-"  # prefix of the names of temporary files and folders
LOCK = ".lock"  # name of the file that locks a folder
RESULT_FOLDERS = "figures", "health"  # folders that hold results within that of a pad
MAX_BYTES = 2**28  # size limit of a file; only recordings may be larger


@contextmanager
def reraise_as_input_error(path: Path) -> Iterator[None]:
    """Convert errors from a document of unexpected structure to an InputError that names its file."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: not as padforge writes it ({short_repr(error)})") from error


@contextmanager
def reraise_write_error(path: Path) -> Iterator[None]:
    """Convert an OSError of the body to an InputError that says why `path` cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def check_writable(folder: Path) -> None:
    """Check that files can be created in `folder`, which may be missing."""
    with reraise_write_error(folder):
        existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
        if not existing.is_dir():
            raise InputError(f"{folder}: cannot be written, {existing} is a file, expected a folder")
        if not os.access(existing, os.W_OK | os.X_OK):
            raise InputError(f"{folder}: cannot be written, {existing} does not allow it; choose another folder")


@contextmanager
def locked(folder: Path, busy: str) -> Iterator[None]:
    """Lock a folder against other processes in the body; if another one has locked it, `busy` is the error."""
    lock = FileLock(folder / LOCK, thread_local=False)
    try:
        with reraise_write_error(folder):
            try:
                lock.acquire(blocking=False)
            except Timeout as error:
                raise InputError(busy) from error
        yield
    finally:
        if lock.is_locked:
            with suppress(OSError):  # before release, or it may be another's; Windows removes the file itself
                (folder / LOCK).unlink()
            lock.release()


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Lock `folder` against other runs, and remove old temporary files of killed runs.

    A missing folder is created, and removed at the end if it is empty.
    """
    check_writable(folder)
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    with reraise_write_error(folder):
        make_folder(folder)
    try:
        with locked(folder, f"{folder}: another run is writing there; wait for its end, or choose another folder"):
            remove_leftovers(folder, 86400.0)  # unchanged for a day
            yield
    finally:
        with suppress(OSError):  # not empty
            for path in created:
                path.rmdir()


def remove_leftovers(folder: Path, min_age_s: float = 0.0) -> None:
    """Remove temporary folders of killed runs that have been unchanged for `min_age_s`; links are not followed."""
    for path in folder.glob(f"{UNFINISHED}*"):
        with suppress(OSError):  # it belongs to another user, or was removed by another process
            if path.is_dir() and not path.is_symlink() and time.time() - path.stat().st_mtime >= min_age_s:
                shutil.rmtree(path)


@contextmanager
def temporary_folder(folder: Path, prefix: str = UNFINISHED) -> Iterator[Path]:
    """Create an empty folder with a name that begins with `prefix`; remove it with its contents at the end."""
    path = folder / f"{prefix}{secrets.token_hex(8)}"
    try:  # begins before `mkdir`, so that an interrupt cannot leave the folder
        path.mkdir()
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path with the same name, which replaces it on success.

    A path that is itself temporary is yielded unchanged.
    """
    if path.parent.name.startswith(UNFINISHED) or path.name.startswith(UNFINISHED):
        yield path
        return
    with reraise_write_error(path):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: cannot be written (it exists and is no file)")
        make_folder(path.parent)
        with temporary_folder(path.parent) as folder:
            yield folder / path.name
            sync(folder / path.name)
            (folder / path.name).replace(path)
        sync(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write `text` atomically as UTF-8 with unchanged line ends; surrogates are escaped, as in \\udc80."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document` atomically as JSON; NaN and infinity raise ValueError."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, unless they exist, and synchronise their names to the disk."""
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in created:
        sync(path.parent)


def sync(path: Path) -> None:
    """Synchronise a file, or the names in a folder, to the disk, so that they survive a power cut; POSIX only."""
    if os.name != "posix":
        return
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            to_disk(handle)
        finally:
            os.close(handle)
    except OSError as error:
        # Some network disks cannot synchronise a folder, and opening it needs the permission to read it.
        if error.errno not in (errno.EINVAL, errno.EACCES) or not path.is_dir():
            raise


def _sync_all(paths: Iterable[Path]) -> None:
    for path in paths:
        sync(path)


def to_disk(handle: int) -> None:
    """Synchronise an open file to the disk; on macOS `os.fsync` would leave it in the drive's cache."""
    if sys.platform == "darwin":
        import fcntl

        with suppress(OSError):  # the disk does not support it
            fcntl.fcntl(handle, fcntl.F_FULLFSYNC)
            return
    os.fsync(handle)


@contextmanager
def atomic_files(folder: Path, without: Collection[str] = ()) -> Iterator[Path]:
    """Replace a set of files together: yield an empty folder, whose files are moved to `folder` on success.

    They may lie in folders of it. If the body fails, `folder` is unchanged. A kill during the move leaves no JSON
    document of either set. Files named in `without` are removed before the move.
    """
    with reraise_write_error(folder):
        make_folder(folder)
        with temporary_folder(folder) as stage:
            yield stage
            paths = (path.relative_to(stage) for path in stage.rglob("*") if path.is_file())
            names = sorted(path.as_posix() for path in paths if not path.parts[0].startswith(UNFINISHED))
            folders = {(folder / name).parent for name in names} | {folder}
            documents = [name for name in names if name.endswith(".json")]
            for name in names:
                if (folder / name).is_dir():
                    raise InputError(f"{folder / name}: is a folder, expected a file or nothing")
                sync(stage / name)
                with reraise_write_error((folder / name).parent):
                    make_folder((folder / name).parent)
            for name in (*documents, *without):
                (folder / name).unlink(missing_ok=True)
            _sync_all(folders)
            for group in ([name for name in names if name not in documents], documents):
                for name in group:
                    (stage / name).replace(folder / name)
                _sync_all(folders)


def check_file(path: Path, max_bytes: int = MAX_BYTES) -> Path:
    """Return `path` if it is a regular file of at most `max_bytes`, otherwise raise InputError."""
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # ValueError: an invalid name
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "Is a directory" if stat.S_ISDIR(status.st_mode) else "a pipe or device, expected a file"
        raise InputError(f"{path}: cannot be read ({kind})")
    if status.st_size > max_bytes:
        raise InputError(f"{path}: cannot be read (it has {status.st_size} bytes, allowed are {max_bytes})")
    return path


def read_bytes(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read the contents of a file that passes `check_file`."""
    try:
        return check_file(path, max_bytes).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def read_json(path: Path, *formats: str) -> dict[str, Any]:
    """Read a JSON document whose `format` is one of `formats`, such as "padforge-morphology/1"."""
    content = read_bytes(path)
    try:
        document = json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON file ({error})") from error
    actual = document.get("format") if isinstance(document, dict) else None
    if actual not in formats:
        raise InputError(f"{path}: format is {short_repr(actual)}, expected {' or '.join(map(repr, formats))}")
    return document


def sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 digest of a file, or of the sorted digests and names of a folder's files."""
    if path.is_dir():
        children = [child for child in sorted(path.iterdir()) if child.is_file() and child.name != LOCK]
        lines = [f"{sha256(child)}  {child.name}" for child in children]
        return hashlib.sha256("\n".join(lines).encode(errors="surrogateescape")).hexdigest()
    with check_file(path, sys.maxsize).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_local(name: str) -> bool:
    """Return whether a name from a document is that of a result in its folder, or in a folder of results there."""
    path = Path(name)
    return path.parent.as_posix() in (".", *RESULT_FOLDERS) and path.name not in ("", "..")


def find_unchanged(folder: Path, digests: Mapping[str, object]) -> set[str]:
    """Return the names of a folder's files that still have the digest in `digests`; invalid entries are ignored."""
    unchanged = set[str]()
    for name, digest in digests.items():
        with suppress(InputError, OSError):
            if is_local(name) and check_file(folder / name) and sha256(folder / name) == digest:
                unchanged.add(name)
    return unchanged


def provenance(
    command: str, seed: int | None = None, inputs: Sequence[Path] = (), packages: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the provenance of a result, without time and output folder, so that equal runs give equal bytes.

    `inputs` are the files and folders that it was made from, recorded by their digests; versions of `packages` are
    recorded besides those of the usual ones.
    """
    return {
        "command": command,
        "seed": seed,
        "versions": {"python": platform.python_version()}
        | {name: installed_version(name) for name in ("padforge", "numpy", "scipy", *packages)},
        "inputs": {path.name: sha256(path) for path in inputs},
    }


@cache
def installed_version(package: str) -> str:
    """Return the version of an installed package, which is read once a process."""
    return metadata.version(package)


def find_dependents(path: Path, remade: Collection[str] = ()) -> list[str]:
    """Return the names of the results in a file's folder made from it, also indirectly, except those `remade`."""
    folders = [path.parent / name for name in (".", *RESULT_FOLDERS)]
    found = [file for folder in folders for file in folder.glob("[!.]*.json") if file != path]
    documents = {file.relative_to(path.parent).as_posix(): _read_dict(file) for file in found}
    documents |= {file.parent.name: _read_dict(file) for file in path.parent.glob("[!.]*/start.json") if file != path}
    sources, dependents = [path], set[str]()
    for source in sources:
        digest, origin = None, dict[str, Any]()
        if not source.is_dir():  # of a recording, a folder, documents hold another digest
            digest, origin = sha256(source), _as_dict(_read_dict(source).get("provenance"))
        for name, document in documents.items():  # a pad does not depend on that which it derives from
            is_pad = str(document.get("format")).startswith("padforge-morphology/")
            if name not in dependents and not is_pad and _is_made_from(document, source.name, digest, origin):
                dependents.add(name)
                sources.append(path.parent / name)
    return sorted(dependents - {*remade})


def check_replaceable(
    path: Path, by: Path | Mapping[str, Any], remade: Collection[str] = (), force: bool = False
) -> None:
    """Raise InputError if a file exists, differs from what replaces it, and another result was made from it.

    `by` is the file that replaces it, or the part of its provenance known in advance; `remade` are the names of files
    that are replaced together with it.
    """
    if force or not path.is_file():
        return
    if isinstance(by, Path):
        is_same = sha256(by) == sha256(path)
    else:
        stored = _as_dict(_read_dict(path).get("provenance"))
        is_same = all(stored.get(key) == value for key, value in json.loads(json.dumps(by)).items())
    if not is_same and (dependents := find_dependents(path, remade)):
        *names, last = dependents
        listed = f"{', '.join(names)} and {last} were" if names else f"{last} was"
        raise InputError(f"{path}: {listed} made from it; choose another --out, or replace it with --force")


def _as_dict(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _read_dict(path: Path) -> dict[str, Any]:
    """Read a JSON object; return an empty one for any other file, which a user may have put there."""
    try:
        return _as_dict(json.loads(read_bytes(path)))
    except (InputError, ValueError, RecursionError):
        return {}


def _is_made_from(document: Mapping[str, Any], name: str, digest: str | None, origin: Mapping[str, Any]) -> bool:
    """Return whether the inputs of a document include a file of this digest, or a model of this provenance."""
    inputs = _as_dict(_as_dict(document.get("provenance")).get("inputs"))
    if digest is None:
        return name in inputs
    if name == "morphology.json" and document.get("morphology_sha256") == digest:
        return True
    return inputs.get(name) == digest or (bool(origin) and inputs.get(Path(name).stem) == origin)
