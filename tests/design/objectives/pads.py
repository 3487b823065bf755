"""Pads that several tests of rules and penalties look at."""

import numpy as np

from padforge.design import Morphology


def bent(across, along=2.5, fibre=0):
    """A 4 x 4 grid with one knot of one fibre moved."""
    knots = Morphology.straight(4).knots
    middle = knots.mean(axis=1, keepdims=True)
    knots = np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1)
    knots[fibre, 1] = (along, across) if fibre < 4 else (across, along)
    return Morphology(knots)
