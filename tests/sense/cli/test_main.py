import subprocess
import sys
from pathlib import Path

import pytest

from design import Morphology


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
        ("evaluate", "--model", "model", "rec", "--lost", "0,1"),
        ("locate", "--model", "absent", ".", "--out", "p.csv"),
    ):
        code, out, err = padforge_sense(*arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
    assert sorted(path.name for path in Path().iterdir()) == ["noise.csv", "noise.mat", "noise.txt", "pad.toml"]


def test_importing_takes_no_torch() -> None:
    modules = ("sense", "sense.cli.main", "sense.settings", "sense.localizer.localizer")
    code = (
        f"import importlib, sys\nfor name in {(*modules, 'sense.localizer.calibration.calibration')}:\n"
        "    importlib.import_module(name)\n"
        "    assert not {'torch', 'matplotlib'} & set(sys.modules), name\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


BARE = """
import re, sys
from importlib.abc import MetaPathFinder
from importlib.metadata import PackageNotFoundError, packages_distributions, requires

def name(text):
    return re.split("[^A-Za-z0-9._-]", text)[0].lower().replace("_", "-")

def with_needs(library, found):
    if library not in found:
        found.add(library)
        try:
            needs = requires(library) or ()
        except PackageNotFoundError:
            return found
        for need in needs:
            if "extra ==" not in need:
                with_needs(name(need), found)
    return found

KEPT = with_needs("padforge", set())
GONE = {module for module, by in packages_distributions().items() if not {name(each) for each in by} & KEPT}

class Bare(MetaPathFinder):
    def find_spec(self, fullname, path, target=None):
        if fullname.partition(".")[0] in GONE:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)

assert {"torch", "scipy", "matplotlib", "build123d", "shapely"} <= GONE and "numpy" not in GONE
sys.meta_path.insert(0, Bare())
from padforge import main
sys.argv[0] = "padforge"
main()
"""
"""padforge as it is without any of its extras."""


def bare(*words: str) -> tuple[int, str, str]:
    done = subprocess.run([sys.executable, "-c", BARE, *words], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


def test_places_are_found_without_what_only_other_jobs_need(model, monkeypatch) -> None:
    monkeypatch.chdir(model)
    code, out, err = bare("sense", "locate", "--model", ".", "recording")
    assert (code, err) == (0, "")
    assert out.endswith("-> places.csv\n")
    code, out, err = bare("sense", "evaluate", "--model", ".", "recording", "--lost", "1")
    assert (code, err) == (0, "")
    assert "mean" in out
    code, out, err = bare("sense", "live", "--model", ".", "--replay", "recording", "--speed", "1000", "--port", "0")
    assert code == 0, err
    code, out, err = bare("sense", "calibrate", "recording", "--out", "again")
    assert (code, out) == (2, "")
    assert err.startswith("padforge: this needs ")
    assert err.endswith("pip install 'padforge[train]'\n")
    code, _, err = bare("run", "--out", "pad")
    assert (code, err.count("\n")) == (2, 1)
    assert err.endswith("pip install 'padforge[design,cad,train]'\n")


def test_numbers_and_places_that_cannot_be_are_one_line(few) -> None:
    huge = "9" * 20
    for arguments, message in (
        (("locate", "--model", "model", "rec", "--mask", huge, "--out", "p.csv"), f"fibre {huge}: no such fibre"),
        (("evaluate", "--model", "model", "rec", "--lost", huge), f"{huge} is not in the range 0<=x<=8"),
        (("evaluate", "--model", "model", "rec", "--lost", ""), "'' is not a valid integer"),
        (("locate", "--model", "model", "rec", "--out", "pad.toml/p.csv"), "pad.toml/p.csv: cannot be written"),
        (("locate", "--model", "model", "rec", "--out", "model"), "directory"),
        (("calibrate", "rec", "--out", "pad.toml/model"), "pad.toml is a file, expected a folder"),
        (("calibrate", "pad.toml", "--out", "m"), "pad.toml: no recording, expected a folder"),
        (("calibrate", "absent", "--out", "m"), "absent: no recording, expected a folder with start.json"),
        (("record", "--out", "pad.toml/rec"), "pad.toml is a file, expected a folder"),
        (("import", "rec", "--out", "r"), "rec: ends in '', allowed are .mat"),
    ):
        code, out, err = few(*arguments)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert message in err


@pytest.mark.parametrize("asked", [("record", "--rig", "ur5"), ("record", "--through-drivers"), ("doctor",)])
def test_a_rig_where_none_can_run_is_one_line(
    padforge_sense, monkeypatch: pytest.MonkeyPatch, asked: tuple[str, ...]
) -> None:
    Morphology.straight(4).save("morphology.json")
    monkeypatch.setattr("platform.system", lambda: "Windows")
    code, out, err = padforge_sense(*asked, "--morphology", "morphology.json")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "a rig needs Linux or macOS, this is Windows; allowed here is --rig simulated" in err
