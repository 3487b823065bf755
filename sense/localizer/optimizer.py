"""Cautious AdamW with a one-cycle learning rate: the training loop of the networks of localizer and health."""

import time
from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

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


def fit_network(
    parameters: Mapping[str, Tensor],
    loss_of_batch: Callable[[], Tensor],
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
        parameters: weights by name, which require gradients and are changed in place.
        loss_of_batch: samples a batch and returns its loss.
        steps: of the training.
        learning_rate: maximum.
        seconds: limit the training in place of `steps`.
        weight_decay: of AdamW.
        on_progress: called with (n, `REPORTS`, "").

    Returns:
        The moving averages of the weights by name.
    """
    begin = time.monotonic()
    weights = list(parameters.values())
    sizes, shapes = [weight.numel() for weight in weights], [weight.shape for weight in weights]
    flat = torch.cat([weight.detach().flatten() for weight in weights])
    gradient = torch.zeros_like(flat)
    for weight, shape, values, slopes in zip(weights, shapes, flat.split(sizes), gradient.split(sizes), strict=True):
        weight.data, weight.grad = values.view(shape), slopes.view(shape)  # one step for all
    average = flat.numpy().copy()
    arrays = flat.numpy(), gradient.numpy(), np.zeros_like(average), np.zeros_like(average), average
    share, step, reports = 0.0, 0, 0
    torch.set_flush_denormal(True)  # denormal numbers, to which moments of vanishing gradients decay, are slow
    try:
        while share < 1:
            step += 1
            share = step / steps if seconds is None else min((time.monotonic() - begin) / max(seconds, 1e-9), 1.0)
            loss_of_batch().backward()
            # The first steps decay faster, so that the initial weights do not weigh on the average.
            renewal = 1 - min(AVERAGE_DECAY, step / (step + 9))
            _take_step(*arrays, step, learning_rate * one_cycle(share), weight_decay, renewal)
            if share * REPORTS >= reports + 1:
                reports = int(share * REPORTS)
                on_progress(reports, REPORTS, "")
    finally:
        torch.set_flush_denormal(False)
    ends = np.cumsum(sizes)[:-1]
    fitted = zip(parameters, shapes, np.split(average, ends), strict=True)
    return {name: values.reshape(shape) for name, shape, values in fitted}


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
    """Take a step of all weights (n,) by their gradient (n,), which becomes 0; update its mean and mean square.

    The moving average of the weights is renewed by that share. In two passes over memory it takes a sixth of the time
    that a dozen operations of torch take.
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
        gradient[i] = zero
