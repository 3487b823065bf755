"""Files of every stage: atomic writes, sets of files replaced together, locks, self-describing JSON and provenance.

A set of files (a pad, a mould, a localizer) is replaced by a write-ahead protocol:

1. The files are written into a temporary folder beside their destinations.
2. That folder is renamed to `EXCHANGE`. This single rename is the commit: from here on readers get the new files.
3. The files move to their destinations, and the folder is removed.

A run that is killed before step 2 leaves a temporary folder, which the next run removes; one that is killed after it
leaves `EXCHANGE`, from which readers take the files that have not moved yet, and which the next writer completes.
Each step is synchronised to the disk before the next one, so that a power cut ends a run as a kill does.
"""

import errno
import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import cache, partial
from importlib import metadata
from itertools import count
from pathlib import Path
from typing import IO, Any, NamedTuple

from padforge.design.common.validation import InputError, short_repr

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

UNFINISHED = ".unfinished-"  # prefix of the names of temporary files and folders
EXCHANGE = f"{UNFINISHED}exchange"  # folder of a committed set of files that are moving to their destinations
MAX_BYTES = 2**28  # size limit of a file; of what padforge writes only recordings are larger
PATIENCE_S = 10.0  # how long to wait for another run that moves its files, which takes milliseconds

_NOTE, _MAX_NOTE_BYTES = f"{UNFINISHED}note", 2**20  # the file in `EXCHANGE` that says what it does
_MAX_ATTEMPTS = 100
_LOCK_OFFSET = 2**40  # byte of a file that is locked on Windows, beyond the end of any
_PACKAGES = ("padforge", "numpy", "scipy")
_MORPHOLOGY = "padforge-morphology/"  # prefix of the format of pads: one derived from another stands on its own


@contextmanager
def reraise_as_input_error(path: Path) -> Iterator[None]:
    """Report a document without the structure that padforge writes as an InputError that names its file."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: not as padforge writes it ({short_repr(error)})") from error


@contextmanager
def reraise_write_error(path: Path) -> Iterator[None]:
    """Report an OSError of the body as an InputError that says why `path` cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def check_writable(folder: Path) -> None:
    """Check that files can be created in `folder`, or that it can be created itself."""
    with reraise_write_error(folder):
        existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
        if not existing.is_dir():
            raise InputError(f"{folder}: cannot be written, {existing} is a file, expected a folder")
        if not os.access(existing, os.W_OK | os.X_OK):
            raise InputError(f"{folder}: cannot be written, {existing} does not allow it; choose another folder")


class BusyError(InputError):
    """Another process holds the lock."""


def _try_lock(handle: int) -> bool | None:
    """Lock an open file or folder without waiting: whether that was possible, None on a disk without locks.

    The lock is on the file or folder itself: it ends with the process however that is killed, and leaves no file.
    """
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        import msvcrt

        position = os.lseek(handle, 0, os.SEEK_CUR)
        os.lseek(handle, _LOCK_OFFSET, os.SEEK_SET)  # Windows lets nobody read a locked byte
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]  Windows only
        finally:
            os.lseek(handle, position, os.SEEK_SET)
    except OSError as error:
        return False if fcntl is None or isinstance(error, BlockingIOError) else None
    return True


