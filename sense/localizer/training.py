"""Training of the networks: their tasks, and the loss of the localizer.

The loss is the distance, not its square, plus a likelihood of the expected error. Every step masks random fibres,
augments the positions (and depths) of presses, whose features follow the response model, and reads them at random
moments of a phase. The networks of the ensemble are trained without the Bayesian member, whose residual a smaller
network learns. Since errors of both kinds differ, those of the combination are smaller by a tenth. The ensemble is not
selected, or stopped early, by presses held back, which are too few for that.
"""

import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from threading import Event, Lock
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from padforge.common.parallel import makespan, one_thread, run_tasks
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.validation import InputError
from padforge.sense.arrays import Array, Floats
from padforge.sense.localizer.backpropagation import TrainableMlp, random_weights
from padforge.sense.localizer.bayes import BayesianLocalizer, fit_stages
from padforge.sense.localizer.moments import PHASES, RESIDUAL, RESIDUAL_PHASE, Phase
from padforge.sense.localizer.network import (
    MAX_LOG_ERROR,
    MIN_LOG_ERROR,
    N_OUTPUTS,
    Networks,
    Weights,
    stack_members,
    unstack_members,
)
from padforge.sense.localizer.optimizer import fit_network
from padforge.sense.localizer.press_sampler import PressSampler
from padforge.sense.localizer.scaler import TrainingPresses, leave_one_out_residuals
from padforge.sense.settings import LocalizerSettings


@contextmanager
def joint_progress(totals: Sequence[int], on_progress: OnProgress) -> Iterator[Callable[[int, int, int, str], None]]:
    """Report the progress of several trainings in threads, with `totals` steps each, as one.

    Yields a function that a training calls with its number, its steps done and in all, and, before and after the steps,
    the name of its work. It raises CancelledError in trainings that still run when the block ends, as on Ctrl-C.
    """
    steps, lock, has_ended = [0] * len(totals), Lock(), Event()

    def update(number: int, done: int, total: int, what: str) -> None:
        if has_ended.is_set():
            raise CancelledError
        with lock:
            if not what:
                steps[number] = round(done / total * totals[number])
            on_progress(sum(steps), sum(totals), what)

    try:
        yield update
    finally:
        has_ended.set()


MEASURE_WEIGHT = 0.5  # weight of the error of a scaled depth or force, relative to that of the distance
LOG_ERROR_WEIGHT = 0.1  # weight of the likelihood of the expected error, relative to that of the distance
ROUNDING = 0.5
"""Share of the expected error within which the loss is quadratic in the distance rather than linear: smaller errors
than expected are chance."""
COMMON_SQUARE = 10.0
"""Mean square of inputs along a direction above which the direction is scaled down. Windows of a fibre correlate so
strongly that a network would otherwise learn late what they differ in."""
COMMON_DIRECTIONS = 16  # directions that are scaled down at most, those in which inputs vary most
COMMON_BATCHES = 16  # batches on which these directions are fitted
INPUT_NOISE = 0.02  # standard deviation of noise on scaled features, which are about 1
AUGMENTATION = 1.6
"""Standard deviation of augmented positions, in distances between neighbouring presses: 1.3 mm with 3000 presses on a
pad of 45 mm, and 5 mm with 240, between which there is more to interpolate."""
POSITION_AUGMENTATION = 0.26  # the same where depths vary, scaled, for a press of the middle depth
DEPTH_AUGMENTATION = 0.3  # standard deviation of augmented depths, scaled, for a press of the middle depth
MIN_BATCHES = 9  # minimum steps of an epoch
MAX_STEPS = 9900  # maximum steps of a training
DEPTH_STEP_FACTOR = 2  # factor on the steps where depths vary, which is harder to learn
RECENT_BATCHES = 64  # latest batches of the residual network, which takes every second batch from these
MAX_RESIDUAL_SIZE = {"hidden": 128, "layers": 3}  # a larger residual network gains nothing
PUBLISHED_HIDDEN = 50  # neurons of the published network, of one tanh layer
PACE_STEPS = 12  # steps that measure the pace, with a time budget
MIN_LENGTHS = 5  # times the usual length that a time budget gives each training before it adds members
MAX_MEMBERS = 64  # maximum members that a time budget adds up to
MIN_STEPS = 36
"""Steps that a time budget must allow each network: after 9 steps the error on the example is three times that of a
complete training, after 36 it is a third larger."""


