"""How a program ends whose threads are still at work."""

import os
import subprocess
import sys

import pytest


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_an_end_from_outside_is_told_and_crashes_nothing() -> None:
    """Threads of torch that are at work when the interpreter ends do so."""
    code = """
import os, signal, sys, threading
import click, torch
from design.common.command_line import run_to_end
from design.common.computing import run_tasks
sys.argv = ["padforge"]
at_work = threading.Barrier(5, lambda: threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start())
def train():
    x = torch.ones(20, 20, requires_grad=True)
    at_work.wait()
    while True:
        (x @ x).sum().backward()
@click.command()
def work():
    print("begun")
    for _ in run_tasks([(number, train) for number in range(5)], at_once=5):
        pass
sys.exit(run_to_end(work, "padforge", {}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    said = done.stderr.strip()
    assert (done.returncode, said) == (130, "padforge: interrupted; what was finished is kept")
    assert done.stdout == "begun\n"
