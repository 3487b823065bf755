"""What of the scatter of responses grows with them, on presses whose scatter is known."""

from dataclasses import replace

import numpy as np
import pytest

from design.pad.twin import Twin
from sense.twin.fitting import Freedom, fit
from sense.twin.laid_pad import LaidPad, Plan
from sense.twin.responses import Responses
from sense.twin.scatter import response_scatter
from tests.sense.twin.conftest import responses_of


@pytest.mark.parametrize(("share", "common", "floor"), [(0.0, 0.0, 0.01), (0.18, 0.36, 0.01), (0.18, 0.9, 0.002)])
def test_share_common_and_floor_of_the_scatter_are_found(printed: Twin, share, common, floor) -> None:
    still = replace(printed, channels=tuple(replace(channel, noise_v=0.0) for channel in printed.channels))
    exact = responses_of(still, 1500)
    live = [channel for channel in printed.channels if channel.fibre is not None]
    fibres = tuple(channel.fibre for channel in live if channel.fibre is not None)
    plan = Plan.of(printed.morphology)
    pad = LaidPad.on_plan(plan, fibres, printed.frame, 0.55).with_gains(exact)
    pad = fit(pad, exact, Freedom(aside_mm=1.0, uneven=0.2)).pad
    rng, full_scale = np.random.default_rng(4), np.abs(exact.volts).max()
    own, shared = rng.standard_normal(exact.volts.shape), rng.standard_normal((len(exact), 1))
    gain = 1 + share * (np.sqrt(1 - common) * own + np.sqrt(common) * shared)
    volts = exact.volts * gain + floor * full_scale * rng.standard_normal(exact.volts.shape)
    noise_v = (volts - exact.volts).std(axis=0)
    found = response_scatter(pad, Responses(exact.places_mm, volts, exact.there), noise_v)
    assert found.share == pytest.approx(share, abs=0.03)
    # a floor far below what grows is hidden by it, but never mistaken for much
    assert found.floor * noise_v.mean() == pytest.approx(floor * full_scale, rel=0.35, abs=0.25 * noise_v.mean())
    if share:
        assert found.common == pytest.approx(common, abs=0.15)


def test_too_few_presses_tell_nothing_that_grows(printed: Twin) -> None:
    few = responses_of(printed, 20)
    live = tuple(channel.fibre for channel in printed.channels if channel.fibre is not None)
    pad = LaidPad.on_plan(Plan.of(printed.morphology), live, printed.frame, 0.55)
    assert response_scatter(pad, few, np.ones(len(live))).share == 0.0
