"""Every rule as a penalty: nothing where it holds, more the more it is broken, with a true gradient."""

import numpy as np
import pytest
import torch

from design import Morphology
from design.contact import fibre_axes
from design.curves import crossings
from design.penalties import penalties
from design.rules import check
from design.settings import Pad, Rules

NONE = Rules(min_bend_radius_mm=0, min_gap_mm=0, same_family_crossings=0, border_mm=0, max_length_mm=1e6)


def axes(pad):
    travel, cross, _ = fibre_axes(pad)
    return torch.tensor(travel[0], requires_grad=True), torch.tensor(cross[0], requires_grad=True)


def found(pad, rules, margin=1.0):
    return {rule: value.item() for rule, value in penalties(*axes(pad), Pad(grid=pad.grid), rules, margin).items()}


def bent(cross, travel=2.5, fibre=0, others=0.0):
    """A 4 x 4 grid with one knot of one fibre moved, the others lifted by `others`."""
    knots = Morphology.straight(4).knots
    middle = knots.mean(axis=1, keepdims=True)
    middle[:4, :, 1] += others
    knots = np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1)
    knots[fibre, 1] = (travel, cross) if fibre < 4 else (cross, travel)
    return Morphology(knots)


def test_the_straight_grid_has_no_penalty():
    assert set(found(Morphology.straight(4), Rules()).values()) == {0.0}


@pytest.mark.parametrize(
    ("limits", "mild", "worse"),
    [
        ({"min_bend_radius_mm": 60.0}, bent(1.75), bent(1.9)),
        ({"min_gap_mm": 5.0}, bent(1.7), bent(1.9)),
        ({"same_family_crossings": 0}, bent(2.2), bent(2.8)),
        ({"border_mm": 4.0}, bent(4.6, travel=0.3), bent(4.6, travel=0.2)),
        ({"max_length_mm": 60.0}, bent(2.8), bent(3.8)),
        ({"max_crossings": 10}, bent(1.1), bent(3.5, travel=4.5)),
        ({"min_crossing_angle_deg": 85.0}, bent(1.3), bent(1.9)),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_broken_rule_has_a_penalty_that_grows(limits, mild, worse):
    rules = NONE.model_copy(update=limits)
    (rule,) = limits
    grid, little, much = (found(pad, rules)[rule] for pad in (Morphology.straight(4), mild, worse))
    if rule != "max_crossings":
        assert grid == pytest.approx(0, abs=1e-9)
    assert 0 < little <= much


def test_where_the_penalties_vanish_with_a_margin_the_exact_check_passes():
    """On random gentle pads; those with a penalty are only counted, so that the test is seen to look at both kinds."""
    rng, rules, passed = np.random.default_rng(0), Rules(min_bend_radius_mm=3, min_gap_mm=5, max_length_mm=70), 0
    for _ in range(60):
        knots = Morphology.straight(4).knots
        inner = np.linspace(knots[:, 0], knots[:, -1], 7).transpose(1, 0, 2)[:, 1:-1]
        scatter = rng.uniform(0.02, 0.3)
        inner[:4, :, 1] += scatter * rng.standard_normal((4, 5))
        inner[4:, :, 0] += scatter * rng.standard_normal((4, 5))
        pad = Morphology(np.concatenate([knots[:, :1], inner, knots[:, 1:]], axis=1))
        if sum(found(pad, rules, margin=1.05).values()) == 0:
            passed += 1
            assert check(pad, rules) == []
    assert 5 < passed < 55


def test_folds_that_come_near_each_other_are_pushed_apart():
    knots = np.array([[0, 1], [0.9, 1], [1.0, 1.9], [1.1, 1.9], [1.2, 1.0], [2, 1.0]])
    straight = np.stack([np.ones(6), np.linspace(0, 2, 6)], axis=-1)
    pad = Morphology(np.stack([knots, straight]))
    rules = NONE.model_copy(update={"min_gap_mm": 4.0})
    assert found(pad, rules)["folds"] > 0
    assert {v.fibres for v in check(pad, rules)} == {(1,)}


def test_the_soft_number_of_crossings_is_the_number_of_crossings():
    rules = NONE.model_copy(update={"max_crossings": 1})
    for seed in range(3):
        pad = Morphology.random(3, 2, seed)
        number = sum((c.first < 3) != (c.second < 3) for c in crossings(pad))
        assert found(pad, rules)["max_crossings"] + 1 == pytest.approx(number, rel=0.25)


@pytest.mark.parametrize(
    "rules",
    [
        Rules(min_bend_radius_mm=4, min_gap_mm=9),
        NONE.model_copy(update={"max_crossings": 3, "min_crossing_angle_deg": 60}),
    ],
)
def test_the_gradient_is_that_of_finite_differences(rules):
    """Along random directions, since a search follows it; kinks (a nearest sample that changes) are rare."""
    rng = np.random.default_rng(4)
    pad = Morphology.random(2, 3, seed=5)
    travel, cross = axes(pad)
    total = torch.stack(list(penalties(travel, cross, Pad(grid=2), rules).values())).sum()
    total.backward()
    step = 1e-6 * torch.tensor(rng.standard_normal(cross.shape))
    step[:, [0, -1]] = 0
    with torch.no_grad():
        ahead, behind = (
            torch.stack(list(penalties(travel, cross + sign * step, Pad(grid=2), rules).values())).sum()
            for sign in (1, -1)
        )
    assert cross.grad is not None
    assert (ahead - behind).item() / 2 == pytest.approx((cross.grad * step).sum().item(), rel=2e-2)
