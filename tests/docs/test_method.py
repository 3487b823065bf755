"""The method page describes the program that there is."""

from padforge.design import contact_comparison as comparison
from padforge.design.settings import Contact, PadSettings, SearchSettings
from padforge.sense.localizer import moments, press_sampler
from padforge.sense.localizer.features import N_TIMED
from tests.docs.pages import ROOT

METHOD = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    """Return the text below a heading, as one line."""
    return " ".join(METHOD.partition(f"{title}\n")[2].partition("\n##")[0].split())


def test_errors_under_another_contact_are_described_as_they_are_computed() -> None:
    text, scatter = section("### Errors under another contact"), SearchSettings().response_scatter
    networks = 2 * len(comparison.alternative_contacts(Contact())) * (1 + comparison.MAX_FAILURES * comparison.SUBSETS)
    assert PadSettings().layout.fibres == 8
    for stated in (
        f"{comparison.SIDE**2} presses",
        f"{comparison.N_TEST} others",
        f"{comparison.HIDDEN} neurons",
        f"{networks} networks",
        f"by {scatter.share:.0%}".replace("%", " %"),
        f"{scatter.common:.0%}".replace("%", " %"),
        f"{scatter.floor:.0%} of full scale".replace("%", " %"),
        *(f"| {name} |" for name in comparison.alternative_contacts(Contact())),
    ):
        assert stated in text, stated


def test_strokes_are_as_frequent_and_fast_as_they_are_trained() -> None:
    phases, (slow, fast) = moments.PHASES[N_TIMED], press_sampler.SPEEDS_MM_S
    assert {name: phase.sliding for name, phase in phases.items() if phase.sliding} == {"touched": 0.3}
    assert "strokes: in three of ten presses of the touch" in section("## From presses to positions")
    assert f"at {slow:g} to {fast:g} mm/s" in section("## From presses to positions")
