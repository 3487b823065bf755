import json
import os
import re
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from padforge.common.parallel import Checkpoints
from padforge.common.settings import Spec
from padforge.design import Contact, SearchSettings, Violation
from padforge.design.contact_set import judged_contacts
from padforge.design.design_run import load_result
from padforge.design.report import press_sections
from padforge.run import Run
from padforge.sense.recording.recording import Recording
from padforge.sense.report.calibration import calibrate_into
from tests.helpers.door import called, refused
from tests.helpers.folders import files_in
from tests.helpers.golden import Golden
from tests.helpers.less import compare_little, small_pictures
from tests.padforge.conftest import SMALL

ALL = "design, mould, recording, contacts, calibration"
VOLATILE = ("design.json", "run.json", "report.html")
"""With seconds in them, and digests of these."""


def digests(folder: Path, *without: str) -> dict[str, str]:
    found = files_in(folder / "out" / "pad").items()
    return {name: sha256(content).hexdigest() for name, content in found if name not in without}


def resumed(folder: Path, *more: str) -> str:
    """Go on; what is said to be kept of the earlier run."""
    ended = called("run", "--resume", *more, cwd=folder)
    assert ended.code == 0, ended
    kept = [line for line in ended.err.splitlines() if "reused from an earlier run" in line]
    return kept[0].partition("earlier run: ")[2] if kept else ""


