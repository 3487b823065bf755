"""The paper's evaluation by simulation: how far off a freshly trained localizer finds presses, fibres lost or not."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from padforge.design.common.parallel import one_torch_thread, run_tasks
from padforge.design.common.settings import or_default
from padforge.design.common.validation import InputError, check_int, check_type, short_repr
from padforge.design.contact import serpentine_presses, signals
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.design.settings import MAX_FIBRES, PUBLISHED_CONTACT, Contact, Rectangle, Sensed, sensed_rectangle

if TYPE_CHECKING:
    pass

FAILURES = 3
"""Steps in a row without a new best on validation that end the training."""
RIDGE = 1e-5
"""Penalty of squared output weights per sample: keeps them finite where neurons are alike."""
FIRST_DAMPING = 3.0
"""In units of the mean curvature: high, since small first steps lead to smoother networks."""
EASE = 0.2
"""Least factor by which a step that was taken lowers the damping."""
LEAST_DAMPING, MOST_DAMPING = 1e-15, 1e10
LEAST_SLOPE = 1e-7
BLOCK = 64
"""Columns of a symmetric product made at once."""

Examples = tuple[Tensor, Tensor]


def train_batch(hidden: Tensor, learn: Examples, validate: Examples, epochs: int) -> tuple[Tensor, Tensor, Tensor]:
    """Train every network until validation has not gained for FAILURES steps, or no step makes it better.

    Args:
        hidden: (S, D+1, H) first hidden weights.
        learn, validate: scaled inputs (S, Q, D) and targets (S, A, Q, O).
        epochs: at most so many steps of a network.

    Returns:
        Hidden (S, D+1, H) and output weights (S, H+1, O) that did best on `validate`, and (S,) steps taken.
    """
    live = _Batch.begun(hidden, learn, validate)
    best = live.fit.hidden.clone(), live.fit.output.clone()
    steps = torch.zeros_like(live.number)
    while epochs > 0 and len(live.number):
        better, ended = live.step()
        for kept, own in zip(best, (live.fit.hidden, live.fit.output), strict=True):
            kept[live.number[better]] = own[better]
        steps[live.number] = live.steps
        ended |= live.steps == epochs
        if ended.any():
            live = live.rows(~ended)
    return best[0], best[1], steps


@dataclass
class _Rows:
    """Tensors that have a row for each network."""

    def rows(self, chosen: Tensor) -> Self:
        """Those of some networks."""
        parts = (getattr(self, field.name) for field in fields(self))
        return type(self)(*(part.rows(chosen) if isinstance(part, _Rows) else part[chosen] for part in parts))

    def take(self, other: Self, chosen: Tensor) -> None:
        """Rows `chosen` (S,) of `other` in place of the own ones."""
        every = bool(chosen.all())
        for field in fields(self):
            own, new = getattr(self, field.name), getattr(other, field.name)
            rows = chosen.view(-1, *[1] * (own.dim() - 1))
            setattr(self, field.name, new if every else torch.where(rows, new, own))


@dataclass
class LmBatchState(_Rows):
    """Networks with the output weights that are best for their hidden ones.

    Attributes:
        hidden: (S, D+1, H). targets: (S, Q, O), of those that are equally right the ones nearest to what was found.
        neurons: (S, Q, H+1), the last column 1.
        root: (S, H+1, H+1) by which the neurons become Z = neurons root', with R = 1 - Z Z'.
        output: (S, H+1, O). error: (S, Q, O). squares: (S,) of the error, and the ridge's penalty.
    """

    hidden: Tensor
    targets: Tensor
    neurons: Tensor
    root: Tensor
    output: Tensor
    error: Tensor
    squares: Tensor

    @classmethod
    def of(cls, hidden: Tensor, x: Tensor, targets: Tensor) -> Self:
        """Solve for the output weights, for inputs (S, Q, D+1) with a last column of 1 and targets (S, Q, O)."""
        neurons = neurons_of(hidden, x)
        ridge = RIDGE * x.shape[1]
        gram = neurons.mT @ neurons
        gram.diagonal(dim1=1, dim2=2).add_(ridge)
        factor = torch.linalg.cholesky_ex(gram).L
        root = torch.linalg.solve_triangular(factor, torch.eye(gram.shape[1]).to(gram), upper=False)
        output = root.mT @ (root @ (neurons.mT @ targets))
        error = torch.baddbmm(targets, neurons, output, beta=-1)
        return cls(hidden, targets, neurons, root, output, error, squares(error) + ridge * squares(output))

    def basis(self, like: Tensor) -> Tensor:
        """Z (S, Q, H+1) in the precision of `like`."""
        return self.neurons.to(like) @ self.root.mT.to(like)


@dataclass
class _Batch(_Rows):
    """The networks still in training.

    Attributes:
        number: (L,) which of all networks they are. steps: (L,) each has taken. fit: where they are.
        x, right: (L, Q, D+1) and (L, A, Q, O) to learn from. check_x, check_right: the like for validation.
        least: (L,) least squares on validation so far, and failures: (L,) steps since.
        damping, growth: (L,) damping, and by what it grows if the next step fails.
    """

    number: Tensor
    steps: Tensor
    fit: LmBatchState
    x: Tensor
    right: Tensor
    check_x: Tensor
    check_right: Tensor
    least: Tensor
    failures: Tensor
    damping: Tensor
    growth: Tensor

    @classmethod
    def begun(cls, hidden: Tensor, learn: Examples, validate: Examples) -> Self:
        """Before the first step."""
        (x, right), (check_x, check_right) = ((with_ones(inputs), targets) for inputs, targets in (learn, validate))
        fit = reassigned(LmBatchState.of(hidden, x, right[:, 0]), x, right)
        least = squares(nearest(neurons_of(hidden, check_x) @ fit.output, check_right)[1])
        number = torch.arange(len(hidden), device=hidden.device)
        none = torch.zeros_like(number)
        unset, two = torch.full_like(least, torch.nan), torch.full_like(least, 2.0)
        return cls(number, none, fit, x, right, check_x, check_right, least, none, unset, two)

    def step(self) -> tuple[Tensor, Tensor]:
        """Try a step of every network; where none is taken, the next one is damped more.

        Returns:
            (L,) whether it is the best on validation so far, and whether it was the last one to try.
        """
        slope = pull_back(self.x, self.fit, self.fit.error)
        change = self._change(slope)
        candidate = LmBatchState.of(self.fit.hidden - change.view_as(self.fit.hidden), self.x, self.fit.targets)
        foreseen = (change * (self.damping[:, None] * change + slope)).sum(dim=1)
        ratio = (self.fit.squares - candidate.squares) / foreseen
        gained = (ratio > 0) & candidate.squares.isfinite()
        self.fit.take(reassigned(candidate, self.x, self.right), gained)
        eased = (1 - (2 * ratio - 1) ** 3).clamp(min=EASE)
        self.damping = (self.damping * torch.where(gained, eased, self.growth)).clamp(min=LEAST_DAMPING)
        self.growth = torch.where(gained, 2.0, 2 * self.growth)
        self.steps = self.steps + gained
        found = neurons_of(self.fit.hidden, self.check_x) @ self.fit.output
        checked = squares(nearest(found, self.check_right)[1])
        better = gained & (checked < self.least)
        self.least = torch.where(better, checked, self.least)
        self.failures = torch.where(better, 0, self.failures + gained)
        going = (slope.norm(dim=1) >= LEAST_SLOPE) & (self.damping <= MOST_DAMPING) & (self.failures < FAILURES)
        return better, ~going

    def _change(self, slope: Tensor) -> Tensor:
        """(L, P) by which hidden weights are to be lowered; NaN where a damped matrix is singular to rounding."""
        dual = self.fit.error[0].numel() < slope.shape[1]
        matrix = (dual_curvature if dual else curvature)(self.x.float(), self.fit)
        right = (-self.fit.targets.flatten(1) if dual else slope).float()
        diagonal = matrix.diagonal(dim1=1, dim2=2)
        if self.damping.isnan().any():
            self.damping = FIRST_DAMPING * diagonal.double().sum(dim=1) / slope.shape[1]
        diagonal += self.damping[:, None]
        factor, failed = torch.linalg.cholesky_ex(matrix)
        change = torch.cholesky_solve(right[:, :, None], factor)[:, :, 0].double()
        change[failed != 0] = torch.nan
        if not dual:
            return change
        residual, basis = change.view_as(self.fit.error), self.fit.basis(slope)
        return pull_back(self.x, self.fit, residual - basis @ (basis.mT @ residual))


def with_ones(x: Tensor) -> Tensor:
    """(S, Q, D) with a last column of 1, for the biases."""
    return torch.cat([x, torch.ones_like(x[:, :, :1])], dim=2)


def neurons_of(hidden: Tensor, x: Tensor) -> Tensor:
    """(S, Q, H+1) what the neurons give for x (S, Q, D+1), and 1."""
    return with_ones(torch.tanh(x @ hidden))


def nearest(found: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Of the targets (S, A, Q, O) those nearest to what was found (S, Q, O), and how far off it is."""
    errors = found[:, None] - right
    if right.shape[1] == 1:
        return right[:, 0], errors[:, 0]
    chosen = errors.square().sum(dim=3, keepdim=True).argmin(dim=1, keepdim=True)
    return right.take_along_dim(chosen, dim=1)[:, 0], errors.take_along_dim(chosen, dim=1)[:, 0]


