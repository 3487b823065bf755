"""The masked network in torch, for training it: what `sense.localizer.network` computes in NumPy, and first weights.

The published localizer as a preset: 50 tanh neurons trained by Levenberg-Marquardt.
It knows no lost fibres; the published way is to train another network for every set of them (`fibre_loss_study`). Set
torch to one thread: see `padforge.design.networks`.

Training the network: with `fine_tuning` and `published_training`, the only place of the localizer that needs torch.
The loss is the distance itself, not its square; beside it the network learns how far off it expects to be. Every step
loses a random few fibres of every press and moves the press by a few millimetres, its readings following as the fitted
`response_model` of the pad says. Of several depths, these are learnt too, with forces where they are known, and presses
are moved in depth as well: the lighter, and so the more blurred, the farther. The rate follows one cycle; what is kept
is a running average of the weights. None of it is chosen by presses held back: so few as there are choose by chance.
Beside the members, which know nothing of it, a smaller network learns to correct what an `bayes` finds: their
errors are of different kinds, so together they err by a tenth less than two of either. All are independent, each on a
thread of its own. In a time budget, the cycle is one of time, and there is a network for every core, and more of them
only where each can be trained for five times its usual length: until then, longer training gains more.

Adapting a trained network to a pad that has changed a little, by few presses: needs torch.
So few presses would drag a network of thousands of weights after their own noise. So every step looks at two sets of
presses: the new ones, moved by a few millimetres as in `training`, whose places are known; and the new ones moved
anywhere on the pad, whose places the network is to go on finding where it found them before (Li & Hoiem 2016, Learning
without forgetting). The more presses there are, the more the first count. Expected errors stay as they were.
"""

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Event, Lock
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from padforge.design.common.parallel import one_torch_thread, run_tasks
from padforge.design.networks import fit_batch
from padforge.sense import settings
from padforge.sense.arrays import Floats
from padforge.sense.localizer.bayes import TOLD, BayesianLocalizer
from padforge.sense.localizer.features import TrainingPresses, as_unseen, looked_up
from padforge.sense.localizer.network import EPSILON, LEAST_LOG, MOST_LOG, OUTPUTS, Weights

WARM_UP = 0.2
"""Share of the steps in which the learning rate rises."""
AVERAGE_DECAY = 0.998
"""Decay of the exponential moving average of the weights."""
REPORTS = 40
"""Calls of `on_progress` in a training."""


def one_cycle(share: float) -> float:
    """Return the learning rate, relative to its maximum, after `share` of the steps: linear up, cosine down to 0."""
    if share < WARM_UP:
        return share / WARM_UP
    return 0.5 * (1 + math.cos(math.pi * (share - WARM_UP) / (1 - WARM_UP)))


@dataclass
class TrainingLength:
    """Length of a training, in steps or in seconds.

    Attributes:
        steps: number of steps, where there is no time budget.
        seconds: time budget; None for none. The clock starts when this is made.
    """

    steps: int
    seconds: float | None = None

    def __post_init__(self) -> None:
        self._begin = time.monotonic()

    @property
    def total(self) -> int:
        """Steps, or seconds, of the whole training."""
        return self.steps if self.seconds is None else max(1, round(self.seconds))

    def share(self, step: int) -> float:
        """Return the share of the training, above 0 and up to 1, that is done with a step, counted from 1."""
        if self.seconds is None:
            return step / self.steps
        elapsed = time.monotonic() - self._begin
        return min(elapsed / self.seconds, 1.0) if self.seconds > 0 else 1.0


