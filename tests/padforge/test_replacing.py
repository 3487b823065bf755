import json
import shutil
from pathlib import Path

import pytest

from padforge.common.files import sha256, write_json
from padforge.design.morphology import Morphology
from padforge.sense.recording.run_directory import Recorder
from tests.helpers.door import called, refused
from tests.helpers.folders import files_in
from tests.helpers.less import blank_pictures
from tests.padforge.conftest import SMALLEST

DESIGN, IMPORT = "design --out pad", "design import plan.svg --out pad"


def made_from(path: Path, **inputs: object) -> None:
    path.parent.mkdir(exist_ok=True)
    write_json(path, {"format": "padforge-made/1", "provenance": {"command": "made", "inputs": inputs}})


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("designed")
    (folder / "pad.toml").write_text(SMALLEST)
    assert called(*DESIGN.split(), cwd=folder).code == 0
    Morphology.straight(1).save(folder / "other.json")
    assert called("design", "show", "other.json", "--out", "plan.svg", cwd=folder).code == 0
    return folder


@pytest.fixture
def pad(designed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a designed pad and what was made from it, and a drawing of another one."""
    blank_pictures(monkeypatch)
    folder = shutil.copytree(designed, tmp_path / "work")
    digest = {"morphology.json": sha256(folder / "pad" / "morphology.json")}
    for name in ("fabrication.json", "recording/start.json", "twin.json"):
        made_from(folder / "pad" / name, **digest)
    made_from(folder / "pad" / "calibration.json", recording="of its readings")
    return folder


@pytest.mark.parametrize("words", [f"{DESIGN} --seed 1", IMPORT, "design edit other.json --out pad/morphology.json"])
def test_pad_in_use_is_not_replaced(pad: Path, words: str) -> None:
    line = refused(*words.split(), cwd=pad)
    for said in ("pad/morphology.json: calibration.json", "fabrication.json, recording", "twin.json", "--force"):
        assert said in line


def test_run_replaces_only_files_it_regenerates(pad: Path) -> None:
    shutil.rmtree(pad / "pad" / "recording")
    said = refused("run", "--seed", "1", "--out", "pad", cwd=pad)
    assert "twin.json" in said
    assert "fabrication.json" not in said


def undrawn(pad: Path) -> dict[str, bytes]:
    """What lies in the folder of the pad, but what has times in it, and pictures, which are blank."""
    return {name: content for name, content in files_in(pad / "pad").items() if "design." not in name}


def test_same_pad_replaces_nothing_and_force_what_is_in_use(pad: Path) -> None:
    path = pad / "pad" / "morphology.json"
    before, digest = undrawn(pad), sha256(path)
    for again in (DESIGN, f"{DESIGN} --resume"):
        assert called(*again.split(), cwd=pad).code == 0
        assert undrawn(pad) == before
    for forced, command in ((f"{DESIGN} --seed 1", "padforge design"), (IMPORT, "padforge design import")):
        assert called(*forced.split(), "--force", cwd=pad).code in (0, 1)
        assert sha256(path) != digest
        digest, origin = sha256(path), json.loads(path.read_text())["provenance"]
        assert (origin["command"], origin["seed"]) == (command, None if "import" in command else 1)


def test_refused_search_keeps_checkpoints(pad: Path) -> None:
    """As on another machine: that it is another pad shows only at its end."""
    path = pad / "pad" / "morphology.json"
    path.write_text(path.read_text() + "\n")
    made_from(pad / "pad" / "twin.json", **{"morphology.json": sha256(path)})
    before = files_in(pad / "pad")
    assert "twin.json was made from it" in called(*DESIGN.split(), cwd=pad).err
    after = files_in(pad / "pad")
    assert {name: after[name] for name in before} == before
    assert {name.partition("/")[0] for name in after.keys() - before.keys()} == {"search"}
    assert called(*DESIGN.split(), "--resume", "--force", cwd=pad).code == 0
    assert not (pad / "pad" / "search").exists()


@pytest.mark.parametrize(("version", "kind"), [(2, None), (2, "ur5"), (1, "simulated")])
def test_run_does_not_replace_localizer_of_measured_presses(tmp_path: Path, version: int, kind: str | None) -> None:
    """Nor one of another version, which does not tell."""
    (tmp_path / "pad").mkdir()
    document = {"format": f"padforge-localizer/{version}", "provenance": {"recording_kind": kind} if kind else {}}
    write_json(tmp_path / "pad" / "localizer.json", document)
    why = f"trained on a recording of kind {kind!r}" if version == 2 else "expected 'padforge-localizer/2'"
    said = refused("run", "--out", "pad", cwd=tmp_path)
    assert why in said
    assert said.endswith("; choose another --out, or replace it with --force\n")


def test_run_does_not_replace_measured_recording(folder: Path) -> None:
    """Of a real pad, at work, with files of others in it, or behind a link."""
    recording = folder / "out" / "pad" / "recording"
    kept = files_in(recording)
    with Recorder.resume(recording):
        assert "another program is recording into it" in refused("run", cwd=folder)
    start = json.loads((recording / "start.json").read_text())
    for kind in ("published", "ur5"):
        write_json(recording / "start.json", start | {"source": start["source"] | {"kind": kind}})
        assert "choose another --out" in refused("run", cwd=folder)
    (recording / "start.json").write_bytes(kept["start.json"])
    (recording / "notes.txt").write_text("of the day")
    assert "holds notes.txt, which is no part of a recording" in refused("run", cwd=folder)
    (recording / "notes.txt").unlink()
    recording.rename(folder / "recording")
    recording.symlink_to(folder / "recording")
    assert "is a link" in refused("run", cwd=folder)
    assert (folder / "recording" / "readings.bin").read_bytes() == kept["readings.bin"]
