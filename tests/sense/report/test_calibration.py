"""What a calibration leaves: its document, lines, tables and figures, kept whole, and what they say of its presses."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from padforge.common.page import PageSection
from padforge.sense import Evaluation, LocalizerSettings, Recording, evaluate
from padforge.sense.localizer import evaluation as evaluation_module
from padforge.sense.localizer.evaluation import calibration_lines, moment_lines
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import MOMENTS
from padforge.sense.report import calibration
from padforge.sense.report.sections import calibration_sections, fibre_loss_sections
from tests.helpers.documents import document_text
from tests.helpers.folders import files_in
from tests.helpers.golden import page_text
from tests.sense.conftest import first_presses

TEST = (1, 2, 4, 5, 7)


@pytest.fixture(scope="module")
def few(recording: Recording) -> Recording:
    return first_presses(recording, 8)


@pytest.fixture(scope="module")
def kept(few: Recording, bayesian_localizer: LocalizerModel) -> tuple[LocalizerModel, Evaluation]:
    """As after a training on presses 0, 3 and 6."""
    origin = {"command": "padforge sense calibrate", "seed": 1, "inputs": {"recording": few.digest}}
    model = replace(
        bayesian_localizer,
        training_recording_sha256=few.digest,
        test=TEST,
        provenance=origin,
        radii_presses=24,
        trained_share=0.25,
    )
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(evaluation_module, "MOMENTS", MOMENTS[::4])
        evaluation = evaluate(model, few, (0, 1, 2))
    simulated = evaluation.provenance | {"recording_kind": "simulated"}
    settings = LocalizerSettings().model_dump()
    # at the touch they answer alike whichever fibres have failed
    apart = [row | {"mean_mm": (1 + row["n_failed"] / 4) * row["mean_mm"]} for row in evaluation.by_moment]
    more = {"training_presses": 3, "settings": settings, "provenance": simulated, "by_moment": apart}
    return model, replace(evaluation, **more)


def sections_text(sections: list[PageSection]) -> str:
    parts = [[f"<h2>{section.title}</h2>", *section.body] for section in sections]
    results = [f"{value}: {what}" for section in sections for value, what in section.figures]
    return "\n".join([*results, page_text("<main>" + "".join(part for body in parts for part in body) + "</main>")])


@pytest.mark.usefixtures("blank")
def test_calibration_is_kept_whole(
    kept: tuple[LocalizerModel, Evaluation],
    few: Recording,
    figures: list[Any],
    golden: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(calibration, "calibrate", lambda *_, **__: kept)
    document = calibration.calibrate_into(few, tmp_path, LocalizerSettings(), without={"health"})
    assert files_in(tmp_path).keys() == {name for name in calibration.FILES if "health" not in name}
    golden("sense/calibration/calibration.json", document_text(document), rtol=1e-3)
    lines = [*calibration_lines(document), *moment_lines(document["by_moment"])]
    golden("sense/calibration/lines.txt", "\n".join(lines), rtol=1e-3)
    golden("sense/calibration/page.md", sections_text(calibration_sections(tmp_path, document)), rtol=1e-3)
    for name, figure in zip(("error_map", "error_by_loss", "error_by_moment"), figures, strict=True):
        golden(f"sense/calibration/{name}.txt", figure, rtol=1e-2)


MEASURED = {"depth_mean_mm": 0.214, "depth_p95_mm": 0.523, "depth_within_r90": 0.87}
MEASURED |= {"force_mean_n": 1.04, "force_p95_n": 2.66, "force_within_r90": 0.913}


def make_row(n_failed: int, subsets: int, **more: float) -> dict[str, float]:
    """Of errors that all differ."""
    errors = {"mean_mm": 1.5, "std_mm": 0.25, "max_mm": 2.0, "median_mm": 1.25, "p95_mm": 3.5}
    row = {name: (1 + n_failed) * value for name, value in errors.items()}
    return {"n_failed": n_failed, "subsets": subsets, **row, "within_r50": 0.512, "within_r90": 0.907, **more}


def test_depth_force_and_losses_of_six_fibres_are_kept_whole(golden: Any, tmp_path: Path) -> None:
    """Of a rig, with depth and force; and the sets of up to three of six fibres, of errors that grow with their sum."""
    by_subset = [
        {"failed": [fibre for fibre in range(6) if chosen >> fibre & 1], "mean_mm": 1 + 0.13 * chosen**0.75}
        for chosen in range(64)
        if chosen.bit_count() <= 3
    ]
    document = {
        "errors": [make_row(0, 1, **MEASURED), make_row(3, 20, **{name: 0.9 * x for name, x in MEASURED.items()})],
        "test_presses": 45,
        "split": "chronological",
        "idle_share": [0.1, 0.25, 0.333, 0, 1, 0.5],
        "by_subset": by_subset,
        "by_moment": [],
        "provenance": {"recording_kind": "rig"},
        "trained_share": 1.0,
        "radii_presses": 100,
        "doubts": ["presses may be in inches"],
    }
    golden("sense/calibration/lines_of_a_rig.txt", "\n".join(calibration_lines(document)))
    sections = calibration_sections(tmp_path, document)
    golden("sense/calibration/page_of_a_rig.md", sections_text(sections))
    [section] = fibre_loss_sections(tmp_path, document)
    shades = {float(share): error for share, error in re.findall(r'--shade: ([\d.]+)">([\d.]+)<', str(section.body))}
    assert shades[1.0] == "3.37"  # without 5 and 6
    assert len(shades) == 21
