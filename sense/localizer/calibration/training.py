"""Training the network: with `fine_tuning` and `published_training`, the only place of the localizer that needs torch.

The loss is the distance itself, not its square; beside it the network learns how far off it expects to be. Every step
loses a random few fibres of every press and moves the press by a few millimetres, its readings following as the fitted
`response_model` of the pad says. Of several depths, these are learnt too, with forces where they are known, and presses
are moved in depth as well: the lighter, and so the more blurred, the farther. The rate follows one cycle; what is kept
is that running average of the weights which did best on presses held back for that, which also end the training where
they have long gained nothing. Members are independent, each on a thread of its own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Event, Lock

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from design.common import profiling
from design.common.computing import one_torch_thread, run_tasks
from sense import settings
from sense.health.trained_model import average_in, one_cycle
from sense.localizer.network import EPSILON, LEAST_LOG, MOST_LOG, OUTPUTS, Weights
from sense.recordings.processing.limits import Floats, Mask

MOST_STEPS, LONGER = 11_000, 2
"""Steps of training at most, as presses are moved; of several depths, which are harder to learn, so many times more."""
WEIGHT_DECAY = 1e-2
INPUT_NOISE = 0.02
"""Noise on the scaled inputs while training, their spread being about 1."""
WHOLE = 0.25
"""Share of training presses that keep all fibres; the others lose 1 .. `lost`, each as often."""
MOVED = 0.13
"""Standard deviation of the way a press is moved, in units of the span: 3 mm on a pad of 45 mm."""
BLURRED, DEEPENED = 0.26, 0.3
"""Of several depths, the same and what is added to the depth, in its spans, for one of the middle depth. Lighter ones
are moved by as much more as noise blurs them more, or they would be known again by their noise."""
MEASURING = 0.5
"""Weight of the error of a depth or force in units of its span, beside the distance."""
EXPECTING = 0.1
"""Weight of learning the expected error, beside the distance."""
LOOKS = 40
"""How often in a training the presses held back are looked at."""
PATIENCE = 12
"""Looks without gain that end it."""


@dataclass(frozen=True)
class TrainingPresses:
    """Presses to learn from or to check on.

    Attributes:
        inputs: (Q, C, F) scaled. alive: (Q, C).
        targets: (Q, 2 + T) what the network is to give. stretch: see `Normalization`.
    """

    inputs: Floats
    alive: Mask
    targets: Floats
    stretch: float = 0.0


class StoppedError(Exception):
    """Another training failed, or the user broke off."""


class JointProgress:
    """How far trainings beside each other are; those still at work when the body of `with` ends stop where they tell.

    Args:
        totals: steps of each. progress: called with (steps done, steps in all), of all together.
    """

    def __init__(self, totals: Sequence[int], progress: Callable[[int, int], None]) -> None:
        self._done, self._total, self._progress = [0] * len(totals), sum(totals), progress
        self._lock, self._over = Lock(), Event()

    def tell(self, number: int, done: int) -> None:
        """So many steps of one of the trainings are done."""
        if self._over.is_set():
            raise StoppedError
        with self._lock:
            self._done[number] = done
            self._progress(sum(self._done), self._total)

    def __enter__(self) -> None:
        pass

    def __exit__(self, *error: object) -> None:
        self._over.set()


def train_members(
    learn: TrainingPresses,
    check: TrainingPresses,
    table: Floats,
    options: settings.LocalizerSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None],
) -> Weights:
    """Fit the members of the localizer.

    Args:
        learn, check: presses to learn from, and to tell by when to stop.
        table: (S, S, C, F) scaled inputs by place, over [-1, 1] in x and y.
        options: size of the network and length of the training. rng: of the seeds of torch's own generators.
        progress: called with (steps done, steps in all), of all members together.

    Returns:
        Weights as `network.forward` takes them.
    """
    seeds = [int(seed) for seed in rng.integers(2**63, size=options.members)]
    steps = training_steps(len(learn.inputs), options) * (LONGER if learn.stretch else 1)
    joint = JointProgress([steps] * len(seeds), progress)

    def train(number: int) -> Weights:
        member = _Member(learn, check, table, options, seeds[number])
        return member.train(steps, lambda done: joint.tell(number, done))

    with one_torch_thread(), joint:
        weights = dict(run_tasks((number, partial(train, number)) for number in range(len(seeds))))
    found = [weights[number] for number in range(len(seeds))]
    axis = {name: 1 if name.startswith("hidden") else 0 for name in found[0]}
    return {name: np.concatenate([weights[name] for weights in found], axis=axis[name]) for name in found[0]}


def training_steps(presses: int, options: settings.LocalizerSettings) -> int:
    """Steps that a member takes: `epochs` times through the presses, but no more than `MOST_STEPS`."""
    return min(MOST_STEPS, options.epochs * max(1, presses // options.batch))


class _Member:
    """One network in training, on the GPU where there is one."""

    def __init__(
        self,
        learn: TrainingPresses,
        check: TrainingPresses,
        table: Floats,
        options: settings.LocalizerSettings,
        seed: int,
    ) -> None:
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._generator = torch.Generator(self._device).manual_seed(seed)
        self._options = options
        self._x, self._alive, self._y = self._on_device(learn)
        self._check = self._on_device(check)
        self._fibres, size = self._x.shape[1:]
        self._lost = min(options.lost, self._fibres - 1)
        self._table = torch.from_numpy(table).to(self._device).flatten(2)
        self._bounds = self._y[:, :3].amin(dim=0), self._y[:, :3].amax(dim=0)
        self._steps = torch.tensor(
            [BLURRED, BLURRED, DEEPENED] if learn.stretch else [MOVED, MOVED], device=self._device
        )
        off = (self._y - self._y.mean(dim=0))[:, 2:]
        self._harder = (off[:, :1] * off[:, 1:]).sum() / off[:, :1].square().sum()  # force by depth, in line
        self._stretch = learn.stretch
        self._at_home = inputs_at(self._table, self._y, self._stretch)
        entries, outputs = self._fibres * (size + 1), OUTPUTS + 2 * (self._y.shape[1] - 2)
        self._weights = initial(entries, options, self._generator, outputs)

    def _on_device(self, samples: TrainingPresses) -> tuple[Tensor, Tensor, Tensor]:
        arrays = (samples.inputs, samples.alive, samples.targets)
        x, alive, y = (torch.from_numpy(array).to(self._device) for array in arrays)
        return x, alive, y

    def train(self, steps: int, tell: Callable[[int], None]) -> Weights:
        weights, rate = self._weights, self._options.rate
        average = {name: w.detach().clone() for name, w in weights.items()}
        optimizer = torch.optim.AdamW(weights.values(), lr=rate, weight_decay=WEIGHT_DECAY, fused=True)
        look = max(1, steps // LOOKS)
        masks = self._check[1] & draw_alive(len(self._check[1]), self._fibres, self._lost, self._generator)
        best, least, failures = average, math.inf, 0
        for number in range(1, steps + 1):
            optimizer.param_groups[0]["lr"] = rate * one_cycle(number / steps)
            optimizer.zero_grad()
            self._loss().backward()
            optimizer.step()
            average_in(average.values(), weights.values(), number)
            if number % look == 0 or number == steps:
                error = self._error(average, masks)
                if error < least:
                    best, least, failures = {name: w.clone() for name, w in average.items()}, error, 0
                else:
                    failures += 1
                tell(number)
                if failures == PATIENCE:
                    tell(steps)
                    profiling.looked_at("training steps", number, steps)
                    break
        else:
            profiling.looked_at("training steps", steps, steps)
        return {name: w.cpu().numpy() for name, w in best.items()}

    def _loss(self) -> Tensor:
        batch = min(self._options.batch, len(self._x))
        rows = torch.randint(len(self._x), (batch,), generator=self._generator, device=self._device)
        targets = self._moved(self._y[rows])
        moved = (inputs_at(self._table, targets, self._stretch) - self._at_home[rows]).view(batch, self._fibres, -1)
        inputs = self._x[rows] + moved + INPUT_NOISE * self._normal(*moved.shape)
        alive = self._alive[rows] & draw_alive(batch, self._fibres, self._lost, self._generator)
        learnt, logs = forward(self._weights, masked(inputs, alive)[None])[0].chunk(2, dim=1)
        off, logs = learnt - targets, logs.clamp(LEAST_LOG, MOST_LOG)
        return (misses(off) + EXPECTING * (off.detach().abs() * (-logs).exp() + logs).sum(dim=1)).mean()

    def _moved(self, targets: Tensor) -> Tensor:
        """(B, 2 + T) targets of presses moved by a few millimetres, and in depth, with the force that goes with it."""
        low, high = self._bounds
        steps = self._steps / (1 + self._stretch * targets[:, 2:3]) if self._stretch else self._steps
        moved = targets[:, :3] + steps * self._normal(len(targets), len(self._steps))
        moved = torch.where(moved < low, 2 * low - moved, moved)  # a press that would leave the pad is sent back
        moved = torch.where(moved > high, 2 * high - moved, moved).clamp(-1, 1)
        forces = targets[:, 3:] + self._harder * (moved - targets[:, :3])[:, 2:]
        return torch.cat([moved, forces], dim=1)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator, device=self._device)

    def _error(self, weights: dict[str, Tensor], masks: Tensor) -> float:
        """Mean distance of places on the presses held back, with the fibres in `masks`."""
        x, _, y = self._check
        with torch.no_grad():
            found = forward(weights, masked(x, masks)[None])[0, :, :2]
            return float((found - y[:, :2]).square().sum(dim=1).sqrt().mean())


def misses(off: Tensor) -> Tensor:
    """(..., 2 + T) differences of what is learnt to (...) what they count: the distance, and a share of the others."""
    distance = off[..., :2].square().sum(dim=-1).add(1e-8).sqrt()
    return distance if off.shape[-1] == 2 else distance + MEASURING * off[..., 2:].abs().sum(dim=-1)


def inputs_at(table: Tensor, targets: Tensor, stretch: float) -> Tensor:
    """(B, D) scaled inputs of presses with (B, 2 + T) targets, by `looked_up`; in proportion to their depth."""
    found = looked_up(table, targets[:, :2])
    return found if targets.shape[1] == 2 else (1 + stretch * targets[:, 2:3]) * found


def looked_up(table: Tensor, places: Tensor) -> Tensor:
    """(S, S, D) table over [-1, 1]^2 and (B, 2) places to (B, D), linear between entries."""
    cells = table.shape[0] - 1
    at = ((places + 1) * (cells / 2)).clamp(0, cells - 1e-3)
    whole = at.floor().long()
    x, y = (at - whole).T[:, :, None]
    i, j = whole.T
    low = torch.lerp(table[i, j], table[i, j + 1], y)
    return torch.lerp(low, torch.lerp(table[i + 1, j], table[i + 1, j + 1], y), x)


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


def forward(weights: dict[str, Tensor], x: Tensor) -> Tensor:
    """(E, B, D) entries to (E, B, 2 N), as `network.forward`."""
    h = torch.baddbmm(weights["first.b"], x, weights["first.w"])
    for w, b in zip(weights["hidden.w"], weights["hidden.b"], strict=True):
        h = h + torch.baddbmm(b, _ready(h), w)
    return torch.baddbmm(weights["last.b"], _ready(h), weights["last.w"])


def _ready(h: Tensor) -> Tensor:
    return functional.gelu(functional.layer_norm(h, h.shape[-1:], eps=EPSILON))
