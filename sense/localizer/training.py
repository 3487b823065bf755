"""Training of the networks in torch: one loop for all, and what the localizer minimizes by it.

The loss is the distance, not its square, and a likelihood of the expected error. Every step masks random fibres and
augments the positions (and depths) of presses, their features following the response model, and looks at them at random
moments of its phase. The members of the ensemble know nothing of the Bayesian localizer, whose residual a smaller
network learns: errors of different kinds, so that together they err by a tenth less. Nothing is selected on presses
held back: of so few, chance would select.
"""

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from threading import Event, Lock
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from scipy.linalg import eigh
from torch import Tensor
from torch.optim.adamw import adamw

from padforge.common.parallel import makespan, one_thread, run_tasks
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.validation import InputError
from padforge.design.published.networks import fit_batch
from padforge.sense.arrays import Array, Floats
from padforge.sense.localizer.bayes import BayesianLocalizer, fit_stages
from padforge.sense.localizer.moments import CORRECTED, PHASES, RESIDUAL, Phase
from padforge.sense.localizer.network import (
    MAX_LOG_ERROR,
    MIN_LOG_ERROR,
    N_OUTPUTS,
    Networks,
    Weights,
    stack_members,
    unstack_members,
)
from padforge.sense.localizer.press_sampler import PressSampler
from padforge.sense.localizer.scaler import TrainingPresses, leave_one_out_residuals
from padforge.sense.localizer.torch_network import EnsembleMlp
from padforge.sense.settings import LocalizerSettings

WARM_UP = 0.2  # share of the steps in which the learning rate rises
BETAS = 0.9, 0.95  # decay of the means of gradients and of their squares
AVERAGE_DECAY = 0.998  # decay of the exponential moving average of the weights
REPORTS = 200  # calls of `on_progress` in a training


def one_cycle(share: float) -> float:
    """Return the learning rate, relative to its maximum, after `share` of the steps: linear up, linear down to 0."""
    return min(share / WARM_UP, (1 - share) / (1 - WARM_UP))


@contextmanager
def flushed_denormals() -> Iterator[None]:
    """Take denormal numbers for 0 in this thread: means of gradients that stay 0 fade to them, and they take long."""
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def fit_network(
    parameters: Mapping[str, Tensor],
    loss_of_batch: Callable[[], Tensor],
    steps: int,
    learning_rate: float,
    *,
    seconds: float | None = None,
    weight_decay: float = 1e-2,
    averaged: bool = True,
    on_progress: OnProgress = ignore_progress,
) -> dict[str, Floats]:
    """Minimize a loss by AdamW with a one-cycle learning rate; return the moving average of the weights, or the last.

    Weights by name require gradients and are changed in place. `loss_of_batch` draws a batch and returns its loss,
    `seconds` limit the training in place of `steps`, and `on_progress` is called with (n, `REPORTS`, "").
    """
    begin = time.monotonic()
    weights = list(parameters.values())
    average = [weight.detach().clone() for weight in weights]
    # as torch.optim.AdamW, which imports its compiler: that takes a second
    means, squares = ([torch.zeros_like(weight) for weight in weights] for _ in range(2))
    counts = [torch.zeros(()) for _ in weights]
    how: dict[str, Any] = dict(zip(("beta1", "beta2"), BETAS, strict=True))
    how |= {"weight_decay": weight_decay, "eps": 1e-8, "amsgrad": False, "maximize": False, "fused": True}
    share, step, reports = 0.0, 0, 0
    with flushed_denormals():
        while share < 1:
            step += 1
            share = step / steps if seconds is None else min((time.monotonic() - begin) / max(seconds, 1e-9), 1.0)
            for weight in weights:
                weight.grad = None
            loss_of_batch().backward()  # lays gradients out as their weights, which a fused step takes for granted
            gradients = [cast(Tensor, weight.grad) for weight in weights]
            with torch.no_grad():
                adamw(weights, gradients, means, squares, [], counts, lr=learning_rate * one_cycle(share), **how)
            # The first steps are forgotten sooner than the later ones, or the average would begin at the initial draw.
            decay = min(AVERAGE_DECAY, step / (step + 9)) if averaged else 0.0
            for mean, weight in zip(average, weights, strict=True):
                mean.lerp_(weight.detach(), 1 - decay)
            if share * REPORTS >= reports + 1:
                reports = int(share * REPORTS)
                on_progress(reports, REPORTS, "")
    return {name: mean.numpy() for name, mean in zip(parameters, average, strict=True)}


