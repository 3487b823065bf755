"""Fits of as-built pads and of their scatter, on pads whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.sense.twin.as_built import OFFSET, SENSITIVITY, AsBuiltPad, PadPlan
from padforge.sense.twin.fitting import Priors, estimate_scatter, fit_as_built
from padforge.sense.twin.responses import Responses

from .conftest import PLAN, simulate_responses

FREE = Priors(lateral_offset_mm=1.0, log_sensitivity=0.2)


@pytest.fixture(scope="module")
def start(printed):
    fibres = tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)
    return AsBuiltPad.from_plan(PadPlan.from_morphology(PLAN), fibres, printed.frame, 0.5)


@pytest.fixture(scope="module")
def on_plan(start, responses):
    return fit_as_built(start, responses, Priors())


@pytest.fixture(scope="module")
def fitted(on_plan, responses):
    return fit_as_built(on_plan.pad, responses, FREE)


def test_fit_explains_fresh_presses_better_than_the_plan(printed, on_plan, fitted):
    fresh = simulate_responses(printed, 300, seed=1)
    explained, explained_on_plan = (
        fresh.explained_variance(fit.pad.predict(fresh.positions_mm)) for fit in (fitted, on_plan)
    )
    assert not on_plan.pad.channel_values[:, OFFSET].any()
    assert not on_plan.pad.channel_values[:, SENSITIVITY].any()
    assert not on_plan.pad.profile(np.linspace(0, 1, 9))[1].any()
    assert explained.min() > 0.97
    assert explained.mean() > explained_on_plan.mean()


def test_fit_recovers_lateral_offsets_unless_noise_is_inflated(printed, fitted, responses):
    errors, offsets, plan = [], [], fitted.pad.plan
    for channel, fibre in enumerate(fitted.pad.fibres):
        true = plan.to_grid(printed.as_built_mm[fibre])[1:-1]
        normal = plan.tangents[fibre] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        inside = (np.abs(plan.paths[fibre] - 1.5) < 1).all(axis=1)
        errors.append(((fitted.pad.path(channel)[0] - true) * normal).sum(axis=1)[inside])
        offsets.append(((plan.paths[fibre] - true) * normal).sum(axis=1)[inside])
    assert np.std(np.concatenate(errors)) < 0.7 * np.std(np.concatenate(offsets))
    # inflated noise shrinks offsets and widens their standard deviation
    inflated = fit_as_built(fitted.pad, responses, FREE, noise_inflation=20.0)
    small, large = (np.square(fit.pad.channel_values[:, OFFSET]).sum() for fit in (inflated, fitted))
    assert small < large
    assert inflated.offset_std(0).mean() > fitted.offset_std(0).mean()


@pytest.mark.parametrize(("share", "common", "floor"), [(0.0, 0.0, 0.01), (0.18, 0.36, 0.01), (0.18, 0.9, 0.002)])
def test_estimate_scatter_recovers_share_common_and_floor(printed, fitted, share, common, floor) -> None:
    noiseless = replace(printed, channels=tuple(replace(channel, noise_v=0.0) for channel in printed.channels))
    exact = simulate_responses(noiseless, 900)
    rng, full_scale = np.random.default_rng(4), np.abs(exact.volts).max()
    independent, shared = rng.standard_normal(exact.volts.shape), rng.standard_normal((len(exact), 1))
    gain = 1 + share * (np.sqrt(1 - common) * independent + np.sqrt(common) * shared)
    volts = exact.volts * gain + floor * full_scale * rng.standard_normal(exact.volts.shape)
    noise_v = (volts - exact.volts).std(axis=0)
    scatter = estimate_scatter(fitted.pad, Responses(exact.positions_mm, volts, exact.valid), noise_v)
    assert scatter.share == pytest.approx(share, abs=0.03)
    # a floor far below what grows is hidden by it, but never mistaken for much
    assert scatter.floor * noise_v.mean() == pytest.approx(floor * full_scale, rel=0.35, abs=0.25 * noise_v.mean())
    if share:
        assert scatter.common == pytest.approx(common, abs=0.15)
