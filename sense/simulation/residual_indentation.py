"""Residual indentation: a press leaves a dent in the silicone, which the next press at the same position removes.

After a release the surface stays indented for a while, and the reading of every fibre differs from its rest by a
fraction of its response, its residue. If the pad is pressed there again, the probe fills the dent: the fibres lose
their residue and respond by as much more, so that the response depends on where the pad was pressed before. When the
press ends, a part of the dent returns.
"""

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.settings import RigSettings

MAX_LAG = 32  # number of earlier presses whose residues count
RETURNED = 0.4  # fraction of a removed residue that returns when the press ends


def replaced_residues(
    positions_mm: Array, touch_s: Array, release_s: Array, residues: Array, held: Array, rig: RigSettings
) -> Array:
    """Compute the residues (Q, C) of earlier presses that each of successive presses removes.

    At distance d a press removes the fraction `memory exp(-d^2 / 2 memory_mm^2)` of what remains of a residue. The
    effect on a fibre is proportional to the geometric mean of that residue and of the response to the press itself.
    Presses at positions (Q, 2) begin and end at times (Q,); residues at their end and held responses are (Q, C).
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
