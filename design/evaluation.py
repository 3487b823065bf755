"""The paper's evaluation by simulation: how far off a freshly trained localizer finds presses, fibres lost or not."""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .contact import boustrophedon, signals
from .errors import InputError
from .losses import lost_subsets
from .morphology import Morphology
from .settings import Contact

Array = NDArray[np.float64]

JITTER = 5 / 49
"""Greatest shift of a press off its serpentine, grid units, as published."""


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


def evaluate(
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
        contact: the published default if None.
        lost: numbers of lost fibres; those that would leave no fibre are left out.
        seed: of the jitter, the test presses, the splits and the networks' first weights.
        hidden: neurons of a network.
        presses: to train on, a square number: a serpentine over 1..M (over 0.5..1.5 for a grid of 1).
        test: fresh presses, drawn uniformly over the same square.
        subsets: at most so many sets of a number of lost fibres, always the same; all if None.

    Raises:
        InputError: `presses` is no square of a number from 2, or there is nothing to test on or to lose.
    """
    side = math.isqrt(max(presses, 0))
    if side**2 != presses or side < 2:
        raise InputError(f"presses is {presses}, allowed is a square number from 4")
    if test < 1 or min(lost, default=0) < 0 or (subsets is not None and subsets < 1):
        raise InputError(
            f"test is {test}, lost {lost}, subsets {subsets}, allowed is test >= 1, lost >= 0, subsets >= 1"
        )
    fibres = 2 * pad.grid
    levels = [number for number in lost if number < fibres]
    losses = [lost_subsets(fibres, number, subsets or math.comb(fibres, number)) for number in levels]
    learned, fresh = training_presses(pad.grid, side, seed), fresh_presses(pad.grid, test, seed)
    recorded, found = signals(pad, learned, contact), signals(pad, fresh, contact)

    def error(loss: tuple[int, ...]) -> float:
        from .levenberg_marquardt import fit

        kept = np.setdiff1d(np.arange(fibres), loss)
        rng = np.random.default_rng([2, seed, len(loss), *loss])
        network = fit(recorded[:, kept], learned, rng, hidden)
        return float(np.linalg.norm(network(found[:, kept]) - fresh, axis=1).mean())

    errors = _side_by_side(error, [loss for level in losses for loss in level])
    ends = np.cumsum([len(level) for level in losses])[:-1]
    return [
        LossError(number, len(level), float(level.mean()), float(level.std()), float(level.max()))
        for number, level in zip(levels, np.split(np.array(errors), ends), strict=True)
    ]


def _side_by_side(error: Callable[[tuple[int, ...]], float], losses: list[tuple[int, ...]]) -> list[float]:
    """error(loss) of every loss, one thread a core, torch on one thread in each: it lets go of the interpreter."""
    import torch

    threads = torch.get_num_threads()
    try:
        with ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(error, losses))
    finally:
        torch.set_num_threads(threads)


def training_presses(grid: int, side: int, seed: int) -> Array:
    """(side^2, 2) presses of a jittered serpentine over the square that is evaluated, grid units."""
    jitter_seed = int(np.random.default_rng([0, seed]).integers(2**32))
    if grid == 1:
        return boustrophedon(2, side, JITTER, jitter_seed) - 0.5
    return boustrophedon(grid, side, JITTER, jitter_seed)


def fresh_presses(grid: int, count: int, seed: int) -> Array:
    """(count, 2) presses drawn uniformly over the square that is evaluated, grid units."""
    low, high = (1, grid) if grid > 1 else (0.5, 1.5)
    return np.random.default_rng([1, seed]).uniform(low, high, (count, 2))
