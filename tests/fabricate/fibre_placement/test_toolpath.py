import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from padforge.design.morphology import Morphology
from padforge.fabricate.fibre_placement import Stroke, plan_toolpath
from padforge.fabricate.plan import Plan
from tests.fabricate.planted import with_settings


def strokes(plan: Plan, stretch: float = math.inf) -> list[Stroke]:
    return [stroke for step in plan_toolpath(plan, 0.3, stretch) for stroke in step.strokes]


def least_radii(plan: Plan, stroke: Stroke, window_mm: float) -> np.ndarray:
    """The plain way: the heading every 2 um by scipy's PCHIP, what turns within a window, the most in each piece."""
    family = plan.family(stroke.fibre)
    knots = plan.pad.to_mm(plan.pad.knots[stroke.fibre])
    travel, cross = knots[:, family], knots[:, 1 - family]
    t = np.linspace(travel[0] - window_mm, travel[-1] + window_mm, 40_000)
    inside = (t >= travel[0]) & (t <= travel[-1])
    slope = np.where(inside, PchipInterpolator(travel, cross)(t, 1), 0.0)
    arc = np.concatenate([[0], np.cumsum(np.hypot(1, (slope[1:] + slope[:-1]) / 2) * np.diff(t))])
    turned = np.concatenate([[0], np.cumsum(np.abs(np.diff(np.arctan(slope))))])
    before, after = (np.interp(arc + side * window_mm / 2, arc, turned) for side in (-1, 1))
    radius = window_mm / np.maximum(after - before, 1e-9)
    along = stroke.positions_mm[:, family] * (-1 if family == 0 else 1)
    return np.array([radius[(t >= a) & (t <= b)].min(initial=1e9) for a, b in pairwise(along)])


@pytest.mark.parametrize("stretch", [math.inf, 0.3])
def test_feeds_in_bends_are_within_machine_and_fibre_limits(stretch):
    settings = with_settings(dispenser={"acceleration_mm_s2": 60.0, "feed_mm_s": 12.0})
    plan = Plan(Morphology.random(2, 3, seed=6), settings)
    slow = 0
    for stroke in strokes(plan, stretch):
        radius = least_radii(plan, stroke, 0.3)
        allowed = np.minimum(np.sqrt(60 * radius), 12 * (1 - 0.3 / (2 * radius * stretch)))
        assert (stroke.feeds_mm_s <= np.clip(1.1 * allowed, 1.2, 12) + 1e-9).all()
        slow += (stroke.feeds_mm_s < 6).sum()
        assert np.allclose(stroke.feeds_mm_s / 1.2, np.round(stroke.feeds_mm_s / 1.2))
    assert slow


@pytest.mark.parametrize(
    ("radius_mm", "acceleration", "stretch", "feed"),
    [
        (4.0, 9.5, math.inf, 6.0),  # sqrt(9.5 * 4) = 6.16 mm/s
        (4.0, 26.0, 0.07, 4.0),  # 1 - 0.3 / (2 * 4 * 0.07) = 0.464 of the feed
        (4.0, 9.5, 0.11, 6.0),  # the fibre bears 6.59 mm/s
    ],
)
def test_feed_in_a_bend_follows_from_its_radius(radius_mm, acceleration, stretch, feed):
    """Leads to one side turn by quarters of a circle, of the least radius of the rules; all else here is straight."""
    settings = with_settings(
        pad={"leads": "one side"},
        rules={"min_mean_bend_radius_mm": radius_mm},
        dispenser={"acceleration_mm_s2": acceleration, "feed_mm_s": 10.0},
    )
    (horizontal,) = (each for each in strokes(Plan(Morphology.straight(2), settings), stretch) if each.fibre == 0)
    assert (horizontal.feeds_mm_s.min(), horizontal.feeds_mm_s.max()) == (feed, 10.0)
    slow_mm = horizontal.steps_mm[horizontal.feeds_mm_s == feed].sum()
    ends_mm = 4 * 2 * 0.3  # of both quarters: beside them the needle has half a diameter to get slower in
    assert slow_mm == pytest.approx(math.pi * radius_mm if feed < 10 else horizontal.steps_mm.sum(), abs=ends_mm)
