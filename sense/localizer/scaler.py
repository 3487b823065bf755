"""Scaling of features to about 1, and of positions, depths and forces to the outputs of the networks.

Where depths vary, the networks also predict depth (and force), and features are not centred, so that they remain
proportional to the depth.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field, PlainSerializer, PlainValidator
from pydantic_core import PydanticCustomError

from padforge.sense.arrays import MAX_MM, MAX_VOLTS, MIN_SCALE_V, Array, Floats, Indices, Mask, masked_mean
from padforge.sense.localizer.features import PressFeatures
from padforge.sense.localizer.model_files import DOCUMENT_CONFIG
from padforge.sense.localizer.moments import LATEST_WINDOWS, PRESS_WINDOWS
from padforge.sense.localizer.response_model import ResponseModel, interpolate_grid, leverages, remove_history
from padforge.sense.localizer.response_process import ResponseFit, ResponsePrior, fit_response

MAX_INPUT = 1e4  # magnitude that scaled features are clipped to, and that no real press reaches


def array_field(low: float, high: float) -> tuple[PlainValidator, PlainSerializer]:
    """Annotate an array that a document holds as nested lists of numbers from `low` to `high`."""

    def check(value: object) -> Array:
        try:
            array = np.array(value)
        except ValueError:  # rows of several lengths
            array = np.empty(0, dtype=object)
        if array.dtype.kind not in "fi" or not np.all((array >= low) & (array <= high)):
            message = "expected an array of numbers from {low} to {high}"
            raise PydanticCustomError("array", message, {"low": f"{low:g}", "high": f"{high:g}"})
        return array.astype(np.float64)

    return PlainValidator(check), PlainSerializer(lambda array: array.tolist())


@dataclass(frozen=True)
class ScaledFeatures:
    """Features of Q presses, scaled for the networks."""

    inputs: Floats  # (Q, C, F + G), about 1
    fibre_mask: Mask  # (Q, C), whether the fibre has enough readings
    complete: Mask  # (Q, K), which windows are complete, see `PressFeatures`

    def __getitem__(self, rows: slice | Indices) -> "ScaledFeatures":
        return ScaledFeatures(self.inputs[rows], self.fibre_mask[rows], self.complete[rows])

    def __len__(self) -> int:
        return len(self.inputs)

    @property
    def n_timed(self) -> int:
        """Number of timed windows, K."""
        return self.complete.shape[1]

    @property
    def n_complete(self) -> Indices:
        """Number (Q,) of complete windows of each press."""
        return self.complete.sum(axis=1)

    def without(self, failed: Iterable[int]) -> "ScaledFeatures":
        """Return the features with fibres masked in every press, by their indices."""
        working = ~np.isin(np.arange(self.fibre_mask.shape[1]), list(failed))
        return replace(self, fibre_mask=self.fibre_mask & working)


@dataclass(frozen=True)
class TargetScaler:
    """Scaling of a depth or force to [-1, 1]: `origin` becomes 0, a difference of `scale` 1."""

    __pydantic_config__: ClassVar[ConfigDict] = DOCUMENT_CONFIG
    name: Literal["depth_mm", "force_n"]
    origin: Annotated[float, Field(ge=0, le=MAX_MM)]
    scale: Annotated[float, Field(gt=0, le=MAX_MM)]

    @classmethod
    def fit(cls, name: str, values: Array) -> "TargetScaler":
        """Fit to (Q,) values."""
        low, high = float(values.min()), float(values.max())
        return cls(name, (low + high) / 2, (high - low) / 2 or 1.0)  # pyright: ignore[reportArgumentType]

    def transform(self, values: Array) -> Array:
        """Scale (Q,) values."""
        return (values - self.origin) / self.scale

    def inverse_transform(self, scaled: Array) -> Array:
        """Return the values of (Q,) scaled ones."""
        return scaled * self.scale + self.origin


@dataclass(frozen=True)
class FeatureScaler:
    """Scaling of features and targets, fitted to the presses of training."""

    __pydantic_config__: ClassVar[ConfigDict] = DOCUMENT_CONFIG
    mean_v: Annotated[Array, *array_field(-2 * MAX_VOLTS, 2 * MAX_VOLTS)]  # (C, F + G), 0 for the G modulations
    scale_v: Annotated[Array, *array_field(MIN_SCALE_V, 2 * MAX_VOLTS)]  # (C, F + G), 1 for the G modulations
    history_coef: Annotated[Array, *array_field(-1e6, 1e6)]  # (C, J, F + G), see `ResponseModel`
    history_mean_v: Annotated[Array, *array_field(-2 * MAX_VOLTS, 2 * MAX_VOLTS)]  # (C, J)
    origin_mm: Annotated[Array, *array_field(-MAX_MM, MAX_MM)]  # (2,) position that is 0 when scaled
    scale_mm: Annotated[float, Field(gt=0, le=MAX_MM)]  # distance that is 1 when scaled
    half_size_mm: Annotated[Array, *array_field(0, MAX_MM)]  # (2,) half the size of the area that was pressed
    measures: Annotated[tuple[TargetScaler, ...], Field(max_length=2, strict=False)] = ()  # of depth and force

    @classmethod
    def fit(
        cls,
        features: PressFeatures,
        positions_mm: Array,
        measures: Mapping[str, Array] | None = None,
        phases: Sequence[slice] = (),
    ) -> tuple["FeatureScaler", Floats]:
        """Fit the response model of the pad and the scaling of its features to presses at positions (Q, 2).

        A window is divided by the geometric mean of its own standard deviation and that of its fibre, so that small
        windows stay smaller, and their noise with them. `measures` are the depth and force (Q,) that are to be
        predicted, `phases` as in `ResponseModel.fit`.

        Returns:
            The scaler, and the scaled response by position (S, S, C, F + G), at the scaled depth 0 if depths vary.
        """
        targets = tuple(TargetScaler.fit(name, values) for name, values in (measures or {}).items())
        low, high = positions_mm.min(axis=0), positions_mm.max(axis=0)
        origin, scale_mm = (low + high) / 2, float((high - low).max() / 2) or 1.0
        relative_depth = measures["depth_mm"] / targets[0].origin if measures else None
        scaled_mm = (positions_mm - origin) / scale_mm
        inputs = features.windows, features.history
        response = ResponseModel.fit(scaled_mm, *inputs, features.fibre_mask, relative_depth, phases)
        history = response.history_coef, response.history_mean_v
        windows = remove_history(*inputs, *history)[:, :, : features.windows.shape[2]]
        mask = features.fibre_mask[:, :, None]
        mean = masked_mean(windows, mask)
        variance = masked_mean((windows - mean) ** 2, mask)
        scale = (variance * variance.mean(axis=1, keepdims=True)) ** 0.25
        scale = np.where(scale >= MIN_SCALE_V, scale, 1.0)  # constant windows are not scaled
        padding = ((0, 0), (0, len(phases)))
        mean = np.pad(np.zeros_like(mean) if targets else mean, padding)
        scale = np.pad(scale, padding, constant_values=1.0)
        scaler = cls(mean, scale, *history, origin, scale_mm, (high - low) / 2, targets)
        return scaler, scaler.scale(response.table)

    def transform(self, features: PressFeatures) -> ScaledFeatures:
        """Remove the history from features in volts and scale them."""
        windows = remove_history(features.windows, features.history, self.history_coef, self.history_mean_v)
        return ScaledFeatures(self.scale(windows), features.fibre_mask, features.complete)

    def scale(self, windows: Array) -> Floats:
        """Scale (..., C, F + G) windows without history and modulations."""
        return np.clip((windows - self.mean_v) / self.scale_v, -MAX_INPUT, MAX_INPUT).astype(np.float32)

    @property
    def centring(self) -> Array:
        """What scaling subtracts from windows, scaled; shape (C, F + G)."""
        return self.mean_v / self.scale_v

    def uncentre(self, scaled: Floats) -> Array:
        """Undo the centring of (..., C, F + G) scaled windows, so that 0 is no response."""
        return scaled + self.centring

    @property
    def depth_gain(self) -> float:
        """Relative growth of the response per scaled depth; 0 if depths do not vary."""
        return self.measures[0].scale / self.measures[0].origin if self.measures else 0.0

    def scale_targets(self, positions_mm: Array, measures: Mapping[str, Array] | None = None) -> Floats:
        """Return the scaled targets (Q, 2 + T) of (Q, 2) positions and (Q,) values of each measure."""
        columns = [target.transform((measures or {})[target.name]) for target in self.measures]
        return np.column_stack([self.scale_positions(positions_mm), *columns]).astype(np.float32)

    def scale_positions(self, positions_mm: Array) -> Array:
        """Scale (Q, 2) positions, mm."""
        return (positions_mm - self.origin_mm) / self.scale_mm

    def positions_mm(self, targets: Floats) -> Array:
        """Return the positions of (Q, 2) scaled ones, mm."""
        return targets * self.scale_mm + self.origin_mm

    def training_presses(
        self,
        features: PressFeatures,
        positions_mm: Array,
        measures: Mapping[str, Array] | None = None,
        rate_hz: float = np.inf,
    ) -> "TrainingPresses":
        """Scale features and targets of presses; `rate_hz` of readings is needed only for training with slides."""
        scaled, targets = self.transform(features), self.scale_targets(positions_mm, measures)
        latest_factor, latest_offset = self.latest_window_map(scaled.n_timed)
        return TrainingPresses(
            scaled.inputs,
            scaled.fibre_mask,
            scaled.complete,
            targets,
            depth_gain=self.depth_gain,
            latest_factor=latest_factor,
            latest_offset=latest_offset,
            per_mm=1 / self.scale_mm,
            speed=1 / (self.scale_mm * rate_hz),
        )

    def latest_window_map(self, n_timed: int) -> tuple[Floats, Floats]:
        """Return factors and offsets that map scaled `PRESS_WINDOWS` to scaled `LATEST_WINDOWS` of the same volts.

        Their shapes are (C, len(LATEST_WINDOWS), len(PRESS_WINDOWS)).
        """
        latest = slice(n_timed, n_timed + len(LATEST_WINDOWS))
        pressed = slice(len(PRESS_WINDOWS) if n_timed else 0)
        factor = self.scale_v[:, None, pressed] / self.scale_v[:, latest, None]
        offset = (self.mean_v[:, None, pressed] - self.mean_v[:, latest, None]) / self.scale_v[:, latest, None]
        return factor.astype(np.float32), offset.astype(np.float32)


@dataclass(frozen=True)
class TrainingPresses(ScaledFeatures):
    """Scaled presses and their targets, for training."""

    targets: Floats  # (Q, 2 + T)
    depth_gain: float  # see `FeatureScaler.depth_gain`
    latest_factor: Floats  # see `FeatureScaler.latest_window_map`
    latest_offset: Floats
    per_mm: float  # scaled distance of 1 mm
    speed: float  # scaled distance that 1 mm/s covers per reading; 0 if presses do not slide


def refit_response(
    scaler: FeatureScaler, presses: TrainingPresses, table: Floats, n_windows: int, prior: ResponsePrior
) -> tuple[Floats, ResponseFit]:
    """Refit the F windows of a response table (S, S, C, F + G) to few presses; return the table, and the fit.

    The mean of the prior, if it has one, is in scaled units without centring, see `FeatureScaler.uncentre`.
    """
    relative_depth = 1 + presses.depth_gain * presses.targets[:, 2] if presses.depth_gain else None
    positions, windows = presses.targets[:, :2].astype(np.float64), scaler.uncentre(presses.inputs)[..., :n_windows]
    fit, refitted = fit_response(positions, windows, presses.fibre_mask, prior, relative_depth), table.copy()
    refitted[..., :n_windows] = fit.table - scaler.centring[:, :n_windows]
    return refitted, fit


def leave_one_out_residuals(presses: TrainingPresses, table: Floats, leverage: Array | None = None) -> TrainingPresses:
    """Enlarge the residuals of presses as if the response table had been fitted without their position.

    The leave-one-out residual of a linear fit is its residual divided by 1 - leverage; with some hundred presses it is
    larger by a third. The leverage (Q, C) is that of a fit with a prior; None for that of a `ResponseModel`.
    """
    targets = presses.targets.astype(np.float64)
    positions, relative_depth = targets[:, :2], np.ones(len(targets))
    if presses.depth_gain:
        relative_depth += presses.depth_gain * targets[:, 2]
    expected = relative_depth[:, None, None] * interpolate_grid(table, positions)
    if leverage is None:
        leverage = leverages(positions, relative_depth)[:, None]
    leverage = np.minimum(leverage, 0.9)[:, :, None]  # residuals of isolated presses grow tenfold at most
    residual = (presses.inputs - expected) / np.where(table.any(axis=(0, 1)), 1 - leverage, 1.0)
    return replace(presses, inputs=(expected + residual).astype(np.float32))