class TrainedNetworks(NamedTuple):
    """Networks of the members by phase, and the Bayesian localizers with the network that corrects them, if any."""

    networks: Networks
    bayes: tuple[BayesianLocalizer, ...]
    residual_network: Weights
    trained_share: float  # smallest share of its usual steps that a network took


@dataclass
class TrainingTask:
    """Training of one member of a network."""

    name: str  # of the network: that of its phase, or `RESIDUAL`
    phase: Phase
    options: LocalizerSettings
    steps: int  # usual number
    bayes: Sequence[BayesianLocalizer] = ()  # Bayesian localizers that the residual network corrects
    start: Weights | None = None  # weights of a trained member to continue from
    augmentation_factor: float = 1.0  # on `AUGMENTATION`
    seconds: float | None = None  # limit in place of `steps`


def run_trainings(
    tasks: Sequence[TrainingTask],
    presses: TrainingPresses,
    table: Floats,
    rng: np.random.Generator,
    on_progress: OnProgress = ignore_progress,
) -> tuple[dict[str, Weights], list[int]]:
    """Run trainings in threads; return the networks by name, and the steps that each training has taken."""
    totals = [task.steps if task.seconds is None else max(1, round(task.seconds)) for task in tasks]
    seeds = rng.integers(2**63, size=len(tasks)).tolist()
    on_progress(0, sum(totals), "")

    def train(number: int) -> tuple[Weights, int]:
        task, seed = tasks[number], seeds[number]
        training = Training(presses, table, task, seed)
        fitted = fit_network(
            training.network.parameters,
            training.backpropagate,
            task.steps,
            task.options.learning_rate,
            seconds=task.seconds,
            on_progress=partial(update, number),
        )
        return training.weights(fitted), training.n_steps

    with one_thread(), joint_progress(totals, on_progress) as update:
        trained = dict(run_tasks((number, partial(train, number)) for number in range(len(tasks))))
    members: dict[str, list[Weights]] = {}
    for number, task in enumerate(tasks):
        members.setdefault(task.name, []).append(trained[number][0])
    networks = {name: stack_members(weights) for name, weights in members.items()}
    return networks, [trained[number][1] for number in range(len(tasks))]


