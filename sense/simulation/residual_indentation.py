"""Residual indentation: what a press leaves behind in the silicone, and what the next press there takes away of it.

After a release the surface stays indented for a while, and every fibre off its rest by a share of its response, its
residue. Where the pad is pressed again meanwhile, the probe fills that dent: the fibres give up their residue and
answer by as much more, so that what a press reads depends on where the pad was pressed before. When it ends, a part of
the dent comes back.
"""

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.settings import RigSettings

MAX_LAG = 32
"""Earlier presses whose residues are looked at."""
RETURNED = 0.4
"""Share of what a press takes away of a residue that comes back when it ends."""


def replaced_residues(
    positions_mm: Array, touch_s: Array, release_s: Array, residues: Array, held: Array, rig: RigSettings
) -> Array:
    """Compute what presses, in their order, take away of the residues of those before them; shape (Q, C).

    At distance d a press takes the share `memory exp(-d^2 / 2 memory_mm^2)` of what is left of a residue, of which it
    moves a fibre by the geometric mean of that residue and of its own response: as far as both reach.

    Args:
        positions_mm: centres; shape (Q, 2).
        touch_s: when they begin; shape (Q,).
        release_s: when they end; shape (Q,).
        residues: of each press in all channels at its end; shape (Q, C).
        held: its held response; shape (Q, C).
        rig: `memory`, `memory_mm` and `hysteresis_s`.
    """
    replaced, remaining = np.zeros_like(residues), np.ones(len(residues))
    for q in range(1, len(residues) if rig.memory else 0):
        recent = slice(max(q - MAX_LAG, 0), q)
        squares = ((positions_mm[recent] - positions_mm[q]) ** 2).sum(axis=1)
        replaced_share = rig.memory * np.exp(squares / (-2 * rig.memory_mm**2))
        decayed = np.exp((release_s[recent] - touch_s[q]) / rig.hysteresis_s)
        both = np.sqrt(np.maximum(residues[recent] * held[q], 0))
        replaced[q] = np.sign(held[q]) * ((remaining[recent] * replaced_share * decayed) @ both)
        remaining[recent] *= 1 - (1 - RETURNED) * replaced_share
    return replaced
