"""Folders of results: one run at a time, files that appear together, and what a kill meanwhile has left half done.

Files that belong together are made in a folder of their own. Renaming that to `EXCHANGE` is the one moment in which
they become the valid ones: from then on they are put in place, by the next that reads or writes there if this run is
killed, and until then nothing has changed.
"""

import errno
import json
import os
import shutil
import stat
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from design.common.errors import InputError

from .blame import refuse_unwritable, writing
from .litter import UNFINISHED, clear_litter, scratch
from .locks import BusyError, held, held_folder, is_folder

EXCHANGE = f"{UNFINISHED}exchange"
"""Name of the folder whose files are being put in place."""
_GONE, _KEPT = f"{UNFINISHED}gone", f"{UNFINISHED}kept"
"""In it, the names of files that go as the others come, and those that were there before."""
PATIENCE_S = 10.0
"""How long another run is waited for that puts files in place: it takes milliseconds."""


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
    meanwhile they have all moved for whoever reads them by `reading`. What killed runs have left goes first.

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
    """Put in place what a killed run was putting in place in a folder, so that its files belong together.

    Raises:
        InputError: they cannot be put in place.
    """
    exchange, until = folder / EXCHANGE, time.monotonic() + PATIENCE_S
    while is_folder(exchange) and not _is_strange(exchange, folder):
        try:
            with writing(folder), held(exchange, f"{folder}: another run is putting files in place; wait for its end"):
                _put(exchange, folder)
                with scratch(folder) as away:
                    exchange.rename(away / EXCHANGE)
        except BusyError:
            if time.monotonic() > until:
                raise
            time.sleep(0.01)


def _is_strange(exchange: Path, folder: Path) -> bool:
    """Whether what lies there is no folder, or of one who may not replace files of others, as in /tmp nobody may."""
    try:
        made, about = exchange.lstat(), folder.stat()
    except FileNotFoundError:  # all is in place
        return False
    if not stat.S_ISDIR(made.st_mode):
        return True
    return bool(about.st_mode & stat.S_ISVTX) and made.st_uid not in (os.geteuid(), about.st_uid)


def _put(exchange: Path, folder: Path) -> None:
    """Put the files of an exchange in place, and those out of it that go; doing it again does the rest."""
    for name in _gone(exchange):
        with suppress(ValueError):  # a name that no file can have
            (folder / name).unlink(missing_ok=True)
    for file in _files(exchange):
        file.replace(folder / file.name)


def _gone(exchange: Path) -> list[str]:
    """Names of the files that go; none where these have been noted by nobody, or a power cut has torn the note."""
    note = exchange / _GONE
    if note.is_symlink() or not note.is_file():
        return []
    try:
        names = json.loads(note.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError, RecursionError):
        return []
    told = [name for name in names if isinstance(name, str)] if isinstance(names, list) else []
    return [name for name in told if Path(name).name == name not in ("", "..")]


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
    (stage / _GONE).write_text(json.dumps(without), encoding="utf-8")
    exchange = folder / EXCHANGE
    try:
        _commit(stage, folder)
        _keep(exchange / _KEPT, folder, (*names, *without))  # now that nobody else replaces them
        _put(exchange, folder)
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
