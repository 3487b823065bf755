import json
import re
import shutil
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape

from padforge.common.validation import Fault, InputError
from padforge.design.morphology import Morphology
from padforge.fabricate import build
from padforge.report import write_report
from padforge.sense import Recorder, Recording
from tests.helpers.less import blank_pictures
from tests.padforge.report.conftest import HOSTILE, design_document, study_document, written


def test_text_from_files_is_escaped(pad: Path) -> None:
    design, mould, study = design_document(), json.loads((pad / "fabrication.json").read_text()), study_document()
    design["violations"] = [{"rule": HOSTILE, "fibres": [HOSTILE], "measured": 1, "limit": 2, "place_mm": None}]
    design["provenance"] |= {"command": HOSTILE, "inputs": {HOSTILE.replace("/", ""): HOSTILE}}
    design["terms"][HOSTILE] = HOSTILE
    mould["findings"][0] |= {"message": HOSTILE, "name": HOSTILE}
    mould["silicone"]["name"] = HOSTILE
    study |= {"title": HOSTILE, "text": [HOSTILE], "rows": [{HOSTILE: HOSTILE}]}
    for name, document in (("design", design), ("fabrication", mould), ("studies/drift", study)):
        written(pad / f"{name}.json", document)
    text = write_report(pad.rename(pad.with_name("<b>&"))).read_text()
    assert text.count(escape(HOSTILE)) >= 10
    assert "<img src=" not in text
    assert "<b>&" not in text
    assert text.count("<script") == text.count("</script>") == 3


def test_provenance_compares_inputs_with_files_here(pad: Path) -> None:
    assert "(the one here)" in write_report(pad).read_text()
    document = json.loads((pad / "design.json").read_text())
    written(pad / "design.json", document | {"morphology_sha256": "0" * 64})
    with pytest.raises(Fault, match=r"design .* is of another pad"):
        write_report(pad)
    written(pad / "design.json", document)
    (pad / "morphology.json").write_text("{}")
    with pytest.raises(Fault, match=r"fabrication .* is of another pad"):
        write_report(pad)
    text = (pad / "report.html").read_text()
    assert "(not the one here)" in text
    assert text.index("Files of different pads") < text.index("Design rules"), "first thing on the page"


def test_provenance_names_inputs_elsewhere_and_opens_none(pad: Path) -> None:
    """A file of another folder is not this one's, though it could be found from here; a computed input is a command."""
    (pad.parent / "spec.toml").write_text("secret")
    document = json.loads((pad / "fabrication.json").read_text())
    inputs = {"../spec.toml": "ab12", "pad.toml": "cd34", "twin": {"command": "padforge sense identify"}}
    document["provenance"] |= {"inputs": inputs, "command": "made so", "seed": 7, "versions": {"numpy": "2.0"}}
    (pad / "pad.toml").write_text("[pad]")
    written(pad / "fabrication.json", document)
    text = re.sub(r"\s*<[^>]*>\s*", "|", write_report(pad).read_text())
    read = "../spec.toml ab12; pad.toml cd34 (not the one here); twin: padforge sense identify"
    assert f"|made so||7||numpy 2.0||{read}|" in text


def test_report_warns_of_errors_on_other_recording(pad: Path) -> None:
    """As a run leaves them that is broken off between recording and calibration, for another pad than before."""
    shutil.rmtree(pad / "recording")
    with Recorder(pad / "recording", 1, {"kind": "simulated"}, {}) as recorder:
        recorder.append(np.arange(4) / 10, np.zeros((4, 1)))
        recorder.begin((0, 0), 1)
        recorder.finish(3)
    document = json.loads((pad / "calibration.json").read_text())
    for of, strange in ((Recording.open(pad / "recording").digest, False), ("0" * 64, True)):
        document["provenance"]["inputs"] = {"recording": of}
        written(pad / "calibration.json", document)
        with pytest.raises(Fault, match=r"calibration .* is of another recording") if strange else nullcontext():
            write_report(pad)
    assert "Files of different pads" in (pad / "report.html").read_text()
    (pad / "recording" / "readings.bin").unlink()
    write_report(pad)


@pytest.mark.parametrize("name", ["design", "calibration"])
def test_report_works_with_one_stage(made: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "studies").mkdir()
    shutil.copy(made / f"{name}.json", tmp_path / f"{name}.json")
    text = write_report(tmp_path).read_text()
    assert "Provenance" in text
    assert ("<figure><img" in text) == (name == "design"), "the press alone is drawn by the report"


DAMAGED = {
    "design.json": ['{"format": "padforge-design/1", "terms": {}}', '{"format": "padforge-design/0"}'],
    "fabrication.json": ['{"format": "padforge-fabrication/1", "findings": []}'],
    "calibration.json": ['{"format": "padforge-calibration/1", "errors": []}'],
    "fibre_loss.json": ['{"format": "padforge-fibre-loss/1", "methods": {"x": {"by_subset": [{"failed": [1]}]}}}'],
    "mould.stl": ["solid nothing"],
    "recording/journal.ndjson": ["{}\n"],
    "studies/drift.json": ['{"format": "padforge-study-drift/1", "title": "a", "text": []}'],
}


@pytest.mark.parametrize(("name", "content"), [(name, text) for name, texts in DAMAGED.items() for text in texts])
def test_report_refuses_damaged_file_in_one_line(pad: Path, name: str, content: str) -> None:
    (pad / name).write_text(content)
    with pytest.raises(InputError, match=rf"^{re.escape(str(pad / name))}: [^\n]*$"):
        write_report(pad)


def test_report_refuses_mould_of_other_checks(pad: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blank_pictures(monkeypatch)
    build(Morphology.straight(2), tmp_path / "other", ["stl"])
    for name in ("mould.stl", "figures/orientation.svg"):
        shutil.copy(tmp_path / "other" / name, pad / name)
    line = r"mould\.stl: is not the one fabrication\.json was written with; fabricate again"
    with pytest.raises(InputError, match=line):
        write_report(pad)