def reassigned(fit: LmBatchState, x: Tensor, right: Tensor) -> LmBatchState:
    """The fit to those of the targets (S, A, Q, O) that are nearest to what `fit` finds: never a worse one."""
    if right.shape[1] == 1:
        return fit
    return LmBatchState.of(fit.hidden, x, nearest(fit.neurons @ fit.output, right)[0])


def curvature(x: Tensor, fit: LmBatchState) -> Tensor:
    """J'R J (S, P, P), its lower triangle only, in the precision of x (S, Q, D+1).

    Output k responds to the weight of neuron i on input a by V_ki (1 - h_i^2) x_a: all but V_ki is common to the
    outputs, so that one symmetric product serves all of them.
    """
    networks, samples, inputs = x.shape
    bend = bends(fit).to(x)
    parts = (x[..., None] * bend[:, :, None, :]).view(networks, samples, -1)
    size = parts.shape[2]
    matrix = x.new_empty(networks, size, size)
    # Block by block, which spares almost half of the full product; what lies above the blocks is never read.
    for begin in range(0, size, BLOCK):
        end = begin + BLOCK
        matrix[:, begin:, begin:end] = parts[:, :, begin:].mT @ parts[:, :, begin:end]
    made_up = fit.basis(x).mT @ parts
    matrix.baddbmm_(made_up.mT, made_up, alpha=-1)
    weights = fit.output[:, :-1].to(x)
    shared = weights @ weights.mT
    by_neuron = matrix.view(networks, inputs, len(shared[0]), inputs, len(shared[0]))
    by_neuron *= shared[:, None, :, None, :]
    return matrix