def fit_network(
    parameters: Mapping[str, Tensor],
    loss_of_batch: Callable[[], Tensor],
    length: TrainingLength | int,
    learning_rate: float,
    *,
    weight_decay: float = 1e-2,
    averaged: bool = True,
    on_progress: Callable[[int], None] = lambda done: None,
) -> dict[str, Floats]:
    """Minimize a loss by AdamW with a one-cycle learning rate and averaged weights.

    Args:
        parameters: weights by name, which require gradients; they are changed in place.
        loss_of_batch: draws a batch and returns its loss, a scalar; called once a step.
        length: number of steps, or a `TrainingLength`.
        learning_rate: maximum of the schedule.
        weight_decay: of AdamW.
        averaged: whether the moving average of the weights is returned, or the last ones.
        on_progress: called up to `REPORTS` times with the steps (or seconds, in a time budget) done.

    Returns:
        The weights by the same names, as NumPy arrays.
    """
    length = TrainingLength(length) if isinstance(length, int) else length
    average = [weight.detach().clone() for weight in parameters.values()]
    optimizer = torch.optim.AdamW(parameters.values(), lr=learning_rate, weight_decay=weight_decay, fused=True)
    share, step, reports = 0.0, 0, 0
    while share < 1:
        step += 1
        share = length.share(step)
        optimizer.param_groups[0]["lr"] = learning_rate * one_cycle(share)
        optimizer.zero_grad()
        loss_of_batch().backward()
        optimizer.step()
        # The first steps are forgotten sooner than the later ones, or the average would begin at the initial draw.
        decay = min(AVERAGE_DECAY, step / (step + 9)) if averaged else 0.0
        for mean, weight in zip(average, parameters.values(), strict=True):
            mean.lerp_(weight.detach(), 1 - decay)
        if share * REPORTS >= reports + 1:
            reports = int(share * REPORTS)
            on_progress(round(share * length.total))
    return {name: mean.cpu().numpy() for name, mean in zip(parameters, average, strict=True)}


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


def masked(inputs: Tensor, fibre_mask: Tensor) -> Tensor:
    """(B, C, F) inputs and (B, C) masks to (B, C F + C) entries, as `network.masked`."""
    kept = torch.where(fibre_mask[..., None], inputs, 0.0)
    return torch.cat([kept.flatten(1), fibre_mask.to(inputs.dtype)], dim=1)


def entries(inputs: Tensor, fibre_mask: Tensor, bayes: BayesianLocalizer | None) -> tuple[Tensor, Tensor]:
    """(B, D) what enters a network for (B, C, F) inputs, and the place that it is to correct: (B, 2), or 0 for none."""
    known = masked(inputs, fibre_mask)
    if bayes is None:
        return known, known.new_zeros(())
    with torch.no_grad():
        place, told = bayes(inputs, fibre_mask, torch)
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


HIDDEN = 50
"""Neurons of the experiment's network."""


def train_published(learn: TrainingPresses, check: TrainingPresses, rng: np.random.Generator) -> Weights:
    """Fit the published network.

    Args:
        learn, check: presses to learn from, and to tell by when to stop.
        rng: source of the first weights.

    Returns:
        Weights as `network.forward` takes them, the scales of the published network folded in.
    """
    x, y, *checks = (_flat(part) for part in (learn.inputs, learn.targets, check.inputs, check.targets))
    network = fit_batch(x[None], y, [rng], HIDDEN, validation=(checks[0][None], checks[1]))[0]
    into, onto = network.inputs, network.targets
    plain = network.hidden[:, :-1]
    slope = np.divide(plain, into.half, out=np.zeros_like(plain), where=into.half > 0)
    weights = {
        "first.w": slope.T,
        "first.b": (network.hidden[:, -1] - slope @ into.middle)[None],
        "last.w": (onto.half[:, None] * network.output[:, :-1]).T,
        "last.b": (onto.middle + onto.half * network.output[:, -1])[None],
    }
    return {name: np.ascontiguousarray(weight[None], dtype=np.float32) for name, weight in weights.items()}


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1).astype(np.float64)


