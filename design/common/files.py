"""Files as every stage writes and reads them: atomic, together or not at all, self-describing JSON."""

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
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple

from padforge.design.common.validation import InputError, short_repr


@contextmanager
def reraise_as_input_error(path: Path) -> Iterator[None]:
    """Blame a document that is not as padforge writes it on its file."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: not as padforge writes it ({error!r})") from error


@contextmanager
def reraise_write_error(path: Path) -> Iterator[None]:
    """Turn what the system has against writing `path` into one line.

    Raises:
        InputError: naming `path` and the reason.
    """
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def check_writable(folder: Path) -> None:
    """Raise InputError if files cannot be put into `folder`, or it is not there and cannot be made."""
    with reraise_write_error(folder):
        there = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
        if not there.is_dir():
            raise InputError(f"{folder}: cannot be written, {there} is a file, expected a folder")
        if not os.access(there, os.W_OK | os.X_OK):
            raise InputError(f"{folder}: cannot be written, {there} does not allow it; choose another folder")


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCKS = fcntl is not None
"""Whether this system can tell of a file or folder, while others may rename it, that its run is no more."""
_LOCK_FILE, _FAR = ".unfinished-lock", 2**40
"""On Windows: what keeps others off the folder it is in, and the byte of a file that is locked, beyond all content."""


class BusyError(InputError):
    """Somebody else is at work with it."""


def lock(file: IO[Any] | int | None, busy: str) -> None:
    """Keep others off until `file`, or what this descriptor is of, is closed; on a disk without locks nobody is.

    Raises:
        BusyError: saying `busy`, where somebody has locked it.
    """
    if file is None:
        return
    try:
        if fcntl is None:
            _lock_far(file if isinstance(file, int) else file.fileno())
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if fcntl is None or isinstance(error, BlockingIOError):
            raise BusyError(busy) from error


def _lock_far(handle: int) -> None:
    """Lock a byte of a file on Windows, where nobody can read what is locked."""
    import msvcrt

    at = os.lseek(handle, 0, os.SEEK_CUR)
    os.lseek(handle, _FAR, os.SEEK_SET)
    try:
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # pyright: ignore[reportAttributeAccessIssue]  there alone
    finally:
        os.lseek(handle, at, os.SEEK_SET)


@contextmanager
def held_folder(folder: Path, busy: str) -> Iterator[None]:
    """`locked`, of a folder that stays where it is: on Windows by a file in it, which goes with whoever made it."""
    if LOCKS:
        with locked(folder, busy):
            yield
        return
    try:
        handle = os.open(folder / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_TEMPORARY)  # pyright: ignore[reportAttributeAccessIssue]
    except PermissionError as error:  # it is there, and on its way out
        raise BusyError(busy) from error
    try:
        lock(handle, busy)
        yield
    finally:
        os.close(handle)


@contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Keep others off a file or folder to the end or the death of this run, as `lock` does.

    Raises:
        BusyError: saying `busy`, where somebody has it, or it has gone meanwhile.
        InputError: it cannot be opened.
    """
    if not LOCKS:
        yield
        return
    with reraise_write_error(path):
        try:
            handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except FileNotFoundError as error:
            raise BusyError(busy) from error
    try:
        lock(handle, busy)
        if not is_at(handle, path):
            raise BusyError(busy)
        yield
    finally:
        os.close(handle)


def try_lock(handle: int) -> bool | None:
    """Lock what a descriptor is of: whether that was free, or None where disk or system have no such locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_at(handle: int, path: Path) -> bool:
    """Whether an open file or folder still lies at a path."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def is_folder(path: Path) -> bool:
    """Whether a folder lies there, and not a link to one."""
    try:
        return stat.S_ISDIR(path.lstat().st_mode)
    except (OSError, ValueError):  # ValueError: a name that no file can have
        return False


UNFINISHED = ".unfinished-"
"""Names of files and folders begin with this until they are whole."""
_SET = f"{UNFINISHED}set-"


def clear_litter(folder: Path, folders: str = _SET, files: str = UNFINISHED) -> None:
    """Remove what killed runs of this user have left in a folder; never what a link leads to.

    Args:
        folders, files: with what their names begin, see `temporary_folder` and `temporary_file`; 16 hex digits follow.
    """
    if not LOCKS:
        return
    of_folders = re.compile(rf"{re.escape(folders)}[0-9a-f]{{16}}")
    of_files = re.compile(rf"{re.escape(files)}[0-9a-f]{{16}}(\.[^.]+)?")
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                ours = of_folders.fullmatch(entry.name)
            else:
                ours = entry.is_file(follow_symlinks=False) and of_files.fullmatch(entry.name)
            if ours:
                _remove(Path(entry.path))


