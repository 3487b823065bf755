"""The paper's evaluation by simulation: how far off a freshly trained localizer finds presses, fibres lost or not."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from padforge.design.common.computing import one_torch_thread, run_tasks
from padforge.design.common.errors import InputError, instance, shown, whole
from padforge.design.common.settings import or_default
from padforge.design.criteria.fibre_loss import lost_subsets
from padforge.design.pad.contact import boustrophedon, signals
from padforge.design.pad.knots import Array
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import MOST_FIBRES, PUBLISHED_CONTACT, Contact, Rectangle, Sensed, sensed_rectangle

from .levenberg_marquardt import Network, best_device, fit_many

Loss = tuple[int, ...]
"""Fibres that are lost, by index."""

JITTER = 5 / 49
"""Greatest shift of a press off its serpentine, grid units, as published."""
MOST_PRESSES, MOST_NETWORKS = 2**20, 2**20
BATCH = 14
"""Networks trained at once by a core, which gains nothing from more; a GPU takes all of a level."""


@dataclass(frozen=True)
class LossError:
    """Localisation error with some fibres lost, in grid units, over the sets of fibres that may be lost.

    Attributes:
        lost: how many fibres. subsets: how many sets of them were lost in turn.
        mean, std, max: of the sets' mean Euclidean distances.
    """

    lost: int
    subsets: int
    mean: float
    std: float
    max: float


def localisation_error(
    pad: Morphology,
    contact: Contact | None = None,
    lost: Sequence[int] = (0, 1, 2, 3),
    seed: int = 0,
    hidden: int = 50,
    presses: int = 1024,
    test: int = 2000,
    subsets: int | None = None,
) -> list[LossError]:
    """The error of the published localizer, trained afresh for every set of lost fibres (paper, evaluation).

    It is taken over presses that were never trained on; the paper's own figures are over all presses, those trained on
    included, and so are lower. Networks are trained side by side, one thread a core, and do not depend on how many.

    Args:
        contact: PUBLISHED_CONTACT if None.
        lost: numbers of lost fibres; those that would leave no fibre are left out.
        seed: of the jitter, the test presses, the splits and the networks' first weights.
        hidden: neurons of a network.
        presses: to train on, a square number: a serpentine over 1..M (over 0.5..1.5 for a grid of 1), as published;
            `PressSets` has them anywhere.
        test: fresh presses, drawn uniformly over the same square.
        subsets: at most so many sets of a number of lost fibres, always the same; all if None.

    Raises:
        InputError: `presses` is no square of a number from 2, there is nothing to test on, or too much to do.
    """
    presses = whole("presses", presses, 4, MOST_PRESSES)
    side = math.isqrt(presses)
    if side**2 != presses:
        raise InputError(f"presses is {presses}, allowed is a square number from 4")
    test, hidden = whole("test", test, 1, MOST_PRESSES), whole("hidden", hidden, 1, 1000)
    seed, contact = whole("seed", seed, 0, 2**64 - 1), or_default("contact", contact, Contact, PUBLISHED_CONTACT)
    fibres = len(instance("pad", pad, Morphology).knots)
    if not isinstance(lost, Sequence) or isinstance(lost, str):
        raise InputError(f"lost is {shown(lost)}, expected numbers of lost fibres")
    levels = [number for number in lost if whole("lost", number, 0, 2 * MOST_FIBRES) < fibres]
    sets = [math.comb(fibres, number) for number in levels]
    if subsets is not None:
        sets = [min(all_of_them, whole("subsets", subsets, 1, MOST_NETWORKS)) for all_of_them in sets]
    if sum(sets) > MOST_NETWORKS:
        raise InputError(f"subsets is {subsets}: that takes {sum(sets)} networks, allowed are {MOST_NETWORKS}")
    losses = [lost_subsets(fibres, number, most) for number, most in zip(levels, sets, strict=True)]
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

    def loss_errors(self, losses: Sequence[Sequence[Loss]], hidden: int) -> list[LossError]:
        """Errors of networks of `hidden` neurons with fibres lost: for each number of them, over the sets given."""

        def means(batch: list[Loss]) -> Array:
            networks = self.learn(batch, hidden)
            return np.array([self.errors(*pair).mean() for pair in zip(networks, batch, strict=True)])

        parts = {(at, k): batch for at, level in enumerate(losses) for k, batch in enumerate(batches(level))}
        with one_torch_thread():
            found = dict(run_tasks((key, partial(means, batch)) for key, batch in parts.items()))
        by_level = [np.concatenate([found[key] for key in parts if key[0] == at]) for at in range(len(losses))]
        return [
            LossError(len(sets[0]), len(level), float(level.mean()), float(level.std()), float(level.max()))
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
    return boustrophedon(rectangle, side, JITTER, jitter_seed)


def fresh_presses(rectangle: Rectangle, count: int, seed: int) -> Array:
    """(count, 2) presses drawn uniformly over a rectangle, grid units."""
    low, high = rectangle
    return np.random.default_rng([1, seed]).uniform(low, high, (count, 2))
