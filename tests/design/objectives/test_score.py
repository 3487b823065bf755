import numpy as np
import pytest

from padforge.design import Contact, Morphology, PadSettings, RulesSettings, check_rules, draw_plan
from padforge.design.contact import fibre_axes
from padforge.design.objectives.penalties import penalties
from padforge.design.objectives.score import score, sharpness, sharpness_loss
from padforge.design.optimize.gradient import Parametrization
from padforge.design.published.objective import published_terms
from padforge.design.signal_gradients import FibreCurves
from tests.design.wild_pads import KINDS, wild_knots


def test_score_evaluates_the_sensed_area(little_scored):
    """The published terms and the information are of presses between the fibres, wherever else it is pressed."""
    # a layer leaves no fibre idle anywhere
    pad, disc = Morphology.random(2, 4, seed=1), Contact(radius=0.9, sides=None)
    beyond, wide = (
        score(pad, disc, max_failures=0, pad_settings=PadSettings(sensed_mm=size)) for size in ("beyond", (30, 20))
    )
    for name in beyond:
        assert (beyond[name] == wide[name]) == name.startswith(("published", "information", "penalty"))
    assert score(pad, disc, max_failures=0) == beyond
    layer = score(pad, max_failures=0)
    assert beyond["published_objective"] == published_terms(pad, disc)[0].objective != layer["published_objective"]
    assert layer["published_objective"] == published_terms(pad)[0].objective  # a layer has none of its own


def test_sharpness_has_a_closed_form_and_a_gradient():
    assert sharpness(np.array([[0.0, 1.0, 2.0, 3.0], [0.0, 0.0, 1.0, 0.0]])) == pytest.approx((1 + 2) / 4)
    travel, cross, *_ = fibre_axes(Morphology.random(3, 4, seed=2))
    knots, move = np.array([travel[0], cross[0]]), np.random.default_rng(3).standard_normal((2, 6, 6))
    size = PadSettings(grid=3)

    def loss(step):
        along, across = knots + step * move
        curves = FibreCurves(along, across, size.layout)
        value, gradient = sharpness_loss(curves, Contact(), size)
        return value, (curves.by_knots(gradient) * move).sum()

    assert (loss(1e-6)[0] - loss(-1e-6)[0]) / 2e-6 == pytest.approx(loss(0.0)[1], rel=1e-3)


CONTACTS = [
    Contact(),
    Contact(radius=1e-9, sides=None),
    Contact(radius=0.1, sides=3, weight="inverse", length="euclidean"),
    Contact(radius=1e4, sides=4),
]
RULES = [
    RulesSettings(max_crossings=3, min_crossing_angle_deg=45.0, min_gap_mm=5.0),
    RulesSettings(min_mean_bend_radius_mm=0, min_gap_mm=1e-9, border_mm=0, min_crossing_angle_deg=1e-9),
    RulesSettings(min_mean_bend_radius_mm=1000, min_gap_mm=1000, border_mm=1000, max_length_mm=1e-3),
]


@pytest.mark.parametrize("kind", [*KINDS, "no knots"])
def test_score_rules_and_plan_of_wild_pads_are_finite(kind, little_scored):
    seed = [*KINDS, "no knots"].index(kind)
    rng, contact, rules = np.random.default_rng(seed), CONTACTS[seed % 4], RULES[seed % 3]
    count = 0 if kind == "no knots" else int(rng.integers(1, 7))
    pad = Morphology(wild_knots(kind, 1 + seed % 2, count, rng), rng.choice([0.1, 11.25, 1000.0]))
    terms = score(pad, contact, seed % 9, (1e-9, 0.1, 10.0)[seed % 3], rules)
    assert np.isfinite([*terms.values()]).all()
    assert 0 <= terms["published_entropy"] <= 2 * np.log2(49) + 1e-9
    findings = check_rules(pad, rules)
    assert np.isfinite([[finding.measured, finding.limit] for finding in findings]).all()
    draw_plan(pad, contact, findings).draw_without_rendering()
    assert pad.tiled(2).grid == 2 * pad.grid
    if pad.knots.shape[1] > 2:
        fibres = Parametrization.from_knots(pad.knots, pad.layout, 0.01)
        assert np.isfinite(fibres.knots()).all()
        size = PadSettings(grid=pad.grid, pitch_mm=pad.pitch_mm)
        values, *gradient = penalties(*fibres.axes(), size, rules)
        assert all(np.isfinite(value) and value >= 0 for value in values.values())
        assert np.isfinite(gradient).all()