LEAST_BATCHES, MOST_STEPS, LONGER = 10, 11_000, 2
"""Steps an epoch at least and of a training at most, as presses are moved and so never the same; of several depths, and
without the release, which are harder to learn, so many times more."""
WEIGHT_DECAY = 1e-2
INPUT_NOISE = 0.02
"""Noise on the scaled inputs while training, their spread being about 1."""
MOVED = 2.2
"""Standard deviation of the way a press is moved, in distances between neighbours: 2 mm among 3000 presses on a pad of
45 mm, 7 mm among 240, which leave more to guess between them."""
BLURRED, DEEPENED = 0.26, 0.3
"""Of several depths, the same and what is added to the depth, in its spans, for one of the middle depth. Lighter ones
are moved by as much more as noise blurs them more, or they would be known again by their noise."""
EXPECTING = 0.1
"""Weight of learning the expected error, beside the distance."""
CORRECTOR = {"hidden": 128, "layers": 3}
"""Size of the network that corrects what the observer finds, at most: larger ones gain nothing."""
TRIED, LENGTHENED, MOST_MEMBERS = 12, 5, 64
"""Of a time budget: steps that tell the pace, usual lengths of a member before there are more of them, and the most."""


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


class Trained(NamedTuple):
    """Weights as `network.forward` takes them, of the members and of the network that corrects the observer, if any."""

    weights: Weights
    bayes: BayesianLocalizer | None
    residual_network: Weights


