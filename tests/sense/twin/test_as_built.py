"""The parametric model of a pad: derivatives, closed forms, transform and path; and the search for its wiring."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.design import Contact, Morphology, signals
from padforge.design.twin import PlanTransform
from padforge.sense.twin import as_built
from padforge.sense.twin.as_built import N_CHANNEL, N_OFFSET, N_SHARED, OFFSET, AsBuiltPad, PadPlan
from padforge.sense.twin.responses import Responses
from padforge.sense.twin.wiring import Wiring, as_stated, find_wirings, images, planned_paths_mm
from tests.sense.conftest import few_candidates

from .conftest import PLAN

F, J, K, STEP = 60, 7, 6, 0.25
POSITIONS_MM = np.random.default_rng(2).uniform(-10, 10, (40, 2))


@pytest.fixture
def pad() -> AsBuiltPad:
    plan = PadPlan.from_morphology(PLAN)
    pad = AsBuiltPad.from_plan(plan, (2, 0, 3), PlanTransform(True, 4.0, (1.0, -2.0), 0.95), 0.5)
    return replace(pad, values=pad.values + 0.03 * np.random.default_rng(0).standard_normal(pad.values.size))


def test_jacobian_agrees_with_differences(pad):
    jacobians = pad.predict_with_jacobian(POSITIONS_MM)[1]
    steps = 1e-6 * np.eye(len(pad.values))
    for index in [*range(N_SHARED), *range(N_SHARED, len(pad.values), 11)]:
        step = steps[index]
        ahead, behind = (replace(pad, values=pad.values + sign * step).predict(POSITIONS_MM) for sign in (1, -1))
        slope = (ahead - behind) / 2e-6
        for channel in range(3):
            columns = np.concatenate([np.arange(N_SHARED), as_built.channel_indices(channel)])
            derivative = jacobians[channel][:, columns == index].sum(axis=1)
            assert slope[:, channel] == pytest.approx(derivative, abs=1e-6)


def test_other_values_scale_the_profile_to_one_keep_predictions_and_are_fitted(pad):
    values = pad.values.copy()
    values[4:N_SHARED] *= 3
    scaled = pad.with_values(values)
    assert np.abs(scaled.profile(np.linspace(0, scaled.max_distance, 101))[0]).max() == pytest.approx(1)
    assert scaled.predict(POSITIONS_MM) == pytest.approx(replace(pad, values=values).predict(POSITIONS_MM))
    # gains and rests are recovered
    responses = Responses(POSITIONS_MM, pad.predict(POSITIONS_MM), np.ones((40, 3), bool))
    values = pad.values.copy()
    values[N_SHARED:].reshape(-1, N_CHANNEL)[:, :2] = [1.0, 0.0]
    fitted = replace(pad, values=values).fit_gains(responses)
    assert fitted.channel_values[:, :2] == pytest.approx(pad.channel_values[:, :2])


def test_align_transform_moves_common_offsets_into_the_transform(pad):
    values = pad.values.copy()
    values[N_SHARED:].reshape(-1, N_CHANNEL)[:, OFFSET] = np.repeat([0.2, -0.1], N_OFFSET)
    shifted = replace(pad, values=values)
    aligned = shifted.align_transform()
    assert np.abs(aligned.channel_values[:, OFFSET]).max() < 1e-6
    assert aligned.predict(POSITIONS_MM) == pytest.approx(shifted.predict(POSITIONS_MM), abs=1e-9)
    volts = pad.predict(POSITIONS_MM)  # offsets that have a rotation in common
    assert pad.align_transform().predict(POSITIONS_MM) == pytest.approx(volts, abs=0.02 * np.ptp(volts))


def test_channel_response_moves_with_the_fibre_grows_with_it_and_ends_with_the_profile():
    rng = np.random.default_rng(1)
    x = np.linspace(0, 4, F + 1)
    line = np.column_stack([x, 0.4 * np.sin(2 * x)])
    step = np.diff(line, axis=0)
    length = np.hypot(*step.T)
    fibre: dict[str, Any] = {
        "fibre": ((line[1:] + line[:-1]) / 2, step / length[:, None], length),
        "lateral_offset": 0.1 * rng.standard_normal((2, J)),
        "log_sensitivity": 0.2 * rng.standard_normal((1, J)),
        "positions": np.column_stack([rng.uniform(0, 4, 9), rng.uniform(-1, 1, 9)]),
        "profile": rng.standard_normal((2, K)),
    }
    moved = {**fibre, "lateral_offset": np.tile([[0.3], [-0.2]], J)}
    back = {**fibre, "lateral_offset": np.zeros((2, J)), "positions": fibre["positions"] - [0.3, -0.2]}
    assert as_built.channel_response(**moved, step=STEP)[0] == pytest.approx(
        as_built.channel_response(**back, step=STEP)[0], abs=1e-12
    )
    far = {**back, "positions": np.array([[2.0, 0.4 + 0.5 + (K + 1) * STEP]])}
    assert not any(np.any(part) for part in as_built.channel_response(**far, step=STEP))
    # it grows with the length of a stretched fibre
    path = np.column_stack([(np.arange(F) + 0.5) / F, np.zeros(F)])
    elements = path, np.tile([1.0, 0.0], (F, 1)), np.full(F, 1 / F)
    straight = {**fibre, "fibre": elements, "log_sensitivity": np.zeros((1, J))}
    straight |= {"profile": np.ones((2, K)) * [[1.0], [0.0]], "positions": np.array([[0.5, 0.0]])}
    stretched = {**straight, "lateral_offset": np.vstack([0.1 * (np.arange(J) - 1) / (J - 3), np.zeros(J)])}
    plain = {**straight, "lateral_offset": np.zeros((2, J))}
    # within one step of the press all splines of weight 1 add up to 1, so the response is the length
    assert as_built.channel_response(**plain, step=2.0)[0][0] == pytest.approx(1.0)
    assert as_built.channel_response(**stretched, step=2.0)[0][0] == pytest.approx(1.1)


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
