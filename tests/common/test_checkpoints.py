"""Checkpoints of a search: resuming, damage, and removal."""

import os
from pathlib import Path

import numpy as np
import pytest

from padforge.common.parallel import Checkpoints
from padforge.common.validation import InputError
from tests.helpers.kills import after_kills

pytestmark = pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")


def work(folder: Path) -> None:
    """A search that keeps its states, goes on from them, and comes to its end."""
    kept = Checkpoints(folder, {"search": {"seed": 1}})
    states = kept.begin(resume=True)
    for start in range(2):
        kept.save(start, {"state": np.full(3, start)} | states.get(start, {}))
    assert set(Checkpoints(folder, {"search": {"seed": 1}}).begin(resume=True)) == {0, 1}
    kept.clear()


@pytest.mark.slow
def test_checkpoints_resume_after_a_kill_at_any_operation(tmp_path: Path) -> None:
    left = set()
    for folder in after_kills(lambda folder: work(folder / "search"), Path.mkdir, tmp_path):
        left |= {path.name.partition("-")[0] for path in (folder / "search").glob("*")}
        work(folder / "search")
        assert not list(folder.iterdir())
    assert left >= {".unfinished", "search.json", "start_0000.npz"}


def test_torn_states_are_refused_in_one_line(tmp_path: Path) -> None:
    Checkpoints(tmp_path, {}).save(0, {"state": np.zeros(100)})
    path = tmp_path / "start_0000.npz"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"start_0000\.npz: cannot be read"):
        Checkpoints(tmp_path, {}).begin(resume=True)
