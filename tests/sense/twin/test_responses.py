"""Responses and their noise, against what is known of a simulated pad."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense import RigSettings, simulate
from padforge.sense.twin.responses import Responses, compute_responses, fit_gp, select_one_depth


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


def test_fit_gp_separates_noise_from_a_function_of_position_and_ignores_invalid_responses():
    positions_mm = np.random.default_rng(0).uniform(-20, 20, (500, 2))
    noise = np.random.default_rng(1).standard_normal((500, 2))
    function = 3 * np.sin(positions_mm[:, 0] / 9) + np.cos(positions_mm[:, 1] / 7)
    volts = np.column_stack([function + 0.2 * noise[:, 0], noise[:, 1]])
    std, log_bayes_factor = fit_gp(Responses(positions_mm, volts, np.ones((500, 2), bool)), 10)
    assert std == pytest.approx([0.2, 1.0], rel=0.12)
    assert log_bayes_factor[0] > 100
    assert log_bayes_factor[1] < 5
    valid = np.column_stack([np.arange(500) % 2 == 1, np.arange(500) < 9])
    std, log_bayes_factor = fit_gp(Responses(positions_mm, np.where(valid, volts, 1e6), valid), 10)
    assert std == pytest.approx([0.2, np.nan], rel=0.15, nan_ok=True)
    assert log_bayes_factor[1] == 0
