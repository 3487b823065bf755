import os
import subprocess
import sys
import threading
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from padforge.common.parallel import cluster, makespan, one_thread, run_tasks
from padforge.common.validation import Fault


@pytest.mark.parametrize(
    ("parts", "workers", "expected"),
    [([3, 3, 2], 1, 8), ([3, 3, 2], 2, 5), ([3, 3, 2], 3, 3), ([3, 3, 2], 8, 3), ([4, 2, 1, 1], 2, 4)],
)
def test_makespan_is_when_the_last_worker_ends(parts, workers, expected):
    assert makespan(parts, workers) == expected


def test_run_tasks_follows_up_and_yields_as_completed_within_max_parallel():
    def next_one(key, result):
        return partial(str.__add__, result, key) if len(result) < 3 else None

    found = list(run_tasks([("a", lambda: "a"), ("b", lambda: "b")], follow_up=next_one))
    for key in ("a", "b"):
        assert [result for own, result in found if own == key] == [key, 2 * key, 3 * key]
    first, inside, most = threading.Event(), 0, 0

    def counted(work):
        nonlocal inside, most
        inside += 1
        most = max(most, inside)
        work()
        inside -= 1

    tasks = [("slow", first.wait), ("quick", lambda: None), ("last", first.set)]
    found = [key for key, _ in run_tasks([(key, partial(counted, work)) for key, work in tasks], max_parallel=2)]
    assert found[0] == "quick"
    assert most == 2
    with pytest.raises(ZeroDivisionError):
        list(run_tasks([("a", partial(pow, 0, -1))]))


def test_run_tasks_starts_nothing_after_an_exception_and_does_not_wait():
    begun, never = [], threading.Event()

    def work(number):
        begun.append(number)
        if number == 1:
            never.wait()
        return number

    kept = []

    def listen():
        for key, _ in run_tasks([(number, partial(work, number)) for number in range(9)], max_parallel=2):
            kept.append(key)
            if len(kept) == 3:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        listen()
    assert kept == [0, 2, 3]
    assert begun == [0, 1, 2, 3]
    never.set()


@pytest.mark.parametrize(("killed", "said"), [(False, "has lost its scheduler"), (True, "loses every worker")])
def test_cluster_failure_is_a_fault_of_one_line(monkeypatch, killed, said):
    distributed = pytest.importorskip("distributed")

    class Client(nullcontext):
        def get_executor(self, **how):
            return ThreadPoolExecutor(1)

    def lost():
        raise distributed.scheduler.KilledWorker("a task", None, 3) if killed else CancelledError

    monkeypatch.setattr(distributed, "Client", lambda address, timeout: Client())
    with pytest.raises(Fault, match=f"the cluster at tcp://there {said}; .* --resume"), cluster("tcp://there") as pool:
        list(run_tasks([("a", lost)], pool))


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_one_thread_nests_and_restores():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with threadpool_limits(3, "blas"):
            with one_thread():
                with one_thread():
                    assert list(run_tasks([("a", one_thread()(torch.get_num_threads))])) == [("a", 1)]
                assert (torch.get_num_threads(), blas_threads()) == (1, {1})
            assert (torch.get_num_threads(), blas_threads()) == (3, {3})
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_sigterm_during_torch_tasks_exits_130_without_a_crash() -> None:
    code = """
import os, signal, sys, threading
import click, torch
from padforge.common.command_line import run_to_end
from padforge.common.parallel import run_tasks
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
    for _ in run_tasks([(number, train) for number in range(5)], max_parallel=5):
        pass
sys.exit(run_to_end(work, "padforge", {}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    said = done.stderr.strip()
    assert (done.returncode, said) == (130, "padforge: interrupted; what was finished is kept")
    assert done.stdout == "begun\n"
