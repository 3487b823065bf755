"""Search for wirings, and what straight fibres leave open."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Contact, Morphology, signals
from padforge.design.twin import PlanTransform
from padforge.sense.twin.as_built import PadPlan
from padforge.sense.twin.responses import Responses
from padforge.sense.twin.wiring import Wiring, as_stated, find_wirings, images, planned_paths_mm
from tests.sense.conftest import few_candidates

from .conftest import PLAN


@pytest.mark.slow  # the quick tests of `identify` find wirings, too
@few_candidates()
def test_find_wirings_puts_the_true_one_first(printed, responses) -> None:
    """Though readings are missing, and what stands in their place is nonsense."""
    volts, valid = responses.volts.copy(), responses.valid.copy()
    volts[::3, 0], valid[::3, 0] = 5.0, False
    responses = Responses(responses.positions_mm, volts, valid)
    best = find_wirings(PadPlan.from_morphology(PLAN), responses, np.random.default_rng(0))[0]
    assert best.fibres == tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)
    assert best.transform.mirrored
    assert np.hypot(*np.subtract(best.transform.shift_mm, printed.frame.shift_mm)) < 1.0
    assert best.match > 0.9


@pytest.mark.parametrize(
    ("fibres", "pitch_mm", "count"), [(3, 11.25, 8), ((2, 3), (8.0, 12.0), 4), ((2, 2), (8.0, 9.0), 4)]
)
def test_images_of_a_wiring_respond_alike_on_straight_fibres(fibres, pitch_mm, count) -> None:
    pad = Morphology.straight(fibres, pitch_mm)
    start = Wiring(PlanTransform(True, -97.0, (3.0, 1.0), 1.1), 0.5, tuple(range(len(pad.knots)))[::-1], 0.5)
    positions_mm = np.random.default_rng(0).uniform(-8, 8, (40, 2))
    wirings = [start, *images(start, pad.layout)]
    assert len({(wiring.transform.mirrored, wiring.fibres) for wiring in wirings}) == count
    expected, *others = (
        signals(pad, pad.to_grid(wiring.transform.to_plan(positions_mm)), Contact(model="profile"))[:, wiring.fibres]
        for wiring in wirings
    )
    for other in others:
        np.testing.assert_allclose(other, expected, atol=1e-9)
    plan = PadPlan.from_morphology(pad, 5)
    planned, *others = (planned_paths_mm(plan, wiring.transform, wiring.fibres) for wiring in wirings)
    for other in others:  # each from one end or the other
        same, reverse = np.abs(planned - other).max((1, 2)), np.abs(planned - other[:, ::-1]).max((1, 2))
        np.testing.assert_allclose(np.minimum(same, reverse), 0, atol=1e-9)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turn_deg", [-180, 90])
def test_planned_paths_lie_under_the_arm_where_the_transform_takes_them_to_the_plan(mirrored, turn_deg) -> None:
    plan, fibres = PadPlan.from_morphology(PLAN, 5), (2, 0)
    expected = (plan.paths[[2, 0]] - np.array(plan.layout.extent) / 2) * plan.layout.unit_mm
    paths_mm = planned_paths_mm(plan, PlanTransform(mirrored, turn_deg + 8.0, (3.0, 1.0), 1.1), fibres)
    on_plan = [PlanTransform(mirrored, turn_deg).to_plan(path) for path in paths_mm]
    np.testing.assert_allclose(on_plan, expected, atol=1e-9)


def test_the_stated_wiring_reads_fibres_in_order_of_a_pad_in_the_middle_of_what_was_pressed(responses) -> None:
    elsewhere = replace(responses, positions_mm=responses.positions_mm + np.array([200.0, -100.0]))
    wiring = as_stated(np.array([0, 2, 3]), elsewhere, 11.25)
    assert wiring.fibres == (0, 2, 3)
    assert np.abs(wiring.transform.to_plan(elsewhere.positions_mm).mean(axis=0)).max() < 3
    assert as_stated(np.array([1]), responses, 11.25).transform == PlanTransform()
