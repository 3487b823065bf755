"""How often presses lie within the radii that a localizer tells, on test presses of many simulated recordings.

`python -m padforge.benchmarks.radii_coverage RECORDINGS SEED` prints a line per recording, and at the end the means
over all recordings with their standard errors: the share of presses within the radii of 50 and 90 %, by number of lost
fibres.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from padforge.common.parallel import one_torch_thread
from padforge.design import Morphology
from padforge.sense import LocalizerSettings, RigSettings, calibrate, simulate

PRESSES = (300, 3000)
GRIDS = (2, 3, 4, 5)
"""The least has four fibres, of which three may be lost."""
MOST_KNOTS = 6
SPLITS = ("chronological", "random")
LEARNT = LocalizerSettings(members=2, hidden=64, layers=3, epochs=240, max_failures=3)
"""Enough to find places at all: the radii are to hold however good a localizer is."""


@dataclass(frozen=True)
class Covered:
    """What one recording has shown.

    Attributes:
        pad: in words. presses: of the recording. tested: how many of them. split: how these were chosen.
        within: (4, 2) shares of test presses within the radii of 50 and 90 %, with 0 to 3 fibres lost.
    """

    pad: str
    presses: int
    tested: int
    split: str
    within: np.ndarray

    def __str__(self) -> str:
        radii = "  ".join(
            f"r{share}" + "".join(f" {value:.3f}" for value in self.within[:, column])
            for column, share in enumerate((50, 90))
        )
        return f"{self.pad:<22} {self.presses:>4} presses, {self.tested:>3} tested, {self.split:<13} {radii}"


def covered(number: int, seed: int) -> Covered:
    """Record presses on a pad, both drawn by `number` and `seed`, learn from a part and test on the rest."""
    rng = np.random.default_rng([seed, number])
    grid, straight = int(rng.choice(GRIDS)), bool(rng.integers(2))
    knots = int(rng.integers(1, MOST_KNOTS + 1))
    pad = Morphology.straight(grid) if straight else Morphology.random(grid, knots, seed=rng)
    presses = round(math.exp(rng.uniform(*np.log(PRESSES))))
    recording = simulate(pad, RigSettings(presses=presses, seed=int(rng.integers(2**32))))
    split = SPLITS[number % 2]
    _, evaluation = calibrate(recording, LEARNT.model_copy(update={"split": split, "seed": int(rng.integers(2**32))}))
    within = np.array([[row["within_r50"], row["within_r90"]] for row in evaluation.errors])
    name = f"grid {grid}, {'straight' if straight else f'random, {knots} knots'}"
    return Covered(name, presses, evaluation.test_presses, split, within)


def summary(found: Sequence[Covered]) -> list[str]:
    """Means over recordings and their standard errors, a line for each split and one for all."""
    lines = []
    for name in (*SPLITS, "all"):
        shares = np.array([each.within for each in found if name in (each.split, "all")])
        if len(shares) < 2:
            continue
        mean, error = shares.mean(axis=0), shares.std(axis=0, ddof=1) / math.sqrt(len(shares))
        for column, share in enumerate((50, 90)):
            told = "  ".join(f"{mean[lost, column]:.4f} +- {error[lost, column]:.4f}" for lost in range(len(mean)))
            lines.append(f"{name}, {len(shares)} recordings, within r{share} with 0.. fibres lost: {told}")
    return lines


def main(recordings: int, seed: int) -> None:
    """Print what each of so many recordings shows, as it is known, and what they show together."""
    found = []
    for number in range(recordings):
        found.append(covered(number, seed))
        print(f"{number:>4}  {found[-1]}", flush=True)
    print("\n".join(summary(found)), flush=True)


if __name__ == "__main__":
    with one_torch_thread():
        main(int(sys.argv[1]), int(sys.argv[2]))
