"""What every study shares: pads by name, one run at a time in a folder, resumed work, all results or none."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from padforge.design import Contact, InputError, Morphology, PadSettings, SearchSettings
from padforge.design.optimize.search import SearchResult
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.studies import drift, scaling, sensitivity
from padforge.sense.studies.indentation import Learning, force_study, shape_study
from padforge.sense.studies.multicontact import multicontact_study
from padforge.sense.studies.robustness import robustness_study
from padforge.sense.studies.study import Findings, Study, Task, described, load_pads, run, study_lines
from tests.helpers.door import refused

PADS = {"square": Morphology.straight(2), "random": Morphology.random(2, 2, 0)}
LEAST: dict[str, Callable[[], Study]] = {
    "robustness": lambda: robustness_study(PADS, max_failures=1, hidden=4, presses=16, test=20),
    "drift": lambda: drift.drift_study(
        *({"random": PADS["random"]}, {"real": simulate(PADS["square"], RigSettings(presses=40, seed=3))}),
        **{"rig": RigSettings(drift_mv=300), "presses": 40, "hidden": 4, "epochs": 2},
    ),
    "force": lambda: force_study(PADS, noise_counts=(1.0,), learning=Learning(60, 40, hidden=4, epochs=3)),
    "shape": lambda: shape_study(PADS, presses=100, test=60, hidden=4, epochs=3),
    "multicontact": lambda: multicontact_study(PADS, presses=100, test=60, hidden=5, members=2, epochs=3),
    "scaling": lambda: scaling.scaling_study({"square": PADS["square"]}, grids=(2, 4), side=16),
    "sensitivity": lambda: sensitivity.sensitivity_study(PADS, radii=(0.6, 1.0), sides=(4,)),
}


def stop(done: int, total: int, name: str) -> None:
    if done == 2:
        raise KeyboardInterrupt


@pytest.mark.parametrize("name", LEAST)
def test_a_study_broken_off_ends_the_same(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drift, "MEMBERS", 2)
    monkeypatch.setattr(drift, "FILTERS", {each: drift.FILTERS[each] for each in (drift.RAW, drift.AS_PUBLISHED)})
    for module in (scaling, sensitivity):
        monkeypatch.setattr(module, "HIDDEN", 12)
        monkeypatch.setattr(module, "TEST", 50)
    monkeypatch.setattr(scaling, "EPOCHS", 8)
    monkeypatch.setattr(sensitivity, "SIDE", 8)
    monkeypatch.setattr(sensitivity, "MEMBERS", 2)
    whole = run(LEAST[name](), tmp_path / "whole", jobs=1)
    study = replace(LEAST[name](), draw=lambda document: Figure())
    with pytest.raises(KeyboardInterrupt):
        run(study, tmp_path / "broken", jobs=1, progress=stop)
    seen: list[int] = []
    again = run(study, tmp_path / "broken", resume=True, progress=lambda done, total, name: seen.append(done))
    assert seen[0] >= 2
    for row in (*whole["rows"], *again["rows"]):
        for seconds in ("seconds", "seconds_per_10000"):
            row.pop(seconds, None)
    assert again == whole
    stem = whole["format"].removeprefix("padforge-study-").removesuffix("/1")
    names = [f"{stem}.{end}" for end in ("csv", "json", "md", "png")]
    assert sorted(path.name for path in (tmp_path / "whole").iterdir()) == names
    assert (tmp_path / "whole" / f"{stem}.png").read_bytes().startswith(b"\x89PNG")
    json.dumps(whole, allow_nan=False)
    assert len({tuple(row) for row in whole["rows"]}) == 1
    lines = study_lines(whole)
    assert len(lines) == 1 + len(whole["rows"]) + 1 + len(whole["text"])
    assert all(any(label in line for line in lines) for label in ("square", "random") if label in str(whole["rows"]))


def one(
    name: str = "x", seed: int = 0, make: Callable[[], dict] = lambda: {"a": np.ones(1)}, tasks: str = "a"
) -> Study:
    conclude = lambda states: Findings([{"a": 1}], [])  # noqa: E731
    return Study(name, "X", {"seed": seed}, [Task(task, make) for task in tasks], conclude, lambda document: Figure())


def test_a_folder_in_which_a_study_is_at_work_or_one_of_other_settings_was_broken_off_is_refused(
    tmp_path: Path,
) -> None:
    def meet() -> dict:
        with pytest.raises(InputError, match="a x study is at work there"):
            run(one(), tmp_path)
        return {}

    run(one(make=meet), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.csv", "x.json", "x.md", "x.png"]
    with pytest.raises(KeyboardInterrupt):
        run(one(tasks="abc"), tmp_path, jobs=1, progress=stop)
    others = (one(seed=1, tasks="abc"), one(tasks="abcd"), one(tasks="bac"))
    for other, said in zip(others, ("begun with x seed 0, now 1", *["begun with x tasks"] * 2), strict=True):
        with pytest.raises(InputError, match=said):
            run(other, tmp_path, resume=True)


def test_a_lock_that_goes_while_it_is_taken_keeps_nobody_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who had it may come to the end between the opening of its file and the lock on that."""
    monkeypatch.setattr("padforge.design.common.files.lock", lambda file, busy: (tmp_path / ".x.lock").unlink())
    with pytest.raises(InputError, match="a x study is at work there"):
        run(one(), tmp_path)