def _is_at(handle: int, path: Path) -> bool:
    """Whether `path` is that of an open file or folder still."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def lock(file: IO[Any] | int, busy: str) -> None:
    """Lock an open file until it is closed, or raise BusyError(busy); do nothing on a disk without locks."""
    if _try_lock(file if isinstance(file, int) else file.fileno()) is False:
        raise BusyError(busy)


@contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Lock a file or folder in the body; do nothing on Windows, where nothing open can be renamed.

    Raises:
        BusyError: with the message `busy`: another process has locked it, or has removed it meanwhile.
        InputError: it cannot be opened.
    """
    if fcntl is None:
        yield
        return
    with reraise_write_error(path):
        try:
            handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except FileNotFoundError as error:
            raise BusyError(busy) from error
    try:
        lock(handle, busy)
        if not _is_at(handle, path):
            raise BusyError(busy)
        yield
    finally:
        os.close(handle)


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Keep other runs out of `folder` while results are made for it, and complete or remove what a killed run left.

    A folder that did not exist is created, and removed again if it stays empty.

    Raises:
        InputError: another run has locked it, or it cannot be written.
    """
    check_writable(folder)
    busy = f"{folder}: another run is writing there; wait for its end, or choose another folder"
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    with reraise_write_error(folder):
        make_folder(folder)
    try:
        with locked(folder, busy) if fcntl is not None else _lock_file(folder / f"{UNFINISHED}lock", busy):
            recover(folder)
            remove_leftovers(folder)
            yield
    finally:
        with suppress(OSError):  # not empty
            for path in created:
                path.rmdir()


@contextmanager
def _lock_file(path: Path, busy: str) -> Iterator[None]:
    """Lock a file that stands for its folder, since Windows locks no folders."""
    try:
        with path.open("ab") as file:
            lock(file, busy)
            yield
    finally:
        with suppress(OSError):  # another run has it open
            path.unlink()


def remove_leftovers(folder: Path, prefix: str = UNFINISHED) -> None:
    """Remove temporary files and folders of this user's killed runs; symbolic links are not followed."""
    if fcntl is None:  # whether their run is at work cannot be known
        return
    names = re.compile(rf"{re.escape(prefix)}[0-9a-f]{{16}}(\.[^.]+)?")
    with suppress(OSError):
        for path in [path for path in folder.iterdir() if names.fullmatch(path.name)]:
            with suppress(OSError), ExitStack() as stack:
                handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
                stack.callback(os.close, handle)
                status = os.fstat(handle)
                if status.st_uid != os.geteuid() or not _try_lock(handle) or not _is_at(handle, path):
                    continue
                if stat.S_ISDIR(status.st_mode):
                    shutil.rmtree(path, ignore_errors=True)
                elif stat.S_ISREG(status.st_mode):
                    path.unlink()


def temporary_folder(folder: Path, prefix: str = UNFINISHED) -> AbstractContextManager[Path]:
    """Create an empty folder in `folder`, its name with `prefix`; remove it with its content at the end."""
    return _temporary(folder, prefix, "", Path.mkdir, lambda path: shutil.rmtree(path, ignore_errors=True))


def temporary_file(folder: Path, suffix: str = "", prefix: str = UNFINISHED) -> AbstractContextManager[Path]:
    """Create an empty file in `folder`, its name with `prefix` and `suffix`; remove it at the end unless renamed."""
    create, remove = partial(Path.touch, exist_ok=False), partial(Path.unlink, missing_ok=True)
    return _temporary(folder, prefix, suffix, create, remove)


@contextmanager
def _temporary(
    folder: Path, prefix: str, suffix: str, create: Callable[[Path], object], remove: Callable[[Path], object]
) -> Iterator[Path]:
    """Create a temporary file or folder, locked so that other runs do not take it for a leftover."""
    remove_leftovers(folder, prefix)
    while True:
        path = folder / f"{prefix}{secrets.token_hex(8)}{suffix}"
        with ExitStack() as stack:
            for _ in range(2):  # before it exists, so that no interrupt leaves it; twice, where one interrupts removal
                stack.callback(remove, path)
            create(path)
            if fcntl is not None:
                try:
                    handle = os.open(path, os.O_RDONLY)
                except FileNotFoundError:  # another run removed it before it was locked
                    continue
                stack.callback(os.close, handle)
                if _try_lock(handle) is False or not _is_at(handle, path):
                    continue
            yield path
            return


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path beside it, with its suffix, which replaces it on success.

    The temporary file exists, is empty and locked; write into it rather than replace it. A path that is temporary
    itself is yielded as it is.
    """
    if path.name.startswith(UNFINISHED):
        yield path
        return
    with reraise_write_error(path):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: cannot be written (it exists and is no file)")
        make_folder(path.parent)
        recover(path.parent)  # else a later recovery would replace the new file by an older one
        with temporary_file(path.parent, path.suffix) as temporary:
            yield temporary
            sync(temporary)
            temporary.replace(path)
        sync(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write `text` atomically as UTF-8, its line ends unchanged; what UTF-8 cannot encode is written as \\udc80."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document` atomically as JSON, which does not have NaN or infinity: these raise ValueError."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def make_folder(folder: Path) -> None:
    """Create a folder, and those above it, such that they outlast a power cut; one that exists stays as it is."""
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in created:
        sync(path.parent)


def sync(path: Path) -> None:
    """Synchronise a file, or the names in a folder, to the disk, so that they outlast a power cut; POSIX only."""
    if os.name != "posix":
        return
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            to_disk(handle)
        finally:
            os.close(handle)
    except OSError as error:
        # Of a folder this is more than some network disks can do, and than whoever may write there need be allowed.
        if error.errno not in (errno.EINVAL, errno.EACCES) or not path.is_dir():
            raise


def to_disk(handle: int) -> None:
    """Synchronise an open file to the disk; on macOS out of the drive's own cache too, where `os.fsync` leaves it."""
    try:
        fcntl.fcntl(handle, fcntl.F_FULLFSYNC)  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    except (AttributeError, OSError):  # another system, or a disk without that operation
        os.fsync(handle)


