"""What a run that is killed leaves half done, by names that nothing else has, for the next one to clear up.

A file or folder of such a name is locked by whoever makes it, so that one whose lock is free is of a run that is no
more. Where the system has no locks, nothing is cleared up.
"""

import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from .locks import LOCKS, is_at, try_lock

UNFINISHED = ".unfinished-"
"""Names of files and folders begin with this until they are whole."""
_SET = f"{UNFINISHED}set-"


def clear_litter(folder: Path, folders: str = _SET, files: str = UNFINISHED) -> None:
    """Remove what killed runs of this user have left in a folder; never what a link leads to.

    Args:
        folders, files: with what their names begin, see `scratch` and `unfinished_file`; 16 hex digits follow.
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
def scratch(folder: Path, prefix: str = _SET) -> Iterator[Path]:
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
def unfinished_file(folder: Path, suffix: str = "", prefix: str = UNFINISHED) -> Iterator[Path]:
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