def test_a_system_that_keeps_what_is_open_is_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows removes no lock while it is held."""
    unlink = Path.unlink

    def kept(path: Path, missing_ok: bool = False) -> None:
        if path.suffix == ".lock":
            raise PermissionError(13, "in use")
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", kept)
    run(one(), tmp_path)
    run(one(), tmp_path)
    assert (tmp_path / "x.json").exists()


def test_a_figure_that_fails_leaves_no_half_of_the_results(tmp_path: Path) -> None:
    def draw(document: object) -> Figure:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(replace(one(tasks=""), draw=draw), tmp_path)
    unwritable = Findings([{"a": 1}], [], {"map": object()})
    with pytest.raises(TypeError, match="JSON"):
        run(replace(one(tasks=""), conclude=lambda states: unwritable), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes as POSIX has them")
def test_a_lock_that_is_no_file_is_neither_waited_for_nor_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").touch()
    for make in (os.mkfifo, lambda lock: lock.symlink_to(tmp_path / "mine")):
        make(tmp_path / ".x.lock")
        with pytest.raises(InputError, match=r"\.x\.lock: is no file"):
            run(one(), tmp_path)
        (tmp_path / ".x.lock").unlink()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["robustness", "nowhere.json"], "nowhere.json: no such file, and none of square, optimised, random-N"),
        (["robustness", "square", "square"], "one called square is there already"),
        (["robustness", "square", "--presses", "1000"], "presses is 1000, allowed is a square number from 4"),
        (["robustness", "square@0"], "square@0: no such file"),
        (["scaling", "square", "--grids", "4,x"], "grids is '4,x', expected numbers from 2 to 256"),
        (["scaling", "square@3", "--grids", "4"], "grids has 4, expected multiples of 3"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(arguments: list[str], said: str, tmp_path: Path) -> None:
    assert said in refused("study", *arguments, "--out", "out", cwd=tmp_path)


@pytest.mark.slow
def test_an_interrupt_ends_at_once_and_keeps_what_was_finished(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "padforge", "study", "robustness", "square@6", "--presses", "256"]
    study = subprocess.Popen(
        [*command, "--out", str(out)],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    try:
        deadline = time.monotonic() + 120
        while not list(out.glob("robustness-unfinished/start_*.npz")) and time.monotonic() < deadline:
            time.sleep(0.1)
        study.send_signal(signal.SIGINT)
        begin = time.monotonic()
        _, said = study.communicate(timeout=60)
    finally:
        study.kill()
    assert study.returncode == 130
    assert said == "padforge: interrupted; --resume goes on from what was finished\n"
    assert time.monotonic() - begin < 30
    assert list(out.glob("robustness-unfinished/start_*.npz"))


def test_pads_are_told_by_file_or_by_name_and_described(tmp_path: Path) -> None:
    winding = Morphology.random(2, 3, 0)
    path = tmp_path / "mine" / "morphology.json"
    path.parent.mkdir()
    winding.save(path)
    assert load_pads(("square@3", "random-2@2", str(path)), seed=4) == {
        "square@3": Morphology.straight(3),
        "random-2@2": Morphology.random(2, 2, 4),
        "mine": winding,
    }
    paths = [tmp_path / f"{name}.json" for name in ("-_+x", "=1+1", "@mine")]
    for path in paths:
        winding.save(path)
    # no label is a formula of a spreadsheet
    assert list(load_pads([str(path) for path in paths], seed=0)) == ["x", "1+1", "mine"]
    told = described({"square": Morphology.straight(2), "wide": Morphology.straight((1, 3), (8.0, 15.0))})
    assert (told["square"]["grid"], told["square"]["pitch_mm"]) == (2, 11.25)
    assert (told["wide"]["fibres"], told["wide"]["pitch_mm"]) == ([1, 3], (8.0, 15.0))


def test_pads_are_searched_for_with_so_many_knots_by_either_method(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def remembered(pad: PadSettings, contact: Contact, settings: SearchSettings) -> SearchResult:
        asked.append((pad.grid, settings.method, settings.knots, settings.seed))
        return SearchResult(Morphology.straight(pad.grid), {}, [], "start 1", {})

    monkeypatch.setattr("padforge.design.optimize.search.search", remembered)
    names = ("optimised", "optimised-5", "genetic-1@2", "optimised-30@3")
    assert tuple(load_pads(names, seed=4)) == names
    assert asked == [(4, "descent", 21, 4), (4, "descent", 5, 4), (2, "genetic", 1, 4), (3, "descent", 30, 4)]
    with pytest.raises(InputError, match="genetic search knots: got 65"):
        load_pads(("genetic-65",), seed=0)
    for name in ("genetic", "optimised-0", "square-5"):
        with pytest.raises(InputError, match="none of square, optimised, random-N, optimised-N, genetic-N"):
            load_pads((name,), seed=0)
