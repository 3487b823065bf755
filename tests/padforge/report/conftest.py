"""A folder with what every stage leaves, made up, and the report on it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from padforge.common.files import provenance
from padforge.common.plotting import save_figure
from padforge.design.morphology import Morphology
from padforge.design.report import draw_plan
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings
from padforge.fabricate import build
from padforge.report import write_report
from tests.helpers.less import small_pictures

HOSTILE = '</script><img src="x" onerror="document.title=1"> & <b>'
PAD = Morphology.random(2, 2, seed=1)


def written(path: Path, document: dict) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(document))


def design_document() -> dict:
    used = {"pad": PadSettings(grid=2), "contact": Contact(), "search": SearchSettings(), "rules": RulesSettings()}
    settings = {name: section.model_dump(mode="json") for name, section in used.items()}
    return {
        "format": "padforge-design/1",
        "terms": {
            "expected_error_mm_0": 0.675,
            "expected_error_mm_1": 0.9,
            "ambiguity_mm_0": 1.125,
            "ambiguity_mm_1": 2.25,
            "information": 9.5,
        },
        "descriptions": {"information": "mutual information, bits"},
        "straight": {
            "expected_error_mm_0": 1.35,
            "expected_error_mm_1": 2.7,
            "ambiguity_mm_0": 2.8125,
            "ambiguity_mm_1": 5.625,
        },
        "violations": [],
        "provenance": provenance("padforge design", 3) | {"settings": settings},
    }


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


def contacts_document() -> dict:
    """Of a pad that errs by half as much as straight fibres, but not under the published disc."""
    errors = {("as assumed", "designed"): [0.5, 0.75], ("as assumed", "straight"): [1.0, 1.5]}
    errors |= {("published disc, K = 0.6", "designed"): [4.0, 6.0], ("published disc, K = 0.6", "straight"): [3.0, 5.0]}
    rows = [{"contact": contact, "pad": pad, "errors_mm": each} for (contact, pad), each in errors.items()]
    scatter = {"floor": 0.02, "share": 0.18, "common": 0.36}
    return {"format": "padforge-contacts/1", "scatter": scatter, "rows": rows, "provenance": provenance("padforge run")}


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
    """A folder with what every stage leaves, and a study."""
    folder = tmp_path_factory.mktemp("made")
    PAD.save(folder / "morphology.json")
    with pytest.MonkeyPatch.context() as patch:
        small_pictures(patch)
        build(PAD, folder, ["stl", "png"], inputs=[folder / "morphology.json"])
    save_figure(draw_plan(PAD, Contact()), folder / "figures" / "design.svg")
    written(folder / "design.json", design_document())
    written(folder / "calibration.json", calibration_document())
    written(folder / "contacts.json", contacts_document())
    source = {"kind": "simulated", "rig": {"rate_hz": 13.3, "depth_mm": 5.0}}
    made_by = provenance("padforge sense record")
    start = {"format": "padforge-recording/1", "fibres": 4, "source": source, "provenance": made_by}
    written(folder / "recording" / "start.json", start)
    written(folder / "studies" / "drift.json", study_document())
    shutil.copy(folder / "figures" / "tracks.png", folder / "studies" / "drift.png")
    return folder


@pytest.fixture
def pad(made: Path, tmp_path: Path) -> Path:
    """A copy of it, to be changed."""
    return shutil.copytree(made, tmp_path / "pad")


@pytest.fixture(scope="session")
def page(made: Path) -> Path:
    return write_report(made)
