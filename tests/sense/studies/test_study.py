"""What every study shares: one at a time in a folder, all results or none."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from design import InputError
from sense.studies.study import Findings, Study, Task, _alone, run


def test_other_settings_are_no_help_to_a_study_broken_off(tmp_path: Path) -> None:
    kept = {"begun": 0}

    def task() -> dict:
        kept["begun"] += 1
        if kept["begun"] > 1:
            raise KeyboardInterrupt
        return {"a": np.ones(1)}

    def made(seed: int) -> Study:
        return Study(
            "x", "X", {"seed": seed}, [Task("a", task)] * 2, lambda states: Findings([], []), lambda document: Figure()
        )

    with pytest.raises(KeyboardInterrupt):
        run(made(0), tmp_path, jobs=1)
    with pytest.raises(InputError, match="begun with x seed 0, now 1"):
        run(made(1), tmp_path, resume=True)


def test_a_folder_in_which_the_same_study_is_at_work_is_refused(tmp_path: Path) -> None:
    def made(make: Callable[[], dict]) -> Study:
        return Study("x", "X", {}, [Task("a", make)], lambda states: Findings([{"a": 1}], []), lambda _: Figure())

    def meet() -> dict:
        with pytest.raises(InputError, match="a x study is at work there"):
            run(made(lambda: {}), tmp_path)
        return {}

    run(made(meet), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.csv", "x.json", "x.md", "x.png"]


def test_a_system_that_keeps_what_is_open_is_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows removes no lock while it is held."""

    def unlink(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "in use")

    study = Study("x", "X", {}, [], lambda states: Findings([{"a": 1}], []), lambda _: Figure())
    with monkeypatch.context() as windows, _alone(tmp_path, "x"):
        windows.setattr(Path, "unlink", unlink)
    run(study, tmp_path)
    assert (tmp_path / "x.json").exists()


def test_a_figure_that_fails_leaves_no_half_of_the_results(tmp_path: Path) -> None:
    def draw(document: object) -> Figure:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(Study("x", "X", {}, [], lambda states: Findings([{"a": 1}], []), draw), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes as POSIX has them")
def test_a_lock_that_is_no_file_is_neither_waited_for_nor_followed(tmp_path: Path) -> None:
    study = Study("x", "X", {}, [], lambda states: Findings([{"a": 1}], []), lambda _: Figure())
    (tmp_path / "mine").touch()
    for make in (os.mkfifo, lambda lock: lock.symlink_to(tmp_path / "mine")):
        make(tmp_path / ".x.lock")
        with pytest.raises(InputError, match=r"\.x\.lock: is no file"):
            run(study, tmp_path)
        (tmp_path / ".x.lock").unlink()


def test_a_lock_that_has_gone_keeps_nobody_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who had it may come to the end between the opening of its file and the lock on that."""

    def late(file: object, busy: str) -> None:
        (tmp_path / ".x.lock").unlink()

    monkeypatch.setattr("design.common.files.lock", late)
    with pytest.raises(InputError, match="a x study is at work there"), _alone(tmp_path, "x"):
        pass
