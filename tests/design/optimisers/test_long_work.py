"""Long searches on the command line: killed and resumed, on a cluster that loses a worker, ended by the clock."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor
from typing import cast

import pytest

from design.common import computing
from design.common.checkpoints import Checkpoints
from design.common.command_line import run_to_end
from design.optimisers.search import SearchRun, search
from design.settings import PadSettings, RulesSettings, SearchSettings
from padforge import cli

SETTINGS = """
[pad]
grid = 2
[search]
knots = 3
starts = 2
steps = 75
lost = 1
[rules]
enforce = false
"""
"""Without rules, whose repair takes longer than the steps, and is broken off and resumed in the tests of searches."""


def design(folder, *arguments):
    """The command in a process of its own."""
    (folder / "pad.toml").write_text(SETTINGS)
    command = [sys.executable, "-m", "padforge", "design", "--out", "pad", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def design_here(folder, monkeypatch, *arguments):
    """The exit code of the command in this process."""
    (folder / "pad.toml").write_text(SETTINGS)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["padforge", "design", "--out", "pad", *arguments])
    return run_to_end(cli, "padforge", {})


def finished(process):
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def latest(folder):
    """When a state was last kept."""
    return max(path.stat().st_mtime_ns for path in folder.glob("start_*.npz"))


def wait_for(happened, process):
    while not happened():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


@pytest.mark.skipif(os.name != "posix", reason="kills as POSIX does")
def test_a_search_killed_and_then_interrupted_resumes_to_the_same_file(tmp_path, monkeypatch):
    """A kill leaves states alone, Ctrl-C the best so far as well; what goes on from both ends as if unbroken."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    whole.mkdir()
    broken.mkdir()
    code, pad = design_here(whole, monkeypatch), broken / "pad"
    assert code == 0
    process = design(broken)
    wait_for((pad / "search" / "start_0000.npz").exists, process)
    process.kill()
    finished(process)
    assert not (pad / "morphology.json").exists()
    killed_at = latest(pad / "search")
    process = design(broken, "--resume")
    wait_for(lambda: latest(pad / "search") > killed_at, process)
    process.send_signal(signal.SIGINT)
    stopped, out, err = finished(process)
    assert stopped == 130, err
    assert "interrupted: the best so far" in out
    assert json.loads((pad / "design.json").read_text())["stopped"] == "interrupted"
    assert (pad / "search" / "start_0000.npz").exists()
    assert design_here(broken, monkeypatch, "--resume") == code
    for name in ("morphology.json", "design.svg"):
        assert (pad / name).read_bytes() == (whole / "pad" / name).read_bytes()
    assert not (pad / "search").exists()


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_an_end_from_outside_is_as_ctrl_c_unless_it_is_ignored():
    """As under nohup, which ignores that the terminal hangs up."""
    code = (
        "import signal\n"
        "from design.common.command_line import _prepare\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "_prepare()\n"
        "print(signal.getsignal(signal.SIGHUP) is signal.SIG_IGN)\n"
        "print(signal.getsignal(signal.SIGTERM) is signal.default_int_handler)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]


@pytest.mark.filterwarnings("ignore")
def test_a_scheduler_that_is_not_there_is_one_line(tmp_path, monkeypatch, capsys):
    pytest.importorskip("distributed")
    monkeypatch.setattr(computing, "SCHEDULER_S", 0.2)
    assert design_here(tmp_path, monkeypatch, "--scheduler", "tcp://127.0.0.1:9") == 2
    err = capsys.readouterr().err
    assert "--scheduler is tcp://127.0.0.1:9: no Dask scheduler answers there" in err
    assert "Traceback" not in err


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_loses_a_worker_finds_the_same_pad():
    """Its only one: another is started in its place, and goes on."""
    distributed = pytest.importorskip("distributed")
    pad, settings = PadSettings(grid=2), SearchSettings(knots=3, starts=2, steps=40, lost=1)
    rules = RulesSettings(enforce=False)
    here = search(pad, settings=settings, rules=rules)
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        victim = next(iter(client.run(os.getpid).values()))
        slices = []

        def report(*step):
            slices.append(step)
            if len(slices) == 2:
                threading.Thread(target=os.kill, args=(victim, signal.SIGKILL)).start()

        executor = cast(Executor, client.get_executor(pure=False, retries=10))
        there = search(pad, settings=settings, rules=rules, run=SearchRun(report, executor=executor))
        assert len(slices) > 2
        with pytest.raises(ProcessLookupError):
            os.kill(victim, 0)
    assert there.morphology == here.morphology
    assert there.history == here.history


def test_a_folder_that_holds_more_than_states_keeps_it(tmp_path):
    (tmp_path / "search.json").write_text('{"format": "padforge-search/1"}')
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "start_of_mine.npz").write_text("mine as well")
    Checkpoints(tmp_path, {}).begin(resume=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.txt", "start_of_mine.npz"]
