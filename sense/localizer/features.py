"""Features of presses: means of each fibre's readings over windows of the press, and its history before it.

Both are relative to the baseline of the fibre, its mean at rest just before the press. Where a window of `moments`
would reach into a neighbouring press, the nearest reading of its own press is repeated. The history shows how far the
fibre has crept after earlier presses, and so how it still creeps. Each feature depends on one fibre alone, so that a
failed fibre can be masked and affects no other. Gaps (NaN) are interpolated; a fibre with too few readings in a press
is masked in it. Readings are frames here (see `recording.frames`).
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from padforge.sense.arrays import Array, Indices, Mask, press_bounds
from padforge.sense.localizer.moments import (
    LATEST_WINDOWS,
    MODULATED,
    N_TIMED,
    PRESS_WINDOWS,
    RELEASE_WINDOWS,
    REST,
    Window,
    complete_windows,
)

FeatureSet = Literal["windows", "published", "array"]
"""Features of a press: windows, the published running medians, or arrays that a caller computed."""
HISTORY_WINDOWS: tuple[Window, ...] = (
    *((-2, 0), (-5, -2), (-10, -5), (-15, -10), (-18, -15), (-20, -18), (-30, -20), (-40, -30)),
    *((-50, -40), (-60, -50), (-80, -60), (-100, -80), (-120, -100), (-160, -120)),
)
"""Windows before a press, since silicone creeps for seconds to minutes after an earlier one."""
SLOW = (800, 4000)  # lengths of the slow medians before a press, readings: one and five minutes at 13 Hz
N_MEDIAN_SAMPLES = 200  # readings in a slow median
N_FEATURES = N_TIMED + len(LATEST_WINDOWS) + len(MODULATED)
N_HISTORY = len(HISTORY_WINDOWS) + len(SLOW)
MEDIAN_WIDTH = 15  # of the published running median, readings
MEDIAN_OFFSET = 10  # readings from a command to the middle of the published median
MIN_PRESENT = 0.75  # minimum share of valid readings of a fibre in a press


@dataclass(frozen=True)
class PressFeatures:
    """Features of Q presses in volts."""

    windows: Array  # (Q, C, F), relative to the baseline
    history: Array  # (Q, C, J), relative to the baseline; J = 0 for features without moments
    fibre_mask: Mask  # (Q, C), whether the fibre has enough readings
    complete: Mask  # (Q, K), complete windows of the press and the release; K = 0 for features without moments

    def __getitem__(self, rows: Indices | slice) -> "PressFeatures":
        return PressFeatures(self.windows[rows], self.history[rows], self.fibre_mask[rows], self.complete[rows])

    def __add__(self, other: "PressFeatures") -> "PressFeatures":
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return PressFeatures(*map(np.concatenate, pairs))

    def __len__(self) -> int:
        return len(self.windows)


def compute_features(
    readings: Array,
    down_command: Indices,
    up_command: Indices,
    until: Indices | None = None,
    is_published: bool = False,
    history: Array | None = None,
) -> PressFeatures:
    """Compute the features of every press from readings (R, C), V, NaN where missing.

    Commands (Q,) are the first readings after the probe was sent down and up, `until` (Q,) the first readings that are
    not used, None for all up to the next press. The published running medians do not depend on it. The history
    (Q, C, J) of the presses takes longest, and is given if it was computed before.
    """
    filled = interpolate_gaps(readings)
    _, next_begin = press_bounds(down_command, up_command, len(readings))
    until = next_begin if until is None else np.clip(until, down_command + 1, next_begin)
    fibre_mask = valid_fibres(readings, down_command, up_command, until)
    if is_published:
        return features_without_moments(_running_medians(filled, down_command, up_command), fibre_mask)
    windows = window_means(filled, down_command, up_command, until)
    complete = complete_windows(down_command, up_command, until)
    history = compute_history(filled, down_command) if history is None else history
    return PressFeatures(windows, history, fibre_mask, complete)


def features_without_moments(windows: Array, fibre_mask: Mask) -> PressFeatures:
    """Return features (Q, C, F) that have no history and do not depend on a moment."""
    return PressFeatures(windows, np.empty((*fibre_mask.shape, 0)), fibre_mask, np.empty((len(windows), 0), bool))


def valid_fibres(readings: Array, down_command: Indices, up_command: Indices, until: Indices) -> Mask:
    """Return a mask (Q, C) of fibres with enough readings in a press, from the rest before it to `until` (Q,)."""
    first, ends = np.maximum(down_command + REST[0], 0), np.minimum(until, up_command + RELEASE_WINDOWS[-1][1])
    counts = np.vstack([np.zeros((1, readings.shape[1])), np.cumsum(~np.isnan(readings), axis=0)])
    return counts[ends] - counts[first] >= MIN_PRESENT * (ends - first)[:, None]


def interpolate_gaps(readings: Array) -> Array:
    """Fill gaps of (R, C) readings linearly; a fibre without any reading becomes 0."""
    missing = np.isnan(readings)
    if not missing.any():
        return readings
    filled = np.where(missing, 0.0, readings)
    rows = np.arange(len(readings))
    for fibre in np.flatnonzero(missing.any(axis=0) & ~missing.all(axis=0)):
        gap = missing[:, fibre]
        filled[gap, fibre] = np.interp(rows[gap], rows[~gap], readings[~gap, fibre])
    return filled


def window_means(readings: Array, down_command: Indices, up_command: Indices, until: Indices) -> Array:
    """Return (Q, C, F) means over the windows of press, release and latest readings, V, relative to the baseline."""
    previous_end, _ = press_bounds(down_command, up_command, len(readings))
    baseline = mean_at_rest(readings, down_command, previous_end)
    return windows_from_rest(readings, baseline, down_command, up_command, until)


def mean_at_rest(readings: Any, down_command: Any, previous_end: Any, xp: Any = np) -> Any:
    """Return the baselines (Q, C), V: means before the presses, after the ends (Q,) of the previous ones.

    All arrays are of the module `xp`, numpy or torch.
    """
    return _gather(readings, down_command, REST, previous_end, down_command, xp).mean(axis=1)


def windows_from_rest(
    readings: Any, baseline: Any, down_command: Any, up_command: Any, until: Any, xp: Any = np
) -> Any:
    """Return the windows of `window_means`, relative to a known baseline (Q, C).

    All arrays are of the module `xp`, numpy or torch.
    """
    hold_end = xp.minimum(up_command, until)
    spans = [(down_command, window, hold_end) for window in PRESS_WINDOWS]
    spans += [(up_command, window, until) for window in RELEASE_WINDOWS]
    spans += [(hold_end, window, hold_end) for window in LATEST_WINDOWS]
    means = [_gather(readings, origin, window, down_command, high, xp).mean(axis=1) for origin, window, high in spans]
    return xp.stack(means, axis=2) - baseline[:, :, None]


def compute_history(readings: Any, down_command: Any, xp: Any = np) -> Any:
    """Return the history (Q, C, J) before the presses, V, relative to the baseline: windows, then slow medians.

    It includes all readings, whether or not a press is known there. So the baseline is the mean of all readings in
    `REST`, also of those before the end of the previous press, which `mean_at_rest` does not use. All arrays are of the
    module `xp`, numpy or torch.
    """
    offset = readings[0]  # subtracted so that long sums keep their digits
    sums = xp.cumsum(readings - offset, axis=0)
    sums = xp.concat([xp.zeros_like(sums[:1]), sums])

    def mean(window: Window) -> Any:
        first = xp.clip(down_command + window[0], 0, None)
        end = xp.maximum(down_command + window[1], first + 1)
        return (sums[end] - sums[first]) / (end - first)[:, None] + offset

    means = [mean(window) for window in HISTORY_WINDOWS]
    medians = [_slow_median(readings, down_command, length, xp) for length in SLOW]
    baseline = mean(REST)
    return xp.stack([*means, *medians], axis=2) - baseline[:, :, None]


def _slow_median(readings: Any, down_command: Any, length: int, xp: Any) -> Any:
    """Return the (Q, C) medians of `N_MEDIAN_SAMPLES` of the `length` readings before each press."""
    offsets = xp.arange(-length, 0, length // N_MEDIAN_SAMPLES)
    if xp is not np:  # the median of torch is the lower one of two
        samples = xp.sort(readings[xp.clip(down_command[:, None] + offsets, 0, None)], axis=1).values
        n = samples.shape[1]
        return samples[:, (n - 1) // 2 : n // 2 + 1].mean(axis=1)
    out = np.empty((len(down_command), readings.shape[1]))
    for first in range(0, len(down_command), 1024):  # in chunks, since a press takes kilobytes
        index = np.maximum(down_command[first : first + 1024, None] + offsets, 0)
        out[first : first + 1024] = np.median(readings[index], axis=1)
    return out


def _running_medians(readings: Array, down_command: Indices, up_command: Indices) -> Array:
    """Return the published features (Q, C, 3), V: the running medians before, in and after the press."""
    previous_end, next_begin = press_bounds(down_command, up_command, len(readings))
    window = (-(MEDIAN_WIDTH // 2), MEDIAN_WIDTH // 2 + 1)
    ranges = (
        (down_command - MEDIAN_OFFSET, previous_end, down_command),
        (down_command + MEDIAN_OFFSET, down_command, up_command),
        (up_command + MEDIAN_OFFSET, down_command, next_begin),
    )
    medians = [np.median(_gather(readings, middle, window, low, high, np), axis=1) for middle, low, high in ranges]
    return np.stack(medians, axis=2)


def _gather(readings: Any, origin: Any, window: Window, low: Any, high: Any, xp: Any) -> Any:
    """Return the readings (Q, W, C) at `origin` + window, these indices clipped to low <= index < high <= R."""
    index = xp.maximum(origin[:, None] + xp.arange(*window), low[:, None])
    return readings[xp.minimum(index, high[:, None] - 1)]
