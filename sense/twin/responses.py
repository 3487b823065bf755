"""Responses of the channels to presses at known positions, and Gaussian processes fitted to them.

The response of a channel to a press is its mean while the tip rests in the silicone, minus the baseline before the
press and the effect of the history of the channel.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial import KDTree

from padforge.sense.arrays import Array, Indices, Mask, masked_mean
from padforge.sense.localizer.features import compute_features
from padforge.sense.localizer.moments import PRESS_WINDOWS
from padforge.sense.localizer.response_model import ResponseModel, remove_history
from padforge.sense.recording.recording import Recording

DEPTH_TOLERANCE = 0.15  # relative difference of depths up to which presses count as equally deep
FIRST_HELD = 3  # first window of the press that counts as held: the tip has come to rest in the silicone
HOLD = np.array([(end - first) * (k >= FIRST_HELD) for k, (first, end) in enumerate(PRESS_WINDOWS)], float)
HOLD /= HOLD.sum()
"""Weights of the windows of a press in its response; shape (9,)."""
RIDGE_HISTORY = 300.0  # penalty on weights of the history; smaller than for a localizer, since responses are the result
GP_WIDTHS = (0.4, 0.8)  # candidate standard deviations of the Gaussian kernel, grid units
GP_PRESSES = 800  # maximum presses of a Gaussian process, the size of an eigenvalue problem
GP_RATIOS = np.append(0.0, np.geomspace(1e-2, 1e4, 61))  # candidate ratios of the variances of function and noise
MIN_GP_PRESSES = 10


@dataclass(frozen=True)
class Responses:
    """Responses of C channels to Q presses."""

    positions_mm: Array  # (Q, 2), in the arm's frame
    volts: Array  # (Q, C)
    valid: Mask  # (Q, C), whether the channel has enough readings

    def __len__(self) -> int:
        return len(self.positions_mm)

    def select(self, rows: Indices, channels: Indices | slice = slice(None)) -> "Responses":
        """Return the responses of some channels to some presses."""
        return Responses(self.positions_mm[rows], self.volts[rows][:, channels], self.valid[rows][:, channels])

    @property
    def variance(self) -> Array:
        """Variance of the responses of each channel; shape (C,); 1 for a channel without responses."""
        variance = masked_mean((self.volts - masked_mean(self.volts, self.valid)) ** 2, self.valid)
        return np.where(variance > 0, variance, 1.0)

    def explained_variance(self, predicted: Array) -> Array:
        """Return the share of each channel's variance (C,) that a prediction (Q, C) explains."""
        return 1 - masked_mean((self.volts - predicted) ** 2, self.valid) / self.variance


def select_one_depth(recording: Recording) -> Recording:
    """Keep the positions of presses of the most common depth only, since a deeper one responds more.

    Other presses remain in the history of later ones. If no depth is known, all are assumed to be equal.
    """
    depths_mm = np.where(recording.has_position, recording.actual_depths_mm, np.nan)
    ordered = np.sort(depths_mm[depths_mm > 0])[::-1]
    if not len(ordered):
        return recording
    # the presses within the tolerance of each depth are counted; of equally common ones, the deepest responds most
    last = np.searchsorted(-ordered, -(1 - DEPTH_TOLERANCE) * ordered, "right")
    first = np.searchsorted(-ordered, -(1 + DEPTH_TOLERANCE) * ordered, "left")
    common = ordered[np.argmax(last - first)]
    is_common = np.abs(depths_mm - common) <= DEPTH_TOLERANCE * common
    return replace(recording, presses_mm=np.where(is_common[:, None], recording.presses_mm, np.nan))


def compute_responses(recording: Recording, training: Mask) -> Responses:
    """Compute the responses to all Q presses of known position; history is fitted to those in the mask `training`."""
    presses = recording.down_command, recording.up_command, recording.presses_mm
    down, up, positions_mm = (part[recording.has_position] for part in presses)
    inputs = compute_features(recording.readings, down, up, until=up)
    pressed = inputs.windows[:, :, : len(PRESS_WINDOWS)]
    normalized, *_ = normalize(positions_mm)
    model = ResponseModel.fit(
        normalized[training],
        pressed[training],
        inputs.history[training],
        inputs.fibre_mask[training],
        ridge_history=RIDGE_HISTORY,
    )
    windows = remove_history(pressed, inputs.history, model.history_coef, model.history_mean_v)
    return Responses(positions_mm, windows @ HOLD, inputs.fibre_mask)


