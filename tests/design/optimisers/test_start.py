"""A start in slices: shorter ones, where steps are slow, lead to the same fibres."""

import pytest

from design.optimisers.problem import SearchProblem
from design.optimisers.search import search
from design.optimisers.start import advance_start
from design.settings import PadSettings, RulesSettings, SearchSettings

SMALL = SearchSettings(knots=3, starts=1, steps=30, population=20, generations=4, lost=1)


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_slow_steps_come_in_shorter_slices_to_the_same_result(method, monkeypatch):
    settings = SMALL.model_copy(update={"method": method})
    whole = search(settings=settings)
    monkeypatch.setattr("design.optimisers.start.SLICE_S", -1.0)
    problem = SearchProblem(PadSettings(), (settings.usual_contact,), settings, RulesSettings(), None)
    assert advance_start(problem, 0, None).step == 1
    assert search(settings=settings).morphology == whole.morphology
