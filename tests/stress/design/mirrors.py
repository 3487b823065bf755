"""Pads and presses in the mirror, and what the whole of a fibre gives."""

import numpy as np

from design import Contact, Morphology
from tests.stress.values import Array


def mirrored(pad: Morphology) -> Morphology:
    """The pad seen in a mirror along y: fibres of either family keep their places in it from the other side."""
    knots, size = pad.knots.copy(), pad.grid + 1
    knots[..., 0] = size - knots[..., 0]
    return Morphology(np.concatenate([knots[: pad.grid, ::-1], knots[pad.grid :][::-1]]), pad.pitch_mm)


def transposed(pad: Morphology) -> Morphology:
    """The pad with x and y exchanged."""
    return Morphology(np.concatenate([pad.knots[pad.grid :], pad.knots[: pad.grid]])[..., ::-1], pad.pitch_mm)


def whole_lengths(pad: Morphology, contact: Contact) -> Array:
    """(2M,) the longest a signal can be with weight 1."""
    axes = [0] * pad.grid + [1] * pad.grid
    if contact.length == "manhattan":
        return np.array([np.abs(np.diff(knots, axis=0)).sum() for knots in pad.knots])
    return np.array([np.hypot(*np.diff(knots, axis=0).T).sum() + np.abs(np.diff(knots[:, 1 - a])).sum() + pad.grid + 1
                     for knots, a in zip(pad.knots, axes, strict=True)])  # fmt: skip