def dual_curvature(x: Tensor, fit: LmBatchState) -> Tensor:
    """R J J'R (S, Q O, Q O), in the precision of x (S, Q, D+1).

    Entry ((q, k), (r, l)) of J J' is (x_q . x_r) sum_i V_ki V_li b_qi b_ri with b = 1 - h^2.
    """
    networks, samples, many = fit.error.shape
    bend, basis = bends(fit).to(x), fit.basis(x)
    alike = x @ x.mT
    matrix = x.new_empty(networks, samples, many, samples, many)
    pulls = [bend * fit.output[:, None, :-1, k].to(x) for k in range(many)]
    for k in range(many):
        for other in range(k + 1):
            block = (pulls[k] @ pulls[other].mT).mul_(alike)
            block.baddbmm_(basis, basis.mT @ block, alpha=-1)
            block.baddbmm_(block @ basis, basis.mT, alpha=-1)
            matrix[:, :, k, :, other] = block
            if other < k:
                matrix[:, :, other, :, k] = block.mT
    return matrix.view(networks, samples * many, samples * many)


def pull_back(x: Tensor, fit: LmBatchState, error: Tensor) -> Tensor:
    """J'e (S, P) for errors (S, Q, O)."""
    return (x.mT @ ((error @ fit.output[:, :-1].mT) * bends(fit))).flatten(1)


