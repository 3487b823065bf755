"""Training the network: the only place that needs torch.

The loss is the distance itself, not its square; the rate follows one cycle; every press of every step loses a random
few fibres; and what is kept is a running average of the weights. Nothing is held back to stop early: the number of
epochs is a setting, so that whoever splits off a test share knows it was never seen.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from . import settings
from .network import EPSILON, Floats, Weights

WARM_UP = 0.2
"""Share of the steps in which the rate of learning rises."""
WEIGHT_DECAY = 1e-2
AVERAGE = 0.998
"""Share of the running average of the weights that a step leaves as it was."""
INPUT_NOISE = 0.02
"""Noise on the scaled inputs while training, their spread being about 1."""
WHOLE = 0.4
"""Share of training presses that keep all fibres; the others lose 1 .. `lost`, each as often."""


def train(
    inputs: Floats,
    targets: Floats,
    options: settings.Localizer,
    rng: np.random.Generator,
    progress: Callable[[int, int], None],
) -> Weights:
    """Fit the members of the localizer.

    Args:
        inputs: (Q, C, F) scaled inputs. targets: (Q, 2) places in units of the span.
        options: size of the network and length of the training.
        rng: source of the seed of torch's own generator, which draws all that is random here.
        progress: called with (epochs done, epochs in all).

    Returns:
        Weights as `network.forward` takes them.
    """
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    with _one_thread():
        return _train(inputs, targets, options, generator, progress)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to one thread: matrices this small gain a third from a second one, and where another program has
    that core, the two wait for each other and the training takes ten times as long."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _train(
    inputs: Floats,
    targets: Floats,
    options: settings.Localizer,
    generator: torch.Generator,
    progress: Callable[[int, int], None],
) -> Weights:
    x, y = torch.from_numpy(inputs), torch.from_numpy(targets)
    members, (presses, fibres, _) = options.members, x.shape
    weights = initial(x[0].numel() + fibres, options, generator)
    average = [w.detach().clone() for w in weights.values()]
    batch = min(options.batch, presses)
    steps = presses // batch * options.epochs
    optimizer = torch.optim.AdamW(weights.values(), lr=options.rate, weight_decay=WEIGHT_DECAY, fused=True)
    step = 0
    for epoch in range(options.epochs):
        order = torch.rand(members, presses, generator=generator).argsort(dim=1)
        for first in range(0, presses - batch + 1, batch):
            rows = order[:, first : first + batch]
            noisy = x[rows] + INPUT_NOISE * torch.randn(*rows.shape, *x.shape[1:], generator=generator)
            alive = draw_alive(members, batch, fibres, min(options.lost, fibres - 1), generator)
            found = forward(weights, masked(noisy, alive))
            loss = (found - y[rows]).square().sum(dim=2).add(1e-8).sqrt().mean(dim=1).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.param_groups[0]["lr"] = options.rate * one_cycle((step + 1) / steps)
            optimizer.step()
            step += 1
            # The average forgets the first steps sooner than the later ones, or it would start from the initial draw.
            keep = min(AVERAGE, step / (step + 9))
            with torch.no_grad():
                for kept, weight in zip(average, weights.values(), strict=True):
                    kept.lerp_(weight, 1 - keep)
        progress(epoch + 1, options.epochs)
    return {name: w.numpy() for name, w in zip(weights, average, strict=True)}


def one_cycle(share: float) -> float:
    """Rate of learning after `share` of the steps: up along a line to 1, then down along a cosine to 0."""
    if share < WARM_UP:
        return share / WARM_UP
    return 0.5 * (1 + math.cos(math.pi * (share - WARM_UP) / (1 - WARM_UP)))


def initial(entries: int, options: settings.Localizer, generator: torch.Generator) -> dict[str, Tensor]:
    """Random first weights, named and shaped as in `network.Weights`, for `entries` numbers entering."""
    members, hidden, layers = options.members, options.hidden, options.layers

    def normal(*shape: int, gain: float = 1.0) -> Tensor:
        return torch.randn(*shape, generator=generator) * (gain / shape[-2] ** 0.5)

    weights = {
        "first.w": normal(members, entries, hidden),
        "first.b": torch.zeros(members, 1, hidden),
        "hidden.w": normal(layers, members, hidden, hidden, gain=0.5),
        "hidden.b": torch.zeros(layers, members, 1, hidden),
        "last.w": normal(members, hidden, 2, gain=0.3),
        "last.b": torch.zeros(members, 1, 2),
    }
    return {name: w.requires_grad_() for name, w in weights.items()}


def draw_alive(members: int, batch: int, fibres: int, lost: int, generator: torch.Generator) -> Tensor:
    """(E, B, C) masks, true where a fibre lives: all of them, or 1 .. `lost` fewer, each set of a size as likely."""
    count = torch.randint(1, max(lost, 1) + 1, (members, batch, 1), generator=generator)
    whole = torch.rand(members, batch, 1, generator=generator) < (WHOLE if lost else 1.0)
    rank = torch.rand(members, batch, fibres, generator=generator).argsort(dim=2)
    return (rank >= count) | whole


def masked(inputs: Tensor, alive: Tensor) -> Tensor:
    """(E, B, C, F) inputs and (E, B, C) masks to (E, B, C F + C) entries, as `network.masked`."""
    kept = torch.where(alive[..., None], inputs, 0.0)
    return torch.cat([kept.flatten(2), alive.to(inputs.dtype)], dim=2)


def forward(weights: dict[str, Tensor], x: Tensor) -> Tensor:
    """(E, B, D) entries to (E, B, 2) places, as `network.forward`."""
    h = torch.baddbmm(weights["first.b"], x, weights["first.w"])
    for w, b in zip(weights["hidden.w"], weights["hidden.b"], strict=True):
        h = h + torch.baddbmm(b, _ready(h), w)
    return torch.baddbmm(weights["last.b"], _ready(h), weights["last.w"])


def _ready(h: Tensor) -> Tensor:
    return functional.gelu(functional.layer_norm(h, h.shape[-1:], eps=EPSILON))