def _remove(path: Path) -> None:
    """Remove a file or folder of this user's, unless somebody is at work with it or that cannot be told."""
    with suppress(OSError):
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            if os.fstat(handle).st_uid != os.geteuid() or not try_lock(handle) or not is_at(handle, path):
                return
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()
        finally:
            os.close(handle)


@contextmanager
def temporary_folder(folder: Path, prefix: str = _SET) -> Iterator[Path]:
    """Yield an empty folder in `folder` that goes at the end, with all that is still in it; left ones go first.

    Raises:
        OSError: it cannot be made.
    """
    clear_litter(folder, prefix)
    while True:
        made = folder / f"{prefix}{secrets.token_hex(8)}"
        with ExitStack() as end:
            for _ in range(2):  # the second time where a Ctrl-C meets the first
                end.callback(shutil.rmtree, made, ignore_errors=True)
            made.mkdir()
            if _kept_from_others(made, os.O_RDONLY, end):
                yield made
                return


@contextmanager
def temporary_file(folder: Path, suffix: str = "", prefix: str = UNFINISHED) -> Iterator[Path]:
    """Yield an empty file in `folder` that is gone at the end, unless it has got another name; left ones go first.

    Raises:
        OSError: it cannot be made.
    """
    clear_litter(folder, files=prefix)
    while True:
        made = folder / f"{prefix}{secrets.token_hex(8)}{suffix}"
        with ExitStack() as end:  # from before there is a file, so that no interrupt finds one that nobody clears up
            end.callback(made.unlink, missing_ok=True)
            if not LOCKS:
                made.touch(exist_ok=False)
            elif not _kept_from_others(made, os.O_RDONLY | os.O_CREAT | os.O_EXCL, end):
                continue
            yield made
            return


def _kept_from_others(made: Path, flags: int, end: ExitStack) -> bool:
    """Lock what is just made, to that end; False where another run took it for litter before it was locked."""
    if not LOCKS:
        return True
    try:
        handle = os.open(made, flags, 0o666)
    except FileNotFoundError:
        if made.parent.is_dir() and not flags & os.O_CREAT:
            return False
        raise
    end.callback(os.close, handle)
    return try_lock(handle) is not False and is_at(handle, made)


EXCHANGE = f"{UNFINISHED}exchange"
"""Name of the folder whose files are being put in place."""
_NOTE, _SEAL, _KEPT = f"{UNFINISHED}note", f"{UNFINISHED}seal", f"{UNFINISHED}kept"
"""In it, the names of files that come and go, what binds these to the folder, and the files that were there before."""
_MAX_SEAL_BYTES = 1000
PATIENCE_S = 10.0
"""How long another run is waited for that puts files in place: it takes milliseconds."""


