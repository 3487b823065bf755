"""A folder with what every stage leaves, and the report on it."""

import shutil
from pathlib import Path

import pytest

from padforge.design.common.files import provenance
from padforge.design.common.plotting import save_figure
from padforge.design.report import draw_plan
from padforge.design.settings import Contact
from padforge.fabricate import build
from padforge.report import write_report
from tests.padforge.report.documents import (
    PAD,
    calibration_document,
    contacts_document,
    design_document,
    study_document,
    written,
)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what every stage leaves, and a study."""
    folder = tmp_path_factory.mktemp("made")
    PAD.save(folder / "morphology.json")
    build(PAD, folder, ["stl", "png"], inputs=[folder / "morphology.json"])
    save_figure(draw_plan(PAD, Contact()), folder / "design.svg")
    written(folder / "design.json", design_document())
    written(folder / "calibration.json", calibration_document())
    written(folder / "contacts.json", contacts_document())
    source = {"kind": "simulated", "rig": {"rate_hz": 13.3, "depth_mm": 5.0}}
    made_by = provenance("padforge sense record")
    start = {"format": "padforge-recording/2", "fibres": 4, "source": source, "provenance": made_by}
    written(folder / "recording" / "start.json", start)
    written(folder / "studies" / "drift.json", study_document())
    shutil.copy(folder / "tracks.png", folder / "studies" / "drift.png")
    return folder


@pytest.fixture
def pad(made: Path, tmp_path: Path) -> Path:
    """A copy of it, to be changed."""
    return shutil.copytree(made, tmp_path / "pad")


@pytest.fixture(scope="session")
def page(made: Path) -> Path:
    return write_report(made)
