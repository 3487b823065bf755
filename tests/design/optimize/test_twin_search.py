"""Which pad a search for a twin hands back: never one that locates less well than plain pads do."""

import re

import numpy as np
import pytest

from padforge.design.contact_comparison import ContactErrors
from padforge.design.morphology import Morphology
from padforge.design.optimize import search
from padforge.design.optimize.search import SearchOptions, choose, search_for_twin
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

PLAIN = {"default": np.array([1.0, 1.0, 1.5, 2.0]), "straight fibres": np.array([0.9, 1.2, 2.0, 3.0])}


@pytest.mark.parametrize(
    ("twin", "expected"),
    [
        ([0.9, 0.9, 1.0, 1.5], "twin"),  # better everywhere
        ([0.92, 1.02, 1.0, 1.0], "twin"),  # within what networks tell
        ([1.02, 0.5, 0.5, 0.5], "default"),  # far better with fibres failed, but an eighth worse with all alive
        ([2.0, 2.0, 2.0, 3.5], "default"),
    ],
)
def test_choose_takes_no_pad_that_is_worse_than_plain_ones(twin, expected):
    assert choose(PLAIN | {"twin": np.array(twin)}) == expected


def test_choose_takes_the_least_bad_where_each_is_worse_somewhere():
    errors = {"default": np.array([2.0, 1.0]), "straight fibres": np.array([1.0, 2.0]), "twin": np.array([1.3, 1.3])}
    assert choose(errors) == "twin"


@pytest.mark.parametrize(
    ("rules", "expected"), [({"enforce": False}, "straight fibres"), ({"max_length_mm": 20}, "twin")]
)
def test_search_for_twin_hands_back_what_locates_best_and_can_be_built_if_any_can(rules, expected, monkeypatch, golden):
    """What a criterion promises does not count."""
    monkeypatch.setattr("padforge.design.optimize.gradient.REPAIR_STEPS", 20)

    def judged(pads, contacts, size, search):
        assert set(pads) == ({"default", "straight fibres", "twin", "from default"} if expected != "twin" else {"twin"})
        for name in pads:
            errors = (1.0, 1.0) if name == "straight fibres" else (2.0, 2.0)
            yield ContactErrors("", name, errors)

    monkeypatch.setattr(search, "errors_by_contact", lambda *asked: list(judged(*asked)))
    quick = SearchSettings(knots=3, starts=1, steps=2, max_failures=1)
    pad, contact = PadSettings(grid=1), Contact(sensitivity_profile=((0, 1), (5, 0.6), (9, 0.1), (12, 0)))
    steps = []
    run = SearchOptions(on_progress=lambda done, total, what: steps.append(what))
    found = search_for_twin(pad, contact, quick, RulesSettings(**rules), quick, run=run)
    assert found.candidate == expected
    assert bool(found.violations) == (expected == "twin")
    if expected == "straight fibres":
        assert found.morphology == Morphology.straight(pad.layout)
        assert found.terms["expected_error_mm_0"] == pytest.approx(found.straight["expected_error_mm_0"], rel=1e-6)
    words = dict.fromkeys(re.sub(r"\d+\.\d+", "#", what) for what in steps)
    history = [f"{row['run']}, step {row['step']}" for row in found.history]
    golden("design/twin_search.txt", "\n".join([*words, *history]))
