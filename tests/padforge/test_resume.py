"""A run that goes on where it was broken off, in a time that is given to all of it."""

import json
import os
import shutil
import time
from pathlib import Path

import pytest

import padforge.running
import sense.cli.calibration
from design.common.checkpoints import Checkpoints
from design.common.files import sha256
from sense.recordings.recorder import Recorder
from tests.padforge.program import called
from tests.padforge.test_run import SMALL

ALL = "fibres, mould, recording, contacts, calibration"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which a run has come to its end."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "pad.toml").write_text(SMALL)
    ended = called("run", "--formats", "stl,svg", cwd=folder, limit_s=300)
    assert ended.code == 0, ended
    return folder


@pytest.fixture
def folder(finished: Path, tmp_path: Path) -> Path:
    """The same, to go on in."""
    return shutil.copytree(finished, tmp_path / "run")


def resumed(folder: Path, *more: str) -> str:
    """Go on; what is said to be kept of the earlier run."""
    ended = called("run", "--resume", "--formats", "svg,stl", *more, cwd=folder, limit_s=300)
    assert ended.code == 0, ended
    kept = [line for line in ended.err.splitlines() if "kept as an earlier run has made it" in line]
    return kept[0].partition("made it: ")[2] if kept else ""


def digests(folder: Path, *without: str) -> dict[str, str]:
    out = folder / "out" / "pad"
    return {path.name: sha256(path) for path in out.iterdir() if path.name not in without}