class StoppedError(Exception):
    """Another training failed, or the user interrupted."""


class JointProgress:
    """Progress of trainings in threads, of `totals` steps, reported together.

    Those still at work when the `with` block ends stop at their next report.
    """

    def __init__(self, totals: Sequence[int], on_progress: OnProgress) -> None:
        self._done, self._totals, self._on_progress = [0] * len(totals), totals, on_progress
        self._lock, self._stopped = Lock(), Event()

    def update(self, number: int, done: int, total: int, what: str) -> None:
        """Report the progress of one training, in its own steps; raise StoppedError if the `with` block has ended.

        `what` names work before or after these, which leaves the steps as they are.
        """
        if self._stopped.is_set():
            raise StoppedError
        with self._lock:
            if not what:
                self._done[number] = round(done / total * self._totals[number])
            self._on_progress(sum(self._done), sum(self._totals), what)

    def __enter__(self) -> None:
        pass

    def __exit__(self, *error: object) -> None:
        self._stopped.set()


MEASURE_WEIGHT = 0.5  # weight of the error of a scaled depth or force, beside the distance
LOG_ERROR_WEIGHT = 0.1  # weight of the likelihood of the expected error, beside the distance
COMMON_SQUARE, COMMON_DIRECTIONS, COMMON_BATCHES = 10.0, 16, 16
"""Mean square from which on directions of the inputs are scaled down, of the most that vary, and the batches that these
are learnt from. Windows of a fibre vary alike, and so much that a network learns their differences late."""
INPUT_NOISE = 0.02  # standard deviation of noise on scaled features, which are about 1
AUGMENTATION = 2.2
"""Standard deviation of augmented positions, in distances between neighbouring presses: 2 mm among 3000 presses on a
pad of 45 mm, 7 mm among 240, which leave more to interpolate."""
POSITION_AUGMENTATION, DEPTH_AUGMENTATION = 0.26, 0.3
"""Where depths vary: standard deviations in scaled position and depth, of a press of the middle depth."""
MIN_BATCHES, MAX_STEPS, HARDER = 9, 9900, 2
"""Steps of an epoch at least, and of a training at most; how much longer training takes where depths vary, which is
harder to learn."""
RESIDUAL_NETWORK = {"hidden": 128, "layers": 3}
"""Largest size of the network that corrects the Bayesian localizer: larger ones gain nothing."""
PUBLISHED_HIDDEN = 50  # neurons of the published network, of one tanh layer
PACE_STEPS, MIN_LENGTHS, MAX_MEMBERS = 12, 5, 64
"""With a time budget: steps that measure the pace, usual lengths of a training before there is another for each core,
and the most networks."""
MIN_STEPS = 36
"""Steps that a time budget must allow each network: with 9 the error on the example is three times that of a whole
training, with 36 a third greater."""


class TrainedNetworks(NamedTuple):
    """Networks of the members by phase, and the Bayesian localizers with the network that corrects them, if any."""

    networks: Networks
    bayes: tuple[BayesianLocalizer, ...]
    residual_network: Weights
    trained_share: float  # of its usual steps, of the network that took the least


