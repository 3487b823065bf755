"""Commands that would leave results of a pad beside another one: refused ahead, in one line, unless by --force."""

import shutil
from pathlib import Path

import pytest

from design.common.files import sha256, write_json
from design.pad.morphology import Morphology
from tests.padforge.program import called

SMALL = "[pad]\ngrid = 2\n[search]\nknots = 2\nstarts = 1\nsteps = 5\nlost = 1\n[rules]\nenforce = false\n"
DESIGN = "design --out pad"


def made_from(path: Path, **inputs: object) -> None:
    path.parent.mkdir(exist_ok=True)
    write_json(path, {"format": "padforge-made/1", "provenance": {"command": "made", "inputs": inputs}})


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("designed")
    (folder / "pad.toml").write_text(SMALL)
    assert called(*DESIGN.split(), cwd=folder).code == 0
    return folder


@pytest.fixture
def folder(designed: Path, tmp_path: Path) -> Path:
    """A designed pad and what was made from it, and a drawing of another one."""
    folder = shutil.copytree(designed, tmp_path / "work")
    digest = {"morphology.json": sha256(folder / "pad" / "morphology.json")}
    for name in ("fabrication.json", "recording/start.json", "twin.json"):
        made_from(folder / "pad" / name, **digest)
    made_from(folder / "pad" / "calibration.json", recording="of its readings")
    Morphology.straight(2).save(folder / "other.json")
    assert called("design", "show", "other.json", "--out", "plan.svg", cwd=folder).code == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "words",
    [
        f"{DESIGN} --seed 1",
        f"{DESIGN} --seed 1 --resume",
        f"{DESIGN} --from pad/morphology.json",
        "design import plan.svg --out pad",
        "design edit other.json --out pad/morphology.json",
        "run --seed 1 --out pad",
    ],
)
def test_a_pad_that_others_were_made_from_is_kept(folder: Path, words: str) -> None:
    before = contents(folder)
    if words.startswith("run"):
        shutil.rmtree(folder / "pad" / "recording")
        before = contents(folder)
    ended = called(*words.split(), cwd=folder)
    assert (ended.code, ended.err.count("\n")) == (2, 1), ended
    assert "pad/morphology.json: " in ended.err
    assert "twin.json" in ended.err
    if not words.startswith("run"):  # which makes these again
        assert "calibration.json" in ended.err
        assert "fabrication.json, recording" in ended.err
    assert "another --out, or replace it with --force" in ended.err
    assert contents(folder) == before


@pytest.mark.parametrize("words", [f"{DESIGN} --seed 1", "design import plan.svg --out pad"])
def test_by_force_it_is_replaced(folder: Path, words: str) -> None:
    before = sha256(folder / "pad" / "morphology.json")
    assert called(*words.split(), "--force", cwd=folder).code in (0, 1)
    assert sha256(folder / "pad" / "morphology.json") != before


def test_the_same_pad_again_replaces_nothing(folder: Path) -> None:
    before = contents(folder / "pad")
    for again in (DESIGN, f"{DESIGN} --resume"):
        assert called(*again.split(), cwd=folder).code == 0
        assert {**contents(folder / "pad"), "design.json": b""} == {**before, "design.json": b""}  # times are in it


def test_a_search_that_ends_elsewhere_is_kept_to_be_gone_on_with(folder: Path) -> None:
    """As on another machine: that it is another pad shows only at its end."""
    path = folder / "pad" / "morphology.json"
    path.write_text(path.read_text() + "\n")
    made_from(folder / "pad" / "twin.json", **{"morphology.json": sha256(path)})
    before = contents(folder / "pad")
    assert "twin.json was made from it" in called(*DESIGN.split(), cwd=folder).err
    after = contents(folder / "pad")
    assert {name: after[name] for name in before} == before
    assert {name.partition("/")[0] for name in after.keys() - before.keys()} == {"search"}
    assert called(*DESIGN.split(), "--resume", "--force", cwd=folder).code == 0
    assert not (folder / "pad" / "search").exists()


def test_a_run_keeps_a_localizer_of_other_presses(folder: Path) -> None:
    shutil.rmtree(folder / "pad")
    (folder / "pad").mkdir()
    for told in ({}, {"recording_kind": "ur5"}):
        write_json(folder / "pad" / "localizer.json", {"format": "padforge-localizer/2", "provenance": told})
        ended = called("run", "--out", "pad", cwd=folder)
        assert (ended.code, ended.err.count("\n")) == (2, 1), ended
        assert f"of kind {told.get('recording_kind')!r}, not a simulated one" in ended.err
    assert [path.name for path in (folder / "pad").iterdir()] == ["localizer.json"]