class _Note(NamedTuple):
    """What an exchange does."""

    inodes: list[int]  # of its destination and itself; no copy preserves these: it is carried out only where it began
    names: list[str]
    removed: list[str]


@contextmanager
def atomic_files(folder: Path, without: Collection[str] = ()) -> Iterator[Path]:
    """Replace a set of files together: yield an empty folder, whose files move to `folder` on success.

    On failure `folder` is as it was before. If the run is killed while the files move, or one of them cannot be moved,
    all functions of this module read the new files, and the next run completes the move. Files named in `without` are
    removed as the others come.
    """
    with reraise_write_error(folder):
        make_folder(folder)
        recover(folder)
        with temporary_folder(folder) as stage:
            yield stage
            _commit(stage, folder, without)
    try:
        recover(folder)
    except KeyboardInterrupt:
        recover(folder)
        raise


def _commit(stage: Path, folder: Path, without: Collection[str]) -> None:
    """Turn a temporary folder into an exchange, once all of its files can be expected to move."""
    files = [path for path in stage.iterdir() if path.is_file() and not path.is_symlink()]
    names = [path.name for path in files if not path.name.startswith(UNFINISHED)]
    names.sort(key=lambda name: (name.endswith(".json"), name))  # JSON documents, which hold digests, move last
    for path in (folder / name for name in names):
        with suppress(OSError):  # nothing there, or a link that leads nowhere
            if not stat.S_ISREG(mode := path.stat().st_mode):
                kind = "a folder" if stat.S_ISDIR(mode) else "no file"
                raise InputError(f"{path}: is {kind}, expected a file or nothing")
            protected = folder.stat().st_mode & stat.S_ISVTX  # as /tmp, where nobody may replace files of others
            if protected and os.geteuid() not in (0, path.lstat().st_uid, folder.stat().st_uid):
                raise InputError(f"{path}: cannot be written, it belongs to another user")
    inodes = [folder.stat().st_ino, stage.stat().st_ino]
    note = _Note(inodes, names, sorted({*without} - {*names}))
    (stage / _NOTE).write_text(json.dumps(note), encoding="utf-8")
    for path in (*(stage / name for name in (*names, _NOTE)), stage):
        sync(path)
    for attempt in count(1):
        try:
            stage.rename(folder / EXCHANGE)
            sync(folder)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST) or attempt == _MAX_ATTEMPTS:
                raise
        recover(folder)  # another run has committed meanwhile


