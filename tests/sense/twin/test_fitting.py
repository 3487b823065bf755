"""Fitted pads are near the truth and say how sure that is; wirings, noise and scatter are found again."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.sense.twin.as_built import AWAY, COUNTS, LaidPad, PadPlan, Responses
from padforge.sense.twin.fitting import Freedom, assigned, fit, response_scatter, smooth_function, wirings

from .conftest import PLAN, responses_of

FREE = Freedom(aside_mm=1.0, uneven=0.2)


@pytest.fixture(scope="module")
def start(printed):
    fibres = tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)
    return LaidPad.on_plan(PadPlan.of(PLAN), fibres, printed.frame, 0.5)


@pytest.fixture(scope="module")
def fitted(start, answers):
    return fit(fit(start, answers, Freedom()).pad, answers, FREE)


def test_a_fit_explains_fresh_presses_and_is_nearer_to_the_truth_than_the_plan_is(printed, start, fitted, answers):
    fresh = responses_of(printed, 300, seed=1)
    explained = fresh.explained(fitted.pad.predict(fresh.positions_mm))
    assert explained.min() > 0.97
    assert explained.mean() > fresh.explained(fit(start, fresh, Freedom()).pad.predict(fresh.positions_mm)).mean()
    off, planned = [], []
    for channel, fibre in enumerate(fitted.pad.fibres):
        plan = fitted.pad.plan
        true = plan.to_grid(printed.as_built_mm[fibre])[1:-1]
        across = plan.tangent[fibre] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        inside = (np.abs(plan.course[fibre] - 1.5) < 1).all(axis=1)
        off.append(((fitted.pad.course(channel)[0] - true) * across).sum(axis=1)[inside])
        planned.append(((plan.course[fibre] - true) * across).sum(axis=1)[inside])
    assert np.std(np.concatenate(off)) < 0.7 * np.std(np.concatenate(planned))
    pad = fit(start, answers, Freedom()).pad
    assert not pad.own[:, AWAY].any()
    assert not pad.own[:, COUNTS].any()
    assert not pad.weights(np.linspace(0, 1, 9))[1].any()
    cautious = fit(fitted.pad, answers, FREE, caution=20.0)
    assert np.square(cautious.pad.own[:, AWAY]).sum() < np.square(fitted.pad.own[:, AWAY]).sum()
    assert cautious.unsure(0).mean() > fitted.unsure(0).mean()
    assert response_scatter(start, responses_of(printed, 20), np.ones(len(start.fibres))).share == 0.0


@pytest.mark.slow
def test_the_true_wiring_is_more_probable_than_another(start, answers, fitted):
    swapped = LaidPad.on_plan(start.plan, start.fibres[::-1], start.frame, 0.5)
    other = fit(fit(swapped, answers, Freedom()).pad, answers, FREE)
    assert fitted.evidence > other.evidence + 50


@pytest.mark.parametrize(("share", "common", "floor"), [(0.0, 0.0, 0.01), (0.18, 0.36, 0.01), (0.18, 0.9, 0.002)])
def test_share_common_and_floor_of_the_scatter_are_found(printed, fitted, share, common, floor) -> None:
    """What of the scatter of responses grows with them, on presses whose scatter is known."""
    still = replace(printed, channels=tuple(replace(channel, noise_v=0.0) for channel in printed.channels))
    exact = responses_of(still, 900)
    rng, full_scale = np.random.default_rng(4), np.abs(exact.volts).max()
    own, shared = rng.standard_normal(exact.volts.shape), rng.standard_normal((len(exact), 1))
    gain = 1 + share * (np.sqrt(1 - common) * own + np.sqrt(common) * shared)
    volts = exact.volts * gain + floor * full_scale * rng.standard_normal(exact.volts.shape)
    noise_v = (volts - exact.volts).std(axis=0)
    found = response_scatter(fitted.pad, Responses(exact.positions_mm, volts, exact.there), noise_v)
    assert found.share == pytest.approx(share, abs=0.03)
    # a floor far below what grows is hidden by it, but never mistaken for much
    assert found.floor * noise_v.mean() == pytest.approx(floor * full_scale, rel=0.35, abs=0.25 * noise_v.mean())
    if share:
        assert found.common == pytest.approx(common, abs=0.15)


PLACES = np.random.default_rng(0).uniform(-20, 20, (500, 2))
NOISE = np.random.default_rng(1).standard_normal((500, 2))
FUNCTION = 3 * np.sin(PLACES[:, 0] / 9) + np.cos(PLACES[:, 1] / 7)


def test_noise_is_told_from_a_function_of_place_and_what_is_missing_does_not_count():
    found = smooth_function(
        Responses(PLACES, np.column_stack([FUNCTION + 0.2 * NOISE[:, 0], NOISE[:, 1]]), np.ones((500, 2), bool)), 10
    )
    assert found.noise == pytest.approx([0.2, 1.0], rel=0.12)
    assert found.certainty[0] > 100
    assert found.certainty[1] < 5
    there = np.ones((500, 2), bool)
    there[::2, 0] = False
    there[:, 1] = np.arange(500) < 9
    volts = np.where(there, (FUNCTION + 0.2 * NOISE[:, 0])[:, None], 1e6)
    found = smooth_function(Responses(PLACES, volts, there), 10)
    assert found.noise[0] == pytest.approx(0.2, rel=0.15)
    assert np.isnan(found.noise[1])
    assert found.certainty[1] == 0


@pytest.mark.parametrize("missing", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_channels_and_frame_are_found_first_of_all(printed, answers, missing) -> None:
    """Also where presses lack a channel: these do not count."""
    if missing:
        volts, there = answers.volts.copy(), answers.there.copy()
        volts[::3, 0], there[::3, 0] = 5.0, False
        answers = Responses(answers.positions_mm, volts, there)
    found = wirings(PadPlan.of(PLAN), answers, np.random.default_rng(0))[0]
    assert found.fibres == tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)
    assert found.frame.mirrored
    assert np.hypot(*np.subtract(found.frame.shift_mm, printed.frame.shift_mm)) < 1.0
    assert found.match > 0.9


def test_every_channel_gets_another_fibre_and_all_have_one_sign():
    alike = -np.array([[0.9, 0.8], [0.8, 0.1], [-1.0, -1.0]])
    match, fibres = assigned(alike)
    assert fibres == (1, 0)
    assert match == np.mean([0.8**2, 0.8**2])
