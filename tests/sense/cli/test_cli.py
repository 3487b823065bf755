"""`padforge sense` from the outside: files in, files out, one line for a mistake."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import padforge
from sense import Recording, export_csv

SPEC = "[localizer]\nmembers = 1\nhidden = 24\nlayers = 1\nepochs = 4\n[rig]\npresses = 60\n[pad]\ngrid = 2\n"


@pytest.fixture
def padforge_sense(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    """Run `padforge sense ...` in a folder with a pad.toml; gives exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    Path("pad.toml").write_text(SPEC)

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["padforge", "sense", *arguments])
        with pytest.raises(SystemExit) as caught:
            padforge.main()
        out, err = capsys.readouterr()
        return caught.value.code or 0, out, err  # type: ignore[return-value]

    return run


def test_from_recording_to_places(padforge_sense) -> None:
    assert padforge_sense("record", "--seed", "3", "--out", "rec")[0] == 0
    code, out, _ = padforge_sense("calibrate", "rec", "--test-split", "chronological", "--out", "model", "--json")
    assert code == 0
    document = json.loads(out)
    assert document == json.loads(Path("model/calibration.json").read_text())
    assert document["split"] == "chronological"
    assert document["test"]["press"] == list(range(51, 60))
    for name in ("error_map.png", "error_by_loss.png"):
        assert Path("model", name).read_bytes()[:4] == b"\x89PNG"
    code, out, _ = padforge_sense("evaluate", "--model", "model", "rec", "--lost", "0,3", "--json")
    assert code == 0
    assert json.loads(out)["errors"] == [document["errors"][0], document["errors"][3]]
    assert padforge_sense("locate", "--model", "model", "rec", "--mask", "0,3", "--out", "places.csv")[0] == 0
    table = np.genfromtxt("places.csv", delimiter=",", names=True)
    assert table.dtype.names == ("press", "x_mm", "y_mm", "sd_x_mm", "sd_y_mm", "r50_mm", "r90_mm")
    assert len(table) == 60
    assert (table["r50_mm"] < table["r90_mm"]).all()


def test_a_fibre_found_at_fault_is_left_out(padforge_sense) -> None:
    """400 presses; a fibre reads one value from the 300th on: health names it, and places do without it."""
    assert padforge_sense("record", "--presses", "400", "--out", "rec")[0] == 0
    assert padforge_sense("calibrate", "rec", "--out", "model")[0] == 0
    code, out, _ = padforge_sense("health", "--model", "model", "rec")
    assert (code, out.strip()) == (0, "sound fibres: 0, 1, 2, 3")
    whole = Recording.open("rec")
    readings = np.array(whole.readings)
    readings[whole.begun[300] - 15 :, 2] = readings[whole.begun[300] - 15, 2]
    Recording(readings, whole.times_s, whole.presses_mm, whole.begun, whole.lifted).save("stuck", {})
    code, out, _ = padforge_sense("health", "--model", "model", "stuck", "--json")
    assert code == 1
    (finding,) = json.loads(out)["findings"]
    assert finding["fibres"] == [2]
    assert 300 <= finding["press"] <= 320
    code, _, err = padforge_sense("locate", "--model", "model", "stuck", "--out", "places.csv")
    assert (code, err.count("\n")) == (0, 1)
    assert "left out from there on" in err
    padforge_sense("locate", "--model", "model", "stuck", "--mask", "2", "--out", "masked.csv")
    places, masked = (Path(name).read_text().splitlines() for name in ("places.csv", "masked.csv"))
    assert places[322:] == masked[322:]
    assert places[:200] != masked[:200]


def test_too_few_presses_for_health_are_said_to_be_and_leave_no_older_one(padforge_sense) -> None:
    padforge_sense("record", "--presses", "400", "--out", "rec")
    padforge_sense("calibrate", "rec", "--out", "model")
    assert Path("model/health.json").exists()
    padforge_sense("record", "--presses", "50", "--out", "short")
    code, _, err = padforge_sense("calibrate", "short", "--out", "model")
    assert (code, err.count("\n")) == (0, 1)
    assert "no watch is kept on the fibres' health" in err
    assert not list(Path("model").glob("health.*"))
    code, _, err = padforge_sense("health", "--model", "model", "short")
    assert (code, err.count("\n")) == (2, 1)


def test_csv_comes_in(padforge_sense, recording: Recording) -> None:
    export_csv(recording, "r.csv")
    assert padforge_sense("import", "r.csv", "--out", "rec")[0] == 0
    assert Recording.open("rec") == recording
    start = json.loads(Path("rec/start.json").read_text())
    assert start["format"] == "padforge-recording/1"
    assert set(start["provenance"]["inputs"]) == {"r.csv"}


