"""Scores of pads: every term by name, whatever the size of the pad."""

import math

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.design.contact import fibre_axes
from padforge.design.objectives.score import TERMS, score, sharpness
from padforge.design.published.objective import published_terms
from padforge.design.settings import PadSettings
from padforge.design.signal_gradients import FibreCurves


def test_score_evaluates_the_sensed_area(little_scored):
    """The published terms and the information are of presses between the fibres, wherever else it is pressed."""
    # a layer leaves no fibre idle anywhere
    pad, disc = Morphology.random(2, 4, seed=1), Contact(radius=0.9, sides=None)
    beyond, wide = (score(pad, disc, max_failures=0, size=PadSettings(sensed_mm=size)) for size in ("beyond", (30, 20)))
    for name in beyond:
        assert (beyond[name] == wide[name]) == name.startswith(("published", "information", "penalty"))
    assert score(pad, disc, max_failures=0) == beyond
    layer = score(pad, max_failures=0)
    assert beyond["published_objective"] == published_terms(pad, disc)[0].objective != layer["published_objective"]
    assert layer["published_objective"] == published_terms(pad)[0].objective  # a layer has none of its own


def test_score_joint_entropy_saturates_before_those_of_families(little_scored):
    """49 presses give no more than log2 49 bits, and straight fibres have them."""
    pad = Morphology.straight(4)
    assert score(pad, max_failures=0)["published_joint_entropy"] == pytest.approx(math.log2(49))
    assert published_terms(pad)[0].entropy < 9
    one = score(Morphology.straight((1, 0)), max_failures=0)  # one family is all there is
    assert one["published_joint_entropy"] == one["published_entropy"]


def test_sharpness_has_a_closed_form():
    assert sharpness(np.array([[0.0, 1.0, 2.0, 3.0], [0.0, 0.0, 1.0, 0.0]])) == pytest.approx((1 + 2) / 4)


@pytest.mark.parametrize("term", [term for term in TERMS if term.loss is not None], ids=lambda term: term.name)
def test_losses_of_a_search_have_gradients(term):
    travel, cross, ends, _ = fibre_axes(Morphology.random(3, 4, seed=2))
    knots, move = np.array([travel[0], cross[0]]), np.random.default_rng(3).standard_normal((2, 6, 6))
    size = PadSettings(grid=3)

    def loss(step):
        along, across = knots + step * move
        curves = FibreCurves(along, across, ends, size.layout.unit_mm)
        value, gradient = term.loss(curves, Contact(), size)
        return value, (curves.by_knots(gradient) * move).sum()

    assert (loss(1e-6)[0] - loss(-1e-6)[0]) / 2e-6 == pytest.approx(loss(0.0)[1], rel=1e-3)
