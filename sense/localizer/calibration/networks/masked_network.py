"""The masked network in torch, for training it: what `sense.localizer.network` computes in NumPy, and first weights."""

import torch
from torch import Tensor
from torch.nn import functional

from padforge.sense import settings
from padforge.sense.localizer.network import EPSILON, OUTPUTS
from padforge.sense.localizer.response.observer import Observer
from padforge.sense.localizer.response.response_model import looked_up

WHOLE = 0.25
"""Share of training presses that keep all fibres; the others lose 1 .. `lost`, each as often."""
MEASURING = 0.5
"""Weight of the error of a depth or force in units of its span, beside the distance."""


def misses(off: Tensor) -> Tensor:
    """(..., 2 + T) differences of what is learnt to (...) what they count: the distance, and a share of the others."""
    distance = off[..., :2].square().sum(dim=-1).add(1e-8).sqrt()
    return distance if off.shape[-1] == 2 else distance + MEASURING * off[..., 2:].abs().sum(dim=-1)


def inputs_at(table: Tensor, targets: Tensor, stretch: float) -> Tensor:
    """(B, D) scaled inputs of presses with (B, 2 + T) targets, by `looked_up`; in proportion to their depth."""
    found = looked_up(table, targets[:, :2], torch)
    return found if targets.shape[1] == 2 else (1 + stretch * targets[:, 2:3]) * found


def initial(
    entries: int, options: settings.LocalizerSettings, generator: torch.Generator, outputs: int = OUTPUTS
) -> dict[str, Tensor]:
    """Random first weights of one member, named and shaped as in `network.Weights`, for `entries` numbers entering."""
    hidden, layers = options.hidden, options.layers

    def normal(*shape: int, gain: float = 1.0) -> Tensor:
        return torch.randn(*shape, generator=generator, device=generator.device) * (gain / shape[-2] ** 0.5)

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(*shape, device=generator.device)

    weights = {
        "first.w": normal(1, entries, hidden),
        "first.b": zeros(1, 1, hidden),
        "hidden.w": normal(layers, 1, hidden, hidden, gain=0.5),
        "hidden.b": zeros(layers, 1, 1, hidden),
        "last.w": normal(1, hidden, outputs, gain=0.3),
        "last.b": zeros(1, 1, outputs),
    }
    return {name: w.requires_grad_() for name, w in weights.items()}


def draw_alive(batch: int, fibres: int, lost: int, generator: torch.Generator) -> Tensor:
    """(B, C) masks, true where a fibre lives: all of them, or 1 .. `lost` fewer, each set of a size as likely."""
    device = generator.device
    count = torch.randint(1, max(lost, 1) + 1, (batch, 1), generator=generator, device=device)
    whole = torch.rand(batch, 1, generator=generator, device=device) < (WHOLE if lost else 1.0)
    rank = torch.rand(batch, fibres, generator=generator, device=device).argsort(dim=1)
    return (rank >= count) | whole


def masked(inputs: Tensor, alive: Tensor) -> Tensor:
    """(B, C, F) inputs and (B, C) masks to (B, C F + C) entries, as `network.masked`."""
    kept = torch.where(alive[..., None], inputs, 0.0)
    return torch.cat([kept.flatten(1), alive.to(inputs.dtype)], dim=1)


def entries(inputs: Tensor, alive: Tensor, observer: Observer | None) -> tuple[Tensor, Tensor]:
    """(B, D) what enters a network for (B, C, F) inputs, and the place that it is to correct: (B, 2), or 0 for none."""
    known = masked(inputs, alive)
    if observer is None:
        return known, known.new_zeros(())
    with torch.no_grad():
        place, told = observer(inputs, alive, torch)
    return torch.cat([known, told], dim=1), place


def forward(weights: dict[str, Tensor], x: Tensor) -> Tensor:
    """(E, B, D) entries to (E, B, 2 N), as `network.forward`."""
    h = torch.baddbmm(weights["first.b"], x, weights["first.w"])
    for w, b in zip(weights["hidden.w"], weights["hidden.b"], strict=True):
        h = h + torch.baddbmm(b, _ready(h), w)
    return torch.baddbmm(weights["last.b"], _ready(h), weights["last.w"])


def forward_fast(weights: dict[str, Tensor], x: Tensor) -> Tensor:
    """What `forward` gives to about 1 %, for training, which errs no more for it.

    A processor that has instructions for it multiplies matrices in bfloat16, with sums in single precision, four times
    as fast; on others, and in a torch that does not say so, this is `forward` itself.
    """
    able = getattr(torch.cpu, "get_capabilities", dict)().get("avx512_bf16", False)
    with torch.autocast("cpu", torch.bfloat16, enabled=able):
        return forward(weights, x).float()


def _ready(h: Tensor) -> Tensor:
    return functional.gelu(functional.layer_norm(h, h.shape[-1:], eps=EPSILON))
