import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from padforge.common.files import provenance
from padforge.common.plotting import save_figure
from padforge.design import Contact, Morphology, draw_plan
from padforge.fabricate import build
from padforge.report import write_report
from tests.design import test_reports as made_up
from tests.helpers.less import small_pictures

HOSTILE = '</script><img src="x" onerror="document.title=1"> & <b>'
PAD = Morphology.random(2, 2, seed=1)


def written(path: Path, document: dict) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(document))


def design_document() -> dict:
    document: dict = made_up.design_document() | {"violations": [], "descriptions": {"sharpness": "how jagged"}}
    document["provenance"] |= provenance("padforge design", 3)
    return {"format": "padforge-design/1"} | document


def errors(by_subset: dict[tuple[int, ...], float]) -> dict:
    rows = []
    for lost in sorted({len(each) for each in by_subset}):
        means = [mean for each, mean in by_subset.items() if len(each) == lost]
        names = ("mean_mm", "std_mm", "max_mm", "median_mm", "p95_mm", "within_r50", "within_r90")
        values = dict.fromkeys(names, 0.5) | {"mean_mm": float(np.mean(means)), "max_mm": max(means)}
        rows.append({"n_failed": lost, "subsets": len(means), **values})
    return {"errors": rows, "by_subset": [{"failed": list(lost), "mean_mm": mean} for lost, mean in by_subset.items()]}


def calibration_document() -> dict:
    found = {(): 1.0, (0,): 1.5, (1,): 4.25, (2,): 1.25, (3,): 2.0}
    pairs = {(one, two): found[one,] + found[two,] for two in range(4) for one in range(two)}
    return {
        "format": "padforge-calibration/1",
        **errors(found | pairs),
        "split": "random",
        "test_presses": 12,
        "idle_share": [0.1, 0.2, 0.3, 0.4],
        "provenance": provenance("padforge sense calibrate", 0),
    }


def study_document() -> dict:
    return {
        "format": "padforge-study-drift/1",
        "title": "Drift",
        "text": ["First.", "Second."],
        "rows": [{"pad": "square", "error": 1.25, "kept": True}, {"pad": "ours", "error": None, "kept": False}],
        "provenance": provenance("padforge study drift"),
    }


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    PAD.save(folder / "morphology.json")
    with pytest.MonkeyPatch.context() as patch:
        small_pictures(patch)
        build(PAD, folder, ["stl", "png"], inputs=[folder / "morphology.json"])
    save_figure(draw_plan(PAD, Contact()), folder / "figures" / "design.svg")
    written(folder / "design.json", design_document())
    written(folder / "calibration.json", calibration_document())
    contacts = {"format": "padforge-contacts/1", "provenance": provenance("padforge run")} | made_up.contacts_document()
    written(folder / "contacts.json", contacts)
    source = {"kind": "simulated", "rig": {"rate_hz": 13.3, "depth_mm": 5.0}}
    made_by = provenance("padforge sense record")
    start = {"format": "padforge-recording/1", "fibres": 4, "source": source, "provenance": made_by}
    written(folder / "recording" / "start.json", start)
    written(folder / "studies" / "drift.json", study_document())
    shutil.copy(folder / "figures" / "tracks.png", folder / "studies" / "drift.png")
    return folder


@pytest.fixture
def pad(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "pad")


@pytest.fixture(scope="session")
def page(made: Path) -> Path:
    return write_report(made)
