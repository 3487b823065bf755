"""Localisation ambiguity: how far the place a press is taken for may lie from where it was made.

For presses p_a with signals s_a, noise of standard deviation sigma on every signal and the set of fibres K that
still work, the place b drawn from what a noisy reading of press a leaves possible has the posterior

    w_ab = softmax_b(-|s_a - s_b|^2_K / (4 sigma^2)),

where 4 sigma^2, not 2 sigma^2, since the readings of both presses carry noise. The ambiguity is its mean spread,

    A = sum_k P(k) mean_{K: k lost} mean_a sum_b w_ab |p_a - p_b|,

in grid units, with P(k) the loss distribution. It is bound to the conditional entropy of the place given the signals,
H(p | s) = mean_a sum_b -w_ab log2 w_ab over equally likely presses: both are 0 when every press can be told from every
other, and where n presses cannot be told apart H is log2 n bits and A their mean distance. But A weighs a confusion
by how far off it leads, where an entropy only counts it, and unlike the published joint entropy it does not saturate
at log2 of the number of presses.
"""

import torch
from torch import Tensor


def ambiguity(signals: Tensor, presses: Tensor, kept: Tensor, weight: Tensor, noise: float) -> Tensor:
    """A of the module's formula, a scalar with gradient by the signals.

    Args:
        signals: (2M, Q). presses: (Q, 2), grid units.
        kept: (L, 2M), 1 for a fibre that works, 0 for a lost one. weight: (L,) share of each loss, sum 1.
        noise: sigma of a signal, grid units, > 0.
    """
    difference = (signals[:, :, None] - signals[:, None, :]) ** 2
    apart = (kept @ difference.flatten(1)).view(len(kept), *difference.shape[1:])
    posterior = torch.softmax(apart * (-1 / (4 * noise**2)), dim=-1)
    spread = (posterior * torch.cdist(presses, presses)).sum(dim=-1).mean(dim=-1)
    return spread @ weight


def sharpness(signals: Tensor) -> Tensor:
    """Mean |second difference| of signals (2M, Q) along presses in an order of neighbours, grid units.

    The published term Z without the converter, which has no gradient.
    """
    return signals.diff(n=2, dim=1).abs().mean()
