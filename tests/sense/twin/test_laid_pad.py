"""A laid pad and what its channels answer: derivatives against differences, closed forms, frame and course."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design.twin import PlanTransform
from padforge.sense.twin.as_built import (
    ASIDE,
    AWAY,
    OWN,
    SHARED,
    LaidPad,
    PadPlan,
    Responses,
    along_fibre,
    channel_response,
    own_values,
)

from .conftest import PLAN

F, J, K, STEP = 60, 7, 6, 0.25
PLACES = np.random.default_rng(2).uniform(-10, 10, (40, 2))


@pytest.fixture
def pad() -> LaidPad:
    laid = LaidPad.on_plan(PadPlan.of(PLAN), (2, 0, 3), PlanTransform(True, 4.0, (1.0, -2.0), 0.95), 0.5)
    return replace(laid, values=laid.values + 0.03 * np.random.default_rng(0).standard_normal(laid.values.size))


def test_derivatives_and_steepness_are_those_of_the_prediction(pad):
    rates = pad.parts(PLACES)[1]
    for at in range(len(pad.values)):
        step = np.zeros(len(pad.values))
        step[at] = 1e-6
        ahead, behind = (replace(pad, values=pad.values + sign * step).predict(PLACES) for sign in (1, -1))
        slope = (ahead - behind) / 2e-6
        for channel in range(3):
            columns = np.concatenate([np.arange(SHARED), own_values(channel)])
            found = rates[channel][:, columns == at].sum(axis=1)
            assert slope[:, channel] == pytest.approx(found, abs=1e-6)
    far, mm = np.zeros((40, 3)), 1e-3
    for step in mm * np.eye(2):
        far += ((pad.predict(PLACES + step) - pad.predict(PLACES)) / mm) ** 2
    assert pad.steepness(PLACES) == pytest.approx(far.mean(axis=0), rel=0.05)


def test_reach_gains_rests_and_frame_take_what_is_theirs(pad):
    scaled = pad.values.copy()
    scaled[4:SHARED] *= 3
    moved = pad.at(scaled)
    assert np.abs(moved.weights(np.linspace(0, moved.end, 101))[0]).max() == pytest.approx(1)
    assert moved.predict(PLACES) == pytest.approx(replace(pad, values=scaled).predict(PLACES))
    own = pad.own[:, :2].copy()
    answers = Responses(PLACES, pad.predict(PLACES), np.ones((40, 3), bool))
    other = pad.values.copy()
    other[SHARED:].reshape(-1, OWN)[:, :2] = [1.0, 0.0]
    assert replace(pad, values=other).with_gains(answers).own[:, :2] == pytest.approx(own)
    shared = pad.values.copy()
    rows = shared[SHARED:].reshape(-1, OWN)
    rows[:, AWAY] = np.repeat([0.2, -0.1], ASIDE)
    off = replace(pad, values=shared)
    settled = off.settled()
    assert np.abs(settled.own[:, AWAY]).max() < 1e-6
    turned = pad.settled()  # and so is a turn
    assert turned.predict(PLACES) == pytest.approx(pad.predict(PLACES), abs=0.02 * np.ptp(pad.predict(PLACES)))
    assert settled.predict(PLACES) == pytest.approx(off.predict(PLACES), abs=1e-9)
    assert settled.frame.shift_mm == pytest.approx([1.0 - 0.2 * PLAN.unit_mm, -2.0 + 0.1 * PLAN.unit_mm], abs=0.5)


@pytest.fixture
def case() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    at = np.linspace(0, 4, F + 1)
    line = np.column_stack([at, 0.4 * np.sin(2 * at)])
    along = np.diff(line, axis=0)
    length = np.hypot(*along.T)
    return {
        "course": (line[1:] + line[:-1]) / 2,
        "tangent": along / length[:, None],
        "length": length,
        "aside": 0.1 * rng.standard_normal((2, J)),
        "sensitivity": 0.2 * rng.standard_normal((1, J)),
        "places": np.column_stack([rng.uniform(0, 4, 9), rng.uniform(-1, 1, 9)]),
        "profile": rng.standard_normal((2, K)),
    }


def test_a_fibre_answers_as_it_is_moved_as_long_as_it_is_and_not_beyond_its_reach(case):
    moved = {**case, "aside": np.tile([[0.3], [-0.2]], J)}
    back = {**case, "aside": np.zeros((2, J)), "places": case["places"] - [0.3, -0.2]}
    assert channel_response(**moved, step=STEP)[0] == pytest.approx(channel_response(**back, step=STEP)[0], abs=1e-12)
    straight = {**case, "course": np.column_stack([(np.arange(F) + 0.5) / F, np.zeros(F)])}
    straight |= {"tangent": np.tile([1.0, 0.0], (F, 1)), "length": np.full(F, 1 / F), "sensitivity": np.zeros((1, J))}
    straight |= {"profile": np.ones((2, K)) * [[1.0], [0.0]], "places": np.array([[0.5, 0.0]])}
    stretched = {**straight, "aside": np.vstack([0.1 * (np.arange(J) - 1) / (J - 3), np.zeros(J)])}
    plain = {**straight, "aside": np.zeros((2, J))}
    # within one step of the press all splines of weight 1 add up to 1, so the signal is the length
    assert channel_response(**plain, step=2.0)[0][0] == pytest.approx(1.0)
    assert channel_response(**stretched, step=2.0)[0][0] == pytest.approx(1.1)
    far = {**case, "places": np.array([[2.0, 0.4 + 0.5 + (K + 1) * STEP]])}
    far["aside"] = np.zeros((2, J))
    assert not any(np.any(part) for part in channel_response(**far, step=STEP))
    (value, change), _, _ = along_fibre(np.array([np.full(J, 2.0), np.arange(J, dtype=float)]), F)
    assert value[0] == pytest.approx(2.0)
    assert change[0] == pytest.approx(0.0, abs=1e-12)
    assert np.diff(value[1]) == pytest.approx(change[1][0])
