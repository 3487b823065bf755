"""Estimators as in scikit-learn: the localizer, and features of presses for any regressor."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import validate
from padforge.common.validation import InputError, check_float, check_type
from padforge.sense.arrays import MAX_MM, MAX_VOLTS, Array, Indices, check_magnitude, check_numbers
from padforge.sense.health.health_model import HealthModel
from padforge.sense.live.pipeline import Live
from padforge.sense.localizer.calibration import MAX_TIME_BUDGET_S, CalibrationData, calibrate, fit_model, fit_recording
from padforge.sense.localizer.evaluation import Evaluation, distances, evaluate
from padforge.sense.localizer.features import PressFeatures, compute_features, features_without_moments
from padforge.sense.localizer.model import Localization, LocalizerModel, fitted_model
from padforge.sense.localizer.moments import MODULATED
from padforge.sense.localizer.scaler import FeatureScaler
from padforge.sense.recording.frames import framed
from padforge.sense.recording.recording import PressSelection, Recording
from padforge.sense.settings import LocalizerSettings

OPTIONS = tuple(name for name in LocalizerSettings.model_fields if name not in ("max_failures", "seed"))


class _Estimator:
    """Parameters and representation as scikit-learn asks for them."""

    _names: ClassVar[tuple[str, ...]] = ()  # of the arguments of the constructor

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the arguments of the constructor by name; `deep` has no effect."""
        return {name: getattr(self, name) for name in self._names}

    def set_params(self, **params: Any) -> Self:
        """Set arguments of the constructor by name; the others stay."""
        self.__init__(**{**self.get_params(), **params})
        return self

    def __repr__(self) -> str:
        usual = type(self)().get_params()
        changed = (f"{name}={value!r}" for name, value in self.get_params().items() if value != usual[name])
        return f"{type(self).__name__}({', '.join(changed)})"


