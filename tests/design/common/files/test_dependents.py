"""What was made from a file: by digests and provenance alone, through others, and never by what merely lies there."""

import json
from pathlib import Path
from typing import Any

import pytest

from design.common.errors import InputError
from design.common.files import check_replaceable, find_dependents, sha256, write_json

PAD = "morphology.json"


def document(path: Path, inputs: object = None, **more: object) -> Path:
    path.parent.mkdir(exist_ok=True)
    write_json(path, {"format": "padforge-some/1", "provenance": {"command": path.name, "inputs": inputs}, **more})
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A pad with its mould, its recording, and what was learnt from that."""
    pad = document(tmp_path / PAD, format="padforge-morphology/1")
    digest = {PAD: sha256(pad)}
    document(tmp_path / "design.json", morphology_sha256=digest[PAD])
    document(tmp_path / "fabrication.json", digest)
    document(tmp_path / "recording" / "start.json", digest)
    document(tmp_path / "localizer.json", {"recording": "of its readings"})
    model: dict[str, Any] = json.loads((tmp_path / "localizer.json").read_text())["provenance"]
    document(tmp_path / "fibre_loss.json", {"recording": "of its readings", "localizer": model})
    document(tmp_path / "edited.json", digest, format="padforge-morphology/1")
    document(tmp_path / "contacts.json", {PAD: "of another pad"})
    return tmp_path


def test_dependents_are_found_through_others(folder: Path) -> None:
    made = ["design.json", "fabrication.json", "fibre_loss.json", "localizer.json", "recording"]
    assert find_dependents(folder / PAD) == made
    assert find_dependents(folder / PAD, remade=["design.json", "recording"]) == made[1:4]
    assert find_dependents(folder / "localizer.json") == ["fibre_loss.json"]
    assert find_dependents(folder / "edited.json") == find_dependents(folder / "contacts.json") == []


@pytest.mark.parametrize(
    "content", ["", "3", "[]", '{"provenance": 3}', '{"provenance": {"inputs": [1]}}', "[" * 10**5]
)
def test_what_else_lies_there_is_passed_over(folder: Path, content: str) -> None:
    before = find_dependents(folder / PAD)
    (folder / "other.json").write_text(content)
    (folder / "folder.json").mkdir()
    (folder / ".unfinished-set-0").mkdir()
    document(folder / ".unfinished-set-0" / "start.json", {PAD: sha256(folder / PAD)})
    assert find_dependents(folder / PAD) == before


def test_a_file_that_others_were_made_from_is_replaced_by_force_alone(folder: Path) -> None:
    other = document(folder / "new" / PAD, ["another"])
    for by in (other, {"command": "another"}):
        line = r"morphology.json: fabrication.json, .* and recording were made from it; .* another --out, .* --force$"
        with pytest.raises(InputError, match=line):
            check_replaceable(folder / PAD, by, remade=["design.json"])
        check_replaceable(folder / PAD, by, force=True)
        check_replaceable(folder / "contacts.json", by)
        check_replaceable(folder / "none.json", by)


def test_a_file_that_stays_as_it_is_is_no_other(folder: Path) -> None:
    same = folder / "new" / PAD
    same.parent.mkdir()
    same.write_bytes((folder / PAD).read_bytes())
    check_replaceable(folder / PAD, same)
    check_replaceable(folder / PAD, {"command": PAD})
