import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from design.pad.knots import assemble
from design.pad.morphology import Morphology
from design.settings import PadSettings, RulesSettings
from fabricate.dispensing.course import Stroke, laying_steps
from fabricate.mould.plan import Plan
from fabricate.report.laying import guide
from fabricate.settings import DEFAULTS, DispenserSettings


def with_dispenser(**keys: object):
    return replace(DEFAULTS, dispenser=DispenserSettings.model_validate(keys))


def strokes(plan: Plan, stretch: float = math.inf) -> list[Stroke]:
    return [stroke for step in laying_steps(plan, 0.3, stretch) for stroke in step.strokes]


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
    radius = window_mm / np.maximum(
        np.interp(arc + window_mm / 2, arc, turned) - np.interp(arc - window_mm / 2, arc, turned), 1e-9
    )
    along = stroke.places_mm[:, family] * (-1 if family == 0 else 1)
    return np.array([radius[(t >= a) & (t <= b)].min(initial=1e9) for a, b in pairwise(along)])


@pytest.mark.parametrize("stretch", [math.inf, 0.3])
def test_no_bend_is_taken_faster_than_machine_and_fibre_can(stretch):
    plan = Plan(Morphology.random(2, 3, seed=6), with_dispenser(acceleration_mm_s2=60.0, feed_mm_s=12.0))
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
        (4.0, 26.0, math.inf, 10.0),
        (2.0, 9.5, math.inf, 4.0),  # sqrt(9.5 * 2) = 4.36 mm/s
        (4.0, 26.0, 0.07, 4.0),  # 1 - 0.3 / (2 * 4 * 0.07) = 0.464 of the feed
        (4.0, 9.5, 0.11, 6.0),  # the fibre bears 6.59 mm/s
    ],
)
def test_the_feed_in_a_bend_is_what_its_radius_allows(radius_mm, acceleration, stretch, feed):
    """Leads to one side turn by quarters of a circle, of the least radius of the rules; all else here is straight."""
    settings = replace(
        with_dispenser(acceleration_mm_s2=acceleration, feed_mm_s=10.0),
        pad=PadSettings(leads="one side"),
        rules=RulesSettings(min_bend_radius_mm=radius_mm),
    )
    (horizontal,) = (each for each in strokes(Plan(Morphology.straight(2), settings), stretch) if each.fibre == 0)
    assert (horizontal.feeds_mm_s.min(), horizontal.feeds_mm_s.max()) == (feed, 10.0)
    slow_mm = horizontal.steps_mm[horizontal.feeds_mm_s == feed].sum()
    ends_mm = 4 * 2 * 0.3  # of both quarters: beside them the needle has half a diameter to get slower in
    assert slow_mm == pytest.approx(math.pi * radius_mm if feed < 10 else horizontal.steps_mm.sum(), abs=ends_mm)


def test_bends_only_where_they_are_slow_a_fibre_down():
    """A corner in mid-way: beyond a millimetre of it the needle is as fast as it may be, on the leads as well."""
    inner = np.zeros((2, 3, 2))
    inner[0] = [(0.6, 1.0), (1.0, 1.0), (1.02, 1.2)]
    inner[1] = [(1, 0.5), (1, 1.0), (1, 1.5)]
    bent, straight = strokes(Plan(Morphology(assemble(inner), 10.0)))
    assert straight.feeds_mm_s.tolist() == [10.0]
    at_most = bent.feeds_mm_s == 10
    assert 0 < bent.steps_mm[~at_most].sum() < 6
    assert at_most[[0, -1]].all()
    assert bent.feeds_mm_s.min() < 6


def test_a_fibre_that_bears_less_is_laid_more_slowly_never_at_rest():
    plan = Plan(Morphology.random(2, 4, seed=1))
    feeds = [np.concatenate([stroke.feeds_mm_s for stroke in strokes(plan, each)]) for each in (1e-6, 0.2, 5.0)]
    least, most = [each.min() for each in feeds], [each.max() for each in feeds]
    assert least[0] == 1.0
    assert most == sorted(most)
    lengths = [sum((s.steps_mm / s.feeds_mm_s).sum() for s in strokes(plan, each)) for each in (1e-6, 0.2, 5.0)]
    assert lengths == sorted(lengths, reverse=True)


def test_as_long_as_the_laying_page_has_it_cut():
    plan = Plan(Morphology.random(2, 5, seed=3))
    cut = [fibre["cut_mm"] for fibre in guide.document(plan, 1.0)["fibres"]]
    for stroke in strokes(plan):
        assert stroke.steps_mm.sum() == pytest.approx(cut[stroke.fibre], abs=0.02)


def test_few_corners_where_a_fibre_is_straight():
    plan = Plan(Morphology.straight(3))
    assert all(len(stroke.places_mm) == 2 for stroke in strokes(plan, 1.0))
    assert {stroke.feeds_mm_s.item() for stroke in strokes(plan, 1.0)} == {10.0}
