"""Scaling of positions, depths and windows, against its definitions."""

import numpy as np
import pytest

from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.scaler import TargetScaler


def test_scaled_depths_run_from_minus_1_to_1(deep_localizer: LocalizerModel) -> None:
    scaler = TargetScaler.fit("depth_mm", np.array([1.0, 2.0, 5.0]))
    assert (scaler.origin, scaler.scale) == (3.0, 2.0)
    assert scaler.transform(np.array([1.0, 3.0, 5.0])).tolist() == [-1, 0, 1]
    assert scaler.inverse_transform(np.array([-1.0, 0.5])).tolist() == [1, 4]
    depth = deep_localizer.scaler.measures[0]
    # a scaled depth of 1 responds as much more than one of 0 as it is deeper
    assert 1 + deep_localizer.scaler.depth_gain == pytest.approx((depth.origin + depth.scale) / depth.origin)
