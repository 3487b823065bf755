"""How a pad answers: what each fibre gives for a press at a place, and what still shows of what came before.

A fibre's windows are modelled as a smooth function of the place, a sum of Gaussian bumps on a grid over the pad, plus
a linear function of the fibre's own history: silicone creeps, so the rest is still on its way when the next press
comes. Of presses of several depths, the first is in proportion to the depth. Both are found together by ridge
regression. The second is taken off the windows before they are looked at; the first lets a press be moved by a few
millimetres, which turns thousands of presses into as many as training asks for.

What came before also makes a fibre answer more strongly or weakly: one that was stretched a moment ago gives a fifth
more. A place cannot be cleared of that before it is known, so the network is told: for each phase of a press, what is
left of the answers is fitted by the modelled answer times a linear function of the history, the gain.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from padforge.sense.recordings.processing.limits import LEAST_SPREAD_V, Array, Mask

BUMPS = 21
"""Bumps along a side of the pad."""
WIDTH = 2.0
"""Their standard deviation, in distances between neighbours: wide enough that sums of them are smooth."""
RIDGE_PLACE, RIDGE_HISTORY = 1.0, 300.0
"""Penalties on the squares of the weights: of bumps, and of history in units of its spread. What its numbers tell is
much the same: by little of a penalty, weights cancel each other, and a few hundred presses err by a tenth more."""
STEPS = 60
"""Cells along a side of the table the function is kept in."""
_PART = 16_384


@dataclass(frozen=True)
class ResponseModel:
    """A fitted pad.

    Attributes:
        table: (STEPS + 1, STEPS + 1, C, F + G) V, windows by place in units of the span, over [-1, 1] in x and in y; 0
            for the G gains.
        memory: (C, J, F + G) V/V, what of a volt of history shows in the windows; and by how much, as a share, a volt
            of it weakens the answers in each of G phases, 1/V: taken off nothing, it leaves how much stronger they are.
        usual: (C, J) V, the history that the table is for.
    """

    table: Array
    memory: Array
    usual: Array

    @classmethod
    def fit(
        cls,
        places: Array,
        windows: Array,
        history: Array,
        alive: Mask,
        strengths: Array | None = None,
        phases: Sequence[slice] = (),
    ) -> "ResponseModel":
        """From places (Q, 2) within [-1, 1], windows (Q, C, F) V, history (Q, C, J) V of presses of training.

        A fibre learns from the presses in which it is alive, (Q, C).

        Args:
            strengths: (Q,) how deep each press was, relative to that of the table; all alike if None.
            phases: windows that are stronger together, G times.
        """
        fibres, pasts = history.shape[1:]
        size = windows.shape[2]
        grid = np.linspace(-1, 1, STEPS + 1)
        at_table = bumps(np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2))
        usual = np.zeros((fibres, pasts))
        memory = np.zeros((fibres, pasts, size + len(phases)))
        table = np.zeros((len(at_table), fibres, size + len(phases)))
        penalty = np.diag(np.repeat([RIDGE_PLACE, RIDGE_HISTORY], [BUMPS**2, pasts]))
        for fibre in np.flatnonzero(alive.any(axis=0)):
            there = alive[:, fibre]
            past, answer = history[there, fibre], windows[there, fibre]
            usual[fibre] = past.mean(axis=0)
            spread = past.std(axis=0)
            past = np.divide(past - usual[fibre], spread, out=np.zeros_like(past), where=spread > LEAST_SPREAD_V)
            shown = None if strengths is None else strengths[there]
            own, both = _moments(places[there], past, answer, shown)
            weights = np.linalg.solve(own + penalty, both)
            by_place, by_past = weights[: BUMPS**2], weights[BUMPS**2 :]
            gains = []
            if phases:
                expected = _answers(places[there], by_place, shown)
                left = answer - expected - past @ by_past
                gains = [_gain(expected[:, phase].mean(axis=1), left[:, phase].mean(axis=1), past) for phase in phases]
            shares = np.column_stack([by_past, *(-gain for gain in gains)])
            memory[fibre] = np.divide(
                shares, spread[:, None], out=np.zeros(shares.shape), where=spread[:, None] > LEAST_SPREAD_V
            )
            table[:, fibre, :size] = at_table @ by_place
        return cls(table.reshape(STEPS + 1, STEPS + 1, fibres, -1), memory, usual)


def _answers(places: Array, by_place: Any, strengths: Array | None) -> Array:
    """(Q, F) V, what a fibre is expected to give, a part at a time."""
    parts = range(0, len(places), _PART)
    found = np.concatenate([bumps(places[first : first + _PART]) @ by_place for first in parts])
    return found if strengths is None else strengths[:, None] * found


def _gain(expected: Array, left: Array, past: Array) -> Array:
    """(J,) by how much, as a share, a spread of each history strengthens (Q,) answers that leave (Q,) to explain."""
    usual = expected.std()
    if not past.shape[1] or usual <= LEAST_SPREAD_V:
        return np.zeros(past.shape[1])
    known = np.hstack([expected[:, None] / usual * past, past])  # what is added anew is none of the gain
    own = known.T @ known + RIDGE_HISTORY * np.eye(known.shape[1])
    return np.linalg.solve(own, known.T @ left)[: past.shape[1]] / usual


def _moments(places: Array, past: Array, answer: Array, strengths: Array | None) -> tuple[Array, Array]:
    """K' K and K' answer of the bumps and history K of presses, a part at a time: they take kilobytes a press."""
    own = both = np.zeros(())
    for first in range(0, len(places), _PART):
        part = slice(first, first + _PART)
        shown = _shown(places[part], None if strengths is None else strengths[part])
        known = np.hstack([shown, past[part]])
        own, both = own + known.T @ known, both + known.T @ answer[part]
    return own, both


def _shown(places: Array, strengths: Array | None) -> Array:
    return bumps(places) if strengths is None else strengths[:, None] * bumps(places)


def settled(windows: Array, history: Array, memory: Array, usual: Array) -> Array:
    """(Q, C, F + G) windows as they would be after the usual history, and by how much stronger they are for it."""
    gains = memory.shape[2] - windows.shape[2]
    return np.pad(windows, ((0, 0), (0, 0), (0, gains))) - np.einsum("qcj,cjf->qcf", history - usual, memory)


def looked_up(table: Any, places: Any, xp: Any = np) -> Any:
    """(S, S, D) table over [-1, 1] in x and y, and (B, 2) places, to (B, D), linear between entries.

    Args:
        xp: the module whose arrays these are, numpy or torch.
    """
    side = table.shape[0]
    at = xp.clip((places + 1) * ((side - 1) / 2), 0, side - 1 - 1e-3)
    whole = xp.floor(at)
    x, y = (at - whole).T[:, :, None]
    corner = xp.asarray(whole[:, 0] * side + whole[:, 1], dtype=xp.int64)
    flat = table.reshape(side * side, -1)
    near = (1 - y) * flat[corner] + y * flat[corner + 1]
    return (1 - x) * near + x * ((1 - y) * flat[corner + side] + y * flat[corner + side + 1])


def leverages(places: Array, strengths: Array | None = None) -> Array:
    """(Q,) by how much a press decides what is expected of it, 0 to 1: those of one place together, (Q, 2)."""
    nothing = np.empty((len(places), 0))
    own = _moments(places, nothing, nothing, strengths)[0] + RIDGE_PLACE * np.eye(BUMPS**2)
    alone = np.empty(len(places))
    for first in range(0, len(places), _PART):
        part = slice(first, first + _PART)
        known = _shown(places[part], None if strengths is None else strengths[part])
        alone[part] = (known * np.linalg.solve(own, known.T).T).sum(axis=1)
    _, place = np.unique(places, axis=0, return_inverse=True)
    return np.bincount(place.ravel(), alone).astype(np.float64)[place.ravel()]


def bumps(places: Array) -> Array:
    """(Q, 2) places in units of the span to (Q, BUMPS^2) values of the bumps."""
    apart = 2 / (BUMPS - 1)
    centres = np.linspace(-1, 1, BUMPS)
    x, y = np.exp(-0.5 * ((places[:, :, None] - centres) / (WIDTH * apart)) ** 2).transpose(1, 0, 2)
    return (x[:, :, None] * y[:, None, :]).reshape(len(places), -1)