def breaks(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_run_makes_everything(finished: tuple[Path, str], golden: Golden) -> None:
    """Whatever decimals so short a search and training come to."""
    folder, printed = finished
    out = folder / "out" / "pad"
    lines = [printed, *sorted(files_in(out))]
    for path in sorted(out.rglob("*.json")):
        document = json.loads(path.read_text())
        origin = document.get("provenance", {})
        made = f"{origin.get('command')} of {sorted(origin.get('inputs', ()))}, seed {origin.get('seed')}"
        lines.append(f"{path.name}: {document['format']}, {made}")
    text = (out / "report.html").read_text()
    lines += re.findall(r"<h[23][^>]*>(.*?)</h", text)
    golden("padforge/run.txt", "\n".join(lines), forget=[r"\d+\.\d+", "(?<=or better: ).*"])
    assert text.count('src="data:image/') == 9
    assert [row["n_failed"] for row in json.loads((out / "calibration.json").read_text())["errors"]] == [0, 1]
    rows = json.loads((out / "contacts.json").read_text())["rows"]
    assert len(rows) == 2 * len(judged_contacts(Contact(), SearchSettings()))
    assert all(0 < min(row["errors_mm"]) < 20 for row in rows)


def test_resume_reuses_finished_run_of_the_same_search(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it nothing is reused, nor does anything of an earlier run count as finished once it has begun."""
    before = digests(folder, "report.html")
    assert resumed(folder) == ALL
    assert digests(folder, "report.html") == before
    note = folder / "out" / "pad" / "run.json"
    kept = note.read_bytes()
    monkeypatch.setattr("padforge.design.design_run.run_design", breaks)
    assert called("run", "--resume", cwd=folder).code == 0
    assert called("run", "--resume", "--seed", "1", cwd=folder).code == 130
    note.write_bytes(kept)
    assert called("run", cwd=folder).code == 130
    assert not note.exists()


def test_resume_repeats_stages_of_changed_settings(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One setting of each section after another, the first of which really changes what is made; and of the seed."""
    out, text, before, asked = folder / "out" / "pad", SMALL, digests(folder), list[Any]()

    def read(name: str) -> dict[str, Any]:
        return json.loads((out / f"{name}.json").read_text())

    as_before: dict[str, Callable[[], Any]] = {
        "design.design_run.run_design": lambda: (None, load_result(out)),
        "fabricate.build": lambda: SimpleNamespace(to_dict=lambda: read("fabrication")),
        "sense.rig.operation.record_simulated": lambda: Recording.open(out / "recording"),
        "design.contact_comparison.compare_contacts": lambda: read("contacts"),
        "sense.report.calibration.calibrate_into": lambda: read("calibration"),
    }
    for section, change, *repeated in (
        ("mould", "wall_mm = 3", "mould"),
        ("pad", 'leads = "one side"', "design", "mould", "recording", "contacts"),
        ("contact", "depth_mm = 2", "design", "recording", "contacts"),
        ("search", "noise = 0.05", "design", "contacts"),
        ("rules", "border_mm = 1", "design", "mould"),
        ("printer", "bed_mm = [200, 200, 200]", "mould"),
        ("silicone", "modulus_kpa = 70", "mould"),
        ("fibre", "ohm_per_mm = 10", "mould"),
        ("dispenser", "feed_mm_s = 5", "mould"),
        ("rig", "noise_mv = 3", "recording"),
        ("localizer", "seed = 1", "calibration"),
    ):
        head = f"[{section}]\n"
        text = text.replace(head, f"{head}{change}\n") if head in text else f"{text}{head}{change}\n"
        (folder / "pad.toml").write_text(text)
        assert resumed(folder) == ", ".join(stage for stage in ALL.split(", ") if stage not in repeated), section
        if section == "mould":
            after = digests(folder)
            assert [after[name] == before[name] for name in ("mould.stl", "recording/readings.bin")] == [False, True]
            for name, result in as_before.items():
                monkeypatch.setattr(f"padforge.{name}", lambda *ask, make=result, **_: asked.append(ask) or make())
    assert resumed(folder, "--formats", "stl") == "design, recording, contacts, calibration"
    asked.clear()
    assert resumed(folder, "--seed", "7") == ""
    design, recording, contacts, calibration, _ = asked
    assert (design[2], recording[3], contacts[3], calibration[2].seed) == ({"seed": 7}, {"seed": 7}, 7, 7)


def test_resume_repeats_stages_of_changed_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def kept() -> dict[str, str]:
        blank = (".png", "orientation.svg", "crossing.svg", "fabrication.json")  # pictures, and digests of them
        return {name: digest for name, digest in digests(folder, *VOLATILE).items() if not name.endswith(blank)}

    before = kept()
    (folder / "out" / "pad" / "mould.stl").unlink()
    (folder / "out" / "pad" / "localizer.safetensors").write_bytes(b"torn")
    (folder / "out" / "pad" / "recording" / "readings.bin").write_bytes(b"")
    assert resumed(folder) == "design, contacts"
    assert kept() == before
    (folder / "pad.toml").write_text(SMALL.replace("presses = 60", 'plan = "plan.csv"'))
    monkeypatch.setattr("padforge.sense.report.calibration.calibrate_into", breaks)
    for x_mm in (1, 2):
        (folder / "plan.csv").write_text("x_mm,y_mm\n" + 60 * f"{x_mm},0\n")
        assert called("run", "--resume", cwd=folder).code == 130
        assert set(Recording.open(folder / "out" / "pad" / "recording").presses_mm[:, 0]) == {x_mm}


@pytest.mark.slow
def test_resume_continues_interrupted_search_and_calibration(finished, tmp_path, monkeypatch) -> None:
    """And a run broken off twice gives the same files as one that was not."""
    (tmp_path / "pad.toml").write_text(SMALL)
    compare_little(monkeypatch)
    small_pictures(monkeypatch)
    save, begin, found = Checkpoints.save, Checkpoints.begin, []

    def save_and_break(kept: Checkpoints, start: int, state: dict) -> None:
        save(kept, start, state)
        raise SystemExit(9)

    def begin_and_note(kept: Checkpoints, resume: bool) -> dict:
        found.append(begin(kept, resume))
        return found[-1]

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", save_and_break)
        assert called("run", cwd=tmp_path).code == 9
    assert not (tmp_path / "out" / "pad" / "morphology.json").exists()
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "begin", begin_and_note)
        patch.setattr("padforge.sense.report.calibration.calibrate_into", breaks)
        ended = called("run", "--resume", cwd=tmp_path)
    assert (ended.code, "reused from an earlier run" in ended.err) == (130, False), ended
    assert [sorted(states) for states in found] == [[0]]
    assert not (tmp_path / "out" / "pad" / "search").exists()
    assert resumed(tmp_path) == "design, recording, contacts"
    assert digests(tmp_path, *VOLATILE) == digests(finished[0], *VOLATILE)


def test_interrupted_run_keeps_earlier_recording(folder: Path) -> None:
    """Whose mould and recording are of another pad than what was found so far, as the report then tells."""
    recording = folder / "out" / "pad" / "recording" / "readings.bin"
    before = recording.read_bytes()
    (folder / "long.toml").write_text(SMALL.replace("steps = 10", "steps = 1000000"))
    ended = threading.Event()

    def interrupt() -> None:
        while not any((folder / "out" / "pad" / "search").glob("start_*")):
            if ended.wait(0.05):
                return
        os.kill(os.getpid(), signal.SIGINT)

    watch = threading.Thread(target=interrupt)
    watch.start()
    result = called("run", "--spec", "long.toml", cwd=folder)
    ended.set()
    watch.join()
    assert result.code == 130, result.out + result.err
    assert recording.read_bytes() == before
    result = called("report", cwd=folder)
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert "fabrication (fabricate) is of another pad than the morphology.json here" in result.err


def test_run_exits_1_on_a_failed_check_or_a_broken_rule_and_writes_all_nevertheless(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(settings: str, said: str) -> int:
        (folder / "pad.toml").write_text(SMALL + settings)
        ended = called("run", "--resume", "--formats", "svg", cwd=folder)
        assert said in ended.out
        assert ended.out.splitlines()[-1] == f"report: {Path('out/pad/report.html')}"
        return ended.code

    assert ended("[mould]\nfloor_mm = 2.05\n", "warn layers: ") == 0
    assert ended("[printer]\nbed_mm = [30, 30, 30]\n", "FAIL bed: ") == 1
    broken = replace(load_result(folder / "out" / "pad"), violations=[Violation("max_length_mm", (1,), 600.0, 500.0)])
    monkeypatch.setattr("padforge.design.design_run.load_result", lambda _: broken)
    assert ended("", "broken: max_length_mm: fibre 1: ") == 1


@pytest.mark.slow
def test_time_budget_covers_all_stages(tmp_path: Path, brief: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search and a training of hours, which end, and what they left is finished."""
    monkeypatch.setattr("padforge.run.RESERVE_S", 1.0)
    monkeypatch.setattr("padforge.sense.localizer.training.MIN_STEPS", 1)
    text = SMALL.replace("steps = 10", "steps = 1000000").replace("epochs = 4", "epochs = 9999")
    (tmp_path / "pad.toml").write_text(text)
    run, given = calibrate_into, []

    def noted(*arguments, **more):
        given.append(more["time_budget"])
        return run(*arguments, **more)

    monkeypatch.setattr("padforge.sense.report.calibration.calibrate_into", noted)
    words = ("run", "--time-budget", "8", "--formats", "stl")
    ended = called(*words, cwd=tmp_path)
    assert ended.code in (0, 1), ended
    assert "(out of time: the best so far)" in ended.out
    assert len(given) == 1
    assert 0 < given[0] < 7
    assert "not converged" in ended.out
    again = called(*words, "--resume", cwd=tmp_path)
    assert f"earlier run: {ALL}" in again.err, again


def test_run_trains_nothing_in_a_time_budget_that_is_spent(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A part of it counts from the beginning of the run, whatever has passed of it."""
    begun = Run(Spec.load(None), folder, time_budget=100, started_s=time.monotonic() - 30)
    assert begun.remaining_s(0.5) == pytest.approx(20, abs=1)
    assert begun.remaining_s(reserve_s=25) == pytest.approx(45, abs=1)
    monkeypatch.setattr("padforge.run.RESERVE_S", 4.999)
    (folder / "out" / "pad" / "localizer.json").unlink()
    said = "--time-budget: got 5 s, nothing of it remains for the training; continue with --resume and more"
    ended = called("run", "--resume", "--time-budget", "5", cwd=folder)
    assert (ended.code, ended.err) == (2, f"padforge: {said}\n"), ended
    assert not (folder / "out" / "pad" / "localizer.json").exists()


@pytest.mark.parametrize("stages", ["", ', "stages": {"sense": {"files": 3}}'])
def test_damaged_note_is_refused(folder: Path, stages: str) -> None:
    """Before a stage is done again, whichever stage's entry is damaged."""
    (folder / "out" / "pad" / "run.json").write_text(f'{{"format": "padforge-run/1"{stages}}}')
    assert "run.json: " in refused("run", "--resume", cwd=folder)


def test_report_is_deterministic(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("padforge.design.report.press_sections", press_sections)  # every report draws its own
    page = folder / "out" / "pad" / "report.html"
    pages = []
    for _ in range(2):
        page.unlink()
        assert called("report", ".", cwd=page.parent).code == 0
        pages.append(page.read_bytes())
    assert pages[0] == pages[1]
    assert b"<title>Pad report: pad</title>" in pages[0]
