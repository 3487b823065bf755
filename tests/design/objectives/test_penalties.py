"""Every rule as a penalty: nothing where it holds, more the more it is broken, with a true gradient."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from padforge.design import Morphology, check_rules
from padforge.design.contact import fibre_axes
from padforge.design.kernels.rule_penalties import sum_closeness
from padforge.design.objectives.penalties import COMMON_WEIGHT, penalties
from padforge.design.paths.curves import crossings, lengths, refine
from padforge.design.settings import PadSettings, RulesSettings
from tests.design.objectives.pads import bent, only, swung
from tests.helpers.golden import json_text


def axes(pad):
    travel, cross = fibre_axes(pad)[:2]
    return travel[0], cross[0]


def found(pad, rules, margin=1.0):
    return penalties(*axes(pad), PadSettings(grid=pad.grid), rules, margin).values


def slanting(shift):
    """A 4 x 4 grid with one vertical that crosses the straight horizontal 2 the more flatly the more it shifts."""
    knots = Morphology.straight(4).knots
    inner = knots[:, :1] + np.array([0.3, 0.7])[:, None] * (knots[:, -1:] - knots[:, :1])
    inner[4] = [(1, 1.8), (1 + shift, 2.2)]
    return Morphology(np.concatenate([knots[:, :1], inner, knots[:, -1:]], axis=1))


def test_vanishing_penalties_imply_kept_rules():
    """On random gentle pads; those with a penalty are only counted, so that the test is seen to look at both kinds."""
    rng, rules = np.random.default_rng(0), RulesSettings(min_mean_bend_radius_mm=3, min_gap_mm=5, max_length_mm=70)
    assert set(found(Morphology.straight(4), RulesSettings()).values()) == {0.0}
    passed = 0
    for _ in range(16):
        knots = Morphology.straight(4).knots
        inner = np.linspace(knots[:, 0], knots[:, -1], 7).transpose(1, 0, 2)[:, 1:-1]
        scatter = rng.uniform(0.02, 0.3)
        inner[:4, :, 1] += scatter * rng.standard_normal((4, 5))
        inner[4:, :, 0] += scatter * rng.standard_normal((4, 5))
        pad = Morphology(np.concatenate([knots[:, :1], inner, knots[:, 1:]], axis=1))
        if sum(found(pad, rules, margin=1.05).values()) == 0:
            passed += 1
            assert check_rules(pad, rules) == []
    assert 2 < passed < 14


@pytest.mark.parametrize(
    ("pad", "rules", "tolerance"),
    [
        (Morphology.random(2, 3, seed=5), only(same_family_crossings=0, max_length_mm=50), 1e-5),
        (Morphology.random(2, 3, seed=5), only(max_crossings=4, min_crossing_angle_deg=60), 1e-5),
        (Morphology.random(3, 3, seed=2), only(same_family_crossings=1), 1e-5),
        # the tangent at the nearest sample turns as well, which the gradient leaves out
        (Morphology.random(2, 3, seed=5), only(min_gap_mm=9), 0.03),
        # and the middle of a stretch in common moves
        (slanting(2.0), only(max_common_track_mm=1.6), 0.1),
    ],
)
def test_penalty_gradients_match_finite_differences(pad, rules, tolerance):
    """Along random directions, since a search follows it; kinks (a nearest sample that changes) are rare."""
    size, (along, across) = PadSettings(grid=pad.grid), axes(pad)
    values, *gradient = penalties(along, across, size, rules)
    assert sum(values.values()) > 0
    for seed in range(3):
        step = 1e-7 * np.random.default_rng(seed).standard_normal((2, *across.shape))
        step[:, :, [0, -1]] = 0
        ends = (penalties(along + s * step[0], across + s * step[1], size, rules).values for s in (1, -1))
        ahead, behind = (sum(values.values()) for values in ends)
        parts = gradient * step
        assert (ahead - behind) / 2 == pytest.approx(parts.sum(), abs=tolerance * np.abs(parts).sum())


@pytest.mark.parametrize(("bent_radius_mm", "all_bends", "margin"), [(1e6, True, 1.0), (30.0, False, 1.3)])
def test_bends_and_end_slopes_of_a_tangled_pad(bent_radius_mm, all_bends, margin, golden):
    """Whose gradient leaves out how the arc lengths change that samples stand for, so that differences are others."""
    pad, rules = Morphology.random(2, 4, seed=5), only(min_mean_bend_radius_mm=9.0, border_mm=12.0)
    size = PadSettings(grid=2, bent_radius_mm=bent_radius_mm)
    values, *gradient = penalties(*axes(pad), size, rules, margin, all_bends=all_bends)
    golden(f"design/penalties_{margin:g}.json", json_text({**values, "gradient": np.array(gradient)}))


@pytest.mark.parametrize("margin", [1.0, 1.2])
def test_penalties_of_plain_pads_have_closed_forms(margin):
    # a sample nearer by the share c costs c + 10 c^2; in a row of four the outer two have one neighbour, not two
    straight, close = Morphology.straight(4), 1 - 11.25 / (15.0 * margin)
    terms = found(straight, only(min_gap_mm=15.0, same_family_crossings=0), margin)
    assert terms["min_gap_mm"] == pytest.approx((close + 10 * close**2) * 6 / 4)
    assert terms["same_family_crossings"] == pytest.approx(close + 10 * close**2)
    # two fibres that swing by a slope of 1.5 cross at 33.7 degrees, and the other three pairs more steeply
    shortfall = 1 - np.degrees(np.arctan(1 / 1.5)) / 50 / margin
    terms = found(swung(), only(min_crossing_angle_deg=50.0), margin)
    assert terms["min_crossing_angle_deg"] == pytest.approx(shortfall, rel=0.1)
    # half the limit from where a straight horizontal crosses a fibre it is off by that times the sine; half-way between
    # turning points a PCHIP is half as steep again
    share = 1 - 0.8 / margin * np.sin(np.arctan(0.4 / 3.0)) / 0.4
    expected = COMMON_WEIGHT * share * 1.6 / margin / 11.25 / 8 / 5  # by its share of the length of all fibres
    terms = found(slanting(2.0), only(max_common_track_mm=1.6), margin)
    assert terms["max_common_track_mm"] == pytest.approx(expected, rel=0.05)
    # all fibres of the grid are 56.25 mm long; one alone counts by its share of the pad
    assert found(straight, only(max_length_mm=45.0), margin)["max_length_mm"] == pytest.approx(1.25 * margin - 1)
    pad = bent(3.0)
    over = lengths(pad)[0] * pad.unit_mm / 57.0 - 1
    assert found(pad, only(max_length_mm=57.0 * margin), margin)["max_length_mm"] == pytest.approx(over / 8, rel=0.02)


def test_closeness_is_to_all_that_a_sample_stands_for() -> None:
    """The nearest sample is 2.5 away along the fibre, but its piece of the tangent begins 0.5 beside the point."""
    points, flat, shares = (
        np.array([[[0.0, 0.0]] * 2, [[-9.0, 0.5], [2.5, 0.5]]]),
        np.zeros((2, 2)),
        [[0.1] * 2, [0.1, 2]],
    )
    gradient, close = np.zeros_like(points), 1 - np.hypot(0.5, 0.5)
    cost = sum_closeness(points, flat, flat, np.array(shares), np.array([[0, 1]]), 1.0, 0.0, 1.0, gradient)
    assert cost == pytest.approx(2 * (close + 10 * close**2))
    np.testing.assert_allclose(gradient[0], -gradient[1, 1] / 2 * [[1], [1]])
    assert (gradient[0] > 0).all()


def test_penalties_vanish_just_within_the_limits():
    terms = found(Morphology.straight(4), only(min_gap_mm=11.2, same_family_crossings=0))
    assert terms["min_gap_mm"] == terms["same_family_crossings"] == 0
    assert found(swung(), only(min_crossing_angle_deg=30.0))["min_crossing_angle_deg"] == pytest.approx(0, abs=0.01)
    assert found(slanting(2.0), only(max_common_track_mm=7.0))["max_common_track_mm"] == 0


@given(st.integers(1, 8), st.integers(0, 10**6))
@settings(max_examples=30)
def test_no_bend_that_breaks_the_rule_clearly_goes_without_a_penalty(knots, seed):
    """Also one between two samples, from which a whole window leads past it; of one fibre, whose bends are few."""
    size, rules = PadSettings(horizontals=1, verticals=0), only(min_mean_bend_radius_mm=2.0)
    pad = Morphology.random(size.layout, knots, seed=seed)
    if any(bend.measured < 0.93 * 2.0 for bend in check_rules(pad, rules)):
        assert penalties(*axes(pad), size, rules, 1.05).values["min_mean_bend_radius_mm"] > 0


def test_same_family_crossings_penalty_counts_the_excess():
    """A fibre that swings over two others and back crosses four times; the count is soft, what is made of it is not."""

    def penalty(allowed, margin=1.0):
        rules = only(same_family_crossings=allowed)
        return found(bent(3.4), rules, margin)["same_family_crossings"]

    count = penalty(1) + 1
    assert count == pytest.approx(4, rel=0.1)
    assert penalty(5) == 0
    assert penalty(8, margin=8.0) == pytest.approx(count - 1)
    assert penalty(6, margin=2.0) == pytest.approx((count - 3) / 3)


def test_max_crossings_penalty_counts_those_above_the_fewest_that_families_have():
    """Else a repair, whose margin grows, bends fibres for what cannot be."""
    straight, rules = Morphology.straight(2), only(max_crossings=4)
    pad = Morphology(refine(straight.knots, 6, straight.layout))  # its samples are denser, so the soft number is exact
    assert found(pad, rules, margin=1.3)["max_crossings"] == pytest.approx(0, abs=0.01)
    for seed in range(2):
        pad = Morphology.random(3, 3, seed)
        number = sum((c.first < 3) != (c.second < 3) for c in crossings(pad))
        assert number > 9
        assert 9 * (found(pad, only(max_crossings=9))["max_crossings"] + 1) == pytest.approx(number, rel=0.25)


@pytest.mark.parametrize("margin", [1.0, 1.5])
def test_folds_penalty_matches_dense_distances_and_spares_steep_fibres(margin):
    """Against the nearest of many points of SciPy's curve that lie half a turn of a gap away or more."""
    knots = np.array([[0, 1], [0.9, 1], [1.0, 1.9], [1.1, 1.9], [1.2, 1.0], [2, 1.0]])
    straight = np.stack([np.ones(6), np.linspace(0, 2, 6)], axis=-1)
    pad, gap = Morphology(np.stack([knots, straight])), margin * 4.0 / 11.25
    curve = PchipInterpolator(knots[:, 0], knots[:, 1])
    shares = (1 - np.cos(np.arange(12) * np.pi / 12)) / 2  # samples are denser towards the ends of spans
    samples = np.append(knots[:-1, :1] + np.diff(knots[:, :1], axis=0) * shares, 2.0)
    at = np.unique(np.concatenate([np.linspace(0, 2, 20_001), samples]))
    line = np.column_stack([at, curve(at)])
    arc = np.append(0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())
    expected = 0.0
    for index in np.searchsorted(at, samples):
        far = np.abs(arc - arc[index]) >= np.pi / 2 * gap
        close = max(1 - np.linalg.norm(line[far] - line[index], axis=1).min() / gap, 0)
        expected += (close + 10 * close**2) / (2 * len(samples))
    rules = only(min_gap_mm=4.0)
    assert found(pad, rules, margin)["folds"] == pytest.approx(expected, rel=0.2)
    assert {v.fibres for v in check_rules(pad, rules)} == {(1,)}
    knots = np.array([[0, 1], [0.5, 1.9], [1.5, 1.9], [2, 1]])  # whose samples lie further apart than the gap
    pad = Morphology(np.stack([knots, np.stack([np.ones(4), np.linspace(0, 2, 4)], axis=-1)]), 11.25)
    assert found(pad, only(min_gap_mm=0.5))["folds"] == 0
    assert check_rules(pad, only(min_gap_mm=0.5)) == []
