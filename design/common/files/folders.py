"""Folders of results: one run at a time, files that appear together, and what a kill meanwhile has left half done.

Files that belong together are made in a folder of their own. Renaming that to `EXCHANGE` is the one moment in which
they become the valid ones: from then on they are put in place, by the next run that writes there if this one is
killed, and until then nothing has changed. Who only reads changes nothing: see `resolve_exchange`.
"""

import errno
import json
import os
import shutil
import stat
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from padforge.design.common.errors import InputError

from .blame import refuse_unwritable, writing
from .litter import UNFINISHED, clear_litter, scratch
from .locks import BusyError, held, held_folder, is_folder

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
def claimed(folder: Path) -> Iterator[None]:
    """Keep other runs off `folder` while results are made for it; one that was not there goes again if left empty.

    What a killed run has left there is put in place, or goes.

    Raises:
        InputError: another run is at it, or it cannot be written.
    """
    refuse_unwritable(folder)
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        with held_folder(folder, f"{folder}: another run is writing there; wait for its end, or choose another folder"):
            settle(folder)
            clear_litter(folder)
            yield
    finally:
        with suppress(OSError):  # where something is in it
            for each in missing:
                each.rmdir()


@contextmanager
def staged(folder: Path, without: Collection[str] = ()) -> Iterator[Path]:
    """Yield an empty folder in `folder`; on success its files move to `folder`, on failure they vanish.

    Where they cannot all be moved, or an interrupt comes meanwhile, `folder` is put back as it was; after a kill
    meanwhile they have all moved for whoever reads them by `reading`. What killed runs of this user left goes first.

    Args:
        without: names of files in `folder` that go as the others come.

    Raises:
        InputError: `folder` cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        settle(folder)
        with scratch(folder) as stage:
            yield stage
            _exchange(stage, folder, without)


def settle(folder: Path) -> None:
    """Put in place what a killed run of this user was putting in place in a folder, so that its files belong together.

    Raises:
        InputError: they cannot be put in place, or are of another user or folder.
    """
    exchange = folder / EXCHANGE
    with writing(folder), _exchange_in(folder) as note:
        if note is None:
            return
        if {path.lstat().st_uid for path in (exchange, exchange / _NOTE, exchange / _SEAL)} != {_user()}:
            raise InputError(f"{exchange}: left by a run of another user, who puts its files in place by another run")
        _put(exchange, folder, note)
        with scratch(folder) as away:
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
                end.enter_context(held(exchange, f"{folder}: another run is putting files in place; wait for its end"))
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
        settle(folder)
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
