"""What calibrations and identifications leave, kept whole: documents, lines, sections and figures."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from padforge.common.page import PageSection
from padforge.design.settings import Contact
from padforge.sense import Evaluation, LocalizerSettings, Recording, evaluate
from padforge.sense.localizer import evaluation as evaluation_module
from padforge.sense.localizer.evaluation import calibration_lines, moment_lines
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import MOMENTS
from padforge.sense.report import calibration
from padforge.sense.report import identification as report
from padforge.sense.report.identification import identification_lines, identification_sections, identify_into
from padforge.sense.report.sections import calibration_sections, fibre_loss_sections
from padforge.sense.twin.contact_fit import ContactFit
from padforge.sense.twin.identification import Identification, MeasuredContact
from padforge.sense.twin.wiring import Wiring
from tests.helpers.folders import files_in
from tests.helpers.golden import json_text, page_text
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
    golden("sense/calibration/calibration.json", json_text(document), rtol=1e-3)
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
    for rows in ([make_row(0, 1), make_row(1, 6)], [make_row(0, 1)]):  # less is known of less
        sections += calibration_sections(tmp_path, document | {"errors": rows, "by_subset": []})
    golden("sense/calibration/page_of_a_rig.md", sections_text(sections))
    [section] = fibre_loss_sections(tmp_path, document)
    shades = {float(share): error for share, error in re.findall(r'--shade: ([\d.]+)">([\d.]+)<', str(section.body))}
    assert shades[1.0] == "3.37"  # without 5 and 6
    assert len(shades) == 21


Identified = tuple[dict[str, Any], list[Any]]


@pytest.fixture
def identify(identification: Identification, monkeypatch, tmp_path, figures) -> Callable[..., Identified]:
    """Return a function to the document and the figures, of which nothing is saved."""

    def identify(**changes: object) -> Identified:
        monkeypatch.setattr(report, "save_figure", lambda figure, path: None)
        monkeypatch.setattr(report, "identify_pad", lambda *_: replace(identification, **changes))
        document = identify_into(Mock(mirrored=True), identification.pad, tmp_path)
        assert json.loads((tmp_path / "identification.json").read_text()) == json.loads(json.dumps(document))
        return document, figures

    return identify


def make_contact() -> MeasuredContact:
    """Four numbers that differ in each of three fits."""
    as_built = ContactFit(1.114, 1.366, 0.634, 0.021, 0.047, 0.936)
    on_plan = ContactFit(1.021, 1.204, 0.796, 0.032, 0.058, 0.681)
    gaussian = ContactFit(1.333, 2.0, 0.0, 0.043, 0.0, 0.612)
    return MeasuredContact(Contact(depth_mm=4.0), as_built, on_plan, gaussian)


def test_identification_is_kept_whole(
    identification: Identification, identify: Callable[..., Identified], golden: Any, tmp_path: Path
) -> None:
    """Of a pad whose second channel is dead, of which another wiring is as good, with shares that are told apart."""
    swapped = Wiring(identification.fit.pad.transform, 0.5, (1, 0, 2, 3), 0.9)
    shares = {"explained": np.array([0.91, 0.82, 0.73, 0.64]), "explained_smooth": np.array([0.95, 0.8, 0.85, 0.6])}
    shares |= {"explained_on_plan": 0.551, "noise": 0.0123, "noise_v": 1.1e-3 * np.arange(1, 6)}
    live = np.array([0, 2, 3, 4])
    document, drawn = identify(alternatives=[swapped], contact=make_contact(), live=live, **shares)
    golden("sense/identification/identification.json", json_text(document), forget=_VERSIONS, rtol=2e-2)
    golden("sense/identification/lines.txt", "\n".join(identification_lines(document, tmp_path)), rtol=2e-2)
    sections = identification_sections(tmp_path, document)
    page = page_text("<main>" + "".join(sections[0].body) + "</main>")
    golden("sense/identification/page.md", f"# {sections[0].title}\n{sections[0].figures}\n{page}", rtol=2e-2)
    for name, figure in zip(("responses", "plan"), drawn, strict=True):
        golden(f"sense/identification/{name}.txt", figure, rtol=2e-2)


_VERSIONS = (r'"versions": \{[^}]*\}', r'"created": "[^"]*"')


def test_lines_state_the_side_with_regard_to_the_rig(golden: Any) -> None:
    """A mirrored rig has mirrored positions already: its twin is mirrored only where that was wrong."""
    document = {"presses": 10, "channels": [], "explained": 0.9, "explained_on_plan": 0.8, "noise": 0.01, "doubts": []}
    lines = []
    for mirrored, rig in product((False, True), ({}, {"rig_mirrored": False}, {"rig_mirrored": True})):
        frame = {"mirrored": mirrored, "turn_deg": -0.04, "shift_mm": [0.06, -0.04], "scale": 1.0}
        pose = identification_lines(document | {"frame": frame} | rig, Path())[3]
        lines.append(f"mirrored {mirrored}, {rig}: {pose}")
    golden("sense/identification/sides.txt", "\n".join(lines))
