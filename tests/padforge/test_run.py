"""The whole chain on a small pad."""

import hashlib
import json
import math
import os
import shutil
import signal
import sys
import threading

import pytest
import trimesh
from safetensors.numpy import load_file

import padforge as front_door
from tests.padforge.program import called, padforge

SMALL = """
[pad]
grid = 2
[search]
knots = 2
starts = 1
steps = 10
lost = 1
[rig]
presses = 80
[localizer]
members = 1
hidden = 16
epochs = 4
lost = 1
"""


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chain")
    (folder / "pad.toml").write_text(SMALL)
    return folder, called("run", cwd=folder, limit_s=300)


def test_run_makes_everything(chain):
    folder, result = chain
    assert result.code == 0, result.out + result.err
    out = folder / "out" / "pad"
    names = {path.name for path in out.iterdir()}
    assert names >= {
        *("morphology.json", "design.json", "design.svg", "design.png"),
        *(
            "mould.stl",
            "mould.step",
            "tracks.svg",
            "mould.png",
            "tracks.png",
            "laying.md",
            "orientation.svg",
            "fabrication.json",
        ),
        *("recording", "localizer.safetensors", "localizer.json", "calibration.json", "contacts.json"),
        *("error_map.png", "error_by_loss.png", "report.html"),
    }
    mesh = trimesh.load_mesh(out / "mould.stl")
    assert mesh.is_watertight
    assert mesh.body_count == 1
    walls = 2 * (2 + 2 + 6 * math.tan(math.radians(2)))  # exits, walls and their lean
    assert mesh.extents[:2] == pytest.approx([3 * 11.25 + walls] * 2, abs=1e-3)
    assert load_file(out / "localizer.safetensors")
    errors = json.loads((out / "calibration.json").read_text())["errors"]
    assert [row["lost"] for row in errors] == [0, 1]
    for name in ("design", "fabrication", "calibration", "morphology", "localizer"):
        document = json.loads((out / f"{name}.json").read_text())
        assert document["format"] == f"padforge-{name}/{2 if name == 'localizer' else 1}"
        assert set(document["provenance"]) >= {"command", "seed", "versions", "inputs"}


def test_errors_are_told_under_other_contacts_than_the_one_believed(chain):
    folder, result = chain
    document = json.loads((folder / "out/pad/contacts.json").read_text())
    assert {row["pad"] for row in document["rows"]} == {"designed", "straight"}
    assert len(document["rows"]) == 8
    assert all(len(row["errors_mm"]) == 4 and 0 < min(row["errors_mm"]) < 20 for row in document["rows"])
    assert result.out.count("\ncontact: a small network on one reading of each fibre errs by ") == 1


def test_the_report_is_one_page_with_its_pictures(chain):
    text = (chain[0] / "out" / "pad" / "report.html").read_text()
    assert text.count('src="data:image/') == 6
    assert "http://" not in text.replace("http://www.w3.org", "")
    for heading in ("Fibres", "Mould", "Making the pad", "Recording", "Calibration", "Lost fibres", "Provenance"):
        assert f">{heading}</h2>" in text


def test_running_again_gives_the_same_pad(chain):
    """In a process of its own, as people run it."""
    folder, _ = chain
    before = (folder / "out/pad/morphology.json").read_bytes(), (folder / "out/pad/mould.stl").read_bytes()
    result = padforge("run", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert ((folder / "out/pad/morphology.json").read_bytes(), (folder / "out/pad/mould.stl").read_bytes()) == before


def test_an_interrupted_run_keeps_the_recording_of_the_one_before(chain, tmp_path):
    """Whose mould and recording are of another pad than what was found so far, as the report then tells."""
    folder = shutil.copytree(chain[0], tmp_path / "again")
    recording = folder / "out" / "pad" / "recording" / "readings.bin"
    before = recording.read_bytes()
    (folder / "long.toml").write_text(SMALL.replace("steps = 10", "steps = 1000000"))
    ended = threading.Event()

    def interrupt():
        while not any((folder / "out" / "pad" / "search").glob("start_*")):
            if ended.wait(0.05):
                return
        os.kill(os.getpid(), signal.SIGINT)

    watch = threading.Thread(target=interrupt)
    watch.start()
    result = called("run", "--spec", "long.toml", cwd=folder, limit_s=300)
    ended.set()
    watch.join()
    assert result.code == 130, result.out + result.err
    assert recording.read_bytes() == before
    result = called("report", cwd=folder)
    assert (result.code, result.err.count("\n")) == (1, 1)
    assert "fabrication (fabricate) is of another pad than the morphology.json here" in result.err


def test_the_front_door_in_one_process(chain, tmp_path, monkeypatch, capsys):
    """Settings, a page of what is there, and one line for what is not."""

    def ends(*arguments):
        monkeypatch.setattr(sys, "argv", ["padforge", *arguments])
        with pytest.raises(SystemExit) as end:
            front_door.main()
        return end.value.code

    monkeypatch.chdir(tmp_path)
    assert ends("init") == 0
    assert (tmp_path / "pad.toml").read_text(encoding="utf-8").count("[") >= 8
    capsys.readouterr()
    assert ends("init") == 2
    assert capsys.readouterr().err.count("\n") == 1
    shutil.copytree(chain[0] / "out" / "pad", tmp_path / "pad")
    page = tmp_path / "pad" / "report.html"
    pages = []
    for _ in range(2):
        page.unlink()
        assert ends("report", "pad") == 0
        pages.append(hashlib.sha256(page.read_bytes()).hexdigest())
    assert pages[0] == pages[1]
    assert ">Calibration</h2>" in page.read_text(encoding="utf-8")
