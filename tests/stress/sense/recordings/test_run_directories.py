"""Folders of recordings, spoiled: what was written, what is left of it, or one line."""

import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given

import sense
from tests.helpers.effort import few
from tests.stress.sense.cases import right_or_refused, seeds
from tests.stress.sense.spoiling import SMALL, dumped, edited, flipped, put, run_directory


def within(whole: sense.Recording, part: sense.Recording) -> bool:
    """Whether all presses of `part` are presses of `whole`, with the readings they had there."""
    rows = len(part.readings)
    return (
        np.array_equal(whole.readings[:rows], part.readings, equal_nan=True)
        and set(map(tuple, part.presses_mm.tolist())) <= set(map(tuple, whole.presses_mm.tolist()))
        and set(part.begun.tolist()) <= set(whole.begun.tolist())
    )


@few(80)
@given(seed=seeds)
def test_a_run_directory_gives_its_own_presses_or_one_line(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "run"
    files = dict(run_directory(tmp_path_factory.getbasetemp()))
    name = list(files)[rng.integers(len(files))]
    kind = rng.integers(4)
    if kind == 0:
        del files[name]
    elif kind == 1:
        other = list(files)[rng.integers(len(files))]
        files[name], files[other] = files[other], files[name]
    else:
        files[name] = flipped(rng, files[name])
    put(folder, files)
    found = right_or_refused(lambda: sense.Recording.open(folder))
    if found is not None and name == "readings.bin":
        assert within(SMALL, found)
    resumed = right_or_refused(lambda: sense.Recorder.resume(folder))
    if resumed is not None:
        with resumed:
            pass
        assert resumed.done <= set(range(resumed._press))  # pyright: ignore[reportPrivateUsage]
        if found is not None:
            again = right_or_refused(lambda: sense.Recording.open(folder))
            assert again == found


@few(60)
@given(seed=seeds)
def test_a_start_or_journal_of_other_values(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "run"
    files = dict(run_directory(tmp_path_factory.getbasetemp()))
    if rng.random() < 0.3:
        files["start.json"] = dumped(edited(rng, json.loads(files["start.json"])))
    else:
        lines = files["journal.ndjson"].decode().splitlines()
        at = int(rng.integers(len(lines)))
        lines[at] = dumped(edited(rng, json.loads(lines[at]))).decode()
        if rng.random() < 0.3:
            rng.shuffle(lines)
        files["journal.ndjson"] = ("\n".join(lines) + "\n").encode()
    found = right_or_refused(lambda: sense.Recording.open(put(folder, files)))
    if found is not None:
        assert np.array_equal(found.readings, SMALL.readings)
        assert 0 < len(found.begun) <= 12


@pytest.mark.parametrize("claimed", [0, 6, 2**31, 2**32 - 1])
def test_a_block_that_claims_more_readings_than_it_has_is_none(tmp_path: Path, claimed: int) -> None:
    """Even where its checksum fits."""
    SMALL.save(tmp_path / "rec", {})
    path = tmp_path / "rec" / "readings.bin"
    content = bytearray(path.read_bytes())
    block = content[-256:]
    block[16:20] = claimed.to_bytes(4, "little")
    block[20:24] = zlib.crc32(block[24:], zlib.crc32(block[:20])).to_bytes(4, "little")
    path.write_bytes(content[:-256] + block)
    found = right_or_refused(lambda: sense.Recording.open(tmp_path / "rec"))
    assert found is None or len(found.readings) < len(SMALL.readings)


def test_a_stream_of_magic_words_is_searched_in_no_time(tmp_path: Path) -> None:
    SMALL.save(tmp_path / "rec", {})
    (tmp_path / "rec" / "readings.bin").write_bytes(b"PFB1" * 2_000_000)
    assert right_or_refused(lambda: sense.Recording.open(tmp_path / "rec"), 5) is None
