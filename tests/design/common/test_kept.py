"""Arrays kept on disk are those that were computed; whatever happened to their file, the result is right."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from padforge.design.common.kept import kept

SCORE = """
import sys
from padforge.design.contact import profile_weights
from padforge.design.settings import Contact
for contact in (Contact(), Contact(depth_mm=2.5)):
    print([weights.tobytes().hex() for weights in profile_weights(contact)[0]], "scipy.special" in sys.modules)
"""


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder in which a process that has computed nothing yet keeps arrays."""
    monkeypatch.setattr("padforge.design.common.kept._first", set())
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def compute() -> dict[str, NDArray[np.float64]]:
    """Return arrays that are no one else's."""
    return {"numbers": np.array([0.1, np.nan, -0.0]), "radius": np.array(1 / 3)}


def never() -> dict[str, NDArray[np.float64]]:
    """Stand for what must not be computed again."""
    pytest.fail("computed again")


def are_equal(arrays: object) -> bool:
    """Whether arrays are those of `compute`, to the bit."""
    return isinstance(arrays, dict) and {k: v.tobytes() for k, v in arrays.items()} == {
        k: v.tobytes() for k, v in compute().items()
    }


def test_arrays_are_computed_once(folder: Path) -> None:
    """The second call by the same key reads them; another key has others; only the first of a process are kept."""
    assert are_equal(kept(b"a", compute))
    assert are_equal(kept(b"a", never))
    assert kept(b"b", lambda: {"numbers": np.zeros(1)})["numbers"] == [0]
    assert len(list(folder.iterdir())) == 1


def test_processes_of_other_threads_compute_their_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their sums are rounded otherwise, and so no result depends on who came first."""
    kept(b"a", compute)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    assert kept(b"a", lambda: {"numbers": np.zeros(1)})["numbers"] == [0]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x93NUMPY", b"no archive at all"])
def test_a_file_that_is_no_archive_is_computed_anew(folder: Path, content: bytes) -> None:
    """A file that is torn or another's is replaced."""
    kept(b"a", compute)
    (file,) = folder.iterdir()
    file.write_bytes(content or file.read_bytes()[:-40])
    assert are_equal(kept(b"a", compute))
    assert are_equal(kept(b"a", never))


def test_nothing_is_kept_where_nothing_can_be_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder below a file cannot be made."""
    (folder / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "file" / "below"))
    assert are_equal(kept(b"a", compute))


def test_a_second_process_has_the_same_weights_of_the_same_contact(tmp_path: Path) -> None:
    """Its weights are those of the first to the bit, without the library that solves a press; others are solved."""

    def run() -> list[str]:
        environment, command = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}, [sys.executable, "-c", SCORE]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()

    first, second = run(), run()
    assert [line.split()[-1] for line in first] == ["True", "True"]
    assert [line.split()[-1] for line in second] == ["False", "True"]
    assert [line.split("]")[0] for line in second] == [line.split("]")[0] for line in first]
    assert first[0] != first[1]
