import numpy as np
import pytest

from padforge.design.optimize.genetic import GeneticSearch
from padforge.design.optimize.problem import SearchProblem
from padforge.design.published.objective import published_objective, published_presses, published_terms
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings

PAD, CONTACT = PadSettings(grid=3), PUBLISHED_CONTACT
SMALL = SearchSettings(method="genetic", knots=3, population=20, generations=30)


def bred(generations, search=SMALL, origin=None, pad=PAD):
    """A search after so many generations, and its best objective after each."""
    breeding = GeneticSearch(SearchProblem(pad, (CONTACT,), search, RulesSettings(), origin))
    objectives = []
    for _ in range(generations):
        breeding.advance()
        objectives.append(breeding.objective)
    return breeding, objectives


@pytest.mark.parametrize("asked", [{"levels": 16}, {"weights": (0.5, 0.0, 1e-5), "presses": 3}, {"entropy": "joint"}])
def test_genetic_search_minimises_the_objective_of_its_settings(asked):
    breeding, objectives = bred(2, SMALL.model_copy(update=asked))
    presses = published_presses(PAD.layout, asked.get("presses", 7))
    others = {name: asked[name] for name in asked if name != "presses"}
    assert published_terms(breeding.morphology(), CONTACT, presses, **others)[0].objective == objectives[-1]
    assert published_objective(breeding.morphology(), CONTACT) != objectives[-1]


def test_genetic_search_keeps_or_improves_its_origin():
    """One far better than what so short a search finds: it is kept to the last bit, or improved on."""
    origin = bred(15)[0].morphology()
    value = published_objective(origin, CONTACT)
    breeding, objectives = bred(2, origin=origin)
    assert objectives[0] <= value < bred(2)[1][-1]
    assert published_objective(breeding.morphology(), CONTACT) <= value


def test_genetic_search_is_on_its_way_to_the_published_objective_or_there():
    """The best of the first generation has about 0.114."""
    search = SearchSettings(method="genetic", knots=5, generations=12)
    breeding, objectives = bred(12, search, pad=PadSettings())
    assert breeding.done
    assert objectives[-1] <= 0.1040


def test_half_of_the_first_generation_has_fibres_near_their_levels():
    """Across, with a standard deviation of 1; those of the other half lie anywhere, on a pad of side 5 in units."""
    search = SearchSettings(method="genetic", population=20, knots=12)
    breeding, _ = bred(1, search, pad=PadSettings())
    knots = breeding.state()["population"].reshape(20, 2, 4, 12, 2)  # family, fibre, knot, coordinate
    across = np.stack([knots[:, family, :, :, 1 - family] for family in (0, 1)], axis=1)
    variance = np.sort(((across - np.arange(1, 5)[:, None]) ** 2).mean(axis=(1, 2, 3)))
    assert variance[9] < 1.2  # the pad's edges cut some off
    assert variance[10] > 25 / 12
