"""How a pad answers: what each fibre gives for a press at a place, and what still shows of what came before.

A fibre's windows are modelled as a smooth function of the place, a sum of Gaussian bumps on a grid over the pad, plus
a linear function of the fibre's own history: silicone creeps, so the rest is still on its way when the next press
comes. Of presses of several depths, the first is in proportion to the depth. Both are found together by ridge
regression. The second is taken off the windows before they are looked at; the first lets a press be moved by a few
millimetres, which turns thousands of presses into as many as training asks for.
"""

from dataclasses import dataclass

import numpy as np

from sense.recordings.processing.limits import LEAST_SPREAD_V, Array, Mask

BUMPS = 21
"""Bumps along a side of the pad."""
WIDTH = 2.0
"""Their standard deviation, in distances between neighbours: wide enough that sums of them are smooth."""
RIDGE_PLACE, RIDGE_HISTORY = 1.0, 3.0
"""Penalties on the squares of the weights: of bumps, and of history in units of its spread."""
STEPS = 60
"""Cells along a side of the table the function is kept in."""
_PART = 16_384


@dataclass(frozen=True)
class ResponseModel:
    """A fitted pad.

    Attributes:
        table: (STEPS + 1, STEPS + 1, C, F) V, windows by place in units of the span, over [-1, 1] in x and in y.
        memory: (C, J, F) V/V, what of a volt of history shows in the windows.
        usual: (C, J) V, the history that the table is for.
    """

    table: Array
    memory: Array
    usual: Array

    @classmethod
    def fit(
        cls, places: Array, windows: Array, history: Array, alive: Mask, strengths: Array | None = None
    ) -> "ResponseModel":
        """From places (Q, 2) within [-1, 1], windows (Q, C, F) V, history (Q, C, J) V of presses of training.

        A fibre learns from the presses in which it is alive, (Q, C).

        Args:
            strengths: (Q,) how deep each press was, relative to that of the table; all alike if None.
        """
        fibres, pasts = history.shape[1:]
        grid = np.linspace(-1, 1, STEPS + 1)
        at_table = bumps(np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2))
        usual = np.zeros((fibres, pasts))
        memory = np.zeros((fibres, pasts, windows.shape[2]))
        table = np.zeros((len(at_table), fibres, windows.shape[2]))
        penalty = np.diag(np.repeat([RIDGE_PLACE, RIDGE_HISTORY], [BUMPS**2, pasts]))
        for fibre in np.flatnonzero(alive.any(axis=0)):
            there = alive[:, fibre]
            past, answer = history[there, fibre], windows[there, fibre]
            usual[fibre] = past.mean(axis=0)
            spread = past.std(axis=0)
            past = np.divide(past - usual[fibre], spread, out=np.zeros_like(past), where=spread > LEAST_SPREAD_V)
            own, both = _moments(places[there], past, answer, None if strengths is None else strengths[there])
            weights = np.linalg.solve(own + penalty, both)
            memory[fibre] = np.divide(
                weights[-pasts:].T if pasts else np.empty((windows.shape[2], 0)),
                spread,
                out=np.zeros((windows.shape[2], pasts)),
                where=spread > LEAST_SPREAD_V,
            ).T
            table[:, fibre] = at_table @ weights[: BUMPS**2]
        return cls(table.reshape(STEPS + 1, STEPS + 1, fibres, -1), memory, usual)


def _moments(places: Array, past: Array, answer: Array, strengths: Array | None) -> tuple[Array, Array]:
    """K' K and K' answer of the bumps and history K of presses, a part at a time: they take kilobytes a press."""
    own = both = np.zeros(())
    for first in range(0, len(places), _PART):
        part = slice(first, first + _PART)
        shown = bumps(places[part]) if strengths is None else strengths[part, None] * bumps(places[part])
        known = np.hstack([shown, past[part]])
        own, both = own + known.T @ known, both + known.T @ answer[part]
    return own, both


def settled(windows: Array, history: Array, memory: Array, usual: Array) -> Array:
    """(Q, C, F) windows as they would be after the usual history, see `ResponseModel`."""
    return windows - np.einsum("qcj,cjf->qcf", history - usual, memory)


def bumps(places: Array) -> Array:
    """(Q, 2) places in units of the span to (Q, BUMPS^2) values of the bumps."""
    apart = 2 / (BUMPS - 1)
    centres = np.linspace(-1, 1, BUMPS)
    x, y = np.exp(-0.5 * ((places[:, :, None] - centres) / (WIDTH * apart)) ** 2).transpose(1, 0, 2)
    return (x[:, :, None] * y[:, None, :]).reshape(len(places), -1)
