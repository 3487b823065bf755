"""Work in a process of its own, and kills between two file operations: it ends where it is about to change a file."""

import io
import os
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

KILLED = 9
_CHANGES = {"os.rename", "os.link", "os.remove", "os.mkdir", "os.rmdir", "os.truncate"}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def kill_at(number: int, folder: Path, told: Callable[[], object] = lambda: None) -> None:
    """Let this process end, as by SIGKILL, where it is about to change something in `folder` after `number` changes.

    Args:
        told: called at each change.
    """
    left = iter(range(number))
    within = f"{folder.resolve()}{os.sep}"

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        changes = event in _CHANGES or (event == "open" and isinstance(flags := arguments[2], int) and flags & _WRITES)
        if not changes or isinstance(arguments[0], int):
            return
        if os.path.abspath(os.fsdecode(arguments[0])).startswith(within):  # noqa: PTH100
            told()
            if next(left, None) is None:
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


def forked(work: Callable[[], object], folder: Path, prepare: Callable[[], None] = lambda: None) -> int:
    """Begin `work` in a copy of this process, which has its imports done; the number of that process.

    It leads a group of its own, in `folder`, is given no input, writes to FOLDER.out and FOLDER.err, and has FOLDER.tmp
    for temporary files. It exits as `work` does, or 1 with a traceback.

    Args:
        prepare: called before `work`, where all that is in place.
    """
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        os.setsid()
        os.chdir(folder)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"{folder}.{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout, sys.stderr = (
            io.TextIOWrapper(os.fdopen(number, "wb", buffering=0), write_through=True) for number in (1, 2)
        )
        os.environ["TMPDIR"] = tempfile.tempdir = f"{folder}.tmp"
        prepare()
        work()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(bool(end.code))
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(code)


def on_one_thread() -> None:
    """Begin this program anew where libraries would compute on a thread a core: they read it as they are loaded."""
    one = {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    if not one.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | one)