def breaks(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_of_a_finished_run_nothing_is_done_anew(folder: Path) -> None:
    before = digests(folder)
    assert not {"mould.step", "mould.png"} & before.keys()
    assert resumed(folder) == ALL
    assert digests(folder) == before


def test_without_resume_all_is_done_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing of an earlier run counts as finished once it has begun."""
    monkeypatch.setattr(padforge.running, "_designed", breaks)
    assert called("run", cwd=folder).code == 130
    assert not (folder / "out" / "pad" / "run.json").exists()


@pytest.mark.parametrize(
    ("old", "new", "kept"),
    [
        ("epochs = 4", "epochs = 5", "fibres, mould, recording, contacts"),
        ("presses = 80", "presses = 90", "fibres, mould, contacts"),
        ("[rig]", "[mould]\nwall_mm = 3\n[rig]", "fibres, recording, contacts, calibration"),
    ],
)
def test_what_was_made_of_other_settings_is_made_anew(folder: Path, old: str, new: str, kept: str) -> None:
    before = digests(folder)
    (folder / "pad.toml").write_text(SMALL.replace(old, new))
    assert resumed(folder) == kept
    assert (digests(folder)["mould.stl"] == before["mould.stl"]) == ("mould" in kept)
    assert (digests(folder)["recording"] == before["recording"]) == ("recording" in kept)


def test_a_file_that_is_gone_or_another_one_is_made_anew(folder: Path) -> None:
    before = digests(folder)
    (folder / "out" / "pad" / "mould.stl").unlink()
    (folder / "out" / "pad" / "localizer.safetensors").write_bytes(b"torn")
    (folder / "out" / "pad" / "recording" / "readings.bin").write_bytes(b"")
    assert resumed(folder) == "fibres, contacts"
    assert digests(folder) == before


def test_a_broken_off_calibration_is_all_that_is_done_again(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(finished / "pad.toml", tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(sense.cli.calibration, "run_calibration", breaks)
        assert called("run", "--formats", "stl,svg", cwd=tmp_path, limit_s=300).code == 130
    assert resumed(tmp_path) == "fibres, mould, recording, contacts"
    volatile = ("design.json", "run.json", "report.html")  # with seconds in them, and digests of these
    assert digests(tmp_path, *volatile) == digests(finished, *volatile)


def test_a_search_goes_on_from_its_states(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(finished / "pad.toml", tmp_path)
    save, begin, found = Checkpoints.save, Checkpoints.begin, []

    def save_and_break(kept: Checkpoints, start: int, state: dict) -> None:
        save(kept, start, state)
        raise SystemExit(9)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", save_and_break)
        assert called("run", cwd=tmp_path, limit_s=300).code == 9
    assert not (tmp_path / "out" / "pad" / "morphology.json").exists()

    def begun(kept: Checkpoints, resume: bool) -> dict:
        found.append(begin(kept, resume))
        return found[-1]

    monkeypatch.setattr(Checkpoints, "begin", begun)
    assert resumed(tmp_path) == ""
    assert [sorted(states) for states in found] == [[0]]
    assert digests(tmp_path)["morphology.json"] == digests(finished)["morphology.json"]
    assert not (tmp_path / "out" / "pad" / "search").exists()


def test_a_time_budget_is_for_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search and a training of hours end in time, and what they left is finished."""
    (tmp_path / "pad.toml").write_text(
        SMALL.replace("steps = 10", "steps = 1000000").replace("epochs = 4", "epochs = 9999")
    )
    run, given = sense.cli.calibration.run_calibration, []

    def noted(*arguments, **more):
        given.append(arguments[-1])
        return run(*arguments, **more)

    monkeypatch.setattr(sense.cli.calibration, "run_calibration", noted)
    begin = time.monotonic()
    ended = called("run", "--time-budget", "16", "--formats", "stl,svg", cwd=tmp_path, limit_s=300)
    assert ended.code in (0, 1), ended
    assert time.monotonic() - begin < 45
    assert "(out of time: the best so far)" in ended.out
    assert len(given) == 1
    assert 0 <= given[0] < 8
    again = called("run", "--resume", "--time-budget", "16", "--formats", "stl,svg", cwd=tmp_path, limit_s=300)
    assert f"made it: {ALL}" in again.err, again


@pytest.mark.parametrize(
    ("more", "settings", "told"),
    [
        (("--formats", "stl,obj"), "", "formats: got 'obj'"),
        (("--time-budget", "9"), '[localizer]\nmethod = "published"\n', "method: got published with --time-budget"),
    ],
)
def test_what_cannot_be_is_refused_before_the_search(tmp_path: Path, more: tuple, settings: str, told: str) -> None:
    (tmp_path / "pad.toml").write_text(settings)
    ended = called("run", *more, cwd=tmp_path)
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert told in ended.err
    assert [path.name for path in tmp_path.iterdir()] == ["pad.toml"]


def refused(folder: Path) -> str:
    """What a run says of the recording that is in its way; nothing is changed by it."""
    before = {path: path.lstat().st_mtime_ns for path in folder.rglob("*")}
    ended = called("run", cwd=folder)
    assert (ended.code, ended.err.count("\n")) == (2, 1), ended
    assert {path: path.lstat().st_mtime_ns for path in folder.rglob("*")} == before
    return ended.err


def test_a_recording_that_cannot_give_way_is_told_before_the_search(folder: Path) -> None:
    recording = folder / "out" / "pad" / "recording"
    with Recorder.resume(recording):
        assert "another program is recording into it" in refused(folder)
    journal = recording / "journal.ndjson"
    elsewhere = journal.rename(folder / "journal")
    journal.mkdir()
    (journal / "thesis").touch()
    assert "holds journal.ndjson, which is no part of a recording" in refused(folder)
    (journal / "thesis").unlink()
    journal.rmdir()
    journal.symlink_to(elsewhere)
    assert "holds journal.ndjson, which is no part of a recording" in refused(folder)
    journal.unlink()
    recording.rename(folder / "recording")
    recording.symlink_to(folder / "recording")
    assert "is a link" in refused(folder)
    recording.unlink()
    recording.touch()
    assert "is no folder" in refused(folder)
    assert (folder / "recording" / "readings.bin").stat().st_size > 0


def test_a_note_that_is_none_of_padforge_is_named(folder: Path) -> None:
    for content in (
        "{}",
        json.dumps({"format": "padforge-run/1"}),
        json.dumps({"format": "padforge-run/1", "stages": 3}),
    ):
        (folder / "out" / "pad" / "run.json").write_text(content)
        ended = called("run", "--resume", cwd=folder)
        assert (ended.code, ended.err.count("\n")) == (2, 1)
        assert "run.json: " in ended.err


def test_fibres_of_another_search_are_not_kept(folder: Path) -> None:
    """One that was made in the folder meanwhile, with other settings than the run has."""
    before = digests(folder)
    (folder / "other.toml").write_text(SMALL.replace("starts = 1", "starts = 1\nseed = 5"))
    assert called("design", "--spec", "other.toml", "--force", cwd=folder).code == 0
    assert digests(folder)["morphology.json"] != before["morphology.json"]
    assert resumed(folder) == "mould, recording, contacts, calibration"
    assert digests(folder)["morphology.json"] == before["morphology.json"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes as POSIX has them")
def test_a_pipe_in_place_of_a_result_is_not_waited_for(folder: Path) -> None:
    (folder / "out" / "pad" / "mould.stl").unlink()
    os.mkfifo(folder / "out" / "pad" / "mould.stl")
    ended = called("run", "--resume", "--formats", "svg,stl", cwd=folder)
    assert (ended.code, ended.err.count("\n")) == (2, 1), ended
    assert "mould.stl: " in ended.err
