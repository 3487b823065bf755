"""Localisation ambiguity: how far the place a press is taken for may lie from where it was made.

For presses p_a with signals s_a, noise of standard deviation sigma on every signal and the set of fibres K that
still work, the place b drawn from what a noisy reading of press a leaves possible has the posterior

    w_ab = softmax_b(-|s_a - s_b|^2_K / (4 sigma^2)),

where 4 sigma^2, not 2 sigma^2, since the readings of both presses carry noise. sigma is a share of the full scale,
the mean over fibres of the largest signal, since a converter is matched to what its fibre gives: a longer fibre alone
tells nothing. The ambiguity is its mean spread,

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
        signals: (F, Q). presses: (Q, 2), grid units.
        kept: (L, F), 1 for a fibre that works, 0 for a lost one. weight: (L,) share of each loss, sum 1.
        noise: sigma of a signal, grid units, > 0.
    """
    scaled = kept.double()[:, None, :] * (signals.T.double() / (2 * noise))
    # |s_a|^2 is the same for every b and falls out of the posterior; what is left is one product of matrices, in
    # double precision since it cancels
    likelihood = torch.baddbmm(-(scaled**2).sum(dim=-1)[:, None, :], scaled, scaled.mT, alpha=2)
    posterior = torch.softmax(likelihood.to(presses.dtype), dim=-1)
    spread = torch.einsum("lab,ab->l", posterior, torch.cdist(presses, presses)) / len(presses)
    return spread @ weight


def full_scale(signals: Tensor) -> float:
    """Mean over the fibres that are touched at all of the largest of their signals (F, Q); 1 if none is."""
    largest = signals.detach().amax(dim=1)
    touched = largest[largest > 0]
    return touched.mean().item() if len(touched) else 1.0


def sharpness(signals: Tensor) -> Tensor:
    """Mean |second difference| of signals (F, Q) along presses in an order of neighbours, grid units.

    The published term Z without the converter, which has no gradient.
    """
    return signals.diff(n=2, dim=1).abs().mean()
