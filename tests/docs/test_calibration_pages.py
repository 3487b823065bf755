"""Numbers of presses in the pages on calibrations."""

import re

from padforge.sense.health.health_model import MIN_PRESSES
from padforge.sense.settings import LocalizerSettings
from tests.docs.pages import ROOT


def page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def test_presses_by_hand_suffice_for_health() -> None:
    """Of the recording that is then calibrated; the text names the least that does."""
    text, share = page("howto-by-hand"), 1 - LocalizerSettings().test_share
    [presses] = re.findall(r"--presses (\d+) --out out/mine", text)
    [least] = re.findall(r"Fewer than (\d+)", text)
    assert round(share * int(least)) == MIN_PRESSES <= share * int(presses)
    assert f"{presses} presses take about" in text


def test_tutorial_counts_the_presses_of_its_table() -> None:
    text = page("tutorial-sense")
    assert re.findall(r"error in mm on (\d+) presses", text)[0] == re.findall(r"The table evaluates (\d+) ", text)[0]