def train_members(
    learn: TrainingPresses,
    table: Floats,
    options: settings.LocalizerSettings,
    rng: np.random.Generator,
    progress: Callable[[int, int], None],
    time_budget: float | None = None,
) -> Trained:
    """Fit the members of the localizer, an observer, and the network that corrects it, the last of several members.

    Of presses of several depths there is no observer.

    Args:
        learn: presses to learn from.
        table: (S, S, C, F + G) scaled inputs by place, over [-1, 1] in x and y.
        options: size of the network and length of the training. rng: of the seeds of torch's own generators.
        progress: called with (steps done, steps in all), of all members together; in a time budget, with seconds.
        time_budget: seconds of wall clock to train for, with the members that these are good for; None for the
            members and the length of `options`.
    """
    begin = time.monotonic()
    learn = as_unseen(learn, table)
    steps = training_steps(len(learn.inputs), options) * (
        LONGER if learn.stretch or options.features != "press_and_release" else 1
    )
    networks, seconds = options.members, None
    with one_torch_thread():
        if time_budget is not None:
            pace, cores = _Training(learn, table, options, 0).pace(), os.cpu_count() or 1
            in_turn = max(1, min(round(time_budget / (pace * LENGTHENED * steps)), MOST_MEMBERS // cores))
            networks = max(2, cores * in_turn)
            seconds = max(0.0, time_budget - (time.monotonic() - begin)) / math.ceil(networks / cores)
    observing = networks > 1 and not learn.stretch
    bayes = BayesianLocalizer.fit(table, learn.inputs, learn.fibre_mask, learn.targets) if observing else None
    seeds = [int(seed) for seed in rng.integers(2**63, size=networks)]
    joint = JointProgress([TrainingLength(steps, seconds).total] * networks, progress)
    small = options.model_copy(update={name: min(most, getattr(options, name)) for name, most in CORRECTOR.items()})
    members = networks - observing

    def train(number: int) -> Weights:
        corrects = number == members
        training = _Training(learn, table, small if corrects else options, seeds[number], bayes if corrects else None)
        return training.run(TrainingLength(steps, seconds), lambda done: joint.tell(number, done))

    with one_torch_thread(), joint:
        weights = dict(run_tasks((number, partial(train, number)) for number in range(len(seeds))))
    return Trained(joined([weights[number] for number in range(members)]), bayes, weights.get(members, {}))


def joined(members: Sequence[Weights]) -> Weights:
    """Weights of one member each, on the same presses, as those of all."""
    axis = {name: 1 if name.startswith("hidden") else 0 for name in members[0]}
    return {name: np.concatenate([each[name] for each in members], axis=axis[name]) for name in axis}


def training_steps(presses: int, options: settings.LocalizerSettings) -> int:
    """Steps that a member takes: `epochs` times through the presses, within `LEAST_BATCHES` and `MOST_STEPS`."""
    return min(MOST_STEPS, options.epochs * max(LEAST_BATCHES, presses // options.batch))


class _Training:
    """One network in training, on the GPU where there is one: on its own, or to correct an observer."""

    def __init__(
        self,
        learn: TrainingPresses,
        table: Floats,
        options: settings.LocalizerSettings,
        seed: int,
        bayes: BayesianLocalizer | None = None,
    ) -> None:
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._generator = torch.Generator(self._device).manual_seed(seed)
        self._options = options
        arrays = (learn.inputs, learn.fibre_mask, learn.targets)
        self._x, self._fibre_mask, self._y = (torch.from_numpy(array).to(self._device) for array in arrays)
        self._fibres, size = self._x.shape[1:]
        self._lost = min(options.max_failures, self._fibres - 1)
        self._table = torch.from_numpy(table).to(self._device).flatten(2)
        self._bounds = self._y[:, :3].amin(dim=0), self._y[:, :3].amax(dim=0)
        places = self._y[:, :2].unique(dim=0)
        apart = ((self._bounds[1] - self._bounds[0])[:2].prod() / len(places)).sqrt()
        self._steps = (
            torch.tensor([BLURRED, BLURRED, DEEPENED], device=self._device)
            if learn.stretch
            else (MOVED * apart).expand(2)
        )
        off = (self._y - self._y.mean(dim=0))[:, 2:]
        self._harder = (off[:, :1] * off[:, 1:]).sum() / off[:, :1].square().sum()  # force by depth, in line
        self._stretch = learn.stretch
        at_home = inputs_at(self._table, self._y, self._stretch)
        self._rest = self._x - at_home.view_as(self._x)
        self._bayes = bayes and bayes.changed(lambda part: torch.from_numpy(part).to(self._device))
        width = self._fibres * (size + 1) + (0 if bayes is None else TOLD)
        self._weights = initial(width, options, self._generator, OUTPUTS + 2 * (self._y.shape[1] - 2))

    def pace(self) -> float:
        """Seconds that a step takes."""
        took = []
        for _ in range(TRIED):
            begin = time.monotonic()
            self._loss().backward()
            took.append(time.monotonic() - begin)
        return float(np.median(took))

    def run(self, length: TrainingLength, tell: Callable[[int], None]) -> Weights:
        return fit_network(self._weights, self._loss, length, self._options.learning_rate, on_progress=tell)

    def _loss(self) -> Tensor:
        batch = min(self._options.batch, len(self._x))
        rows = torch.randint(len(self._x), (batch,), generator=self._generator, device=self._device)
        targets = self._moved(self._y[rows])
        rest = self._rest[rows]
        inputs = inputs_at(self._table, targets, self._stretch).view_as(rest) + rest
        inputs += INPUT_NOISE * self._normal(*rest.shape)
        fibre_mask = self._fibre_mask[rows] & draw_alive(batch, self._fibres, self._lost, self._generator)
        known, found = entries(inputs, fibre_mask, self._bayes)
        learnt, logs = forward_fast(self._weights, known[None])[0].chunk(2, dim=1)
        off, logs = learnt + found - targets, logs.clamp(LEAST_LOG, MOST_LOG)
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


STEPS, BATCH, RATE = 200, 128, 1e-4
"""Enough to follow what drifts and too little to forget: errors hardly change for half and twice as much."""
OLD_PRESSES = 100
"""New presses that count as much as what was learnt before."""
MOVED_FINE_TUNING = 0.09
"""Standard deviation of the way a press is moved, in units of the span: 2 mm on a pad of 45 mm."""
FAR_NOISE = 0.1
"""Noise on the scaled inputs of presses moved anywhere, which is less sure than a move by millimetres."""
SPREAD_KEPT = 0.02
"""Weight of keeping the logarithms of expected errors, beside the places."""


def adapt(
    weights: Weights,
    samples: TrainingPresses,
    table: Floats,
    lost: int,
    rng: np.random.Generator,
    bayes: BayesianLocalizer | None = None,
) -> Weights:
    """Adapt the members of a network of method "ensemble", or the network that corrects an observer.

    Args:
        weights: as `network.forward` takes them.
        samples: presses of known place, depth and force, where these were learnt.
        table: (S, S, C, F) scaled inputs by place, over [-1, 1] in x and y.
        lost: fibres that are lost at once, at most, while adapting.
        rng: source of the seed of torch's generator, which draws all that is random here.
        bayes: what they correct, if anything; it stays as it is.

    Returns:
        Weights of the same shapes.
    """
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    before = {name: torch.from_numpy(weight) for name, weight in weights.items()}
    now = {name: weight.clone().requires_grad_() for name, weight in before.items()}
    presses = _Presses(samples, table, min(lost, samples.inputs.shape[1] - 1), generator, bayes)
    members = len(now["first.w"])
    trust = len(samples.inputs) / (len(samples.inputs) + OLD_PRESSES)

    def loss() -> Tensor:
        known, left = presses.nearby()
        off = forward(now, known.expand(members, -1, -1))[..., : left.shape[1]] - left
        near = trust * misses(off).mean(dim=1).sum()
        known = presses.anywhere().expand(members, -1, -1)
        with torch.no_grad():
            found = forward(before, known)
        return near + (1 - trust) * _change(forward(now, known), found)

    with one_torch_thread():
        return fit_network(now, loss, STEPS, RATE, weight_decay=0.0, averaged=False)


class _Presses:
    """Draws presses that resemble the known ones."""

    def __init__(
        self,
        samples: TrainingPresses,
        table: Floats,
        lost: int,
        generator: torch.Generator,
        bayes: BayesianLocalizer | None,
    ) -> None:
        self._x, self._fibre_mask, self._y = (
            torch.from_numpy(a) for a in (samples.inputs, samples.fibre_mask, samples.targets)
        )
        self._table, self._stretch = torch.from_numpy(table).flatten(2), samples.stretch
        self._at_home = inputs_at(self._table, self._y, self._stretch)
        self._lost, self._generator = lost, generator
        self._bayes = bayes and bayes.changed(torch.from_numpy)

    def nearby(self) -> tuple[Tensor, Tensor]:
        """Entries (1, B, D) and what is to be found of them (B, 2 + T), of presses moved by a few millimetres."""
        rows = self._rows()
        targets = self._at(rows, (self._y[rows, :2] + MOVED_FINE_TUNING * self._normal(BATCH, 2)).clamp(-1, 1))
        known, found = self._entries(rows, targets, INPUT_NOISE)
        return known, targets - found

    def anywhere(self) -> Tensor:
        """Entries (1, B, D) of presses moved to any place of the pad."""
        rows = self._rows()
        anywhere = 2 * torch.rand(BATCH, 2, generator=self._generator) - 1
        return self._entries(rows, self._at(rows, anywhere), FAR_NOISE)[0]

    def _rows(self) -> Tensor:
        return torch.randint(len(self._x), (BATCH,), generator=self._generator)

    def _at(self, rows: Tensor, places: Tensor) -> Tensor:
        """(B, 2 + T) targets of presses at other places, as deep and forceful as they were."""
        return torch.cat([places, self._y[rows, 2:]], dim=1)

    def _entries(self, rows: Tensor, targets: Tensor, noise: float) -> tuple[Tensor, Tensor]:
        moved = (inputs_at(self._table, targets, self._stretch) - self._at_home[rows]).view_as(self._x[rows])
        inputs = self._x[rows] + moved
        inputs = inputs + noise * self._normal(*inputs.shape)
        fibre_mask = self._fibre_mask[rows] & draw_alive(BATCH, self._x.shape[1], self._lost, self._generator)
        known, found = entries(inputs, fibre_mask, self._bayes)
        return known[None], found

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator)


def _change(found: Tensor, before: Tensor) -> Tensor:
    """How far what is found and expected errors (E, B, 2 N) moved, summed over members."""
    change, logs = (found - before).chunk(2, dim=2)
    return (misses(change) + SPREAD_KEPT * logs.abs().mean(dim=2)).mean(dim=1).sum()
