"""What a broken off search has left, damaged: gone on with, or refused in one line."""

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.common.errors import InputError
from design.optimisers.search import SearchRun, search
from design.settings import PUBLISHED_CONTACT
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.damage import PAD, RULES, SEARCH, damages, replacements
from tests.stress.door import require_one_line


@pytest.fixture(scope="module")
def begun(tmp_path_factory) -> dict[str, bytes]:
    """Searches of both kinds that were broken off, as files by name."""
    found = {}
    for method in ("descent", "genetic"):
        kept = tmp_path_factory.mktemp(method)
        settings = SEARCH.model_copy(update={"method": method})

        def stop(*_: object) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            search(PAD, PUBLISHED_CONTACT, settings, RULES, run=SearchRun(stop, kept))
        found |= {f"{method}/{path.name}": path.read_bytes() for path in kept.iterdir()}
    return found


@few(20)
@given(st.sampled_from(["descent", "genetic"]), st.data())
def test_damaged_checkpoints(folder: Path, begun: dict[str, bytes], method: str, data: st.DataObject):
    kept = folder / "search"
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir()
    files = {name.split("/")[1]: content for name, content in begun.items() if name.startswith(method)}
    target = data.draw(st.sampled_from(sorted(files)))
    how = data.draw(st.integers(0, 2))
    if how == 0:
        files[target] = data.draw(damages())(files[target])
    elif how == 1:
        files[target] = files[data.draw(st.sampled_from(sorted(files)))]
    elif target.endswith(".npz"):
        files[target] = _changed_arrays(files[target], data)
    else:
        files[target] = json.dumps(data.draw(replacements())(json.loads(files[target]))).encode()
    for name, content in files.items():
        (kept / name).write_bytes(content)
    settings = SEARCH.model_copy(update={"method": method})
    with ends_in_time():
        try:
            found = search(PAD, PUBLISHED_CONTACT, settings, RULES, run=SearchRun(keep_in=kept, resume=True))
        except InputError as error:
            require_one_line(error)
            return
    assert np.isfinite(list(found.terms.values())).all()


def _changed_arrays(content: bytes, data: st.DataObject) -> bytes:
    """A state with one array of other values, another shape, another type, or none."""
    with np.load(io.BytesIO(content)) as arrays:
        state = {name: arrays[name] for name in arrays.files}
    name = data.draw(st.sampled_from(sorted(state)))
    array = state[name]
    match data.draw(st.integers(0, 6)):
        case 0:
            del state[name]
        case 1:
            state[name] = array.reshape(-1)[:0]
        case 2:
            state[name] = np.full(array.shape, data.draw(st.sampled_from([np.nan, np.inf, -1e308, 0, 1e308])))
        case 3:
            state[name] = np.array("text")
        case 4:
            state[name] = np.zeros((2, 3, 4))
        case 5:
            state[name] = array[..., None]
        case 6:
            state["more"] = array
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **state)
    return buffer.getvalue()
