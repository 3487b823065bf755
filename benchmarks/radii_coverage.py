"""How often presses lie within their predicted radii, on test presses of many simulated recordings.

`python -m padforge.benchmarks.radii_coverage RECORDINGS SEED` prints a line per recording, and at the end the means
over all recordings with their standard errors: the shares of presses within the radii of 50 and 90 %, by number of
failed fibres.
"""

import math
import sys

import numpy as np
from numpy.typing import NDArray

from padforge.common.parallel import one_thread
from padforge.design import Morphology
from padforge.sense import LocalizerSettings, RigSettings, calibrate, simulate

PRESSES = (300, 3000)
GRIDS = (2, 3, 4, 5)  # grids of the pads; the smallest has four fibres, of which three may fail
MAX_KNOTS = 6
SPLITS = ("chronological", "random")
SETTINGS = LocalizerSettings(members=2, hidden=64, layers=3, epochs=240, max_failures=3)
"""Enough to localize at all: the radii are to hold however good a localizer is."""


def measure_coverage(number: int, seed: int) -> tuple[str, str, NDArray[np.float64]]:
    """Simulate presses on a random pad, calibrate on a part and test on the others.

    Returns the pad in words, how test presses were chosen, and the shares of test presses within the radii of 50 and
    90 %, with 0 to 3 failed fibres; shape (4, 2).
    """
    rng = np.random.default_rng([seed, number])
    grid, is_straight = int(rng.choice(GRIDS)), bool(rng.integers(2))
    knots = int(rng.integers(1, MAX_KNOTS + 1))
    pad = Morphology.straight(grid) if is_straight else Morphology.random(grid, knots, seed=rng)
    presses = round(math.exp(rng.uniform(*np.log(PRESSES))))
    recording = simulate(pad, RigSettings(presses=presses, seed=int(rng.integers(2**32))))
    split = SPLITS[number % 2]
    _, evaluation = calibrate(recording, SETTINGS.model_copy(update={"split": split, "seed": int(rng.integers(2**32))}))
    name = f"grid {grid}, {'straight' if is_straight else f'random, {knots} knots'}, {presses} presses"
    return name, split, np.array([[row["within_r50"], row["within_r90"]] for row in evaluation.errors])


def main(recordings: int, seed: int) -> None:
    """Print the coverage of every recording, and the means of each split and of all."""
    results = []
    for number in range(recordings):
        name, split, shares = measure_coverage(number, seed)
        results.append((split, shares))
        print(
            f"{number:>4}  {name:<36} {split:<13} r50 {shares[:, 0].round(3)}  r90 {shares[:, 1].round(3)}", flush=True
        )
    for name in (*SPLITS, "all"):
        shares = np.array([shares for split, shares in results if name in (split, "all")])
        if len(shares) > 1:
            mean, error = shares.mean(axis=0), shares.std(axis=0, ddof=1) / math.sqrt(len(shares))
            for column, share in enumerate((50, 90)):
                cells = "  ".join(f"{m:.4f} +- {e:.4f}" for m, e in zip(mean[:, column], error[:, column], strict=True))
                print(f"{name}, {len(shares)} recordings, within r{share} with 0.. failed fibres: {cells}")


if __name__ == "__main__":
    with one_thread():
        main(int(sys.argv[1]), int(sys.argv[2]))
