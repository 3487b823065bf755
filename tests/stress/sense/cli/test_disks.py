"""Commands on disks that are full or closed leave all or nothing."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import padforge
import sense
from design import Morphology
from sense.settings import RigSettings
from tests.helpers.effort import few
from tests.stress.sense.cases import TINY, made
from tests.stress.sense.children import in_child

NOBODY = 65_534
SPEC = """
[localizer]
members = 1
hidden = 8
layers = 1
epochs = 2
[rig]
presses = 40
readings_per_press = 20
[pad]
grid = 2
"""
COMMANDS = {
    "record": ("sense", "record", "--out", "OUT/rec"),
    "import": ("sense", "import", "whole.csv", "--out", "OUT/rec"),
    "calibrate": ("sense", "calibrate", "whole", "--out", "OUT"),
    "export": ("sense", "export", "whole", "OUT/table.csv"),
    "locate": ("sense", "locate", "--model", "model", "whole", "--out", "OUT/places.csv"),
}

MODULES = "encodings.utf_8_sig", "matplotlib.font_manager", "sense.report.calibration_figures", "sense.rig.operation"
"""Imported before, not in each child; and where Python lies in a home, a child of another user cannot look there."""


@pytest.fixture(scope="module")
def bench() -> Iterator[Path]:
    """A folder with settings, a recording, its table, and a model, that every user may look into."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield furnished(Path(name))


def furnished(folder: Path) -> Path:
    for module in MODULES:
        import_module(module)
    sense.simulate(Morphology.straight(2), RigSettings(presses=1))  # kernels that each child would fetch
    (folder / "pad.toml").write_text(SPEC)
    one = made(1, presses=40, cycle=20)
    one.save(folder / "whole", {})
    sense.export_csv(one, folder / "whole.csv")
    sense.calibrate(one, TINY)[0].save(folder / "model")
    return folder


def command(bench: Path, name: str, out: Path, limit: int | None = None, user: int | None = None) -> tuple[int, str]:
    """Run a command of padforge in a child; its exit code and stderr."""
    arguments = [part.replace("OUT", str(out)) for part in COMMANDS[name]]

    def work() -> None:
        os.chdir(bench)
        sys.argv = ["padforge", *arguments]
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        try:
            padforge.main()
        except SystemExit as end:
            sys.stderr.flush()
            os._exit(int(end.code or 0))

    return in_child(work, limit, user)


@pytest.mark.parametrize("name", ["record", "import", "export", "locate"])
@few(3)
@given(limit=st.integers(0, 60_000))
def test_commands_on_a_full_disk_leave_all_or_nothing(bench: Path, name: str, limit: int) -> None:
    out = bench / f"full_{name}_{limit}"
    out.mkdir(exist_ok=True)
    status, said = command(bench, name, out, limit)
    left = {path.name for path in out.iterdir()}
    if status == 0:
        assert len(left) == 1
        if name in ("record", "import"):
            assert len(sense.Recording.open(out / "rec").begun) == 40
        return
    assert (status, said.count("\n"), left) == (2, 1, set()), said
    out.rmdir()


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_in_a_folder_that_is_closed_are_one_line(bench: Path, name: str) -> None:
    out = bench / f"closed_{name}"
    out.mkdir(mode=0o555, exist_ok=True)  # root is nobody there
    status, said = command(bench, name, out, user=NOBODY)
    assert (status, said.count("\n")) == (2, 1), said
    assert str(out) in said
    assert not any(out.iterdir())


def test_a_calibration_on_a_full_disk_leaves_the_older_model(bench: Path) -> None:
    out = bench / "older"
    sense.Localizer.load(bench / "model").save(out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    status, said = command(bench, "calibrate", out, limit=20_000)
    assert (status, "Traceback" in said) == (2, False), said
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_two_imports_into_one_folder_leave_one_of_them_whole(bench: Path, tmp_path: Path) -> None:
    line = [sys.executable, "-m", "padforge", "sense", "import", "whole.csv", "--out", str(tmp_path / "rec")]
    running = [subprocess.Popen(line, cwd=bench, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) for _ in range(2)]
    said = [each.communicate()[1].decode() for each in running]
    assert sorted(each.returncode for each in running) == [0, 2], said
    assert [text.count("\n") for text in sorted(said, key=len)] == [0, 1]
    assert len(sense.Recording.open(tmp_path / "rec").begun) == 40
    assert [path.name for path in tmp_path.iterdir()] == ["rec"]