def test_mistakes_are_one_line_and_leave_nothing(padforge_sense) -> None:
    Path("noise.mat").write_bytes(b"no matlab" * 100)
    Path("noise.csv").write_text("a,b\n1,2\n")
    Path("noise.txt").write_text("hello")
    for name in ("noise.mat", "noise.csv", "noise.txt", "absent.mat", "absent.csv"):
        code, out, err = padforge_sense("import", name, "--out", "rec")
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert name in err
        assert not Path("rec").exists()
    for arguments in (
        ("calibrate", ".", "--out", "model"),
        ("record", "--presses", "0", "--out", "rec"),
        ("evaluate", "--model", "model", "rec", "--lost", "a"),
        ("locate", "--model", "absent", ".", "--out", "p.csv"),
    ):
        code, out, err = padforge_sense(*arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
    assert sorted(path.name for path in Path().iterdir()) == ["noise.csv", "noise.mat", "noise.txt", "pad.toml"]


def test_a_recording_in_the_way_is_left_alone(padforge_sense) -> None:
    padforge_sense("record", "--out", "rec")
    before = Path("rec/readings.bin").read_bytes()
    code, _, err = padforge_sense("record", "--seed", "9", "--out", "rec")
    assert code == 2
    assert "never written over" in err
    assert Path("rec/readings.bin").read_bytes() == before


def test_interrupted_training_leaves_no_file(padforge_sense, monkeypatch: pytest.MonkeyPatch) -> None:
    import sense.localizer.calibration.training

    def interrupted(share: float) -> float:
        raise KeyboardInterrupt

    padforge_sense("record", "--out", "rec")
    monkeypatch.setattr(sense.localizer.calibration.training, "one_cycle", interrupted)
    code, _, err = padforge_sense("calibrate", "rec", "--out", "model")
    assert code == 130
    assert "interrupted" in err
    assert not Path("model").exists()


def test_a_torn_recording_is_said_to_be_one(padforge_sense) -> None:
    padforge_sense("record", "--out", "rec")
    content = Path("rec/readings.bin").read_bytes()
    Path("rec/readings.bin").write_bytes(content[:-100])
    code, _, err = padforge_sense("calibrate", "rec", "--out", "model")
    assert code == 0
    assert "last 1 presses are left out" in err


@pytest.mark.parametrize(
    "module",
    [
        "sense",
        "sense.cli.main",
        "sense.settings",
        "sense.localizer.localizer",
        "sense.localizer.calibration.calibration",
    ],
)
def test_importing_takes_no_torch(module: str) -> None:
    code = f"import sys, {module}; sys.exit('torch' in sys.modules or 'matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_calibration_that_fails_at_its_last_figure_changes_nothing(
    padforge_sense, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sense.report.calibration_figures

    padforge_sense("record", "--out", "rec")
    assert padforge_sense("calibrate", "rec", "--out", "model")[0] == 0
    before = {path.name: path.read_bytes() for path in Path("model").iterdir()}

    def full(document: object, path: Path) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(sense.report.calibration_figures, "draw_error_by_loss", full)
        code, _, err = padforge_sense("calibrate", "rec", "--seed", "5", "--out", "model")
    assert code == 2
    assert "model: cannot be written (No space left on device)" in err.splitlines()[-1]
    assert {path.name: path.read_bytes() for path in Path("model").iterdir()} == before
    assert padforge_sense("calibrate", "rec", "--seed", "5", "--out", "model")[0] == 0
    assert {path.name for path in Path("model").iterdir()} == set(before)
    assert Path("model/localizer.json").read_bytes() != before["localizer.json"]


def test_numbers_and_places_that_cannot_be_are_one_line(padforge_sense) -> None:
    padforge_sense("record", "--out", "rec")
    padforge_sense("calibrate", "rec", "--out", "model")
    huge = "9" * 20
    for arguments, message in (
        (("locate", "--model", "model", "rec", "--mask", huge, "--out", "p.csv"), f"lost fibre {huge}: no such fibre"),
        (
            ("evaluate", "--model", "model", "rec", "--lost", huge),
            f"lost is {huge}, allowed is a whole number",
        ),
        (("evaluate", "--model", "model", "rec", "--lost", ""), "lost names no number of fibres"),
        (("locate", "--model", "model", "rec", "--out", "pad.toml/p.csv"), "pad.toml/p.csv: cannot be written"),
        (("locate", "--model", "model", "rec", "--out", "model"), "directory"),
        (("calibrate", "rec", "--out", "pad.toml/model"), "pad.toml is a file, expected a folder"),
        (("calibrate", "pad.toml", "--out", "m"), "pad.toml: no recording, expected a folder"),
        (("calibrate", "absent", "--out", "m"), "absent: no recording, expected a folder with start.json"),
        (("record", "--out", "pad.toml/rec"), "pad.toml is a file, expected a folder"),
        (("import", "rec", "--out", "r"), "is a directory"),
    ):
        code, out, err = padforge_sense(*arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert message in err