def normalize(positions_mm: Array) -> tuple[Array, Array, float]:
    """Return positions (Q, 2) within the square [-1, 1] about all of them, its centre (2,) and half its side, mm."""
    middle_mm = (positions_mm.min(axis=0) + positions_mm.max(axis=0)) / 2
    half_mm = float(np.abs(positions_mm - middle_mm).max())
    return (positions_mm - middle_mm) / half_mm, middle_mm, half_mm


def near_pairs(positions_mm: Array) -> tuple[Indices, Indices]:
    """Return the indices (n,) of presses and of their nearest neighbours, each pair once."""
    pairs = KDTree(positions_mm).query(positions_mm, 2)[1]
    first, second = np.unique(np.sort(pairs, axis=1), axis=0).T
    return first, second


@dataclass(frozen=True)
class GaussianProcess:
    """Gaussian process of the responses of one channel by position."""

    points: Array  # (n, 2), positions of the presses it was fitted to, grid units
    width: float  # standard deviation of its kernel, grid units
    weights: Array  # (n,), V
    mean_v: float
    noise_v: float  # standard deviation of the noise
    log_bayes_factor: float  # log-likelihood of the process minus that of noise alone

    def predict(self, points: Array) -> Array:
        """Predict the mean (Q,), V, at points (Q, 2), grid units."""
        return self.mean_v + np.exp(_squares(points, self.points) * (-0.5 / self.width**2)) @ self.weights


def fit_gps(responses: Responses, unit_mm: float) -> list[GaussianProcess]:
    """Fit a Gaussian process to each channel, by maximum likelihood over kernel width and noise.

    With fewer than MIN_GP_PRESSES valid presses, the process is 0 and its noise NaN.
    """
    points = responses.positions_mm[:GP_PRESSES] / unit_mm
    squares = _squares(points, points)

    @cache  # most channels are valid in the same presses
    def eigen(valid: bytes, width: float) -> tuple[np.ndarray, np.ndarray]:
        rows = np.frombuffer(valid, bool)
        return np.linalg.eigh(np.exp(squares[np.ix_(rows, rows)] * (-0.5 / width**2)))

    out = []
    for channel in range(responses.volts.shape[1]):
        valid = np.ascontiguousarray(responses.valid[:GP_PRESSES, channel])
        if valid.sum() < MIN_GP_PRESSES:
            out.append(GaussianProcess(np.empty((0, 2)), 1.0, np.empty(0), 0.0, np.nan, 0.0))
            continue
        volts = responses.volts[:GP_PRESSES, channel][valid]
        mean_v = float(volts.mean())
        fits = [(*_fit_ratio(*eigen(valid.tobytes(), width), volts - mean_v), width) for width in GP_WIDTHS]
        noise_v, log_bayes_factor, weights, width = max(fits, key=lambda fit: fit[1])
        out.append(GaussianProcess(points[valid], width, weights, mean_v, noise_v, log_bayes_factor))
    return out


def estimate_noise(responses: Responses, unit_mm: float) -> Array:
    """Return the standard deviation (C,), V, of the noise about a smooth function of the position, see `fit_gps`."""
    return np.array([gp.noise_v for gp in fit_gps(responses, unit_mm)])


def _squares(points: Array, others: Array) -> Array:
    """Return the squared distances (Q, n) of points (Q, 2) from others (n, 2)."""
    return ((points[:, None, :] - others) ** 2).sum(axis=2)


def _fit_ratio(eigenvalues: np.ndarray, eigenvectors: np.ndarray, volts: np.ndarray) -> tuple[float, float, Array]:
    """Return the noise and the log Bayes factor of the most likely of GP_RATIOS, and the weights (n,) of its mean."""
    projected = eigenvectors.T @ volts
    variances = 1 + GP_RATIOS[:, None] * np.maximum(eigenvalues, 0)
    noise_var = np.maximum((projected**2 / variances).mean(axis=1), 1e-300)
    log_likelihood = -0.5 * (len(volts) * np.log(noise_var) + np.log(variances).sum(axis=1))
    best = int(np.argmax(log_likelihood))
    weights = GP_RATIOS[best] * (eigenvectors @ (projected / variances[best]))
    return float(np.sqrt(noise_var[best])), float(log_likelihood[best] - log_likelihood[0]), weights