def train_members(
    presses: TrainingPresses,
    table: Floats,
    options: LocalizerSettings,
    rng: np.random.Generator,
    on_progress: OnProgress,
    time_budget: float | None = None,
    leverage: Array | None = None,
) -> TrainedNetworks:
    """Train the members of the localizer; the last of several is a Bayesian localizer with its residual network.

    A member has a network for each phase of a press. Where depths vary there is no Bayesian localizer. Networks are
    trained in threads. `table` is the (S, S, C, F + G) scaled response by position, over [-1, 1] in x and y.
    `time_budget` is in seconds, for as many members as these are good for, and the progress is in seconds then, else in
    steps of all networks. `leverage` is as in `leave_one_out_residuals`. InputError is raised if a budget ends before
    each network has taken `MIN_STEPS`.
    """
    begin = time.monotonic()
    n_timed, presses = presses.complete.shape[1], leave_one_out_residuals(presses, table, leverage)
    phases = PHASES[n_timed]
    steps = training_steps(len(presses.inputs), options) * (HARDER if presses.depth_gain else 1)
    length, has_bayes = sum(phase.length for phase in phases.values()), options.members > 1 and not presses.depth_gain
    members, cores, pace_s = max(1, options.members - has_bayes), os.cpu_count() or 1, 0.0
    if time_budget is not None:
        with one_thread():
            pace_s = Training(presses, table, options, 0, next(iter(phases.values()))).measure_pace()
        has_bayes = not presses.depth_gain
        members = max(1, min(round(cores * time_budget / (pace_s * MIN_LENGTHS * steps * length)), MAX_MEMBERS))
    fitted = presses.inputs, presses.fibre_mask, presses.targets
    bayes = fit_stages(table, *fitted, n_timed, on_progress) if has_bayes else ()
    # Long trainings begin first, so that no core is idle at the end.
    by_length = sorted(phases.items(), key=lambda item: -item[1].length)
    tasks = [(name, phase) for name, phase in by_length for _ in range(members)]
    tasks += [("", CORRECTED if n_timed else phases["press"])] * has_bayes
    seeds = [int(seed) for seed in rng.integers(2**63, size=len(tasks))]
    all_steps = [round(steps * phase.length) for _, phase in tasks]
    totals, seconds = all_steps, list[float | None]([None] * len(tasks))
    if time_budget is not None:
        remaining_s = max(0.0, time_budget - (time.monotonic() - begin))
        in_turn = [remaining_s * part / makespan(all_steps, cores) for part in all_steps]
        totals, seconds = [max(1, round(each)) for each in in_turn], list[float | None](in_turn)
    on_progress(0, sum(totals), "")
    n_steps = [0] * len(tasks)
    joint = JointProgress(totals, on_progress)
    smaller = {name: min(size, getattr(options, name)) for name, size in RESIDUAL_NETWORK.items()}

    def train(number: int) -> Weights:
        name, phase = tasks[number]
        size, corrected = (options, ()) if name else (options.model_copy(update=smaller), bayes)
        training = Training(presses, table, size, seeds[number], phase, corrected)

        def loss_of_batch() -> Tensor:
            n_steps[number] += 1
            return training.loss()

        fitted = fit_network(
            dict(training.network.named_parameters()),
            loss_of_batch,
            all_steps[number],
            options.learning_rate,
            seconds=seconds[number],
            on_progress=partial(joint.update, number),
        )
        return training.weights(fitted)

    with one_thread(), joint:
        weights = dict(run_tasks((number, partial(train, number)) for number in range(len(tasks))))
    missing = [max(0, min(MIN_STEPS, usual) - done) for done, usual in zip(n_steps, all_steps, strict=True)]
    if time_budget is not None and any(missing):
        needed_s = time.monotonic() - begin + pace_s * makespan(missing, cores)
        raise InputError(
            f"time budget: got {time_budget:.3g} s for the training, in which a network took {min(n_steps)} steps; "
            f"expected at least {MIN_STEPS}, about {math.ceil(needed_s)} s"
        )
    networks = {
        name: stack_members([weights[number] for number, task in enumerate(tasks) if task[0] == name])
        for name in phases
    }
    trained_share = min(min(done / usual, 1.0) for done, usual in zip(n_steps, all_steps, strict=True))
    return TrainedNetworks(networks, bayes, weights[len(tasks) - 1] if has_bayes else {}, trained_share)


