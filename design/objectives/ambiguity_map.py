"""Where a pad confuses presses: the localisation ambiguity place by place, so soon that a person sees it while drawing.

The mean over all places is what `padforge.design.objectives.score.ambiguities` has.
"""

import numpy as np

from padforge.design.contact import fibre_axes, press_shape, signals
from padforge.design.kernels.ambiguity import ambiguity_by_place
from padforge.design.kernels.measured_signals import element_signals, element_spacing, fibre_elements
from padforge.design.kernels.pchip import population_slopes
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.fibre_loss import failure_subsets, loss_shares
from padforge.design.objectives.score import MOST_LOSSES
from padforge.design.paths.curves import lengths
from padforge.design.settings import Contact


def ambiguity_map(
    pad: Morphology, presses: Array, contact: Contact, max_failures: int | tuple[float, ...], noise: float
) -> Array:
    """(K, Q) ambiguity of every press with 0, 1, ... K - 1 fibres lost, mean over such losses, grid units.

    Args:
        presses: (Q, 2) grid units, each of which may be taken for any other. contact: exact, but for a measured reach
            within the PRECISION of `measured_signals`.
        max_failures: how many fibres may fail at most, or weights of 0, 1, ... failed.
        noise: of a signal, share of full scale.
    """
    found = _signals(pad, presses, contact) / lengths(pad)
    largest = found.max(axis=0)
    full_scale = largest[largest > 0].mean() if largest.any() else 1.0
    fibres, most = found.shape[1], min(len(loss_shares(max_failures)), found.shape[1]) - 1
    losses = [failure_subsets(fibres, k, MOST_LOSSES) for k in range(most + 1)]
    padded = [(*loss, *(fibres,) * (most - len(loss))) for level in losses for loss in level]
    ends = np.cumsum([len(level) for level in losses])
    scaled = np.ascontiguousarray(found / (2 * noise * full_scale))
    spread = ambiguity_by_place(scaled, presses, np.array(padded, dtype=np.int64))
    return np.stack([level.mean(axis=1) for level in np.split(spread, ends[:-1], axis=1)])


def _signals(pad: Morphology, presses: Array, contact: Contact) -> Array:
    """(Q, F) as precise as a search needs them."""
    if not contact.sensitivity_profile:
        return signals(pad, presses, contact)
    travel, cross, ends, _ = fibre_axes(pad)
    slope = population_slopes(travel, cross)[0]
    law = press_shape(contact, pad.unit_mm)[2]
    spacing = element_spacing(contact.profile_points(pad.unit_mm))
    elements = fibre_elements(travel[0], cross[0], slope, ends.horizontals, presses, law.radius, spacing, law.length)
    out = np.empty((len(presses), len(slope)))
    element_signals(travel[0], cross[0], elements, presses, law.radius, law.profile, out)
    return out
