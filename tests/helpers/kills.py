"""Kills between two file operations: a process ends where it is about to change a file."""

import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

KILLED = 9
_CHANGES = {"os.rename", "os.link", "os.remove", "os.mkdir", "os.rmdir", "os.truncate"}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def kill_at(number: int, folder: Path) -> None:
    """Let this process end, as by SIGKILL, where it is about to change something in `folder` after `number` changes."""
    left = iter(range(number))
    within = f"{folder.resolve()}{os.sep}"

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        changes = event in _CHANGES or (event == "open" and isinstance(flags := arguments[2], int) and flags & _WRITES)
        if not changes or isinstance(arguments[0], int):
            return
        inside = os.path.abspath(os.fsdecode(arguments[0])).startswith(within)  # noqa: PTH100
        if inside and next(left, None) is None:
            os._exit(KILLED)

    sys.addaudithook(hook)


def killed(work: Callable[[], object], number: int, folder: Path) -> bool:
    """Do `work` in a process that is killed as `kill_at` says; whether it was, and did not come to its end before."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            kill_at(number, folder)
            work()
            code = 0
        finally:
            os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, KILLED), code
    return code == KILLED


def after_kills(work: Callable[[Path], object], make: Callable[[Path], object], base: Path) -> Iterator[Path]:
    """Folders filled by `make`, in which `work` is killed before its first change, its second, ...; at last it ends."""
    for number in count():
        make(folder := base / str(number))
        was_killed = killed(partial(work, folder), number, folder)
        yield folder
        if not was_killed:
            break
