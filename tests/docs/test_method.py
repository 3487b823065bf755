"""The method page describes the program that there is."""

from padforge.design.contact_set import judged_contacts
from padforge.design.objectives import bayes_error
from padforge.design.settings import Contact, SearchSettings
from padforge.sense.localizer import moments, press_sampler
from padforge.sense.localizer.features import N_TIMED
from tests.docs.pages import ROOT

METHOD = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    """Return the text below a heading, as one line."""
    return " ".join(METHOD.partition(f"{title}\n")[2].partition("\n##")[0].split())


def test_errors_under_another_contact_name_those_that_are_compared() -> None:
    text = section("## Errors under another contact")
    for name in judged_contacts(Contact(), SearchSettings()):
        assert f"| {name} |" in text


def test_expected_errors_are_described_as_they_are_computed() -> None:
    text = section("## Expected error")
    assert f"over {bayes_error.PRESSES} simulated presses" in text
    assert f"the expected error is {bayes_error.LEARNING:g} times that of the rule" in text


def test_strokes_are_as_frequent_and_fast_as_they_are_trained() -> None:
    phases, (slow, fast) = moments.PHASES[N_TIMED], press_sampler.SPEEDS_MM_S
    assert {name: phase.sliding for name, phase in phases.items() if phase.sliding} == {"touched": 0.3}
    assert "strokes: in three of ten presses of the touch" in section("## From presses to positions")
    assert f"at {slow:g} to {fast:g} mm/s" in section("## From presses to positions")
