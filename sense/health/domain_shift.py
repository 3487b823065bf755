"""Domain shift between a recording and the calibration of a localizer, after which radii may be too small.

Baselines outside the range of the calibration, or responses of another size than those of the calibration at the
predicted positions, show that the pad, its wiring or the depth of presses has changed. True positions need not be
known. `fault_detector` detects fibres that fail within a recording.
"""

from dataclasses import dataclass, replace
from math import exp, hypot, sqrt

import numpy as np

from padforge.sense.arrays import Array, Mask, press_bounds
from padforge.sense.health.health_model import HealthModel
from padforge.sense.localizer.features import mean_at_rest
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.response_model import interpolate_grid
from padforge.sense.localizer.scaler import ScaledFeatures
from padforge.sense.recording.frames import framed
from padforge.sense.recording.recording import Recording

# Standard deviations of the logarithm of a gain on an unchanged pad
FIBRE_DRIFT = 0.045  # within minutes, of a fibre of the published pad
COMMON_DRIFT = 0.03  # within minutes, of its six fibres together
TRAINING_STD = 0.8  # by the errors of expected responses, over the root of the number of training presses
MAX_DEVIATION = 4.0  # largest usual deviation of a gain, in standard deviations
MIN_PRESSES = 100  # with fewer presses no gain is estimated, since one or two dominate the response of a fibre
MAX_PRESSES = 1000  # presses that are used at most


@dataclass(frozen=True)
class DomainShift:
    """A difference between the fibres now and in the calibration."""

    kind: str  # "rest" or "gain"
    fibres: tuple[int, ...]  # indices of one fibre, or of all
    value: float  # median baseline, V; or size of the responses relative to that in calibration
    usual: tuple[float, float]  # lowest and highest usual value

    @property
    def text(self) -> str:
        """One line; fibres are numbered from 1."""
        (low, high), is_one = self.usual, len(self.fibres) == 1
        name = f"fibre {self.fibres[0] + 1}" if is_one else "all fibres"
        if self.kind == "rest":
            what = f"rests at {self.value:.2f} V, usual since calibration is {low:.2f} to {high:.2f} V"
        else:
            verb = "responds" if is_one else "respond"
            what = f"{verb} {self.value:.2f} times as strongly as in calibration, usual is {low:.2f} to {high:.2f}"
        return f"{name} {what}: radii may be too small; recalibrate"


def detect_shifts(
    localizer: LocalizerModel, health: HealthModel, recording: Recording, fibre_mask: Mask
) -> list[DomainShift]:
    """Detect how a recording differs from that of the calibration; `fibre_mask` (Q, C) is false for faulty fibres.

    The size of responses also depends on the depth of presses. If the localizer predicts depths, responses are compared
    with those expected at these depths. Raises InputError as `LocalizerModel.raw_features` does.
    """
    shifts = _rest_shifts(health, recording, fibre_mask)
    if localizer.features == "windows":
        shifts += _gain_shifts(localizer, health.presses, recording, fibre_mask)
    return shifts


def rest_levels(recording: Recording) -> Array:
    """Return the baselines (Q, C) before the presses of a recording, V; NaN where a reading is missing."""
    frames = framed(recording)
    previous_end, _ = press_bounds(frames.down_command, frames.up_command, len(frames.readings))
    return mean_at_rest(frames.readings, frames.down_command, previous_end)


def _rest_shifts(health: HealthModel, recording: Recording, fibre_mask: Mask) -> list[DomainShift]:
    rests, shifts = rest_levels(recording), []
    for fibre, (low, high) in zip(health.living.tolist(), health.rest_range_v.T.tolist(), strict=True):
        levels = rests[fibre_mask[:, fibre] & np.isfinite(rests[:, fibre]), fibre]
        margin = 0.25 * (high - low)
        usual = low - margin, high + margin
        if len(levels) and not usual[0] <= (median := float(np.median(levels))) <= usual[1]:
            shifts.append(DomainShift("rest", (fibre,), median, usual))
    return shifts


def _gain_shifts(
    localizer: LocalizerModel, n_training: int, recording: Recording, fibre_mask: Mask
) -> list[DomainShift]:
    """Compare responses with those expected at the predicted positions: of all fibres together, or else of each.

    Each fibre is compared at positions that the others predict, so that its own fault does not bias them.
    """
    presses = localizer.scaled_features(recording)
    rows = np.linspace(0, len(presses) - 1, min(len(presses), MAX_PRESSES)).astype(np.int64)
    presses = replace(presses[rows], fibre_mask=presses.fibre_mask[rows] & fibre_mask[rows])
    fibres = tuple(range(localizer.fibres))
    energy, expected = _compare(localizer, presses)
    training_std = TRAINING_STD / sqrt(n_training)
    common = _gain_shift(fibres, energy.sum(axis=1), expected.sum(axis=1), hypot(COMMON_DRIFT, training_std))
    if common or len(fibres) == 1:
        return [common] if common else []
    shifts = []
    for fibre in fibres:
        energy, expected = _compare(localizer, presses, (fibre,))
        shifts.append(_gain_shift((fibre,), energy[:, fibre], expected[:, fibre], hypot(FIBRE_DRIFT, training_std)))
    return [shift for shift in shifts if shift]


def _compare(localizer: LocalizerModel, presses: ScaledFeatures, failed: tuple[int, ...] = ()) -> tuple[Array, Array]:
    """Return the energies (Q, C) of responses and of expected responses, V^2; 0 where a fibre is masked.

    Responses are expected at the positions and depths that the localizer predicts without the failed fibres; they are 0
    if no other fibre is valid.
    """
    scaler = localizer.scaler
    localization = localizer.predict_features(presses, failed)
    expected = interpolate_grid(localizer.table, scaler.scale_positions(localization.positions_mm))
    if scaler.measures:
        expected = expected * (localization.measures["depth_mm"].values / scaler.measures[0].origin)[:, None, None]
    expected_v, response_v = (part * scaler.scale_v + scaler.mean_v for part in (expected, presses.inputs))
    is_located = np.delete(presses.fibre_mask, failed, axis=1).any(axis=1, keepdims=True)
    valid = np.logical_and(is_located, presses.fibre_mask)
    expected_v = np.where(valid[:, :, None], expected_v, 0.0)
    response_v = np.where(expected_v == 0, 0.0, response_v)
    return (response_v**2).sum(axis=2), (expected_v**2).sum(axis=2)


def _gain_shift(fibres: tuple[int, ...], energy: Array, expected: Array, log_std: float) -> DomainShift | None:
    """Compare (Q,) energies of responses with expected ones, and return the gain if it is unusual.

    A least-squares gain would be biased to small values by the errors of the positions.
    """
    if (expected > 0).sum() < MIN_PRESSES:
        return None
    ratio, leverage = energy.sum() / expected.sum(), expected / expected.sum()
    gain = float(np.sqrt(ratio))
    # Jackknife standard error, since the scatter grows with the response and few presses dominate
    residual = (energy / ratio - expected) / (1 - leverage)
    standard_error = float(np.linalg.norm(residual) / (2 * expected.sum()))
    limit = MAX_DEVIATION * hypot(log_std, standard_error)
    usual = exp(-limit), exp(limit)
    return None if usual[0] <= gain <= usual[1] else DomainShift("gain", fibres, gain, usual)
