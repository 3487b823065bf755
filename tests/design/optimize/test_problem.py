"""What a search minimises of a finished pad."""

import numpy as np
import pytest

from padforge.design import Contact, Morphology, PadSettings, RulesSettings, SearchSettings
from padforge.design.contact_set import served_contacts
from padforge.design.objectives.expected_error import POWER, criterion_errors
from padforge.design.objectives.score import ScoredPad
from padforge.design.optimize.problem import build_problem

RULES = RulesSettings(enforce=False)


@pytest.mark.parametrize("fibres", [(1, 0), (1, 1), (2, 2)])
def test_objective_of_straight_fibres_is_1(fibres):
    """Also where fewer fibres can fail than are designed for."""
    pad = PadSettings(horizontals=fibres[0], verticals=fibres[1])
    problem = build_problem(pad, Contact(), SearchSettings(), RULES)
    assert problem.objective(Morphology.straight(fibres)) == pytest.approx(1)


def test_objective_is_a_mean_over_contacts_and_failures_and_of_weighted_terms():
    pad, curved = PadSettings(grid=2), Morphology.random(2, 3, seed=1)
    search = SearchSettings(max_failures=(3.0, 1.0))
    contacts = served_contacts(Contact(), search).values()
    curved_errors, straight_errors = (
        np.array([criterion_errors(fibres, contact, search, pad) for contact in contacts])
        for fibres in (curved, Morphology.straight(2))
    )
    powers = ((curved_errors / straight_errors) ** POWER @ [0.75, 0.25]).mean()
    objective = build_problem(pad, Contact(), search, RULES).objective(curved)
    assert objective == pytest.approx(powers ** (1 / POWER))
    smooth = build_problem(pad, Contact(), search.model_copy(update={"sharpness": 2.0}), RULES)
    sharpness = ScoredPad(curved, Contact(), search, RULES, pad).terms(["sharpness"])["sharpness"]
    assert smooth.objective(curved) == pytest.approx(objective + 2 * sharpness)