class Localizer(_Estimator):
    """Localizer of presses, in the manner of scikit-learn's estimators.

    Args:
        max_failures: failed fibres that it is trained for.
        random_state: seed of the split and of the training.
        **options: other fields of `LocalizerSettings`, with their defaults; checked by `fit`.

    Attributes:
        model_: the trained `LocalizerModel`, after `fit` or `load`.
        calibration_: the `Evaluation` on the test presses, after `fit` to a recording.

    Raises:
        InputError: `LocalizerSettings` has no such option.
    """

    _names = ("max_failures", "random_state", *OPTIONS)
    model_: LocalizerModel
    calibration_: Evaluation

    def __init__(self, max_failures: int = 3, random_state: int = 0, **options: Any) -> None:
        for name in options:
            if name not in OPTIONS:
                raise InputError(f"Localizer has no option {name}, expected one of {', '.join(OPTIONS)}")
        self.max_failures, self.random_state = max_failures, random_state
        for name in OPTIONS:
            setattr(self, name, options.get(name, LocalizerSettings.model_fields[name].default))

    @classmethod
    def from_settings(cls, settings: LocalizerSettings) -> "Localizer":
        """Make a localizer.

        Args:
            settings: the section `[localizer]` of `pad.toml`.
        """
        options = settings.model_dump()
        return cls(random_state=options.pop("seed"), **options)

    @property
    def test_presses_(self) -> Indices:
        """Indices of the presses of the recording that `fit` held back for the test."""
        return np.array(self._fitted.test, dtype=np.int64)

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import InputTags, RegressorTags, Tags, TargetTags  # only scikit-learn itself asks

        return Tags(
            estimator_type="regressor",
            target_tags=TargetTags(required=True, two_d_labels=True, multi_output=True),
            regressor_tags=RegressorTags(),
            input_tags=InputTags(two_d_array=False, three_d_array=True, allow_nan=True),
        )

    def fit(
        self,
        X: "Recording | PressSelection | ArrayLike",
        y: ArrayLike | None = None,
        *,
        time_budget: float | None = None,
        on_progress: OnProgress = ignore_progress,
    ) -> "Localizer":
        """Train on a recording, and test on a share of its presses; or train on all presses given, without a test.

        Args:
            X: a recording, which is also tested on; or presses of one, `recording[presses]`; or (Q, C, F) features of
                presses, V, NaN where a fibre gave none.
            y: (Q, 2) positions, mm, with arrays; None for those of the recording.
            time_budget: seconds to train for, which decide on the number of members.
            on_progress: as in `calibrate`.

        Raises:
            InputError: an option or array out of range, too few presses, too short a time budget, or a training that
                diverged.
        """
        params = self.get_params()
        settings = validate(LocalizerSettings, {"seed": params.pop("random_state"), **params}, "[localizer]")
        if isinstance(X, Recording | PressSelection) and y is not None:
            raise InputError("y is given beside a recording, which holds the positions; expected None")
        if isinstance(X, PressSelection):
            positioned = X.presses[X.recording.has_position[X.presses]]
            rng = np.random.default_rng(settings.seed)
            self.model_ = fit_recording(X.recording, positioned, settings, rng, on_progress, time_budget)
            return self
        if isinstance(X, Recording):
            self.model_, self.calibration_ = calibrate(X, settings, time_budget=time_budget, on_progress=on_progress)
            return self
        if settings.method != "ensemble":
            raise InputError(f"method is {settings.method}, allowed with arrays is ensemble")
        budget = None if time_budget is None else check_float("time_budget", time_budget, 0, MAX_TIME_BUDGET_S)
        features, positions_mm = _array_features(X), _array_positions(y)
        if len(features) != len(positions_mm):
            raise InputError(f"X has {len(features)} presses and y {len(positions_mm)}, expected as many")
        digest = hashlib.sha256(features.windows.tobytes() + positions_mm.tobytes()).hexdigest()
        data = CalibrationData(features, None, positions_mm, {}, "array", 1.0, digest)
        rng = np.random.default_rng(settings.seed)
        self.model_ = fit_model(data, np.arange(len(features)), settings, rng, on_progress, budget)
        self.model_ = replace(self.model_, split=settings.split)
        return self

    def predict(self, X: "Recording | PressSelection | ArrayLike", failed: ArrayLike = ()) -> Localization:
        """Predict the position of every press.

        Args:
            X: a recording, or presses of one; or (Q, C, F) features as those that were fitted, V.
            failed: indices of fibres to mask in every press.

        Raises:
            InputError: not fitted, or as `LocalizerModel.predict`.
        """
        if isinstance(X, Recording):
            return self._fitted.predict(X, failed)
        if isinstance(X, PressSelection):
            return self._fitted.localize(self._fitted.scaled_features(X.recording)[X.presses], failed)
        model, features = self._fitted, _array_features(X)
        if model.features != "array" or features.windows.shape[1:] != model.scaler.mean_v.shape:
            raise InputError(
                f"X has shape {features.windows.shape} for a localizer of {model.fibres} fibres and features "
                f"{model.features}, expected a recording, or (Q, C, F) as it was fitted to"
            )
        return model.localize(model.scaler.transform(features), failed)

    def score(self, X: "Recording | PressSelection | ArrayLike", y: ArrayLike | None = None) -> float:
        """Return the negative mean error, mm: greater is better.

        Args:
            X: as `predict`.
            y: (Q, 2) true positions, mm; None for those of a recording. Presses of unknown position are left out.
        """
        predicted = self.predict(X).positions_mm
        true = X.presses_mm if isinstance(X, Recording | PressSelection) and y is None else _array_positions(y)
        return -float(np.nanmean(distances(predicted, true)))

    def evaluate(self, recording: Recording, max_failures: int | None = None) -> Evaluation:
        """Evaluate for every set of up to `max_failures` failed fibres.

        Args:
            recording: of the pad; of the training recording, only the presses that were held back are used.
            max_failures: most fibres that fail at once; None for as many as in training.

        Raises:
            InputError: not fitted, or as `evaluation.evaluate`.
        """
        model = self._fitted
        most = model.max_failures if max_failures is None else max_failures
        return evaluate(model, recording, range(min(most, model.fibres - 1) + 1))

    def live(self, rate_hz: float, fibres: int | None = None, health: HealthModel | None = None) -> Live:
        """Begin to follow the pad as it is read: `live.update(time_s, volts)` returns what has happened.

        Args:
            rate_hz: readings per second: at least 3/4 of the rate of the calibration, or of 13.3 if that is lower.
            fibres: as of `Live`.
            health: as of `Live`.

        Raises:
            InputError: not fitted, or as `Live`.
        """
        return Live(self._fitted, rate_hz=rate_hz, fibres=fibres, health=health)

    def save(self, folder: str | Path) -> None:
        """Write `localizer.json` and `localizer.safetensors`.

        Args:
            folder: destination; its localizer is replaced.

        Raises:
            InputError: not fitted, or the folder cannot be written.
        """
        self._fitted.save(folder)

    @classmethod
    def load(cls, folder: str | Path) -> "Localizer":
        """Read what `save` wrote; options that the files do not hold have their defaults.

        Args:
            folder: that was passed to `save`.

        Raises:
            InputError: as `LocalizerModel.load`.
        """
        model = LocalizerModel.load(folder)
        localizer = cls(model.max_failures, method=model.method, split=model.split)
        localizer.model_ = model
        return localizer

    @property
    def _fitted(self) -> LocalizerModel:
        return fitted_model(self)


class PressWindows(_Estimator):
    """Transformer from presses of a recording to what the localizer's networks see of them.

    For each fibre these are its windows, without the effect of its history, and the modulations of its sensitivity, all
    scaled to about 1; they are 0 for a fibre that gave too few readings. In a pipeline a regressor follows it::

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


def _array_features(X: ArrayLike) -> PressFeatures:
    windows = check_numbers(X, np.float64, "X").astype(np.float64)
    if windows.ndim != 3 or 0 in windows.shape[1:]:
        raise InputError(f"X has shape {windows.shape}, expected (Q, C, F)")
    check_magnitude("X", windows.reshape(len(windows), -1), MAX_VOLTS, "V", missing=True)
    present = np.isfinite(windows).all(axis=2)
    return features_without_moments(np.where(present[:, :, None], windows, 0.0), present)


def _array_positions(y: ArrayLike | None) -> Array:
    positions_mm = check_numbers([] if y is None else y, np.float64, "y").astype(np.float64)
    if positions_mm.ndim != 2 or positions_mm.shape[1] != 2:
        raise InputError(f"y has shape {positions_mm.shape}, expected (Q, 2)")
    check_magnitude("y", positions_mm, MAX_MM, "mm")
    return positions_mm