def bends(fit: LmBatchState) -> Tensor:
    """(S, Q, H) slopes of the neurons, 1 - h^2."""
    return 1 - fit.neurons[:, :, :-1].square()


def squares(values: Tensor) -> Tensor:
    """(S,) sums of squares of (S, ...)."""
    return values.square().sum(dim=(1, 2))


EPOCHS = 1000
LEARN, VALIDATE = 0.7, 0.15  # shares of the samples; the rest is the test set of the published split


@dataclass(frozen=True)
class ColumnScale:
    """Columns to [-1, 1] and back; a column that never varied becomes 0, which no weight can act on.

    Attributes:
        middle, half: (D,) middle and half width of each column's range.
    """

    middle: Array
    half: Array

    @classmethod
    def of(cls, values: Array) -> "ColumnScale":
        """The scale on which `values` (Q, D) fill [-1, 1]."""
        low, high = values.min(axis=0), values.max(axis=0)
        return cls((low + high) / 2, (high - low) / 2)

    def there(self, values: Array) -> Array:
        """(Q, D) scaled."""
        return np.divide(values - self.middle, self.half, out=np.zeros(values.shape), where=self.half > 0)

    def back(self, scaled: Array) -> Array:
        """(Q, D) in the units they came in."""
        return self.middle + self.half * scaled


@dataclass(frozen=True)
class Network:
    """A trained network: `network(inputs)` (Q, D) gives outputs (Q, O).

    Attributes:
        hidden: (H, D+1) weights of the neurons on scaled inputs, the last column their biases.
        output: (O, H+1) weights of the scaled outputs on the neurons, the last column their biases.
        inputs, targets: scales of the two sides.
        epochs: how long it was trained.
    """

    hidden: Array
    output: Array
    inputs: ColumnScale
    targets: ColumnScale
    epochs: int

    def __call__(self, inputs: ArrayLike) -> Array:
        scaled = self.inputs.there(np.asarray(inputs, dtype=np.float64))
        neurons = np.tanh(scaled @ self.hidden[:, :-1].T + self.hidden[:, -1])
        return self.targets.back(neurons @ self.output[:, :-1].T + self.output[:, -1])


def fit(
    inputs: Array,
    targets: Array,
    rng: np.random.Generator,
    hidden: int = 50,
    epochs: int = EPOCHS,
    check: tuple[Array, Array] | None = None,
) -> Network:
    """Train one network on (Q, D) inputs and (Q, O) targets: `fit_many` with a batch of one.

    Args:
        check: inputs (C, D) and targets (C, O) of validation; where given, all samples are learnt from.
    """
    checks = None if check is None else (check[0][None], check[1])
    return fit_many(inputs[None], targets, [rng], hidden, epochs, checks)[0]


