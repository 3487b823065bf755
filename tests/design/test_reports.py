from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.common.page import page
from padforge.design.contact import FIBRE_BLUR_MM, contact_press
from padforge.design.objectives.score import describe_terms
from padforge.design.report import contact_lines, contact_sections, design_sections, press_sections
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings
from tests.helpers.golden import Golden, page_text
from tests.helpers.less import blank_pictures

TERMS = {"expected_error_mm_1": 2.346, "expected_error_mm_0": 1.0, "sharpness": 0.25, "penalty_end_slopes": 0.125}
STRAIGHT = {"expected_error_mm_1": 4.0, "expected_error_mm_0": 12.34}
VIOLATIONS = [
    {"rule": "min_gap_mm", "fibres": [1, 3], "place_mm": [1.04, -2.0], "measured": 0.5, "limit": 2.0},
    {"rule": "max_crossings", "fibres": [], "place_mm": None, "measured": 9, "limit": 4},
]
PRESS = Contact(depth_mm=2.0, thickness_mm=8.0, tool_radius_mm=10.0, fibre_depths_mm=(1.5, 0.5))
ERRORS_MM = {
    "as assumed": ([0.5, 0.75], [1.0, 1.5]),
    "published disc, K = 0.6": ([4.0, 6.0], [3.0, 6.0]),
    "half": ([2.0, 2.5], [7.0, 5.0]),
}


def design_document(enforce: bool = True) -> dict[str, Any]:
    """The design.json of a pad of 2 + 3 fibres that breaks two rules, unless there are none."""
    sections = (
        PadSettings(horizontals=2, verticals=3, pitch_mm=(8.25, 15.5)),
        SearchSettings(scatter=0.184, noise=0.0123),
        RulesSettings(enforce=enforce, max_crossings=4),
        PRESS,
    )
    return {
        "terms": TERMS.copy(),
        "straight": STRAIGHT,
        "descriptions": describe_terms(TERMS),
        "violations": VIOLATIONS if enforce else [],
        "provenance": {"settings": {each.section(): each.model_dump(mode="json") for each in sections}},
    }


def contacts_document() -> dict[str, Any]:
    rows = [
        {"contact": contact, "pad": pad, "errors_mm": errors_mm}
        for contact, pair in ERRORS_MM.items()
        for pad, errors_mm in zip(("designed", "straight"), pair, strict=True)
    ]
    return {"scatter": {"floor": 0.02, "share": 0.18, "common": 0.36}, "rows": rows}


def test_design_section(golden: Golden, tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures/design.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1"/>')
    sections = [design_sections(tmp_path, design_document(enforce)) for enforce in (True, False)]
    texts = [page_text(page("Pad", "", each)) for each in sections]
    golden("design/report_design.txt", "\n\n".join(texts))


def test_press_section(golden: Golden, monkeypatch: pytest.MonkeyPatch) -> None:
    blank_pictures(monkeypatch)
    limits: list[tuple[Any, ...]] = [(0.2,), (None,), (0.5, ("Dragon Skin 30", 550))]
    texts = [page_text(page("Pad", "", press_sections(design_document(), *limit))) for limit in limits]
    golden("design/report_press.txt", "\n\n".join(texts))
    other = design_document()
    other["provenance"]["settings"]["contact"] = Contact(model="profile").model_dump(mode="json")
    assert press_sections(other, 0.5) == []


def test_contact_section_and_lines(golden: Golden) -> None:
    document = contacts_document()
    better = document | {"rows": document["rows"][:2] + document["rows"][4:]}
    lines = [*contact_lines(document), *contact_lines(better)]
    golden("design/report_contacts.txt", page_text(page("Pad", "", contact_sections(Path(), document))))
    golden("design/contact_lines.txt", "\n".join(lines))


@pytest.mark.parametrize("tool", ["dome", "flat", "ball"])
def test_press_is_drawn_to_scale(golden: Golden, figures: list[Any], monkeypatch, tool: str) -> None:
    blank_pictures(monkeypatch)
    document, contact = design_document(), PRESS.model_copy(update={"tool": tool})
    document["provenance"]["settings"]["contact"] = contact.model_dump(mode="json")
    press_sections(document, None)
    golden(f"design/press_{tool}.txt", figures[0], forget=[r"-?\d\.\d+e-1\d"], rtol=1e-3)
    section = figures[0].axes[0]
    x_mm, height_mm = np.asarray(section.lines[-1].get_xydata(), float).T  # of the vertical fibres
    heights_mm, press = np.linspace(0, 7.5, 30), contact_press(contact)
    strains = [press.strains(np.abs(x_mm), z, FIBRE_BLUR_MM).compressive for z in heights_mm]
    assert np.diff(x_mm) == pytest.approx(8.25)
    assert height_mm == pytest.approx(7.5 - np.trapezoid(strains, heights_mm, axis=0), abs=0.03)
