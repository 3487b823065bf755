"""What of the scatter of responses grows with them, told by presses that lie next to each other.

Half the squared difference of what a fitted pad leaves over of two neighbouring presses is their variance, whatever
smooth function of position is left over besides: floor^2 + share^2 x^2 for responses of x, a straight line over x^2.
Where channels share a part of it, the products of their differences are common share^2 x_c x_c'.
"""

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import KDTree

from padforge.design.twin import TwinScatter
from padforge.sense.recordings.processing.limits import Array

from padforge.sense.twin.laid_pad import LaidPad
from padforge.sense.twin.responses import Responses

MIN_PAIRS = 30
"""Pairs of presses from which a line is fitted."""


def response_scatter(pad: LaidPad, presses: Responses, noise_v: Array) -> TwinScatter:
    """Estimate what of the scatter of responses grows with them.

    Args:
        pad: as it was fitted to the presses.
        presses: their responses, of the live channels.
        noise_v: (C,) standard deviation of each channel's scatter in all.

    Returns:
        The scatter; none that grows where too few presses can tell.
    """
    valid = np.flatnonzero(presses.there.all(axis=1))
    if len(valid) < 2 * MIN_PAIRS:
        return TwinScatter()
    pairs = valid[KDTree(presses.places_mm[valid]).query(presses.places_mm[valid], 2)[1]]
    first, second = np.unique(np.sort(pairs, axis=1), axis=0).T
    expected = pad.predict(presses.places_mm) - pad.own[:, 1]
    difference = (presses.volts - expected)[first] - (presses.volts - expected)[second]
    response = (expected[first] + expected[second]) / 2 / noise_v
    variance = (difference / noise_v) ** 2 / 2
    floor, share = 1.0, 0.0
    for _ in range(10):  # a variance of one pair scatters by about itself
        weight = 1 / (floor + share * response.ravel() ** 2).clip(1e-3)
        lines = np.column_stack([np.ones(response.size), response.ravel() ** 2])
        (floor, share), _ = nnls(weight[:, None] * lines, weight * variance.ravel())
    above = np.triu_indices(response.shape[1], 1)
    scale = 1 / (floor + share * response**2).clip(1e-3)
    alike, product = (
        np.einsum("qc,qd->qcd", each * scale**0.5, each * scale**0.5)[:, above[0], above[1]]
        for each in (response, difference / noise_v / np.sqrt(2))
    )
    squared = share * (alike**2).sum()
    common = float((alike * product).sum() / squared) if squared > 0 else 0.0
    share, floor = (float(np.sqrt(min(each, 1.0))) for each in (share, floor))
    return TwinScatter(share, float(np.clip(common, 0, 0.99)), floor)
