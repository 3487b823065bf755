"""What an identification leaves: its document, lines, section and figures, kept whole, and what they say of the fit."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from padforge.design.settings import Contact
from padforge.sense.report import identification as report
from padforge.sense.report.identification import identification_lines, identification_sections, identify_into
from padforge.sense.twin.contact_fit import ContactFit
from padforge.sense.twin.identification import Identification, MeasuredContact
from padforge.sense.twin.wiring import Wiring
from tests.helpers.documents import document_text
from tests.helpers.golden import page_text

Identified = tuple[dict[str, Any], list[Any]]


@pytest.fixture
def identify(
    identification: Identification, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, figures: list[Any]
) -> Callable[..., Identified]:
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
    golden("sense/identification/identification.json", document_text(document), forget=_VERSIONS, rtol=2e-2)
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
