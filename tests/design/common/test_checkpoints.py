"""The states of a search on disk: what goes with them, and what stays."""

import os
import zipfile
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from design.common.checkpoints import Checkpoints
from design.common.errors import InputError
from tools.kills import killed

pytestmark = pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")


def work(folder: Path) -> None:
    """A search that keeps its states, goes on from them, and comes to its end."""
    kept = Checkpoints(folder, {"search": {"seed": 1}})
    states = kept.begin(resume=True)
    for start in range(2):
        kept.save(start, {"state": np.full(3, start)} | states.get(start, {}))
    assert set(Checkpoints(folder, {"search": {"seed": 1}}).begin(resume=True)) == {0, 1}
    kept.clear()


def test_a_search_that_is_killed_at_any_moment_goes_on_and_leaves_no_litter(tmp_path: Path) -> None:
    left = set()
    for number in count():
        folder = tmp_path / str(number) / "search"
        folder.parent.mkdir()
        ended = not killed(lambda folder=folder: work(folder), number, folder.parent)
        left |= {path.name.partition("-")[0] for path in folder.glob("*")}
        work(folder)
        assert not list(folder.parent.iterdir())
        if ended:
            break
    assert left >= {".unfinished", "search.json", "start_0000.npz"}


def test_what_is_no_state_of_a_search_stays(tmp_path: Path) -> None:
    kept = Checkpoints(tmp_path / "search", {"search": {}})
    kept.save(0, {"state": np.zeros(1)})
    for name in ("start_0.npz", "start_0_notes.npz", ".unfinished-notes.npz"):
        (tmp_path / "search" / name).touch()
    kept.clear()
    names = sorted(path.name for path in (tmp_path / "search").iterdir())
    assert names == [".unfinished-notes.npz", "start_0.npz", "start_0_notes.npz"]


def test_a_state_that_unpacks_to_much_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = Checkpoints(tmp_path, {"search": {}})
    kept.save(0, {"state": np.zeros(10_000)})
    path = tmp_path / "start_0000.npz"
    with zipfile.ZipFile(path) as plain:
        content = {name: plain.read(name) for name in plain.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, each in content.items():
            packed.writestr(name, each)
    assert path.stat().st_size < 2000
    monkeypatch.setattr("design.common.checkpoints.MOST_BYTES", 50_000)
    with pytest.raises(InputError, match=r"start_0000\.npz: .*unpacks to more than 50000 bytes"):
        kept.begin(resume=True)
