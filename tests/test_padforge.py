"""The front door: what it imports, how it fails, and the whole chain on a small pad."""

import hashlib
import json
import math
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import trimesh
from safetensors.numpy import load_file

import padforge as front_door

SMALL = """
[pad]
grid = 2
[search]
knots = 2
starts = 1
steps = 60
lost = 1
[rig]
presses = 80
[localizer]
members = 1
hidden = 16
epochs = 4
lost = 1
"""


def padforge(*arguments, cwd):
    command = [sys.executable, "-m", "padforge", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def loaded_by(code):
    """Names of the modules that `code` loads."""
    script = f"import sys\ntry:\n  {code}\nexcept SystemExit: pass\nprint('\\n@', *sys.modules)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(result.stdout.rsplit("@", 1)[1].split())


def test_help_loads_no_heavy_library():
    modules = loaded_by("sys.argv = ['padforge', '--help']; import padforge; padforge.main()")
    assert not modules & {"torch", "build123d", "OCP", "numpy", "numba", "pydantic", "matplotlib", "shapely"}


def test_design_works_without_torch_and_without_cad():
    modules = loaded_by("import design; design.signals(design.Morphology.straight(1), [[1, 1]])")
    assert "numba" in modules
    assert not modules & {"torch", "build123d", "OCP"}


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chain")
    (folder / "pad.toml").write_text(SMALL)
    return folder, padforge("run", cwd=folder)


def test_run_makes_everything(chain):
    folder, result = chain
    assert result.returncode == 0, result.stdout + result.stderr
    out = folder / "out" / "pad"
    names = {path.name for path in out.iterdir()}
    assert names >= {
        *("morphology.json", "design.json", "design.svg", "design.png"),
        *("mould.stl", "mould.step", "tracks.svg", "mould.png", "tracks.png", "laying.md", "fabrication.json"),
        *("recording", "localizer.safetensors", "localizer.json", "calibration.json"),
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


def test_the_report_is_one_page_with_its_pictures(chain):
    text = (chain[0] / "out" / "pad" / "report.html").read_text()
    assert text.count('src="data:image/') == 5
    assert "http://" not in text.replace("http://www.w3.org", "")
    for heading in ("Fibres", "Mould", "Making the pad", "Recording", "Calibration", "Robustness", "Provenance"):
        assert f">{heading}</h2>" in text


def test_running_again_gives_the_same_pad(chain):
    folder, _ = chain
    before = (folder / "out/pad/morphology.json").read_bytes(), (folder / "out/pad/mould.stl").read_bytes()
    result = padforge("run", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert ((folder / "out/pad/morphology.json").read_bytes(), (folder / "out/pad/mould.stl").read_bytes()) == before


def test_a_recording_of_a_real_pad_is_never_replaced(tmp_path):
    recording = tmp_path / "out" / "pad" / "recording"
    recording.mkdir(parents=True)
    (recording / "start.json").write_text('{"format": "padforge-recording/1", "source": {"kind": "published"}}')
    result = padforge("run", cwd=tmp_path)
    assert result.returncode == 2
    assert "choose another --out" in result.stderr
    assert (recording / "start.json").exists()


def test_what_would_fail_late_is_refused_before_anything_is_done(tmp_path):
    (tmp_path / "pad.toml").write_text("[rig]\npresses = 3\n")
    result = padforge("run", cwd=tmp_path)
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)
    assert "3 presses" in result.stderr
    (tmp_path / "pad.toml").write_text("[pad]\npitch_mm = 0.3\n")
    assert "ridge_width_mm" in padforge("run", cwd=tmp_path).stderr
    assert [path.name for path in tmp_path.iterdir()] == ["pad.toml"]


def test_an_interrupted_run_keeps_the_recording_of_the_one_before(chain):
    folder, _ = chain
    recording = folder / "out" / "pad" / "recording" / "readings.bin"
    before = recording.read_bytes()
    (folder / "long.toml").write_text(SMALL.replace("steps = 60", "steps = 1000000"))
    process = subprocess.Popen([sys.executable, "-m", "padforge", "run", "--spec", "long.toml"], cwd=folder)
    time.sleep(12)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert recording.read_bytes() == before


@pytest.mark.parametrize("content", ['{"format": "padforge-design/1"}', '{"format": "padforge-design/1", "terms": 3}'])
def test_a_report_on_damaged_files_names_them(tmp_path, content):
    (tmp_path / "design.json").write_text(content)
    result = padforge("report", ".", cwd=tmp_path)
    assert result.returncode == 2
    assert "design.json: not as padforge writes it" in result.stderr


def test_what_is_no_part_of_a_recording_is_never_removed(tmp_path):
    recording = tmp_path / "out" / "pad" / "recording"
    recording.mkdir(parents=True)
    (recording / "start.json").write_text('{"format": "padforge-recording/1", "source": {"kind": "simulated"}}')
    (recording / "notes.txt").write_text("of the day")
    result = padforge("run", cwd=tmp_path)
    assert result.returncode == 2
    assert "holds notes.txt, which is no part of a recording" in result.stderr
    assert (recording / "notes.txt").read_text() == "of the day"


def test_a_bare_command_shows_its_help(tmp_path):
    result = padforge(cwd=tmp_path)
    assert result.returncode == 2
    assert "Commands:\n" in result.stderr
    assert "Usage: padforge [OPTIONS]" in result.stderr


def test_init_writes_settings_that_every_command_reads(tmp_path):
    assert padforge("init", cwd=tmp_path).returncode == 0
    text = (tmp_path / "pad.toml").read_text()
    for section in ("pad", "contact", "search", "rules", "mould", "printer", "rig", "localizer"):
        assert f"[{section}]" in text
    again = padforge("init", cwd=tmp_path)
    assert again.returncode == 2
    assert "exists already" in again.stderr
    (tmp_path / "pad.toml").write_text(text.replace("steps = 1000", "steps = 0"))
    result = padforge("run", cwd=tmp_path)
    assert result.returncode == 2
    assert "pad.toml: [search] steps: got 0" in result.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["design", "check", "none.json"],
        ["design", "--knots", "0"],
        ["design", "--no-such-option"],
        ["fabricate", "none.mat"],
        ["fabricate", "check", "none.stl"],
        ["sense", "import", "none.mat"],
        ["sense", "calibrate", "none"],
        ["sense", "evaluate", "--model", "none", "none"],
        ["report", "none"],
        ["no-such-command"],
        ["run", "--spec", "none.toml"],
    ],
)
def test_mistakes_end_in_one_line_and_exit_2(tmp_path, arguments):
    result = padforge(*arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith("padforge: ")
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_the_readme_names_files_that_are_there():
    root = Path(__file__).parents[1]
    text = (root / "README.md").read_text()
    for name in ("out/gallery/plan.png", "out/gallery/mould.png", "out/gallery/error_map.png", "constraints.txt"):
        assert name in text
        assert (root / name).exists()


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
