"""Commands on disks that are full leave all or nothing."""

import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from padforge import sense
from tests.helpers.folders import files_in

COMMANDS = {
    "record": "record --out out/rec",
    "import": "import whole.csv --out out/rec",
    "calibrate": "calibrate rec --seed 3 --without moments --out model",
    "export": "export rec out/table.csv",
    "locate": "locate --model model rec --out out/places.csv",
}


@contextmanager
def full_disk(limit: int) -> Iterator[None]:
    """No file gets longer than `limit` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


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
