"""A folder that somebody else has packed, with the files of a run in it that was never begun here."""

from pathlib import Path

import pytest

from design.pad.morphology import Morphology
from tests.padforge.program import called

EXCHANGE = ".unfinished-exchange"
READERS = (
    *(f"design {name} pad/morphology.json" for name in ("show", "check", "score", "edit")),
    "design --from pad/morphology.json --out other",
    "fabricate check pad/morphology.json",
    "fabricate pad/morphology.json --out other",
    *(f"sense {name} --model pad pad/recording.csv" for name in ("locate", "evaluate", "health")),
    "sense import pad/recording.csv --out other/recording",
    "sense identify other/recording --morphology pad/morphology.json",
)
WRITERS = (
    "run --out pad",
    "design --out pad",
    "report pad",
    "fabricate other/morphology.json --out pad",
    "design show other/morphology.json --out pad/plan.svg",
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with `pad`, as unpacked, and the morphology of another pad."""
    for name in ("pad", f"pad/{EXCHANGE}", "other"):
        (tmp_path / name).mkdir()
        Morphology.straight(2).save(tmp_path / name / "morphology.json")
    (tmp_path / "pad" / "recording.csv").write_text("time_s,fibre_1_v\n0,0\n1,0\n")
    (tmp_path / "pad" / "thesis.txt").write_text("mine")
    (tmp_path / "pad" / EXCHANGE / ".unfinished-gone").write_text('["thesis.txt"]')
    (tmp_path / "pad" / EXCHANGE / ".unfinished-note").write_text('[["morphology.json"], ["thesis.txt"]]')
    (tmp_path / "pad" / EXCHANGE / ".unfinished-seal").write_text("1 2 3 4")
    return tmp_path


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("words", READERS + WRITERS)
def test_no_command_carries_out_what_was_begun_elsewhere(folder: Path, words: str) -> None:
    before = contents(folder)
    ended = called(*words.split(), cwd=folder)
    assert (ended.code, ended.err.count("\n")) == (2, 1), ended
    assert f"{EXCHANGE}: begun in another folder" in ended.err
    assert contents(folder) == before
