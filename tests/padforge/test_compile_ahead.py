"""Kernels compiled beside a first run: only where something is to be compiled, and those that the run then finds."""

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

import padforge.compile_ahead as compile_ahead

COUNT = """
import sys
from numba.core import event

class Listener(event.Listener):
    def on_start(self, started):
        compiled.add(started.data["dispatcher"].py_func.__name__)
    def on_end(self, ended):
        pass

compiled = set()
event.register("numba:compile", Listener())
from padforge.compile_ahead import main
main()
print(*sorted(compiled))
"""


class Process:
    """Stands for the second process."""

    def __init__(self, command: list[str], **_: object) -> None:
        self.log, self.stdin = [*command[1:]], io.BytesIO()
        started.append(self)

    def terminate(self) -> None:
        self.log.append("terminated")

    def wait(self) -> None:
        self.log.append("waited for")


started: list[Process] = []


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty folder of compiled kernels, on two cores."""
    started.clear()
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(subprocess, "Popen", Process)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def test_a_process_is_started_at_once_where_nothing_is_compiled(cache: Path) -> None:
    with compile_ahead.compile_beside() as compile_rest:
        (process,) = started
        assert not process.stdin.closed
        compile_rest()
        assert process.stdin.closed
        compile_rest()  # after each result
    assert process.log == ["-m", "padforge.compile_ahead", "terminated", "waited for"]


def test_a_process_is_started_once_and_only_to_compile(cache: Path) -> None:
    (cache / "kernels.py311.nbi").touch()
    first, second = (njit(function) for function in (lambda x: x + 1, lambda x: x + 2))
    assert first(1) == 2
    with compile_ahead.compile_beside():
        assert first(1) == 2
        assert started == []
        assert [first(1.0), second(1.0), second(np.int32(1))] == [2.0, 3.0, 3]
        assert [process.log for process in started] == [["-m", "padforge.compile_ahead"]]
    assert [process.log[2:] for process in started] == [["terminated", "waited for"]]
    assert second(1j) == 2 + 1j
    assert len(started) == 1


@pytest.mark.slow
def test_kernels_compiled_ahead_are_read_from_disk(tmp_path: Path) -> None:
    """All of them, in the next process; and those of a score among them."""

    def compiled() -> set[str]:
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
        command = [sys.executable, "-c", COUNT]
        run = subprocess.run(command, stdin=subprocess.DEVNULL, env=environment, check=True, stdout=subprocess.PIPE)
        return set(run.stdout.decode().split())

    steps, later = {"leave_one_out_errors", "sum_closeness"}, {"published_terms", "_sweep", "detect", "_compute_inputs"}
    assert steps | later <= compiled()
    assert compiled() == set()
