"""Every term of a pad by name: what the searches minimise, and what the literature reports."""

from collections.abc import Sequence
from dataclasses import asdict

import torch
from torch import Tensor

from padforge.design.common.settings import or_default
from padforge.design.common.validation import InputError, check_type
from padforge.design.contact import grid_positions, relative_stretch, serpentine_presses, signals, signals_quantized
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.fibre_loss import failure_masks, loss_shares
from padforge.design.objectives.published import (
    idle_share,
    information,
    joint_entropy,
    published_presses,
    published_terms,
    quantize,
)
from padforge.design.paths.keep_outs import is_outside
from padforge.design.settings import PUBLISHED_CONTACT, Contact, PadSettings, RulesSettings, SearchSettings


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


SIDE, MOST_LOSSES = 20, 64
AMBIGUITY_NOISE = 0.05
"""Of a signal, share of full scale, under which pads are compared: under less, no good pad confuses anything."""
MOST_PAIRS = 2**29
"""Most pairs of points of one fibre, over all fibres, that are looked at for folds: 2 GiB of distances."""


def ambiguities(
    pad: Morphology, contact: Contact, max_failures: int | tuple[float, ...], noise: float, size: PadSettings
) -> list[float]:
    """Localisation ambiguity (formula of `ambiguity`) with 0, 1, ... fibres lost, grid units, on a grid of presses.

    Args:
        max_failures: how many fibres may fail at most, or weights of 0, 1, ... failed.
        noise: of a signal, share of full scale.
        size: says what is pressed.
    """
    import torch

    presses = free_presses(size)
    found = torch.tensor(relative_stretch(pad, presses, contact).T, dtype=torch.float32)
    touched = found.any(dim=1)  # no other fibre tells presses apart: on a large pad most are between the presses
    found = found[touched]
    places = torch.tensor(presses, dtype=torch.float32)
    fibres = len(pad.knots)
    spread = []
    for k in range(min(len(loss_shares(max_failures)), fibres)):
        kept = torch.tensor(failure_masks(fibres, k, MOST_LOSSES), dtype=torch.float32)[:, touched]
        equal = torch.full((len(kept),), 1 / len(kept))
        spread.append(ambiguity(found, places, kept, equal, noise * full_scale(found)).item())
    return spread


def free_presses(size: PadSettings) -> Array:
    """(Q, 2) up to SIDE x SIDE places over what is pressed, grid units, that lie in no keep-out.

    Raises:
        InputError: there is none.
    """
    presses = grid_positions(size.sensed, SIDE)
    presses = presses[is_outside(presses, size)]
    if not len(presses):
        raise InputError("[pad] keep_out_mm covers all that is pressed ([pad] sensed_mm), allowed is a part of it")
    return presses


def ambiguity_terms(values: Sequence[float], unit_mm: float) -> dict[str, float]:
    """Return `ambiguities`, in grid units of `unit_mm`, by name in mm, as `score` has them."""
    return {f"ambiguity_mm_{n_failed}": unit_mm * value for n_failed, value in enumerate(values)}


def score(
    pad: Morphology,
    contact: Contact | None = None,
    max_failures: int | tuple[float, ...] = 3,
    noise: float = AMBIGUITY_NOISE,
    rules: RulesSettings | None = None,
    size: PadSettings | None = None,
) -> dict[str, float]:
    """Every term of a pad, by name.

    `ambiguity_mm_k` is the expected localisation error in mm over failures of k fibres under the given noise
    (formula of `ambiguity`); `sharpness` the signals' mean second difference along a serpentine; `penalty_RULE` how
    far a rule is broken, as the gradient search has it (`penalties`); `information` that of the pad in bits
    (`information`), `idle_share` the share of presses in which a fibre is idle; the rest are the published terms
    (`published_objective`), of the published contact where `contact` is a measured one, and `published_joint_entropy`,
    that of all fibres together in bits, which its 49 presses limit to log2 49 = 5.61: even straight fibres reach that.

    Presses are where `size` says, whose layout is the pad's whatever it says of that; those of the information and of
    the published terms between the outermost fibres, as published.

    Raises:
        InputError: arguments out of range, or a pad of too many fibres or knots.
    """
    from .penalties import PER_SPAN

    contact, rules = or_default("contact", contact, Contact), or_default("rules", rules, RulesSettings)
    size = or_default("size", size, PadSettings).for_layout(check_type("pad", pad, Morphology).layout)
    asked = SearchSettings(max_failures=max_failures, noise=noise)
    pairs = len(pad.knots) * (PER_SPAN * (pad.knots.shape[1] - 1)) ** 2
    if pairs > MOST_PAIRS:
        raise InputError(f"pad has {len(pad.knots)} fibres of {pad.knots.shape[1]} knots, too many to score its folds")
    return all_terms(pad, ambiguities(pad, contact, asked.max_failures, asked.noise, size), contact, rules, size)


def sharpness_of(pad: Morphology, contact: Contact, size: PadSettings) -> float:
    """Return the signals' mean second difference along a serpentine over what is pressed, grid units."""
    import torch

    return sharpness(torch.tensor(signals(pad, _serpentine(size), contact).T)).item()


def _serpentine(size: PadSettings) -> Array:
    return serpentine_presses(size.sensed, 32, 5 / 49)


def all_terms(
    pad: Morphology, spread: Sequence[float], contact: Contact, rules: RulesSettings, size: PadSettings
) -> dict[str, float]:
    """What `score` gives for a pad of that size, whose `ambiguities` are known to be `spread`."""
    import torch

    from padforge.design.contact import fibre_axes

    from .penalties import penalties

    found = signals(pad, _serpentine(size), contact)
    travel, cross = (torch.tensor(axis[0]) for axis in fibre_axes(pad)[:2])
    broken = penalties(travel, cross, size, rules)
    terms = ambiguity_terms(spread, pad.unit_mm) | {
        "information": information(pad, contact),
        "idle_share": idle_share(found),
    }
    terms["sharpness"] = sharpness_of(pad, contact, size)
    shape = PUBLISHED_CONTACT if contact.sensitivity_profile else contact
    terms |= {f"penalty_{rule}": value.item() for rule, value in broken.items()}
    terms |= {f"published_{name}": value for name, value in asdict(published_terms(pad, shape)[0]).items()}
    levels = quantize(signals_quantized(pad, published_presses(pad.layout), shape))
    return terms | {"published_joint_entropy": joint_entropy(levels)}