class _Note(NamedTuple):
    """What an exchange does: names of files that come, and of those that go."""

    come: list[str]
    go: list[str]


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Keep other runs off `folder` while results are made for it; one that was not there goes again if left empty.

    What a killed run has left there is put in place, or goes.

    Raises:
        InputError: another run is at it, or it cannot be written.
    """
    check_writable(folder)
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    with reraise_write_error(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        with held_folder(folder, f"{folder}: another run is writing there; wait for its end, or choose another folder"):
            recover(folder)
            clear_litter(folder)
            yield
    finally:
        with suppress(OSError):  # where something is in it
            for each in missing:
                each.rmdir()


@contextmanager
def atomic_files(folder: Path, without: Collection[str] = ()) -> Iterator[Path]:
    """Yield an empty folder in `folder`; on success its files move to `folder`, on failure they vanish.

    Where they cannot all be moved, or an interrupt comes meanwhile, `folder` is put back as it was; after a kill
    meanwhile they have all moved for whoever reads them by `reading`. What killed runs of this user left goes first.

    Args:
        without: names of files in `folder` that go as the others come.

    Raises:
        InputError: `folder` cannot be written.
    """
    with reraise_write_error(folder):
        folder.mkdir(parents=True, exist_ok=True)
        recover(folder)
        with temporary_folder(folder) as stage:
            yield stage
            _exchange(stage, folder, without)


def recover(folder: Path) -> None:
    """Put in place what a killed run of this user was putting in place in a folder, so that its files belong together.

    Raises:
        InputError: they cannot be put in place, or are of another user or folder.
    """
    exchange = folder / EXCHANGE
    with reraise_write_error(folder), _exchange_in(folder) as note:
        if note is None:
            return
        if {path.lstat().st_uid for path in (exchange, exchange / _NOTE, exchange / _SEAL)} != {_user()}:
            raise InputError(f"{exchange}: left by a run of another user, who puts its files in place by another run")
        _put(exchange, folder, note)
        with temporary_folder(folder) as away:
            exchange.rename(away / EXCHANGE)


def resolve_exchange(path: Path) -> Path:
    """Return where the valid content of a file lies: in what a killed run was putting in place beside it, or at `path`.

    Nothing is changed by it. A path at which nothing lies is returned for a file that goes.

    Raises:
        InputError: files beside it may be of two runs, as what was being put in place is of another folder.
    """
    with _exchange_in(path.parent) as note:
        if note is None:
            return path
        pending = path.parent / EXCHANGE / path.name
        comes = path.name in note.come and pending.exists()  # else it is in place
        return pending if comes or path.name in note.go else path


@contextmanager
def _exchange_in(folder: Path) -> Iterator[_Note | None]:
    """Yield what the exchange in a folder does, kept from others meanwhile; None where there is none.

    Raises:
        InputError: it was not begun in this folder, or another run does not come to its end.
    """
    exchange, until = folder / EXCHANGE, time.monotonic() + PATIENCE_S
    while is_folder(exchange) and not _is_strange(exchange, folder):
        with ExitStack() as end:
            try:
                end.enter_context(
                    locked(exchange, f"{folder}: another run is putting files in place; wait for its end")
                )
            except BusyError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.01)
                continue
            yield _read_note(exchange, folder)
            return
    yield None


def _write_note(stage: Path, folder: Path, note: _Note) -> None:
    """Note what an exchange does, and bind that to this folder."""
    (stage / _NOTE).write_text(json.dumps(note), encoding="utf-8")
    (stage / _SEAL).write_text(_seal(stage, folder), encoding="utf-8")


def _read_note(exchange: Path, folder: Path) -> _Note:
    """Read what an exchange does, on the word of its seal alone.

    Raises:
        InputError: it was begun in another folder, by another program, or torn by a power cut.
    """
    seal = exchange / _SEAL
    try:
        about = seal.lstat()
        small = stat.S_ISREG(about.st_mode) and about.st_size <= _MAX_SEAL_BYTES
        if small and seal.read_text(encoding="utf-8") == _seal(exchange, folder):
            return _Note(*json.loads((exchange / _NOTE).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        if not is_folder(exchange):  # a run has come to its end meanwhile, where there are no locks
            return _Note([], [])
    raise InputError(
        f"{exchange}: begun in another folder, or torn, so files here may be of two runs; remove it, and make them anew"
    )


def _seal(exchange: Path, folder: Path) -> str:
    """Return what no archive and no copy carries along: numbers of files, and the time at which the note was written.

    That is the system's own time of the last change, which nobody sets and a renamed folder leaves as it was.
    """
    note = (exchange / _NOTE).lstat()
    return " ".join(map(str, (folder.stat().st_ino, exchange.lstat().st_ino, note.st_ino, note.st_ctime_ns)))


def _user() -> int:
    return getattr(os, "geteuid", int)()  # on Windows all files are of user 0


def _is_strange(exchange: Path, folder: Path) -> bool:
    """Whether what lies there is no folder, or of one who may not replace files of others, as in /tmp nobody may."""
    try:
        made, about = exchange.lstat(), folder.stat()
    except FileNotFoundError:  # all is in place
        return False
    if not stat.S_ISDIR(made.st_mode):
        return True
    return bool(about.st_mode & stat.S_ISVTX) and made.st_uid not in (os.geteuid(), about.st_uid)


def _put(exchange: Path, folder: Path, note: _Note) -> None:
    """Put the files of an exchange in place, and those out of it that go; doing it again does the rest."""
    for name in note.go:
        (folder / name).unlink(missing_ok=True)
    for name in note.come:
        with suppress(FileNotFoundError):  # it is in place
            (exchange / name).replace(folder / name)


def _files(stage: Path) -> list[Path]:
    files = (path for path in stage.iterdir() if path.is_file() and not path.is_symlink())
    return sorted(path for path in files if not path.name.startswith(UNFINISHED))


def _exchange(stage: Path, folder: Path, without: Collection[str]) -> None:
    """Move the files of a stage to `folder` and take others out of it: all, or none where that fails."""
    names = [file.name for file in _files(stage)]
    without = sorted({*without} - {*names})
    for path in (folder / name for name in names):
        with suppress(OSError):  # there is nothing, or what a link leads to is gone
            if not stat.S_ISREG(mode := path.stat().st_mode):
                kind = "a folder" if stat.S_ISDIR(mode) else "no file"
                raise InputError(f"{path}: is {kind}, expected a file or nothing")
    note = _Note(names, without)
    _write_note(stage, folder, note)
    exchange = folder / EXCHANGE
    try:
        _commit(stage, folder)
        _keep(exchange / _KEPT, folder, (*names, *without))  # now that nobody else replaces them
        _put(exchange, folder, note)
        exchange.rename(stage)
    except BaseException:
        if not stage.exists():
            exchange.rename(stage)
            _put_back(stage, folder, names)
        raise


def _commit(stage: Path, folder: Path) -> None:
    """Make the files of a stage the valid ones; others that are being put in place come first."""
    while stage.exists():
        recover(folder)
        try:
            stage.rename(folder / EXCHANGE)
        except OSError as error:
            busy = error.errno in (errno.ENOTEMPTY, errno.EEXIST) or is_folder(folder / EXCHANGE)
            if not busy or _is_strange(folder / EXCHANGE, folder):
                raise


def _keep(kept: Path, folder: Path, names: Iterable[str]) -> None:
    """Keep what lies in a folder by some names."""
    kept.mkdir()
    for name in filter(lambda name: os.path.lexists(folder / name), names):
        with suppress(FileNotFoundError):  # somebody has taken it away
            try:
                (kept / name).hardlink_to(folder / name)
            except OSError:  # a disk without such
                shutil.copy2(folder / name, kept / name, follow_symlinks=False)


def _put_back(stage: Path, folder: Path, names: Collection[str]) -> None:
    """Undo what was done of an exchange."""
    kept = stage / _KEPT
    for name in names:
        if not (stage / name).exists() and not os.path.lexists(kept / name):
            (folder / name).unlink(missing_ok=True)
    for file in list(kept.iterdir()) if kept.exists() else ():
        file.replace(folder / file.name)


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it takes `path`'s place, on failure it vanishes.

    The temporary name keeps the suffix, because many writers choose their format by it. It is that of an empty file,
    which has to be written into and not replaced: its lock tells other runs that somebody is at work.
    A reader never sees half a file, and an interrupted write leaves the old one as it was.

    Raises:
        InputError: what the system has against writing `path`, such as a full disk.
    """
    if path.name.startswith(UNFINISHED):  # it is another one's, who puts it in place
        yield path
        return
    with reraise_write_error(path):
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: cannot be written (it is there and no file)")
        path.parent.mkdir(parents=True, exist_ok=True)
        recover(path.parent)  # or an older file would come over this one later
        with temporary_file(path.parent, path.suffix) as temporary:
            yield temporary
            temporary.replace(path)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` as UTF-8 with its own line ends, atomically.

    What UTF-8 has not, as in names of files, is written as \\udc80.
    """
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write `document` to `path` atomically; NaN and infinities are refused, since JSON has none."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def open_in_place(path: Path) -> BinaryIO:
    """Open a file that is there, to be read and changed where it lies, without a buffer; never what a link leads to.

    Raises:
        InputError: it is a link. OSError: it cannot be opened.
    """
    file = path.open("r+b", buffering=0)
    if not os.path.samestat(os.fstat(file.fileno()), path.lstat()):
        file.close()
        raise InputError(f"{path}: is a link, and none is followed where a file is gone on with")
    return file


def sync(path: Path) -> None:
    """Put a file, or the names in a folder, on the disk, so that they outlast a power cut, where the system can."""
    if os.name == "posix":
        handle = os.open(path, os.O_RDONLY)
        try:
            to_disk(handle)
        finally:
            os.close(handle)


def to_disk(handle: int) -> None:
    """As `os.fsync`, and on macOS out of the drive's own cache as well, which fsync leaves it in there."""
    full = getattr(fcntl, "F_FULLFSYNC", None)
    if fcntl is not None and full is not None:
        with suppress(OSError):  # a disk that knows no such order
            fcntl.fcntl(handle, full)
            return
    os.fsync(handle)


_PACKAGES = ("padforge", "numpy", "scipy")

MAX_BYTES = 2**28
"""A file of more is none that padforge has written, but for recordings."""


def check_file(path: Path, most: int = MAX_BYTES) -> Path:
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


def read_bytes(path: Path, most: int = MAX_BYTES) -> bytes:
    """The content of a file.

    Raises:
        InputError: it cannot be read, or see `check_file`.
    """
    valid = check_file(path, most)
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
        raise InputError(f"{path}: format is {short_repr(found)}, expected {' or '.join(map(repr, kinds))}")
    return document


def sha256(path: Path) -> str:
    """Hex digest of a file; of a directory, the digest of its files' names and digests in sorted order.

    Raises:
        InputError: nothing there, or no file, such as a pipe or device that never ends.
    """
    if path.is_dir():
        lines = [f"{sha256(child)}  {child.name}" for child in sorted(path.iterdir()) if child.is_file()]
        return hashlib.sha256("\n".join(lines).encode(errors="surrogateescape")).hexdigest()
    with check_file(path, sys.maxsize).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def unchanged(folder: Path, digests: Mapping[str, object]) -> set[str]:
    """Names of the files in a folder, and of no other one, whose content still has the digest noted for the name."""

    def same(name: str) -> bool:
        try:
            check_file(folder / name)
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


_MORPHOLOGY = "padforge-morphology/"
"""How the format of a pad begins: one that was made from another pad is a pad of its own."""


def find_dependents(path: Path, remade: Collection[str] = ()) -> list[str]:
    """Return the names of documents and recordings beside a file that were made from it, or from such a one.

    Args:
        path: the file.
        remade: names of those that come with the file that takes its place.
    """
    documents = {name: document for name, document in _documents(path.parent) if path.parent / name != path}
    sources, dependents = [path], []
    for source in sources:
        about = _about(source)
        for name in [name for name, document in documents.items() if _is_made_from(document, source.name, *about)]:
            del documents[name]
            dependents.append(name)
            sources.append(path.parent / name)
    return sorted({*dependents} - {*remade})


def check_replaceable(
    path: Path, by: Path | Mapping[str, Any], remade: Collection[str] = (), force: bool = False
) -> None:
    """Refuse to replace a file that others beside it were made from, unless it stays as it is.

    Args:
        path: the file, which need not be there.
        by: the file that takes its place; before there is one, what is known of its provenance.
        remade: see `find_dependents`.
        force: whether it is replaced all the same.

    Raises:
        InputError: naming what was made from it.
    """
    if force or not path.is_file():
        return
    if isinstance(by, Path):
        stays = sha256(by) == sha256(path)
    else:
        before = _provenance(_document(path))
        stays = all(before.get(key) == value for key, value in json.loads(json.dumps(by)).items())
    if not stays and (dependents := find_dependents(path, remade)):
        *names, last = dependents
        listed = f"{', '.join(names)} and {last} were" if names else f"{last} was"
        raise InputError(f"{path}: {listed} made from it; choose another --out, or replace it with --force")


def _documents(folder: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the documents of stages in a folder by name, those of recordings by the name of their folder."""
    for path in sorted([*folder.glob("[!.]*.json"), *folder.glob("[!.]*/start.json")]):
        document = _document(path)
        if not str(document.get("format")).startswith(_MORPHOLOGY):
            yield path.name if path.parent == folder else path.parent.name, document


def _document(path: Path) -> dict[str, Any]:
    """Read a JSON object; an empty one where there is none, since whatever lies in a folder is looked at."""
    try:
        document = json.loads(read_bytes(path))
    except (InputError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _provenance(document: Mapping[str, Any]) -> Mapping[str, Any]:
    made_by = document.get("provenance")
    return made_by if isinstance(made_by, dict) else {}


def _about(source: Path) -> tuple[str | None, Mapping[str, Any]]:
    """Return the digest of a file and its provenance; of a recording neither, as documents have other digests of it."""
    return (None, {}) if source.is_dir() else (sha256(source), _provenance(_document(source)))


def _is_made_from(document: Mapping[str, Any], name: str, digest: str | None, made_by: Mapping[str, Any]) -> bool:
    """Whether a document says that it was made from a file with this digest, or from a model of this provenance."""
    inputs = _provenance(document).get("inputs")
    inputs = inputs if isinstance(inputs, dict) else {}
    if digest is None:
        return name in inputs
    if name == "morphology.json" and document.get("morphology_sha256") == digest:
        return True
    return inputs.get(name) == digest or (bool(made_by) and inputs.get(Path(name).stem) == made_by)
