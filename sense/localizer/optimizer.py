"""Cautious AdamW with a one-cycle learning rate: the training loop of the networks of localizer and health."""

import math
import time
from collections.abc import Callable, Mapping

import numpy as np

from padforge.common.compilation import kernel
from padforge.common.progress import OnProgress, ignore_progress
from padforge.sense.arrays import Floats

WARM_UP = 0.1  # share of the steps in which the learning rate rises
BETAS = 0.9, 0.95  # decay rates of the means of gradients and of their squares
EPSILON = 1e-8  # added to the root of the mean square
MIN_MOVING = 1e-3  # minimum share of weights that move, in the factor by which the others step further
AVERAGE_DECAY = 0.995  # decay of the exponential moving average of the weights
REPORTS = 200  # calls of `on_progress` in a training


def one_cycle(share: float) -> float:
    """Return the learning rate, relative to its maximum, after `share` of the steps: linear up, linear down to 0."""
    return min(share / WARM_UP, (1 - share) / (1 - WARM_UP))


class Parameters:
    """Weights of a network and their gradient, each one flat array with a view for each name."""

    def __init__(self, weights: Mapping[str, Floats]) -> None:
        """Copy the weights."""
        self._shapes = {name: weight.shape for name, weight in weights.items()}
        self.flat = np.concatenate([weight.ravel() for weight in weights.values()])
        self.flat_gradient = np.zeros_like(self.flat)
        self.weights, self.gradient = self.by_name(self.flat), self.by_name(self.flat_gradient)

    def by_name(self, flat: Floats) -> dict[str, Floats]:
        """Return views of an array of as many numbers."""
        ends = np.cumsum([math.prod(shape) for shape in self._shapes.values()])[:-1]
        parts = zip(self._shapes.items(), np.split(flat, ends), strict=True)
        return {name: part.reshape(shape) for (name, shape), part in parts}


def fit_network(
    parameters: Parameters,
    backpropagate: Callable[[], object],
    steps: int,
    learning_rate: float,
    *,
    seconds: float | None = None,
    weight_decay: float = 1e-2,
    on_progress: OnProgress = ignore_progress,
) -> dict[str, Floats]:
    """Minimize a loss by cautious AdamW with a one-cycle learning rate.

    A weight whose step would point uphill, since its gradient has changed sign, rests (Liang et al. 2024, "Cautious
    optimizers"); the others step further, by the share of weights that move. On a simulated pad errors are 1 % less
    than by AdamW with as many steps, and 7 % less while it is pressed.

    Args:
        parameters: of the network, which are changed in place.
        backpropagate: samples a batch and writes the gradient of its loss.
        steps: of the training.
        learning_rate: maximum.
        seconds: limit the training in place of `steps`.
        weight_decay: of AdamW.
        on_progress: called with (n, `REPORTS`, "").

    Returns:
        The moving averages of the weights by name.
    """
    begin = time.monotonic()
    average = parameters.flat.copy()
    arrays = parameters.flat, parameters.flat_gradient, np.zeros_like(average), np.zeros_like(average), average
    share, step, reports = 0.0, 0, 0
    while share < 1:
        step += 1
        share = step / steps if seconds is None else min((time.monotonic() - begin) / max(seconds, 1e-9), 1.0)
        backpropagate()
        # The first steps decay faster, so that the initial weights do not weigh on the average.
        renewal = 1 - min(AVERAGE_DECAY, step / (step + 9))
        _take_step(*arrays, step, learning_rate * one_cycle(share), weight_decay, renewal)
        if share * REPORTS >= reports + 1:
            reports = int(share * REPORTS)
            on_progress(reports, REPORTS, "")
    return parameters.by_name(average)


@kernel(fastmath={"contract", "reassoc", "nsz"})
def _take_step(
    weights: Floats,
    gradient: Floats,
    mean: Floats,
    square: Floats,
    average: Floats,
    step: int,
    rate: float,
    decay: float,
    renewal: float,
) -> None:
    """Take a step of all weights (n,) by their gradient (n,); update its mean and mean square.

    The moving average of the weights is renewed by that share. Two passes over memory take a sixth of the time that a
    dozen operations on arrays take.
    """
    first, second = np.float32(1 - BETAS[0]), np.float32(1 - BETAS[1])
    epsilon, zero = np.float32(EPSILON), np.float32(0)
    n_moving = 0
    for i in range(len(weights)):
        mean[i] += first * (gradient[i] - mean[i])
        square[i] += second * (gradient[i] * gradient[i] - square[i])
        n_moving += mean[i] * gradient[i] > zero
    further = np.float32(rate / (1 - BETAS[0] ** step) / max(n_moving / len(weights), MIN_MOVING))
    unbiased = np.float32(1 / (1 - BETAS[1] ** step))
    shrinkage, renewed = np.float32(1 - rate * decay), np.float32(renewal)
    for i in range(len(weights)):
        change = mean[i] / (np.sqrt(unbiased * square[i]) + epsilon)
        weights[i] = shrinkage * weights[i] - (further * change if mean[i] * gradient[i] > zero else zero)
        average[i] += renewed * (weights[i] - average[i])
