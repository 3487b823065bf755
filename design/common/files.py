"""Files as every stage writes and reads them: atomic, self-describing JSON."""

import hashlib
import json
import os
import platform
import secrets
import shutil
import stat
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import IO, Any

from .errors import InputError, shown

_PACKAGES = ("padforge", "numpy", "scipy")

MOST_BYTES = 2**28
"""A file of more is none that padforge has written, but for recordings."""


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it takes `path`'s place, on failure it vanishes.

    The temporary name keeps the suffix, because many writers choose their format by it.
    A reader never sees half a file, and an interrupted write leaves the old one as it was.

    Raises:
        InputError: what the system has against writing `path`, such as a full disk.
    """
    if path.name.startswith(UNFINISHED):  # it is another one's, who puts it in place
        yield path
        return
    with writing(path):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: cannot be written (it is there and no file)")
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{UNFINISHED}{secrets.token_hex(8)}{path.suffix}")
        try:  # from before there is a file, so that no interrupt finds one that nobody clears up
            temporary.touch(exist_ok=False)
            yield temporary
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` as UTF-8, atomically; what UTF-8 has not, as in names of files, is written as \\udc80."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document` to `path` atomically; NaN and infinities are refused, since JSON has none."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def sync(path: Path) -> None:
    """Put a file, or the names in a folder, on the disk, so that they outlast a power cut, where the system can."""
    if os.name == "posix":
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def require_file(path: Path, most: int = MOST_BYTES) -> None:
    """Refuse what may never end, such as pipes and devices, and what is too large to be looked at.

    Raises:
        InputError: nothing there, no file, or one of more than `most` bytes.
    """
    try:
        about = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error
    if stat.S_ISDIR(about.st_mode):
        raise InputError(f"{path}: cannot be read (Is a directory)")
    if not stat.S_ISREG(about.st_mode):
        raise InputError(f"{path}: cannot be read (a pipe or device, expected a file)")
    if about.st_size > most:
        raise InputError(f"{path}: cannot be read (it has {about.st_size} bytes, allowed are {most})")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """The content of a file.

    Raises:
        InputError: it cannot be read, or see `require_file`.
    """
    require_file(path, most)
    try:
        return path.read_bytes()
    except OSError as error:
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
    """Hex digest of a file; of a directory, the digest of its files' names and digests in sorted order."""
    if path.is_dir():
        lines = [f"{sha256(child)}  {child.name}" for child in sorted(path.iterdir()) if child.is_file()]
        return hashlib.sha256("\n".join(lines).encode()).hexdigest()
    with path.open("rb") as file:
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


try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

UNFINISHED = ".unfinished-"
"""Names of files and folders begin with this until they are whole."""
_STAGE = f"{UNFINISHED}set-"


@contextmanager
def as_written(path: Path) -> Iterator[None]:
    """Blame a document that is not as padforge writes it on its file."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: not as padforge writes it ({error!r})") from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the system has against writing `path` into one line.

    Raises:
        InputError: naming `path` and the reason.
    """
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def refuse_unwritable(folder: Path) -> None:
    """Raise InputError if files cannot be put into `folder`, or it is not there and cannot be made."""
    with writing(folder):
        there = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
        if not there.is_dir():
            raise InputError(f"{folder}: cannot be written, {there} is a file, expected a folder")
        if not os.access(there, os.W_OK | os.X_OK):
            raise InputError(f"{folder}: cannot be written, {there} does not allow it; choose another folder")


@contextmanager
def staged(folder: Path, without: Collection[str] = ()) -> Iterator[Path]:
    """Yield an empty folder in `folder`; on success its files move to `folder`, on failure they vanish.

    Where they cannot all be moved, or an interrupt comes meanwhile, `folder` is put back as it was. Such folders that
    killed runs have left go first.

    Args:
        without: names of files in `folder` that go as the others come.

    Raises:
        InputError: `folder` cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(f"{_STAGE}*") if fcntl else ():
            with suppress(InputError), _held(left, f"{left}: is at work"):
                shutil.rmtree(left, ignore_errors=True)
        stage = folder / f"{_STAGE}{secrets.token_hex(8)}"
        with ExitStack() as end:
            for _ in range(2):  # the second time where a Ctrl-C meets the first
                end.callback(shutil.rmtree, stage, ignore_errors=True)
            stage.mkdir()
            end.enter_context(_held(stage, f"{stage}: another run clears it up"))
            yield stage
            _exchange(stage, folder, without)


def _exchange(stage: Path, folder: Path, without: Collection[str]) -> None:
    """Move the files of a stage to `folder` and take others out of it: all, or none where that fails."""
    names = sorted(file.name for file in stage.iterdir())
    for path in (folder / name for name in names):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is {'a folder' if path.is_dir() else 'no file'}, expected a file or nothing")
    kept = stage / UNFINISHED
    kept.mkdir()
    for name in filter(lambda name: os.path.lexists(folder / name), (*names, *without)):
        try:
            (kept / name).hardlink_to(folder / name)
        except OSError:  # a disk without such
            shutil.copy2(folder / name, kept / name, follow_symlinks=False)
    try:
        for name in without:
            (folder / name).unlink(missing_ok=True)
        for name in names:
            (stage / name).replace(folder / name)
    except BaseException:
        for name in names:
            if not (stage / name).exists() and not os.path.lexists(kept / name):
                (folder / name).unlink(missing_ok=True)
        for file in list(kept.iterdir()):
            file.replace(folder / file.name)
        raise


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep other runs off `folder` while results are made for it; one that was not there goes again if left empty.

    Raises:
        InputError: another run is at it, or it cannot be written.
    """
    refuse_unwritable(folder)
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        with _held(folder, f"{folder}: another run is writing there; wait for its end, or choose another folder"):
            yield
    finally:
        with suppress(OSError):  # where something is in it
            for each in missing:
                each.rmdir()


@contextmanager
def _held(folder: Path, busy: str) -> Iterator[None]:
    """Keep others off a folder to the end or the death of this run, as `lock` does."""
    with writing(folder):
        handle = os.open(folder, os.O_RDONLY) if fcntl else None
    try:
        lock(handle, busy)
        yield
    finally:
        if handle is not None:
            os.close(handle)


def lock(file: IO[Any] | int | None, busy: str) -> None:
    """Keep others off until `file`, or what this descriptor is of, is closed, where the system has such locks.

    Raises:
        InputError: saying `busy`, where somebody has locked it.
    """
    if fcntl is None or file is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise InputError(busy) from error