def fit_many(
    inputs: Array,
    targets: Array,
    rngs: Sequence[np.random.Generator],
    hidden: int = 50,
    epochs: int = EPOCHS,
    check: tuple[Array, Array] | None = None,
    also: Array | None = None,
    device: str | None = None,
) -> list[Network]:
    """Train networks of one shape at once: 70 % of the samples to learn from, 15 % for validation, 15 % left aside.

    Args:
        inputs: (S, Q, D) samples of S networks, or (Q, D) that all of them learn from; finite.
        targets: (Q, O) that all of them learn.
        rngs: S sources of the splits and of the first weights.
        hidden: neurons of the hidden layer. epochs: at most so many steps.
        check: inputs (S, C, D) and targets (C, O) of validation; where given, all samples are learnt from.
        also: (A, Q, O) targets that are as right as those of `targets`: a sample counts by the one it comes nearest to.
        device: where torch computes; the GPU if None and there is one.

    Returns:
        S networks, each of the epoch that did best on validation. What a network becomes depends on its `rng` and its
        samples, beyond rounding on no other one of the batch.

    Raises:
        InputError: fewer than 3 samples, not as many targets as inputs, nothing to learn from or with, or numbers that
            are not finite.
    """

    inputs = _require_samples(inputs, targets, len(rngs), hidden)
    right = targets[None] if also is None else np.concatenate([targets[None], also])
    into, onto = [ColumnScale.of(own) for own in inputs], ColumnScale.of(right.reshape(-1, targets.shape[1]))
    samples = inputs.shape[1]
    learnt = round(LEARN * samples) if check is None else samples
    held = max(1, round(VALIDATE * samples))
    learn, validate, starts = [], [], []
    for own, scale, rng in zip(inputs, into, rngs, strict=True):
        order = rng.permutation(samples)
        learn.append((scale.there(own[order[:learnt]]), onto.there(right[:, order[:learnt]])))
        if check is None:
            rows = order[learnt : learnt + held]
            validate.append((scale.there(own[rows]), onto.there(right[:, rows])))
        starts.append(first_weights(scale.half > 0, hidden, rng).T)
    if check is not None:
        places = onto.there(check[1][None])
        validate = [(scale.there(own), places) for own, scale in zip(check[0], into, strict=True)]
    at = device or best_device()
    samples_of = partial(_stacked, device=at)
    trained = train_batch(_tensor(starts, at), samples_of(learn), samples_of(validate), epochs)
    return [
        Network(into_neurons.T, onto_outputs.T, scale, onto, int(taken))
        for scale, into_neurons, onto_outputs, taken in zip(
            into, *(part.cpu().numpy() for part in trained), strict=True
        )
    ]


def _require_samples(inputs: Array, targets: Array, networks: int, hidden: int) -> Array:
    """The inputs (S, Q, D) of so many networks, if they and the targets (Q, O) can be learnt."""
    if min(networks, hidden, inputs.shape[-1]) < 1:
        raise InputError(
            f"{networks} networks of {hidden} neurons for {inputs.shape[-1]} inputs, allowed is at least 1 of each"
        )
    if not (np.isfinite(inputs).all() and np.isfinite(targets).all()):
        raise InputError("inputs or targets hold NaN or infinity, expected finite numbers")
    inputs = np.broadcast_to(inputs, (networks, *inputs.shape[-2:]))
    samples = inputs.shape[1]
    if samples != len(targets) or samples < 3:
        raise InputError(f"{samples} inputs and {len(targets)} targets, allowed is as many of both, at least 3")
    return inputs


