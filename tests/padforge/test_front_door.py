"""The front door: what it imports, how it fails, and what it never touches."""

import subprocess
import sys
from pathlib import Path

import pytest

from design import Contact, PadSettings, RulesSettings, SearchSettings, Spec
from tests.padforge.program import called, padforge


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


def test_a_recording_of_a_real_pad_is_never_replaced(tmp_path):
    recording = tmp_path / "out" / "pad" / "recording"
    recording.mkdir(parents=True)
    (recording / "start.json").write_text('{"format": "padforge-recording/1", "source": {"kind": "published"}}')
    result = called("run", cwd=tmp_path)
    assert result.code == 2
    assert "choose another --out" in result.err
    assert (recording / "start.json").exists()


def test_what_would_fail_late_is_refused_before_anything_is_done(tmp_path):
    (tmp_path / "pad.toml").write_text("[rig]\npresses = 3\n")
    result = called("run", cwd=tmp_path)
    assert (result.code, result.err.count("\n")) == (2, 1)
    assert "3 presses" in result.err
    (tmp_path / "pad.toml").write_text("[pad]\npitch_mm = 0.3\n")
    assert "ridge_width_mm" in called("run", cwd=tmp_path).err
    assert [path.name for path in tmp_path.iterdir()] == ["pad.toml"]


@pytest.mark.parametrize("content", ['{"format": "padforge-design/1"}', '{"format": "padforge-design/1", "terms": 3}'])
def test_a_report_on_damaged_files_names_them(tmp_path, content):
    (tmp_path / "design.json").write_text(content)
    result = called("report", ".", cwd=tmp_path)
    assert result.code == 2
    assert "design.json: not as padforge writes it" in result.err


def test_what_is_no_part_of_a_recording_is_never_removed(tmp_path):
    recording = tmp_path / "out" / "pad" / "recording"
    recording.mkdir(parents=True)
    (recording / "start.json").write_text('{"format": "padforge-recording/1", "source": {"kind": "simulated"}}')
    (recording / "notes.txt").write_text("of the day")
    result = called("run", cwd=tmp_path)
    assert result.code == 2
    assert "holds notes.txt, which is no part of a recording" in result.err
    assert (recording / "notes.txt").read_text() == "of the day"


def test_a_bare_command_shows_its_help(tmp_path):
    result = padforge(cwd=tmp_path)
    assert result.returncode == 2
    assert "Commands:\n" in result.stderr
    assert "Usage: padforge [OPTIONS]" in result.stderr


def test_init_writes_settings_that_every_command_reads(tmp_path):
    assert called("init", cwd=tmp_path).code == 0
    text = (tmp_path / "pad.toml").read_text()
    for section in ("pad", "contact", "search", "rules", "mould", "printer", "dispenser", "rig", "localizer"):
        assert f"[{section}]" in text
    again = called("init", cwd=tmp_path)
    assert again.code == 2
    assert "exists already" in again.err
    (tmp_path / "pad.toml").write_text(text.replace("steps = 1000", "steps = 0"))
    result = called("run", cwd=tmp_path)
    assert result.code == 2
    assert "pad.toml: [search] steps: got 0" in result.err


def test_init_writes_the_world_of_the_paper_if_asked(tmp_path):
    """And says which presets there are, where one is asked for that is none."""
    assert called("init", "--preset", "published", cwd=tmp_path).code == 0
    spec = Spec.load(tmp_path / "pad.toml")
    assert spec.section(PadSettings) == PadSettings(sensed_mm="fibres")
    assert spec.section(Contact) == Contact(radius=0.6, sides=30, weight="uniform", length="manhattan", reach=())
    assert spec.section(SearchSettings) == SearchSettings(noise=0.005, scatter=0.0)
    assert spec.section(RulesSettings) == RulesSettings(max_common_track_mm=None)
    assert called("init", "other.toml", "--preset", "mine", cwd=tmp_path).code == 2
    assert "published" in called("init", "--help", cwd=tmp_path).out


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
    result = called(*arguments, cwd=tmp_path)
    assert result.code == 2
    assert result.err.startswith("padforge: ")
    assert result.err.count("\n") == 1
    assert result.out == ""
    assert list(tmp_path.iterdir()) == []


def test_an_error_gives_no_orders_to_a_terminal(tmp_path):
    (tmp_path / "pad.toml").write_text('[pad]\n"\\u001b]0;title\\u0007\\u009b2J\\u202eä" = 1\n')
    result = called("run", cwd=tmp_path)
    assert result.code == 2
    assert r"[pad] \x1b]0;title\x07\x9b2J\u202eä: no such key" in result.err


def test_the_readme_names_files_that_are_there():
    root = Path(__file__).parents[2]
    text = (root / "README.md").read_text()
    for name in ("out/gallery/plan.png", "out/gallery/mould.png", "out/gallery/error_map.png", "constraints.txt"):
        assert name in text
        assert (root / name).exists()
