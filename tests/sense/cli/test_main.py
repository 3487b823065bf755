"""What commands need installed, and what a terminal types."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from padforge.sense import Recording
from padforge.sense.cli.options import typed_keys
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
        "run --out pad",
    )
    done = subprocess.run([sys.executable, "-c", BARE, *lines], capture_output=True, text=True, check=True)
    located, shown, calibrated, run = json.loads(done.stdout)
    assert located == [0, "60 positions -> places.csv\n", ""]
    assert shown[0] == 0, shown[2]
    assert calibrated[:2] == [2, ""]
    assert calibrated[2].startswith("padforge: this needs ")
    assert calibrated[2].endswith("pip install 'padforge[design]'\n")
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
