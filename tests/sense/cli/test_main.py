"""Commands on full disks and without libraries, which leave all or nothing, and what a terminal types."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from padforge import sense
from padforge.sense import Recording
from padforge.sense.cli.options import typed_keys
from tests.helpers.folders import files_in
from tests.helpers.full_disk import full_disk
from tests.sense.conftest import first_presses

BARE = """
import io, json, re, sys
from contextlib import redirect_stderr, redirect_stdout
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

INSTALLED = with_needs("padforge", set())
MISSING = {module for module, by in packages_distributions().items() if not {name(each) for each in by} & INSTALLED}

class Bare(MetaPathFinder):
    def find_spec(self, fullname, path, target=None):
        if fullname.partition(".")[0] in MISSING:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)

assert {"torch", "matplotlib", "build123d", "shapely"} <= MISSING and "numpy" not in MISSING
sys.meta_path.insert(0, Bare())
from padforge.cli import main
ends = []
for line in sys.argv[1:]:
    sys.argv, out, err = ["padforge", *line.split()], io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            ends.append((end.code or 0, out.getvalue(), err.getvalue()))
print(json.dumps(ends))
"""
"""padforge as it is without any of its extras: runs command lines, and prints their exit codes, stdout and stderr."""


def test_locate_works_without_optional_libraries(few) -> None:
    first_presses(Recording.open("rec"), 3).save("short", {})
    lines = (
        "sense locate --model model rec",
        "sense live --model model --replay short --speed 1e6 --port 0",
        "sense calibrate rec --out again",
        "sense deploy --model model localizer.onnx",
        "run --out pad",
    )
    done = subprocess.run([sys.executable, "-c", BARE, *lines], capture_output=True, text=True, check=True)
    located, shown, calibrated, deployed, run = json.loads(done.stdout)
    assert located == [0, "60 positions -> places.csv\n", ""]
    assert shown[0] == 0, shown[2]
    assert calibrated[:2] == [2, ""]
    assert calibrated[2].startswith("padforge: this needs ")
    assert calibrated[2].endswith("pip install 'padforge[design]'\n")
    assert deployed == [2, "", "padforge: this needs onnx, which is not installed: pip install 'padforge[deploy]'\n"]
    assert (run[0], run[2].count("\n")) == (2, 1)
    assert run[2].endswith("pip install 'padforge[design,cad]'\n")


@pytest.mark.skipif(os.name != "posix", reason="keys are read of POSIX terminals alone")
def test_typed_keys_reads_keys_and_restores_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    import termios

    ours, theirs = os.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        before = termios.tcgetattr(terminal)
        with typed_keys() as typed:
            assert typed() == ""
            os.write(ours, b"sb")  # no newline
            assert typed() == "sb"
            assert typed() == ""
        assert termios.tcgetattr(terminal) == before
    os.close(ours)
    with Path(os.devnull).open() as nothing:  # no terminal
        monkeypatch.setattr(sys, "stdin", nothing)
        with typed_keys() as typed:
            assert typed() == ""


COMMANDS = {
    "record": "record --out out/rec",
    "import": "import whole.csv --out out/rec",
    "calibrate": "calibrate rec --seed 3 --without moments --out model",
    "export": "export rec out/table.csv",
    "locate": "locate --model model rec --out out/places.csv",
}


@pytest.mark.usefixtures("blank", "calibrate_once")
@pytest.mark.parametrize("name", COMMANDS)
def test_command_on_a_full_disk_leaves_all_or_nothing(few, name: str) -> None:
    """Where a model was it stays; whatever the limit, nothing is left of what did not fit."""
    sense.export_csv(sense.Recording.open("rec"), "whole.csv")
    out, words = Path("model" if name == "calibrate" else "out"), COMMANDS[name].split()
    out.mkdir(exist_ok=True)
    before = files_in(out)
    for limit in (0, 20_000) if name == "locate" else (1000,):
        with full_disk(limit):
            code, _, err = few(*words)
        if code == 0:
            assert (name, limit) == ("locate", 20_000)
            (out / "places.csv").unlink()
        else:
            assert (code, err.count("padforge: "), "Traceback" in err) == (2, 1, False), err
            assert files_in(out) == before
    assert few(*words)[0] == 0
    if name == "calibrate":
        assert files_in(out).keys() == set(before) - {"figures/error_by_moment.png"}
        assert (out / "localizer.json").read_bytes() != before["localizer.json"]
    if name in ("record", "import"):
        assert len(sense.Recording.open("out/rec").down_command) == 60


def test_parallel_imports_into_one_folder_leave_one_recording(few) -> None:
    sense.export_csv(sense.Recording.open("rec"), "whole.csv")
    line = [sys.executable, "-m", "padforge", "sense", "import", "whole.csv", "--out", "out/rec"]
    running = [subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) for _ in range(2)]
    said = [each.communicate()[1].decode() for each in running]
    assert sorted(each.returncode for each in running) == [0, 2], said
    assert [text.count("\n") for text in sorted(said, key=len)] == [0, 1]
    assert len(sense.Recording.open("out/rec").down_command) == 60
    assert [path.name for path in Path("out").iterdir()] == ["rec"]