def training_steps(presses: int, options: LocalizerSettings) -> int:
    """Return the steps of a training: `epochs` times through the presses, within `MIN_BATCHES` and `MAX_STEPS`."""
    return min(MAX_STEPS, options.epochs * max(MIN_BATCHES, presses // options.batch))


def train_published(train: TrainingPresses, early_stop: TrainingPresses, rng: np.random.Generator) -> Weights:
    """Train the published network by Levenberg-Marquardt; the error on presses of `early_stop` ends the training."""
    x, y, *held_back = (
        part.reshape(len(part), -1).astype(np.float64)
        for part in (train.inputs, train.targets, early_stop.inputs, early_stop.targets)
    )
    network = fit_batch(x[None], y, [rng], PUBLISHED_HIDDEN, validation=(held_back[0][None], held_back[1]))[0]
    inputs, targets = network.inputs, network.targets
    hidden = network.hidden[:, :-1]
    # The scaling of the network is folded into its weights.
    slope = np.divide(hidden, inputs.half, out=np.zeros_like(hidden), where=inputs.half > 0)
    weights = {
        "first.w": slope.T,
        "first.b": (network.hidden[:, -1] - slope @ inputs.middle)[None],
        "last.w": (targets.half[:, None] * network.output[:, :-1]).T,
        "last.b": (targets.middle + targets.half * network.output[:, -1])[None],
    }
    return {name: np.ascontiguousarray(weight[None], dtype=np.float32) for name, weight in weights.items()}


def _loss(error: Tensor) -> Tensor:
    """Return the (...) loss of (..., 2 + T) errors: the distance, and a share of the others."""
    distance = error[..., :2].square().sum(dim=-1).add(1e-8).sqrt()
    return distance if error.shape[-1] == 2 else distance + MEASURE_WEIGHT * error[..., 2:].abs().sum(dim=-1)


class Training:
    """A network and its loss; on the CPU, as a GPU, which waits for batches and orders, takes no less time."""

    def __init__(
        self,
        presses: TrainingPresses,
        table: Floats,
        options: LocalizerSettings,
        seed: int,
        phase: Phase,
        bayes: Sequence[BayesianLocalizer] = (),
        start: Weights | None = None,
    ) -> None:
        rng = np.random.default_rng(seed)
        self._presses = sampler = PressSampler(presses, table, options.max_failures, rng, phase, bayes)
        self._batch, targets = min(options.batch, len(presses.inputs)), sampler.targets
        self._bounds = low, high = targets[:, :3].min(axis=0), targets[:, :3].max(axis=0)
        distance = math.sqrt((high - low)[:2].prod() / len(np.unique(targets[:, :2], axis=0)))
        varying = POSITION_AUGMENTATION, POSITION_AUGMENTATION, DEPTH_AUGMENTATION
        self._std = np.float32(varying if sampler.depth_gain else (AUGMENTATION * distance,) * 2)
        self._force_per_depth = 0.0
        if sampler.depth_gain:
            centred = (targets - targets.mean(axis=0))[:, 2:]
            self._force_per_depth = (centred[:, :1] * centred[:, 1:]).sum() / np.square(centred[:, :1]).sum()
        n_outputs = N_OUTPUTS + 2 * (targets.shape[1] - 2)
        generator = torch.Generator().manual_seed(seed)
        self.network = EnsembleMlp.random(sampler.n_inputs, n_outputs, options, generator)
        self._directions, self._shrinkage = self._fit_directions()
        if start is not None:
            first = self.scale_up(torch.from_numpy(start["first.w"]).mT).mT
            self.network = EnsembleMlp.from_numpy({**start, "first.w": first.contiguous().numpy()})

    def weights(self, fitted: Weights) -> Weights:
        """Return the weights for inputs as they are, of `fitted` parameters for scaled ones."""
        first = self.scale_down(torch.from_numpy(fitted["first.w"]).mT).mT
        return {**EnsembleMlp.join(fitted), "first.w": np.ascontiguousarray(first.numpy())}

    def measure_pace(self) -> float:
        """Return the seconds that a step takes."""
        durations = []
        for _ in range(PACE_STEPS):
            begin = time.monotonic()
            self.loss().backward()
            durations.append(time.monotonic() - begin)
        return float(np.median(durations))

    def loss(self) -> Tensor:
        """Return the loss of the next batch."""
        inputs, wanted = map(torch.from_numpy, self.draw())
        predicted, log_error = self.network.forward_bfloat16(self.scale_down(inputs))[0].chunk(2, dim=1)
        error, log_error = predicted - wanted, log_error.clamp(MIN_LOG_ERROR, MAX_LOG_ERROR)
        likelihood = (error.detach().abs() * (-log_error).exp() + log_error).sum(dim=1)  # of a Laplace distribution
        return (_loss(error) + LOG_ERROR_WEIGHT * likelihood).mean()

    def draw(self) -> tuple[Floats, Floats]:
        """Draw inputs (1, B, D), and what the network should answer (B, 2 + T)."""
        rows = self._presses.draw(self._batch)
        targets = self._augment_position(self._presses.targets[rows])
        x, position = self._presses.inputs(rows, targets, INPUT_NOISE)
        return x[None], targets - position

    def _fit_directions(self) -> tuple[Tensor, Tensor]:
        """Return the directions (D, n) in which inputs vary most, and the shares (n,) that are taken off these."""
        x = np.concatenate([self.draw()[0][0] for _ in range(COMMON_BATCHES)]).astype(np.float64)
        n_inputs = x.shape[1]
        most = max(n_inputs - COMMON_DIRECTIONS, 0), n_inputs - 1
        squares, directions = eigh(x.T @ x / len(x), subset_by_index=most)
        shrinkage = 1 - (1 + squares.clip(0) / COMMON_SQUARE) ** -0.5
        return torch.from_numpy(directions.astype(np.float32)), torch.from_numpy(shrinkage.astype(np.float32))

    def scale_down(self, x: Tensor) -> Tensor:
        """Scale (..., D) inputs down, most in the directions in which they vary most."""
        return (x - x @ self._directions * self._shrinkage @ self._directions.T) / COMMON_SQUARE**0.5

    def scale_up(self, x: Tensor) -> Tensor:
        """Undo `scale_down`."""
        growth = self._shrinkage / (1 - self._shrinkage)
        return (x + x @ self._directions * growth @ self._directions.T) * COMMON_SQUARE**0.5

    def _augment_position(self, targets: Floats) -> Floats:
        """Move (B, 2 + T) targets at random, and their force with their depth; reflect them at the bounds."""
        low, high = self._bounds
        gain = self._presses.depth_gain
        std = self._std / (1 + gain * targets[:, 2:3]) if gain else self._std
        moved = targets[:, :3] + std * self._presses.rng.standard_normal((len(targets), len(self._std)))
        moved = np.where(moved < low, 2 * low - moved, moved)
        moved = np.clip(np.where(moved > high, 2 * high - moved, moved), -1, 1)
        forces = targets[:, 3:] + self._force_per_depth * (moved - targets[:, :3])[:, 2:]
        return np.concatenate([moved, forces], axis=1).astype(np.float32)


RETRAINING_STEPS, RETRAINING_RATE = 150, 1e-3
"""Steps by which networks follow another response, which is near theirs; with 400 they err no less, and are surer."""


def retrain(
    networks: Networks,
    residual_network: Weights,
    presses: TrainingPresses,
    table: Floats,
    max_failures: int,
    rng: np.random.Generator,
    bayes: Sequence[BayesianLocalizer] = (),
) -> tuple[Networks, Weights]:
    """Train networks further, from where they are, on presses of a pad that responds by another table.

    Networks that are not to be retrained are left out, and a residual network without weights stays so.
    """
    phases = PHASES[presses.complete.shape[1]]
    options = LocalizerSettings(max_failures=max_failures)
    tasks = [(name, weights, phases[name], ()) for name, weights in networks.items()]
    if residual_network:
        phase = CORRECTED if presses.complete.shape[1] else phases["press"]
        tasks.append((RESIDUAL, residual_network, phase, bayes))
    seeds = rng.integers(2**63, size=len(tasks)).tolist()

    def train(number: int) -> Weights:
        _, weights, phase, corrected = tasks[number]
        members = []
        for member in unstack_members(weights):
            training = Training(presses, table, options, seeds[number], phase, corrected, member)
            parameters, steps = dict(training.network.named_parameters()), round(RETRAINING_STEPS * phase.length)
            members.append(training.weights(fit_network(parameters, training.loss, steps, RETRAINING_RATE)))
        return stack_members(members)

    with one_thread():
        trained = dict(run_tasks((number, partial(train, number)) for number in range(len(tasks))))
    by_name = {name: trained[number] for number, (name, *_) in enumerate(tasks)}
    residual_network = by_name.pop(RESIDUAL, residual_network)
    return by_name, residual_network