def recover(folder: Path) -> None:
    """Complete the exchange of this user in a folder, such as a killed run left, so that its files belong together.

    Raises:
        InputError: it cannot be completed, or is of another user or folder.
    """
    exchange, deadline = folder / EXCHANGE, time.monotonic() + PATIENCE_S
    while _read_note(folder) is not None:
        try:
            with reraise_write_error(folder), locked(exchange, f"{folder}: another run is moving its files there"):
                if (note := _read_note(folder)) is None:  # read again under the lock, without which it may change
                    return
                user = getattr(os, "geteuid", int)()  # on Windows all files are of user 0
                if {exchange.lstat().st_uid, (exchange / _NOTE).lstat().st_uid} != {user}:
                    raise InputError(f"{exchange}: left by a run of another user, who completes it by another run")
                for name in note.removed:
                    (folder / name).unlink(missing_ok=True)
                for name in note.names:
                    with suppress(FileNotFoundError):  # it has moved
                        (exchange / name).replace(folder / name)
                sync(folder)
                # One rename ends the exchange: if its folder is not removed then, it is a leftover like any other.
                with suppress(FileNotFoundError):  # on Windows, where another run may have ended it
                    leftover = exchange.rename(folder / f"{UNFINISHED}{secrets.token_hex(8)}")
                    shutil.rmtree(leftover, ignore_errors=True)
        except BusyError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)


def resolve_exchange(path: Path) -> Path:
    """Return where the valid content of a file is: in an exchange that has not moved it yet, or at `path`.

    For a file that the exchange removes, it is a path where nothing is.
    """
    note, pending = _read_note(path.parent), path.parent / EXCHANGE / path.name
    if note is not None and (path.name in note.removed or (path.name in note.names and pending.exists())):
        return pending
    return path


def _read_note(folder: Path) -> _Note | None:
    """Read what the exchange in a folder does; None if there is none.

    Raises:
        InputError: it was begun in another folder, by another program, or torn by a power cut.
    """
    exchange = folder / EXCHANGE
    try:
        status, destination = exchange.lstat(), folder.stat()
        if not stat.S_ISDIR(status.st_mode):
            return None
        if destination.st_mode & stat.S_ISVTX and status.st_uid not in (os.geteuid(), destination.st_uid):
            return None  # of anybody who may create files there, as in /tmp
        file = (exchange / _NOTE).lstat()
        if stat.S_ISREG(file.st_mode) and file.st_size <= _MAX_NOTE_BYTES:
            note = _Note(*json.loads((exchange / _NOTE).read_text(encoding="utf-8")))
            if note.inodes == [destination.st_ino, status.st_ino]:
                return note
    except (OSError, ValueError, TypeError, RecursionError):
        if not os.path.lexists(exchange):  # there is none, or its run has completed it meanwhile
            return None
    raise InputError(
        f"{exchange}: begun in another folder, or torn, so files here may be of two runs; remove it, and make them anew"
    )


def check_file(path: Path, max_bytes: int = MAX_BYTES) -> Path:
    """Return where to read a file of limited size (`resolve_exchange`); refuse a pipe or device, which may not end."""
    try:
        valid = resolve_exchange(path)
        status = valid.stat()
    except InputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "Is a directory" if stat.S_ISDIR(status.st_mode) else "a pipe or device, expected a file"
        raise InputError(f"{path}: cannot be read ({kind})")
    if status.st_size > max_bytes:
        raise InputError(f"{path}: cannot be read (it has {status.st_size} bytes, allowed are {max_bytes})")
    return valid


def read_bytes(path: Path, max_bytes: int = MAX_BYTES) -> bytes:
    """Read the content of a file of at most `max_bytes`, as `check_file`."""
    valid = check_file(path, max_bytes)
    try:
        return valid.read_bytes()
    except OSError as error:
        if isinstance(error, FileNotFoundError) and valid != path:  # it has moved to its destination meanwhile
            return read_bytes(path, max_bytes)
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def read_json(path: Path, *formats: str) -> dict[str, Any]:
    """Read a JSON document whose `format` is one of `formats`, such as "padforge-morphology/1".

    Raises:
        InputError: the file cannot be read, is not JSON, or has another format.
    """
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
    """Compute the SHA-256 digest of a file, or of a folder's sorted file names and digests, in hexadecimal."""
    if path.is_dir():
        lines = [f"{sha256(child)}  {child.name}" for child in sorted(path.iterdir()) if child.is_file()]
        return hashlib.sha256("\n".join(lines).encode(errors="surrogateescape")).hexdigest()
    with check_file(path, sys.maxsize).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def find_unchanged(folder: Path, digests: Mapping[str, object]) -> set[str]:
    """Return the names of the files directly in a folder that still have their digest; `digests` may hold anything."""
    unchanged = set[str]()
    for name, digest in digests.items():
        with suppress(InputError, OSError):
            if Path(name).name == name and check_file(folder / name) and sha256(folder / name) == digest:
                unchanged.add(name)
    return unchanged


