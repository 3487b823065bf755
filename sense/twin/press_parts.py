"""The parts of each press (held response, onset, creep, what remains), separated by how they show in its windows.

The windows of a press are linear in its four parts, and in what it takes away of the residues of earlier presses; how
each shows in them follows from the viscoelastic model by which presses are simulated. What is taken away follows from
what remained of those presses, so both are estimated in turn. Two presses at nearly the same place differ by it alone:
so the share that is taken away, and the distance over which, are those by which such pairs differ least.
"""

from dataclasses import dataclass

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
    superpose_strain,
)
from padforge.sense.simulation.residual_indentation import replaced_residues
from padforge.sense.twin.responses import Responses, near_pairs, normalize

N_ROUNDS = 3
"""Times that parts and what is taken away are estimated in turn."""
HELD = 0.9
"""Share of the held response from which on a window shows it."""
DELAYS = 5
"""Delays over their range that the windows are averaged over."""
BOUNDS = {"memory": (0.0, 1.0), "memory_mm": (1.0, 30.0), "hysteresis_s": (2.0, 100.0)}
"""Of what is fitted to pairs of presses, settings of `[rig]`."""
MAX_TOUCH_S = 1.0
"""Largest `touch_s` of `[rig]`, of a recording of readings that are longer apart."""
SINGLE = 5
"""Windows of the touch that are one reading long."""
FIRST_MEMORY, FIRST_MEMORY_MM = 0.7, 9.0
"""Values from which that search starts."""
N_SEARCHED, MAX_EVALUATIONS = 1500, 40
"""Presses that it looks at, the last ones, and values that it tries in each round."""


@dataclass(frozen=True)
class SplitPresses:
    """Parts of Q presses in all channels, without what they take away of earlier residues."""

    parts: PressParts[Responses]
    pressed: Responses  # mean while the probe rests in the silicone
    rig: dict[str, float]  # settings of `[rig]`: those in BOUNDS, and `touch_s`


def split_presses(recording: Recording, training: Mask, hysteresis_s: float) -> SplitPresses:
    """Split the presses of known position of a recording; maps of their parts are fitted to those in `training`."""
    positioned = recording.has_position
    down, up, positions_mm = (
        recording.down_command[positioned],
        recording.up_command[positioned],
        recording.presses_mm[positioned],
    )
    inputs = compute_features(recording.readings, down, up)
    timed = inputs.windows[:, :, :N_TIMED]
    valid, positions = inputs.fibre_mask, normalize(positions_mm)[0]
    times_s = recording.times_s[down], recording.times_s[np.minimum(up, len(recording.times_s) - 1)]
    cycle = Cycle(2 * int(np.median(up - down)), recording.rate_hz)

    def smoothed(windows: Array) -> Array:
        return interpolate(smooth_maps(positions[training], windows[training], valid[training]), positions)

    rig = RigSettings(hysteresis_s=hysteresis_s, memory=FIRST_MEMORY, memory_mm=FIRST_MEMORY_MM)
    kernels, replaced, parts = part_kernels(cycle, rig), np.zeros(valid.shape), np.empty((4, *valid.shape))
    is_held = kernels[0] >= min(HELD, kernels[0].max())
    pressed = timed[:, :, is_held].mean(axis=2)
    for _ in range(N_ROUNDS):
        windows = timed - replaced[:, :, None] * kernels[4]
        residual = (windows - smoothed(windows))[training]
        for c in range(valid.shape[1]):
            parts[:, :, c] = _split(windows[:, c], residual[:, c], kernels[:4])
        held, residues = np.moveaxis(smoothed(np.moveaxis(parts[[0, 3]], 0, 2)), 2, 0)
        presses = positions_mm, *times_s, residues, held
        rig = _fit_memory(presses, pressed / kernels[4, is_held].mean(), training, rig)
        replaced, kernels = replaced_residues(*presses, rig), part_kernels(cycle, rig)
    pressed = pressed - kernels[4, is_held].mean() * replaced
    held, onset, creep, after = (Responses(positions_mm, part, valid) for part in parts)
    touch_s = min(_surface_s(positions_mm, timed, is_held) / recording.rate_hz, MAX_TOUCH_S)
    fitted = {name: getattr(rig, name) for name in BOUNDS} | {"touch_s": touch_s}
    return SplitPresses(PressParts(held, onset, creep, after), Responses(positions_mm, pressed, valid), fitted)


def _surface_s(positions_mm: Array, windows: Array, is_held: Mask) -> float:
    """Return how far the time of the touch varies over the pad, standard deviation in readings.

    It is when the channel that responds most reaches half of its response: what varies less between neighbours.
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
    """Fit how presses, as in `replaced_residues`, take away residues, by responses (Q, C) at nearly the same place."""
    last = slice(-N_SEARCHED, None)
    positions_mm, touch_s, release_s, residues, held = (values[last] for values in presses)
    rows = np.flatnonzero(training[last])
    first, second = (rows[pair] for pair in near_pairs(positions_mm[rows]))
    low, high = np.array(list(BOUNDS.values())).T
    scale = np.array([0.2, 2.0, 0.2 * rig.hysteresis_s])
    start = np.array([getattr(rig, name) for name in BOUNDS])

    def at(values: Array) -> RigSettings:
        return rig.model_copy(update=dict(zip(BOUNDS, np.clip(values, low, high).tolist(), strict=True)))

    def misfit(values: Array) -> float:
        residual = pressed[last] - replaced_residues(positions_mm, touch_s, release_s, residues, held, at(values))
        squares = np.square(residual[first] - residual[second]).mean(axis=0)
        return float(np.log(np.maximum(squares, MIN_SCALE_V**2)).sum())

    simplex = np.vstack([start, start - np.diag(scale * np.where(start - scale > low, 1, -1))])
    options = {"maxfev": MAX_EVALUATIONS, "initial_simplex": simplex, "xatol": np.inf, "fatol": 1e-3}
    return at(minimize(misfit, start, method="Nelder-Mead", options=options).x)


def part_kernels(cycle: Cycle, rig: RigSettings) -> Array:
    """Compute how 1 V of each part, and of what is taken away, shows in the windows of a press; shape (5, F)."""
    unit, out = np.zeros((5, 2, 5)), []
    unit[:, 0] = np.eye(5)
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
    return np.mean(out, axis=0)


def smooth_maps(positions: Array, windows: Array, valid: Mask) -> Array:
    """Fit smooth functions of the position, within [-1, 1], to windows (Q, C, F); on a grid (S, S, C, F)."""
    return ResponseModel.fit(positions, windows, np.empty((*windows.shape[:2], 0)), valid).table


def interpolate(maps: Array, positions: Array) -> Array:
    """Interpolate maps (S, S, C, F) at positions (Q, 2); shape (Q, C, F)."""
    return interpolate_grid(maps.reshape(*maps.shape[:2], -1), positions).reshape(len(positions), *maps.shape[2:])


def _split(windows: Array, residual: Array, kernels: Array) -> Array:
    """Return the parts (4, Q) of windows (Q, F), least squares weighted by the scatter of residuals (n, F)."""
    weights = 1 / np.maximum(residual.std(axis=0), MIN_SCALE_V)
    return np.linalg.lstsq((kernels * weights).T, (windows * weights).T, rcond=None)[0]
