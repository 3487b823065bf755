"""Scaling of positions, depths and windows, against its definitions."""

import numpy as np
import pytest

from padforge.sense import Recording
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import DOWN, NOW
from padforge.sense.localizer.scaler import TargetScaler


def test_scaled_positions_span_the_longer_side_of_what_was_pressed(
    localizer: LocalizerModel, recording: Recording
) -> None:
    scaler = localizer.scaler
    pressed_mm = np.delete(recording.presses_mm, localizer.test, axis=0)
    low, high = scaler.origin_mm - scaler.half_size_mm, scaler.origin_mm + scaler.half_size_mm
    inside = ((recording.presses_mm >= low - 1e-9) & (recording.presses_mm <= high + 1e-9)).all(axis=1)
    assert inside.mean() > 0.95  # all but a few that were held back
    assert (low >= pressed_mm.min(axis=0) - 1e-9).all()
    assert (high <= pressed_mm.max(axis=0) + 1e-9).all()
    assert scaler.scale_mm == scaler.half_size_mm.max()
    corners = scaler.scale_targets(np.array([low, scaler.origin_mm, high]))
    assert np.abs(corners).max() == pytest.approx(1)
    np.testing.assert_allclose(corners[1], 0, atol=1e-6)
    np.testing.assert_allclose(scaler.positions_mm(corners), [low, scaler.origin_mm, high], atol=1e-4)


def test_scaled_depths_run_from_minus_1_to_1(deep_localizer: LocalizerModel) -> None:
    scaler = TargetScaler.fit("depth_mm", np.array([1.0, 2.0, 5.0]))
    assert (scaler.origin, scaler.scale) == (3.0, 2.0)
    assert scaler.transform(np.array([1.0, 3.0, 5.0])).tolist() == [-1, 0, 1]
    assert scaler.inverse_transform(np.array([-1.0, 0.5])).tolist() == [1, 4]
    depth = deep_localizer.scaler.measures[0]
    # a scaled depth of 1 responds as much more than one of 0 as it is deeper
    assert 1 + deep_localizer.scaler.depth_gain == pytest.approx((depth.origin + depth.scale) / depth.origin)


def test_windows_of_the_touch_become_those_of_now(localizer: LocalizerModel) -> None:
    """The same volts in a window of `DOWN` and in one of `NOW`."""
    scaler, n_timed = localizer.scaler, localizer.interval_factors.shape[0] - 1
    factor, offset = scaler.to_now(n_timed)
    assert factor.shape == offset.shape == (localizer.fibres, len(NOW), len(DOWN))
    volts = np.full(scaler.mean_v.shape, 0.05)
    scaled = (volts - scaler.mean_v) / scaler.scale_v
    for down in range(len(DOWN)):
        now = scaled[:, down, None] * factor[:, :, down] + offset[:, :, down]
        np.testing.assert_allclose(now, scaled[:, n_timed : n_timed + len(NOW)], rtol=1e-4, atol=1e-4)
