"""Checkpoints of a search: resuming, damage, and removal."""

import os
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design.common.parallel import Checkpoints
from padforge.design.common.validation import InputError
from padforge.design.optimize.search import SearchOptions, SearchResult, search
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings
from tests.design.common.damage import damages, read_damaged
from tests.helpers.kills import killed

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


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """Files of searches of both kinds that were broken off."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    found = {}
    for method in ("descent", "genetic"):
        folder = tmp_path_factory.mktemp(method)
        with pytest.raises(KeyboardInterrupt):
            searched(method, SearchOptions(stop, folder))
        found[method] = {path.name: path.read_bytes() for path in folder.iterdir()}
    return found


def searched(method: str, run: SearchOptions) -> SearchResult:
    settings = SearchSettings(method=method, knots=1, starts=1, steps=3, max_failures=0, population=4, generations=2)  # pyright: ignore
    return search(PadSettings(grid=1), PUBLISHED_CONTACT, settings, RulesSettings(enforce=False), run=run)


@given(st.sampled_from(["descent", "genetic"]), damages)
@settings(max_examples=5)
def test_damaged_states_are_resumed_or_refused_in_one_line(begun, tmp_path_factory, method, damage) -> None:
    folder = tmp_path_factory.mktemp("search")
    for name, content in begun[method].items():
        (folder / name).write_bytes(content)
    name = "start_0000.npz"
    run = SearchOptions(keep_in=folder, resume=True)
    found = read_damaged(folder / name, begun[method][name], damage, lambda path: searched(method, run))
    assert found is None or np.isfinite(list(found.terms.values())).all()


def test_states_of_other_arrays_are_refused_in_one_line(begun, tmp_path: Path) -> None:
    for name, content in begun["descent"].items():
        (tmp_path / name).write_bytes(content)
    path = tmp_path / "start_0000.npz"
    state = dict(np.load(path))
    for key, array in state.items():
        np.savez(path, **state | {key: array[..., None]})  # pyright: ignore[reportArgumentType]
        with pytest.raises(InputError, match=r"start_0000\.npz"):
            searched("descent", SearchOptions(keep_in=tmp_path, resume=True))