def best_device() -> str:
    """The name torch has for the GPU, if there is one, else for the processor."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _stacked(pairs: Sequence[tuple[Array, Array]], device: str) -> "tuple[Tensor, Tensor]":
    return _tensor([first for first, _ in pairs], device), _tensor([second for _, second in pairs], device)


def _tensor(parts: Sequence[Array], device: str) -> "Tensor":
    import torch

    return torch.from_numpy(np.stack(parts)).to(device)


def first_weights(varies: NDArray[np.bool_], hidden: int, rng: np.random.Generator) -> Array:
    """Hidden weights (H, D+1) whose slopes are spread over [-1, 1]^D after Nguyen and Widrow.

    Args:
        varies: (D,) which inputs do; the others get weight 0, as if they were not there.
    """
    weights = rng.uniform(-1, 1, (hidden, len(varies))) * varies
    length = 0.7 * hidden ** (1 / max(1, varies.sum()))
    norm = np.linalg.norm(weights, axis=1, keepdims=True)
    weights *= np.divide(length, norm, out=np.zeros_like(norm), where=norm > 0)
    bias = length * np.linspace(-1, 1, hidden) * rng.choice([-1, 1], hidden)
    return np.column_stack([weights, bias])


Loss = tuple[int, ...]
"""Fibres that are lost, by index."""

JITTER = 5 / 49
"""Greatest shift of a press off its serpentine, grid units, as published."""
MOST_PRESSES, MOST_NETWORKS = 2**20, 2**20
BATCH = 14
"""Networks trained at once by a core, which gains nothing from more; a GPU takes all of a level."""


@dataclass(frozen=True)
class FailureError:
    """Localisation error with some fibres lost, in grid units, over the sets of fibres that may be lost.

    Attributes:
        n_failed: number of failed fibres.
        subsets: number of sets of failed fibres.
        mean, std, max: of the sets' mean Euclidean distances.
    """

    n_failed: int
    subsets: int
    mean: float
    std: float
    max: float


def localisation_error(
    pad: Morphology,
    contact: Contact | None = None,
    n_failed: Sequence[int] = (0, 1, 2, 3),
    seed: int = 0,
    hidden: int = 50,
    presses: int = 1024,
    test: int = 2000,
    subsets: int | None = None,
) -> list[FailureError]:
    """The error of the published localizer, trained afresh for every set of lost fibres (paper, evaluation).

    It is taken over presses that were never trained on; the paper's own figures are over all presses, those trained on
    included, and so are lower. Networks are trained side by side, one thread a core, and do not depend on how many.

    Args:
        contact: PUBLISHED_CONTACT if None.
        n_failed: numbers of failed fibres; those that would leave no fibre are left out.
        seed: of the jitter, the test presses, the splits and the networks' first weights.
        hidden: neurons of a network.
        presses: to train on, a square number: a serpentine over 1..M (over 0.5..1.5 for a grid of 1), as published;
            `PressSets` has them anywhere.
        test: fresh presses, drawn uniformly over the same square.
        subsets: at most so many sets of a number of lost fibres, always the same; all if None.

    Raises:
        InputError: `presses` is no square of a number from 2, there is nothing to test on, or too much to do.
    """
    presses = check_int("presses", presses, 4, MOST_PRESSES)
    side = math.isqrt(presses)
    if side**2 != presses:
        raise InputError(f"presses is {presses}, allowed is a square number from 4")
    test, hidden = check_int("test", test, 1, MOST_PRESSES), check_int("hidden", hidden, 1, 1000)
    seed, contact = check_int("seed", seed, 0, 2**64 - 1), or_default("contact", contact, Contact, PUBLISHED_CONTACT)
    fibres = len(check_type("pad", pad, Morphology).knots)
    if not isinstance(n_failed, Sequence) or isinstance(n_failed, str):
        raise InputError(f"n_failed is {short_repr(n_failed)}, expected numbers of failed fibres")
    levels = [number for number in n_failed if check_int("n_failed", number, 0, 2 * MAX_FIBRES) < fibres]
    sets = [math.comb(fibres, number) for number in levels]
    if subsets is not None:
        sets = [min(all_of_them, check_int("subsets", subsets, 1, MOST_NETWORKS)) for all_of_them in sets]
    if sum(sets) > MOST_NETWORKS:
        raise InputError(f"subsets is {subsets}: that takes {sum(sets)} networks, allowed are {MOST_NETWORKS}")
    losses = [failure_subsets(fibres, number, most) for number, most in zip(levels, sets, strict=True)]
    return PressSets.of(pad, side, test, seed, lambda places: signals(pad, places, contact)).loss_errors(losses, hidden)


def batches(losses: Sequence[Loss]) -> list[list[Loss]]:
    """Losses in parts that are trained at once."""
    size = BATCH if best_device() == "cpu" else len(losses)
    return [list(losses[begin : begin + size]) for begin in range(0, len(losses), size)]


@dataclass(frozen=True)
class PressSets:
    """Presses to learn from and fresh ones to test on, with what a pad signals for them.

    Attributes:
        learned: (Q, 2) places, grid units, and recorded: (Q, C) their signals. fresh: (T, 2) and found: (T, C) alike.
        seed: of the networks, besides the fibres they are to do without.
    """

    learned: Array
    recorded: Array
    fresh: Array
    found: Array
    seed: int

    @classmethod
    def of(
        cls,
        pad: Morphology,
        side: int,
        test: int,
        seed: int,
        answer: Callable[[Array], Array],
        sensed_mm: Sensed = "fibres",
    ) -> "PressSets":
        """A serpentine of side^2 presses to learn from and `test` fresh ones, where `sensed_mm` says (`PadSettings`).

        Args:
            answer: gives the signals (Q, C) for places (Q, 2) in grid units.
        """
        rectangle = sensed_rectangle(pad.layout, sensed_mm)
        learned, fresh = training_presses(rectangle, side, seed), fresh_presses(rectangle, test, seed)
        return cls(learned, answer(learned), fresh, answer(fresh), seed)

    def loss_errors(self, losses: Sequence[Sequence[Loss]], hidden: int) -> list[FailureError]:
        """Errors of networks of `hidden` neurons with fibres lost: for each number of them, over the sets given."""

        def means(batch: list[Loss]) -> Array:
            networks = self.learn(batch, hidden)
            return np.array([self.errors(*pair).mean() for pair in zip(networks, batch, strict=True)])

        parts = {(at, k): batch for at, level in enumerate(losses) for k, batch in enumerate(batches(level))}
        with one_torch_thread():
            found = dict(run_tasks((key, partial(means, batch)) for key, batch in parts.items()))
        by_level = [np.concatenate([found[key] for key in parts if key[0] == at]) for at in range(len(losses))]
        return [
            FailureError(len(sets[0]), len(level), float(level.mean()), float(level.std()), float(level.max()))
            for sets, level in zip(losses, by_level, strict=True)
        ]

    def learn(self, losses: Sequence[Loss], hidden: int, repeat: int = 0) -> list[Network]:
        """A network for each of some losses of the same size, trained on the fibres that are left.

        Args:
            repeat: networks of another one start from other weights and split the presses otherwise.
        """
        kept = [self._kept(loss) for loss in losses]
        rngs = [np.random.default_rng([2, self.seed, len(loss), *loss, repeat]) for loss in losses]
        return fit_many(np.stack([self.recorded[:, own] for own in kept]), self.learned, rngs, hidden)

    def errors(self, network: Network, loss: Loss) -> Array:
        """(T,) distances at which a network that does without some fibres finds the fresh presses."""
        return self.distances(network, loss, self.found, self.fresh)

    def distances(self, network: Network, loss: Loss, signals: Array, places: Array) -> Array:
        """(Q,) distances of where a network finds presses by their signals (Q, C) to their places (Q, 2)."""
        return np.linalg.norm(network(signals[:, self._kept(loss)]) - places, axis=1)

    def _kept(self, loss: Loss) -> NDArray[np.int64]:
        return np.setdiff1d(np.arange(self.recorded.shape[1]), loss)


def training_presses(rectangle: Rectangle, side: int, seed: int) -> Array:
    """(side^2, 2) presses of a jittered serpentine over a rectangle, grid units."""
    jitter_seed = int(np.random.default_rng([0, seed]).integers(2**32))
    return serpentine_presses(rectangle, side, JITTER, jitter_seed)


def fresh_presses(rectangle: Rectangle, count: int, seed: int) -> Array:
    """(count, 2) presses drawn uniformly over a rectangle, grid units."""
    low, high = rectangle
    return np.random.default_rng([1, seed]).uniform(low, high, (count, 2))
