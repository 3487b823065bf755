"""Fitted pads are near the truth, and say how sure that is."""

import numpy as np
import pytest

from sense.twin.fitting import Freedom, fit
from sense.twin.laid_pad import AWAY, COUNTS, LaidPad, Plan

from .conftest import PLAN, responses_of

FREE = Freedom(aside_mm=1.0, uneven=0.2)


@pytest.fixture(scope="module")
def start(printed):
    fibres = tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)
    return LaidPad.on_plan(Plan.of(PLAN), fibres, printed.frame, 0.5)


@pytest.fixture(scope="module")
def fitted(start, answers):
    return fit(fit(start, answers, Freedom()).pad, answers, FREE)


def test_a_fit_explains_presses_it_has_not_seen(printed, start, fitted):
    fresh = responses_of(printed, 300, seed=1)
    explained = fresh.explained(fitted.pad.predict(fresh.places_mm))
    assert explained.min() > 0.97
    assert explained.mean() > fresh.explained(fit(start, fresh, Freedom()).pad.predict(fresh.places_mm)).mean()


def test_fibres_are_found_nearer_to_where_they_lie_than_the_plan_is(printed, fitted):
    off, planned = [], []
    for channel, fibre in enumerate(fitted.pad.fibres):
        plan = fitted.pad.plan
        true = plan.to_grid(printed.laid_mm[fibre])[1:-1]
        across = plan.tangent[fibre] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        inside = (np.abs(plan.course[fibre] - 1.5) < 1).all(axis=1)
        off.append(((fitted.pad.course(channel)[0] - true) * across).sum(axis=1)[inside])
        planned.append(((plan.course[fibre] - true) * across).sum(axis=1)[inside])
    assert np.std(np.concatenate(off)) < 0.7 * np.std(np.concatenate(planned))


def test_where_nothing_may_differ_nothing_does(start, answers):
    pad = fit(start, answers, Freedom()).pad
    assert not pad.own[:, AWAY].any()
    assert not pad.own[:, COUNTS].any()
    assert not pad.weights(np.linspace(0, 1, 9))[1].any()


def test_caution_keeps_fibres_nearer_to_their_plan_and_is_less_sure(answers, fitted):
    cautious = fit(fitted.pad, answers, FREE, caution=20.0)
    assert np.square(cautious.pad.own[:, AWAY]).sum() < np.square(fitted.pad.own[:, AWAY]).sum()
    assert cautious.unsure(0).mean() > fitted.unsure(0).mean()


def test_the_true_wiring_is_more_probable_than_another(start, answers, fitted):
    swapped = LaidPad.on_plan(start.plan, start.fibres[::-1], start.frame, 0.5)
    other = fit(fit(swapped, answers, Freedom()).pad, answers, FREE)
    assert fitted.evidence > other.evidence + 50
