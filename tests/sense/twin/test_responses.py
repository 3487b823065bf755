"""Responses and their noise, against what is known of a simulated pad."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense import RigSettings, simulate
from padforge.sense.twin.responses import Responses, compute_responses, fit_gps, select_one_depth


def test_response_is_the_held_level_minus_the_rest() -> None:
    """Readings of 2 V at rest, of 5 V while the tip comes to rest, and of 3 V then."""
    recording = simulate(Morphology.straight(2), RigSettings(presses=80, seed=0))
    readings = np.full_like(recording.readings, 2.0)
    for down, up in zip(recording.down_command, recording.up_command, strict=True):
        readings[down : down + 4], readings[down + 4 : up] = 5.0, 3.0
    responses = compute_responses(replace(recording, readings=readings), np.arange(80) < 60)
    np.testing.assert_allclose(responses.volts, 1.0, atol=0.02)  # of which history takes a little


def test_select_one_depth_keeps_the_most_common_and_all_of_unknown_depth() -> None:
    recording = simulate(
        Morphology.straight(2), RigSettings(presses=9, depths_mm=(0.5, 3.0, 5.0)), Contact(model="profile")
    )
    selected = select_one_depth(recording)
    assert selected.presses_mm[selected.has_position].tolist() == recording.presses_mm[2::3].tolist()
    unknown = replace(recording, depths_mm=np.full(9, np.nan))
    assert select_one_depth(unknown) is unknown
    assert select_one_depth(replace(recording, depths_mm=np.linspace(4.7, 5.3, 9))).has_position.all()


def test_fit_gps_separate_noise_from_a_function_of_position_and_ignore_invalid_responses():
    positions_mm = np.random.default_rng(0).uniform(-20, 20, (500, 2))
    noise = np.random.default_rng(1).standard_normal((500, 2))
    function = 3 * np.sin(positions_mm[:, 0] / 9) + np.cos(positions_mm[:, 1] / 7)
    volts = np.column_stack([function + 0.2 * noise[:, 0], noise[:, 1]])
    smooth, noisy = fit_gps(Responses(positions_mm, volts, np.ones((500, 2), bool)), 10)
    assert (smooth.noise_v, noisy.noise_v) == pytest.approx((0.2, 1.0), rel=0.12)
    assert smooth.log_bayes_factor > 100
    assert noisy.log_bayes_factor < 5
    assert smooth.predict(positions_mm / 10) == pytest.approx(function, abs=0.3)
    valid = np.column_stack([np.arange(500) % 2 == 1, np.arange(500) < 9])
    smooth, unknown = fit_gps(Responses(positions_mm, np.where(valid, volts, 1e6), valid), 10)
    assert smooth.noise_v == pytest.approx(0.2, rel=0.15)
    assert np.isnan(unknown.noise_v)
    assert not unknown.predict(positions_mm / 10).any()