def train_members(
    presses: TrainingPresses,
    table: Floats,
    options: LocalizerSettings,
    rng: np.random.Generator,
    on_progress: OnProgress,
    time_budget: float | None = None,
    leverage: Array | None = None,
) -> TrainedNetworks:
    """Train the members of the localizer in threads, each with a network for every phase of a press.

    The last of several members is a Bayesian localizer with its residual network, unless depths vary.

    Args:
        presses: to train on.
        table: scaled response by position, over [-1, 1] in x and y; shape (S, S, C, F + G).
        options: size and number of the members.
        rng: draws the seeds of the networks.
        on_progress: called with the steps of all networks, or with seconds if there is a time budget.
        time_budget: seconds for the training, which decide on the number of members.
        leverage: as in `leave_one_out_residuals`.

    Raises:
        InputError: the time budget ends before each network has taken `MIN_STEPS`.
    """
    begin = time.monotonic()
    n_timed, presses = presses.complete.shape[1], leave_one_out_residuals(presses, table, leverage)
    phases = PHASES[n_timed]
    steps = training_steps(len(presses.inputs), options) * (DEPTH_STEP_FACTOR if presses.depth_gain else 1)

    # 1. Number of members
    cores, pace_s = os.cpu_count() or 1, 0.0
    if time_budget is None:
        has_bayes = options.members > 1 and not presses.depth_gain
        members = max(1, options.members - has_bayes)
    else:
        has_bayes = not presses.depth_gain
        with one_thread():
            name, phase = next(iter(phases.items()))
            pace_s = Training(presses, table, TrainingTask(name, phase, options, steps), 0).measure_pace()
        length = sum(phase.length for phase in phases.values())
        members = max(1, min(round(cores * time_budget / (pace_s * MIN_LENGTHS * steps * length)), MAX_MEMBERS))
    fitted = presses.inputs, presses.fibre_mask, presses.targets
    bayes = fit_stages(table, *fitted, n_timed, on_progress) if has_bayes else ()

    # 2. One task a network; long ones begin first, so that no core is idle at the end
    by_length = sorted(phases.items(), key=lambda item: -item[1].length)
    tasks = [
        TrainingTask(name, phase, options, round(steps * phase.length))
        for name, phase in by_length
        for _ in range(members)
    ]
    if has_bayes:
        smaller = {name: min(size, getattr(options, name)) for name, size in MAX_RESIDUAL_SIZE.items()}
        phase = RESIDUAL_PHASE if n_timed else phases["press"]
        n_steps = round(steps * phase.length)
        tasks.append(TrainingTask(RESIDUAL, phase, options.model_copy(update=smaller), n_steps, bayes))
    if time_budget is not None:
        remaining_s = max(0.0, time_budget - (time.monotonic() - begin))
        longest = makespan([task.steps for task in tasks], cores)
        for task in tasks:
            task.seconds = remaining_s * task.steps / longest

    # 3. Training
    trained, n_steps = run_trainings(tasks, presses, table, rng, on_progress)
    missing = [max(0, min(MIN_STEPS, task.steps) - done) for task, done in zip(tasks, n_steps, strict=True)]
    if time_budget is not None and any(missing):
        needed_s = time.monotonic() - begin + pace_s * makespan(missing, cores)
        raise InputError(
            f"time budget: got {time_budget:.3g} s for the training, in which a network took {min(n_steps)} steps; "
            f"expected at least {MIN_STEPS}, about {math.ceil(needed_s)} s"
        )
    trained_share = min(min(done / task.steps, 1.0) for task, done in zip(tasks, n_steps, strict=True))
    networks = {name: trained[name] for name in phases}
    return TrainedNetworks(networks, bayes, trained.get(RESIDUAL, {}), trained_share)


