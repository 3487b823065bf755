"""Work in a process of its own, under limits: how it ended, how long it computed and how much memory it had."""

import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tools.kills import forked

MIB = 2**20
ROOT = Path(__file__).resolve().parents[2]
_TOLD = 10**6
"""Bytes of what a process writes that are looked at, the last ones."""


@dataclass(frozen=True)
class Limits:
    """Where a process ends: bytes of memory beyond those it began with, of a file; seconds of computing, and all."""

    memory: int = 3000 * MIB
    file: int = 1000 * MIB
    cpu_s: int = 60
    wall_s: float = 60.0


@dataclass(frozen=True)
class Ended:
    """How a process ended.

    Attributes:
        code: its exit code; less than 0 for a signal. out, err: what it wrote.
        cpu_s: how long it computed. memory: most bytes that it had resident, beyond those it began with.
        hung: whether it was ended for not coming to its end.
    """

    code: int
    out: str
    err: str
    cpu_s: float
    memory: int
    hung: bool = False


def limited(work: Callable[[], object], folder: Path, limits: Limits, interrupt_s: float | None = None) -> Ended:
    """Do `work` in a copy of this process, in `folder`, see `kills.forked`.

    Args:
        interrupt_s: after how long it is interrupted as by Ctrl-C, and again, for Python loses one that comes while it
            clears up; None for never.
    """
    begun_with = Path(f"{folder}.memory")

    def limit() -> None:
        mapped, resident = (int(pages) * resource.getpagesize() for pages in _pages())
        begun_with.write_text(str(resident))
        ends = {resource.RLIMIT_AS: mapped + limits.memory, resource.RLIMIT_FSIZE: limits.file, resource.RLIMIT_CORE: 0}
        for kind, most in ends.items():
            resource.setrlimit(kind, (most, most))
        resource.setrlimit(resource.RLIMIT_CPU, (limits.cpu_s, limits.cpu_s + 1))
        signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell ignores for what runs behind it

    begin, interrupts, hung = time.monotonic(), 0, False
    child = forked(work, folder, limit)
    while True:
        number, status, used = os.wait4(child, os.WNOHANG)
        if number:
            break
        passed = time.monotonic() - begin
        if interrupt_s is not None and passed > interrupt_s * (1 + 5 * interrupts):
            interrupts += 1
            with suppress(ProcessLookupError):  # it leads no group yet
                os.killpg(child, signal.SIGINT)
        if passed > limits.wall_s and not hung:
            hung = True
            os.kill(child, signal.SIGKILL)
        time.sleep(min(0.02, 0.001 + passed / 20))
    with suppress(ProcessLookupError):  # whatever it has left
        os.killpg(child, signal.SIGKILL)
    out, err = (Path(f"{folder}.{name}").read_bytes()[-_TOLD:].decode(errors="replace") for name in ("out", "err"))
    memory = max(used.ru_maxrss * 1024 - int(begun_with.read_text()), 0)
    return Ended(os.waitstatus_to_exitcode(status), out, err, used.ru_utime + used.ru_stime, memory, hung)


def _pages() -> list[str]:
    """Pages that this process has mapped, and those resident."""
    return Path("/proc/self/statm").read_text().split()[:2]


_WATCH = """
import os, signal, sys
child = os.fork() or os.execv(sys.argv[2], sys.argv[2:])
signal.signal(signal.SIGINT, signal.SIG_IGN)
_, status, used = os.wait4(child, 0)
open(sys.argv[1], "w").write(f"{status} {used.ru_utime + used.ru_stime} {used.ru_maxrss}")
"""
"""A small process between: where a large one begins another, the memory of that counts from the large one's."""


def fresh(
    words: list[str], folder: Path, limits: Limits = Limits(6000 * MIB, cpu_s=60), interrupt_s: float | None = None
) -> Ended:
    """Run Python with these arguments in `folder`, in a process that begins with nothing."""
    usage = Path(f"{folder}.usage")
    usage.unlink(missing_ok=True)
    command = [sys.executable, "-S", "-c", _WATCH, str(usage), sys.executable, *words]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": f"{folder}.tmp"}
    ended = limited(lambda: os.execve(sys.executable, command, environment), folder, limits, interrupt_s)
    if not usage.exists():
        return ended
    status, cpu_s, memory = usage.read_text().split()
    code = os.waitstatus_to_exitcode(int(status))
    return Ended(code, ended.out, ended.err, float(cpu_s), int(memory) * 1024, ended.hung)
