"""Expected course of a press, which is subtracted from readings to localize another finger in them."""

from dataclasses import dataclass

import numpy as np

from padforge.sense.arrays import Array, Mask
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import N_PRESS_WINDOWS, PRESS_MIDDLES
from padforge.sense.localizer.response_model import interpolate_grid

MAX_RATIO = 0.9  # maximum ratio of successive changes of a relaxing response
MIN_V2 = 1e-15  # lower limit of sums of squares, V^2


@dataclass(frozen=True)
class PressCourse:
    """Response over time that the calibration expects of a press at a position, scaled to the measured response.

    The effect of earlier presses is removed.
    """

    measured: Array  # (C,), V, in the latest complete window
    expected: Array  # (C,), V, in the same window
    fibre_mask: Mask  # (C,), valid fibres
    pressed: Array  # (len(PRESS_WINDOWS), C), V, expected
    released: Array  # (len(RELEASE_WINDOWS), C), V, expected

    @classmethod
    def fit(cls, model: LocalizerModel, features: PressFeatures, position_mm: Array) -> "PressCourse":
        """Scale the expected response at a position (2,) to the features of one press, of the feature set "windows"."""
        scaler = model.scaler
        position = scaler.scale_positions(position_mm[None])
        scaled = np.stack([interpolate_grid(model.table, position)[0], scaler.transform(features).inputs[0]])
        expected, measured = (scaler.uncentre(scaled) * scaler.scale_v).swapaxes(1, 2)
        latest, mask = max(int(features.complete[0, :N_PRESS_WINDOWS].sum()) - 1, 0), features.fibre_mask[0]
        expected *= _proportion(measured[latest], expected[latest], mask)
        pressed, released = np.split(expected[: features.complete.shape[1]], [N_PRESS_WINDOWS])
        return cls(measured[latest], expected[latest], mask, pressed, released)

    @property
    def explained_share(self) -> float:
        """Share of the squares of the measured response that is explained."""
        return self._share(self.expected)

    @property
    def changes_by_release(self) -> Array:
        """Changes (len(RELEASE_WINDOWS), C), V, from the held press to the windows after its release."""
        return self.released - self.pressed[-1]

    def share_explained_by(self, other: "PressCourse") -> float:
        """Return the share of the squares of the measured response that a multiple of another measured one explains."""
        mask = self.fibre_mask & other.fibre_mask
        return self._share(_proportion(self.measured, other.measured, mask) * other.measured)

    def response(self, frames: Array) -> Array:
        """Return the response (n, C), V, at frames (n,) after the command down, extrapolated as a geometric series."""
        weights = np.stack([np.interp(frames, PRESS_MIDDLES, row) for row in np.eye(N_PRESS_WINDOWS)], axis=1)
        earlier, later = np.diff(self.pressed[-3:], axis=0)
        ratio = float(np.clip((earlier * later).sum() / max((earlier**2).sum(), MIN_V2), 0.0, MAX_RATIO))
        steps = np.maximum(frames - PRESS_MIDDLES[-1], 0.0) / (PRESS_MIDDLES[-1] - PRESS_MIDDLES[-2])
        return weights @ self.pressed + (ratio * (1 - ratio**steps) / (1 - ratio))[:, None] * later

    def _share(self, expected: Array) -> float:
        residual = (self.measured - expected)[self.fibre_mask]
        return 1 - float((residual**2).sum()) / max(float((self.measured[self.fibre_mask] ** 2).sum()), MIN_V2)


def _proportion(measured: Array, expected: Array, fibre_mask: Mask) -> float:
    """Return the factor, at least 0, that fits an expected response (C,) to a measured one by least squares."""
    energy = max(float((expected[fibre_mask] ** 2).sum()), MIN_V2)
    return max(float((measured * expected)[fibre_mask].sum()) / energy, 0.0)