def training_steps(presses: int, options: LocalizerSettings) -> int:
    """Return the steps of a training: `epochs` times through the presses, within `MIN_BATCHES` and `MAX_STEPS`."""
    return min(MAX_STEPS, options.epochs * max(MIN_BATCHES, presses // options.batch))


def train_published(train: TrainingPresses, early_stop: TrainingPresses, rng: np.random.Generator) -> Weights:
    """Train the published network by Levenberg-Marquardt with early stopping on the presses of `early_stop`."""
    from padforge.design.published.networks import fit_batch  # torch takes long to import

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


def loss_gradient(outputs: Floats, targets: Floats) -> Floats:
    """Return the gradient of the loss of a batch by the outputs (B, 2 N) of a network for targets (B, N).

    With the errors e of x and y, m of the measures, and the expected errors s, the loss is the mean over the batch of

        sqrt(|e|^2 + |ROUNDING s|^2) + MEASURE_WEIGHT sum |m| + LOG_ERROR_WEIGHT sum (|error| / s + log s),

    where only the last term trains s, and s alone.
    """
    predicted, log_error = np.split(outputs, 2, axis=1)
    error, clipped = predicted - targets, log_error.clip(MIN_LOG_ERROR, MAX_LOG_ERROR)
    expected = np.exp(clipped)
    rounded = np.sqrt(np.square(error[:, :2]).sum(axis=1) + np.square(ROUNDING * expected[:, :2]).sum(axis=1) + 1e-8)
    grad_position, grad_measures = error[:, :2] / rounded[:, None], MEASURE_WEIGHT * np.sign(error[:, 2:])
    grad_log_error = LOG_ERROR_WEIGHT * (1 - np.abs(error) / expected) * (log_error == clipped)
    return np.concatenate([grad_position, grad_measures, grad_log_error], axis=1) / len(outputs)


class Training:
    """A network and its loss, on the CPU: a GPU is no faster, since it waits for batches and kernel launches."""

    def __init__(self, presses: TrainingPresses, table: Floats, task: TrainingTask, seed: int) -> None:
        rng, options = np.random.default_rng(seed), task.options
        self.n_steps = 0  # batches so far
        self._recent, self._reuses = deque[tuple[Floats, Floats]](maxlen=RECENT_BATCHES), bool(task.bayes)
        self._sampler = sampler = PressSampler(presses, table, options.max_failures, rng, task.phase, task.bayes)
        self._batch, targets = min(options.batch, len(presses.inputs)), sampler.targets
        self._bounds = low, high = targets[:, :3].min(axis=0), targets[:, :3].max(axis=0)
        spacing = math.sqrt((high - low)[:2].prod() / len(np.unique(targets[:, :2], axis=0)))
        std_xy = (task.augmentation_factor * AUGMENTATION * spacing,) * 2
        std_xy_depth = POSITION_AUGMENTATION, POSITION_AUGMENTATION, DEPTH_AUGMENTATION
        self._std = np.float32(std_xy_depth if sampler.depth_gain else std_xy)
        self._force_per_depth = 0.0
        if sampler.depth_gain:
            centred = (targets - targets.mean(axis=0))[:, 2:]
            self._force_per_depth = (centred[:, :1] * centred[:, 1:]).sum() / np.square(centred[:, :1]).sum()
        n_outputs = N_OUTPUTS + 2 * (targets.shape[1] - 2)
        start = task.start or random_weights(sampler.n_inputs, n_outputs, options, rng)
        self._directions, self._shrinkage = self._fit_directions()
        if task.start is not None:
            start = {**start, "first.w": self.scale_up(start["first.w"].swapaxes(1, 2)).swapaxes(1, 2)}
        self.network = TrainableMlp(start, self._batch)

    def weights(self, fitted: Weights) -> Weights:
        """Return weights for unscaled inputs, from `fitted` ones for scaled inputs."""
        first = self.scale_down(fitted["first.w"].swapaxes(1, 2)).swapaxes(1, 2)
        return {**fitted, "first.w": np.ascontiguousarray(first)}

    def measure_pace(self) -> float:
        """Return the seconds that a step takes."""
        durations = []
        for _ in range(PACE_STEPS):
            begin = time.monotonic()
            self.backpropagate()
            durations.append(time.monotonic() - begin)
        return float(np.median(durations))

    def backpropagate(self) -> None:
        """Write the gradient of the loss of the next batch."""
        self.n_steps += 1
        inputs, targets = self._next_batch()
        self.network.backward(loss_gradient(self.network.forward(self.scale_down(inputs)), targets))

    def _next_batch(self) -> tuple[Floats, Floats]:
        """Return a new batch, or every second time a recent one if Bayesian positions make new ones expensive."""
        if not self._reuses:
            return self.sample_batch()
        if self.n_steps % 2:
            self._recent.append(self.sample_batch())
            return self._recent[-1]
        return self._recent[self._sampler.rng.integers(len(self._recent))]

    def sample_batch(self) -> tuple[Floats, Floats]:
        """Sample inputs (B, I) and the targets of the network (B, 2 + T)."""
        rows = self._sampler.sample_rows(self._batch)
        targets = self._augment_position(self._sampler.targets[rows])
        x, position = self._sampler.inputs(rows, targets, INPUT_NOISE)
        return x, targets - position

    def _fit_directions(self) -> tuple[Floats, Floats]:
        """Return the directions (I, n) in which inputs vary most, and the shares (n,) by which these are shrunk."""
        x = np.concatenate([self.sample_batch()[0] for _ in range(COMMON_BATCHES)]).astype(np.float64)
        n_inputs = x.shape[1]
        index_range = max(n_inputs - COMMON_DIRECTIONS, 0), n_inputs - 1  # of the largest eigenvalues
        squares, directions = eigh(x.T @ x / len(x), subset_by_index=index_range)
        directions[np.abs(directions) < 1e-12] = 0  # denormal numbers would make a step take twice as long
        shrinkage = 1 - (1 + squares.clip(0) / COMMON_SQUARE) ** -0.5
        return np.ascontiguousarray(directions, np.float32), shrinkage.astype(np.float32)

    def scale_down(self, x: Floats) -> Floats:
        """Scale (..., I) inputs down, most strongly in the directions in which they vary most."""
        return (x - x @ self._directions * self._shrinkage @ self._directions.T) * np.float32(COMMON_SQUARE**-0.5)

    def scale_up(self, x: Floats) -> Floats:
        """Undo `scale_down`."""
        growth = self._shrinkage / (1 - self._shrinkage)
        return (x + x @ self._directions * growth @ self._directions.T) * np.float32(COMMON_SQUARE**0.5)

    def _augment_position(self, targets: Floats) -> Floats:
        """Augment (B, 2 + T) targets by normal noise, reflected at the bounds; force follows depth."""
        low, high = self._bounds
        gain = self._sampler.depth_gain
        std = self._std / (1 + gain * targets[:, 2:3]) if gain else self._std
        augmented = targets[:, :3] + std * self._sampler.rng.standard_normal((len(targets), len(self._std)))
        augmented = np.where(augmented < low, 2 * low - augmented, augmented)
        augmented = np.clip(np.where(augmented > high, 2 * high - augmented, augmented), -1, 1)
        forces = targets[:, 3:] + self._force_per_depth * (augmented - targets[:, :3])[:, 2:]
        return np.concatenate([augmented, forces], axis=1).astype(np.float32)


RETRAINING_STEPS = 150  # few, since the response is similar; with 400, errors are as large and networks overconfident
RETRAINING_AUGMENTATION = 1.4
"""Factor on `AUGMENTATION`, since presses are few; without it errors on an unchanged pad grow by a tenth."""


def retrain(
    networks: Networks,
    residual_network: Weights,
    presses: TrainingPresses,
    table: Floats,
    max_failures: int,
    rng: np.random.Generator,
    bayes: Sequence[BayesianLocalizer] = (),
) -> tuple[Networks, Weights]:
    """Fine-tune networks on presses of a pad with another response.

    Args:
        networks: to retrain, by phase.
        residual_network: to retrain, if it has weights.
        presses: of the pad.
        table: its scaled response by position; shape (S, S, C, F + G).
        max_failures: maximum number of masked fibres.
        rng: draws the seeds of the networks.
        bayes: Bayesian localizers that the residual network corrects.

    Returns:
        The retrained networks and residual network.
    """
    n_timed = presses.complete.shape[1]
    options = LocalizerSettings(max_failures=max_failures, learning_rate=1e-3)
    starts = [(name, weights, PHASES[n_timed][name], ()) for name, weights in networks.items()]
    if residual_network:
        starts += [(RESIDUAL, residual_network, RESIDUAL_PHASE if n_timed else PHASES[0]["press"], bayes)]
    tasks = []
    for name, weights, phase, corrected in starts:
        shared = name, phase, options, round(RETRAINING_STEPS * phase.length), corrected
        tasks += [TrainingTask(*shared, member, RETRAINING_AUGMENTATION) for member in unstack_members(weights)]
    trained, _ = run_trainings(tasks, presses, table, rng)
    return {name: trained[name] for name in networks}, trained.get(RESIDUAL, residual_network)
