"""Features of presses for any regressor of scikit-learn."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.validation import InputError, check_type
from padforge.sense.arrays import Array
from padforge.sense.localizer.features import MODULATED, PressFeatures, compute_features
from padforge.sense.localizer.scaler import FeatureScaler
from padforge.sense.recording.frames import framed
from padforge.sense.recording.recording import PressSelection, Recording


class PressWindows:
    """Transformer from presses of a recording to what the localizer's networks see of them.

    That is, for each fibre, its windows without the effect of its history and the modulations of its sensitivity,
    scaled to about 1; 0 for a fibre that gave too few readings. In a pipeline a regressor follows it::

        make_pipeline(PressWindows(), KNeighborsRegressor()).fit(recording, recording.presses_mm)
    """

    scaler_: FeatureScaler

    def fit(self, X: Recording | PressSelection, y: ArrayLike | None = None) -> "PressWindows":
        """Learn the response to presses, what history does to it, and its scale.

        Args:
            X: a recording, or presses of one, `recording[presses]`.
            y: (Q, 2) positions, mm; None for those of the recording.

        Raises:
            InputError: no recording, or positions that are missing or not as many.
        """
        positions_mm = np.asarray(X.presses_mm if y is None else y, dtype=np.float64)
        if positions_mm.shape != (len(X), 2) or not np.isfinite(positions_mm).all():
            raise InputError(f"y has shape {positions_mm.shape}, expected ({len(X)}, 2) numbers")
        self.scaler_, _ = FeatureScaler.fit(_features(X), positions_mm, None, MODULATED)
        return self

    def transform(self, X: Recording | PressSelection) -> Array:
        """Return the features; shape (Q, C * F).

        Args:
            X: a recording of the pad, or presses of one.

        Raises:
            InputError: not fitted.
        """
        if not hasattr(self, "scaler_"):
            raise InputError("the transformer is not fitted, expected fit before")
        scaled = self.scaler_.transform(_features(X))
        return np.where(scaled.fibre_mask[:, :, None], scaled.inputs, 0.0).reshape(len(X), -1)

    def fit_transform(self, X: Recording | PressSelection, y: ArrayLike | None = None) -> Array:
        """Fit, and return the features of the same presses.

        Args:
            X: as of `fit`.
            y: as of `fit`.
        """
        return self.fit(X, y).transform(X)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return no arguments, as there are none.

        Args:
            deep: without effect; scikit-learn passes it.
        """
        return {}

    def set_params(self) -> "PressWindows":
        """Set nothing, as there are no arguments."""
        return self

    def __repr__(self) -> str:
        return "PressWindows()"

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import InputTags, Tags, TargetTags, TransformerTags  # only scikit-learn itself asks

        return Tags(
            estimator_type=None,
            target_tags=TargetTags(required=False),
            transformer_tags=TransformerTags(),
            input_tags=InputTags(two_d_array=False),
        )


def _features(X: Recording | PressSelection) -> PressFeatures:
    selection = X[:] if isinstance(X, Recording) else check_type("X", X, PressSelection)
    frames = framed(selection.recording)
    return compute_features(frames.readings, frames.down_command, frames.up_command)[selection.presses]