def provenance(
    command: str, seed: int | None = None, inputs: Sequence[Path] = (), packages: Sequence[str] = ()
) -> dict[str, Any]:
    """Describe where a result comes from; without time and output folder, so that equal work gives equal bytes.

    Recorded are digests of the files and folders it was made from, and versions of `packages` besides the usual ones.
    """
    return {
        "command": command,
        "seed": seed,
        "versions": {"python": platform.python_version()}
        | {name: installed_version(name) for name in (*_PACKAGES, *packages)},
        "inputs": {path.name: sha256(path) for path in inputs},
    }


@cache
def installed_version(package: str) -> str:
    """Return the version of an installed package, which does not change while a process runs: it is read once."""
    return metadata.version(package)


def find_dependents(path: Path, remade: Collection[str] = ()) -> list[str]:
    """Return the names of what was made from a file beside it, directly or not, but for what is `remade` with it."""
    documents = {file.name: _read_dict(file) for file in path.parent.glob("[!.]*.json") if file != path}
    documents |= {file.parent.name: _read_dict(file) for file in path.parent.glob("[!.]*/start.json") if file != path}
    sources, dependents = [path], set[str]()
    for source in sources:
        digest, origin = None, dict[str, Any]()
        if not source.is_dir():  # documents hold other digests of a recording
            digest, origin = sha256(source), _as_dict(_read_dict(source).get("provenance"))
        for name, document in documents.items():
            is_pad = str(document.get("format")).startswith(_MORPHOLOGY)
            if name not in dependents and not is_pad and _is_made_from(document, source.name, digest, origin):
                dependents.add(name)
                sources.append(path.parent / name)
    return sorted(dependents - {*remade})


def check_replaceable(
    path: Path, by: Path | Mapping[str, Any], remade: Collection[str] = (), force: bool = False
) -> None:
    """Check that replacing a file changes nothing, or that no other file beside it was made from it.

    Args:
        path: the file, which need not exist.
        by: the file that replaces it, or, before there is one, its provenance as far as that is certain.
        remade: names of files that are replaced together with it.
        force: skip the check.

    Raises:
        InputError: others were made from it; they are named.
    """
    if force or not path.is_file():
        return
    if isinstance(by, Path):
        is_same = sha256(by) == sha256(path)
    else:
        before = _as_dict(_read_dict(path).get("provenance"))
        is_same = all(before.get(key) == value for key, value in json.loads(json.dumps(by)).items())
    if not is_same and (dependents := find_dependents(path, remade)):
        *names, last = dependents
        listed = f"{', '.join(names)} and {last} were" if names else f"{last} was"
        raise InputError(f"{path}: {listed} made from it; choose another --out, or replace it with --force")


def _as_dict(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _read_dict(path: Path) -> dict[str, Any]:
    """Read a JSON object; an empty one from any other file, since a folder may hold whatever a user puts there."""
    try:
        return _as_dict(json.loads(read_bytes(path)))
    except (InputError, ValueError, RecursionError):
        return {}


def _is_made_from(document: Mapping[str, Any], name: str, digest: str | None, origin: Mapping[str, Any]) -> bool:
    """Whether a document names as its input a file of this digest, or a model of this provenance."""
    inputs = _as_dict(_as_dict(document.get("provenance")).get("inputs"))
    if digest is None:
        return name in inputs
    if name == "morphology.json" and document.get("morphology_sha256") == digest:
        return True
    return inputs.get(name) == digest or (bool(origin) and inputs.get(Path(name).stem) == origin)
