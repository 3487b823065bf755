"""Separation of each press into its parts: held response, onset, creep, and the residue that it leaves behind.

The windows of a press are linear in its four parts, and in the residues of earlier presses that it removes; the kernels
by which each shows in them follow from the viscoelastic model that presses are simulated by. Removed residues depend on
those that earlier presses left, so parts and removed residues are estimated in turn. Two presses at nearly the same
position differ by removed residues alone: the share that a press removes, and the distance over which it does, are
those that make such pairs most alike.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from padforge.sense.arrays import MIN_SCALE_V, Array, Mask
from padforge.sense.localizer.features import compute_features
from padforge.sense.localizer.moments import N_TIMED
from padforge.sense.localizer.response_model import ResponseModel, interpolate_grid
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.built_pad import PressParts
from padforge.sense.simulation.pad_model import (
    DELAY_S,
    RELEASE_S,
    Cycle,
    Motion,
    Viscoelasticity,
    probe_motion,
    replaced_residues,
    superpose_strain,
)
from padforge.sense.twin.responses import Responses, near_pairs, normalize

HELD = 0.9  # share of the held response from which on a window shows it
DELAYS = 5  # delays, evenly over their range, that kernels are averaged over
BOUNDS = {"memory": (0.0, 1.0), "memory_mm": (1.0, 30.0), "hysteresis_s": (2.0, 100.0)}
"""Bounds of the settings of `[rig]` that are fitted to pairs of presses."""
SINGLE = 5  # windows of the touch that are one reading long
N_SEARCHED = 1500  # last presses, to which these settings are fitted
MAX_EVALUATIONS = 40  # of that fit in each round


@dataclass(frozen=True)
class SeparatedPresses:
    """Parts of Q presses in all channels, without the earlier residues that they remove."""

    parts: PressParts[Responses]
    pressed: Responses  # mean while the probe rests in the silicone
    rig: dict[str, float]  # settings of `[rig]`: those in BOUNDS, and `touch_s`


class Kernels(NamedTuple):
    """Windows of a press by 1 V of each of its parts, in the order of `PressParts`, and of the residues it removes."""

    parts: Array  # (4, F)
    removed: Array  # (F,)


def separate_parts(recording: Recording, training: Mask, hysteresis_s: float) -> SeparatedPresses:
    """Separate the parts of the presses of known position; maps of these parts are fitted to presses in `training`."""
    presses = recording.down_command, recording.up_command, recording.presses_mm
    down, up, positions_mm = (part[recording.has_position] for part in presses)
    inputs = compute_features(recording.readings, down, up)
    timed = inputs.windows[:, :, :N_TIMED]
    valid, positions = inputs.fibre_mask, normalize(positions_mm)[0]
    times_s = recording.times_s[down], recording.times_s[np.minimum(up, len(recording.times_s) - 1)]
    cycle = Cycle(2 * int(np.median(up - down)), recording.rate_hz)

    def smoothed(windows: Array) -> Array:
        return interpolate_grid(smooth_maps(positions[training], windows[training], valid[training]), positions)

    rig = RigSettings(hysteresis_s=hysteresis_s, memory=0.7, memory_mm=9.0)  # where the fit of the memory starts
    kernels, removed, parts = part_kernels(cycle, rig), np.zeros(valid.shape), np.empty((4, *valid.shape))
    held_kernel = PressParts(*kernels.parts).held
    is_held = held_kernel >= min(HELD, held_kernel.max())
    pressed = timed[:, :, is_held].mean(axis=2)
    for _ in range(3):
        # 1. Parts of each press, without the residues that it removes
        windows = timed - removed[:, :, None] * kernels.removed
        residual = (windows - smoothed(windows))[training]
        for c in range(valid.shape[1]):
            parts[:, :, c] = _split(windows[:, c], residual[:, c], kernels.parts)
        # 2. Residues that presses remove, by what earlier ones left
        estimated = PressParts(*parts)
        held, residues = np.moveaxis(smoothed(np.moveaxis(np.array([estimated.held, estimated.after]), 0, 2)), 2, 0)
        presses = positions_mm, *times_s, residues, held
        rig = _fit_memory(presses, pressed / kernels.removed[is_held].mean(), training, rig)
        removed, kernels = replaced_residues(*presses, rig), part_kernels(cycle, rig)
    pressed = pressed - kernels.removed[is_held].mean() * removed
    responses = PressParts(*(Responses(positions_mm, part, valid) for part in parts))
    # at most the greatest value of `[rig]`, which readings that are far apart would exceed
    touch_s = min(_touch_std(positions_mm, timed, is_held) / recording.rate_hz, 1.0)
    fitted = {name: getattr(rig, name) for name in BOUNDS} | {"touch_s": touch_s}
    return SeparatedPresses(responses, Responses(positions_mm, pressed, valid), fitted)


def _touch_std(positions_mm: Array, windows: Array, is_held: Mask) -> float:
    """Return the standard deviation over the pad of the time of the touch, in readings.

    The touch is when the channel that responds most reaches half of its response. The variance between neighbouring
    presses, which is noise, is subtracted.
    """
    held = windows[:, :, is_held].mean(axis=2)
    rows = np.arange(len(windows))
    channel = np.abs(held).argmax(axis=1)
    response = held[rows, channel, None]
    rise = windows[rows, channel, :SINGLE] / np.where(np.abs(response) > MIN_SCALE_V, response, np.inf)
    rise = np.pad(rise, ((0, 0), (1, 0)))
    above = rise[:, 1:] >= 0.5
    k = np.where(above.any(axis=1), above.argmax(axis=1), SINGLE - 1)
    below, step = rise[rows, k], rise[rows, k + 1] - rise[rows, k]
    half = k + np.clip((0.5 - below) / np.where(step > 0, step, 1.0), 0, 1)
    first, second = near_pairs(positions_mm)
    return float(np.sqrt(max(half.var() - ((half[first] - half[second]) ** 2).mean() / 2, 0.0)))


def _fit_memory(presses: tuple[Array, ...], pressed: Array, training: Mask, rig: RigSettings) -> RigSettings:
    """Fit how presses, as in `replaced_residues`, remove residues, by responses (Q, C) at nearly the same position."""
    last = slice(-N_SEARCHED, None)
    positions_mm, touch_s, release_s, residues, held = (values[last] for values in presses)
    rows = np.flatnonzero(training[last])
    first, second = (rows[pair] for pair in near_pairs(positions_mm[rows]))
    low, high = np.array(list(BOUNDS.values())).T
    scale = np.array([0.2, 2.0, 0.2 * rig.hysteresis_s])
    start = np.array([getattr(rig, name) for name in BOUNDS])

    def to_settings(values: Array) -> RigSettings:
        return rig.model_copy(update=dict(zip(BOUNDS, np.clip(values, low, high).tolist(), strict=True)))

    def misfit(values: Array) -> float:
        removed = replaced_residues(positions_mm, touch_s, release_s, residues, held, to_settings(values))
        residual = pressed[last] - removed
        squares = np.square(residual[first] - residual[second]).mean(axis=0)
        return float(np.log(np.maximum(squares, MIN_SCALE_V**2)).sum())

    simplex = np.vstack([start, start - np.diag(scale * np.where(start - scale > low, 1, -1))])
    options = {"maxfev": MAX_EVALUATIONS, "initial_simplex": simplex, "xatol": np.inf, "fatol": 1e-3}
    return to_settings(minimize(misfit, start, method="Nelder-Mead", options=options).x)


def part_kernels(cycle: Cycle, rig: RigSettings) -> Kernels:
    """Compute the kernels of a press, averaged over its delays."""
    unit, out = np.zeros((5, 2, 5)), []
    unit[:, 0] = np.eye(5)  # the first press has 1 V of part c in channel c, and removes 1 V of residues in channel 4
    share = (np.arange(DELAYS) + 0.5) / DELAYS
    for touch_s, release_s in zip(*(low + share * (high - low) for low, high in (DELAY_S, RELEASE_S)), strict=True):
        # a press, and none in the cycle after it
        motion = Motion(
            *(np.pad(values, ((0, 1), (0, 0))) for values in probe_motion(cycle, np.array([[touch_s, release_s]])))
        )
        strain = superpose_strain(PressParts(*unit[:4]), unit[4], motion)
        readings = Viscoelasticity(cycle.rate_hz, rig)(strain)
        down, up = np.array([cycle.down_index]), np.array([cycle.readings])
        out.append(compute_features(readings, down, up).windows[0, :, :N_TIMED])
    *parts, removed = np.mean(out, axis=0)
    return Kernels(np.array(parts), removed)


def smooth_maps(positions: Array, windows: Array, valid: Mask) -> Array:
    """Fit smooth functions of the position, within [-1, 1], to windows (Q, C, F); on a grid (S, S, C, F)."""
    return ResponseModel.fit(positions, windows, np.empty((*windows.shape[:2], 0)), valid).table


def _split(windows: Array, residual: Array, kernels: Array) -> Array:
    """Return the parts (4, Q) of windows (Q, F), least squares weighted by the scatter of residuals (n, F)."""
    weights = 1 / np.maximum(residual.std(axis=0), MIN_SCALE_V)
    return np.linalg.lstsq((kernels * weights).T, (windows * weights).T, rcond=None)[0]
