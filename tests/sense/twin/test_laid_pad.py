"""A laid pad: its derivatives, its scale, and what is frame and what is course."""

from dataclasses import replace

import numpy as np
import pytest

from design.pad.twin import Frame
from sense.twin.laid_pad import ASIDE, AWAY, OWN, SHARED, LaidPad, Plan, own_values
from sense.twin.responses import Responses

from .conftest import PLAN

PLACES = np.random.default_rng(2).uniform(-10, 10, (40, 2))


@pytest.fixture
def pad() -> LaidPad:
    laid = LaidPad.on_plan(Plan.of(PLAN), (2, 0, 3), Frame(True, 4.0, (1.0, -2.0), 0.95), 0.5)
    return replace(laid, values=laid.values + 0.03 * np.random.default_rng(0).standard_normal(laid.values.size))


def test_derivatives_are_those_of_the_prediction(pad):
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


def test_steepness_is_how_far_volts_change_with_the_place(pad):
    far, mm = np.zeros((40, 3)), 1e-3
    for step in mm * np.eye(2):
        far += ((pad.predict(PLACES + step) - pad.predict(PLACES)) / mm) ** 2
    assert pad.steepness(PLACES) == pytest.approx(far.mean(axis=0), rel=0.05)


def test_the_reach_is_1_at_its_largest_whatever_was_fitted(pad):
    scaled = pad.values.copy()
    scaled[4:SHARED] *= 3
    moved = pad.at(scaled)
    assert np.abs(moved.weights(np.linspace(0, moved.end, 101))[0]).max() == pytest.approx(1)
    assert moved.predict(PLACES) == pytest.approx(replace(pad, values=scaled).predict(PLACES))


def test_what_all_fibres_share_of_their_way_is_the_frames(pad):
    shared = pad.values.copy()
    rows = shared[SHARED:].reshape(-1, OWN)
    rows[:, AWAY] = np.repeat([0.2, -0.1], ASIDE)
    off = replace(pad, values=shared)
    settled = off.settled()
    assert np.abs(settled.own[:, AWAY]).max() < 1e-6
    assert settled.predict(PLACES) == pytest.approx(off.predict(PLACES), abs=1e-9)
    assert settled.frame.shift_mm == pytest.approx([1.0 - 0.2 * PLAN.unit_mm, -2.0 + 0.1 * PLAN.unit_mm], abs=0.5)


def test_a_turn_that_all_fibres_share_is_the_frames(pad):
    turned = pad.settled()
    assert turned.predict(PLACES) == pytest.approx(pad.predict(PLACES), abs=0.02 * np.ptp(pad.predict(PLACES)))


def test_gains_and_rests_are_those_of_the_answers(pad):
    own = pad.own[:, :2].copy()
    answers = Responses(PLACES, pad.predict(PLACES), np.ones((40, 3), bool))
    other = pad.values.copy()
    other[SHARED:].reshape(-1, OWN)[:, :2] = [1.0, 0.0]
    assert replace(pad, values=other).with_gains(answers).own[:, :2] == pytest.approx(own)
