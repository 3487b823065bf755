"""One residual MLP of the localizer in training: its outputs for a batch, and the gradient by its weights.

The network is that of `network.forward`. A step consists of matrix products by BLAS, and of one kernel a layer for all
between them, in memory that is allocated once. A general framework needs a third more time for networks as small as
these.
"""

import numpy as np

from padforge.common.compilation import kernel
from padforge.sense.arrays import Floats
from padforge.sense.localizer.network import EPSILON, Weights
from padforge.sense.localizer.optimizer import Parameters
from padforge.sense.settings import LocalizerSettings


def random_weights(
    n_inputs: int, n_outputs: int, options: LocalizerSettings, rng: np.random.Generator
) -> dict[str, Floats]:
    """Draw the first weights of one member of the size in `options`."""
    hidden, layers = options.hidden, options.layers

    def normal(*shape: int, gain: float = 1.0) -> Floats:
        return rng.standard_normal(shape, np.float32) * np.float32(gain / shape[-2] ** 0.5)

    return {
        "first.w": normal(1, n_inputs, hidden),
        "first.b": np.zeros((1, 1, hidden), np.float32),
        "hidden.w": normal(layers, 1, hidden, hidden, gain=0.5),
        "hidden.b": np.zeros((layers, 1, 1, hidden), np.float32),
        "last.w": normal(1, hidden, n_outputs, gain=0.3),
        "last.b": np.zeros((1, 1, n_outputs), np.float32),
    }


class TrainableMlp:
    """One member of an ensemble, for batches of one size."""

    def __init__(self, weights: Weights, batch: int) -> None:
        """Copy the weights of an ensemble of one."""
        self.parameters = Parameters(weights)
        n_layers, _, _, hidden = weights["hidden.w"].shape
        # by layer, from the first one on: its normalized sum, and what the next layer multiplies
        self._normalized, self._active = np.empty((2, n_layers + 1, batch, hidden), np.float32)
        self._inverse_std = np.empty((n_layers + 1, batch), np.float32)
        self._sum, self._term = np.empty((2, batch, hidden), np.float32)

    def forward(self, x: Floats) -> Floats:
        """Return the (B, 2 N) outputs for (B, I) inputs."""
        weights = self.parameters.weights
        factors = weights["first.w"][0], *weights["hidden.w"][:, 0]
        biases = weights["first.b"][0, 0], *weights["hidden.b"][:, 0, 0]
        self._x, active = x, x
        self._sum.fill(0)
        for layer, (factor, bias) in enumerate(zip(factors, biases, strict=True)):
            np.matmul(active, factor, out=self._term)
            active = self._active[layer]
            _activate(self._sum, self._term, bias, self._normalized[layer], active, self._inverse_std[layer])
        return active @ weights["last.w"][0] + weights["last.b"][0]

    def backward(self, grad_outputs: Floats) -> None:
        """Write the gradient by the weights, given that by the (B, 2 N) outputs of the latest `forward`."""
        weights, gradient = self.parameters.weights, self.parameters.gradient
        grad_factors = gradient["first.w"][0], *gradient["hidden.w"][:, 0]
        grad_biases = gradient["first.b"][0, 0], *gradient["hidden.b"][:, 0, 0]
        factors_after = *weights["hidden.w"][:, 0], weights["last.w"][0]
        np.matmul(self._active[-1].T, grad_outputs, out=gradient["last.w"][0])
        np.sum(grad_outputs, axis=0, out=gradient["last.b"][0, 0])
        grad_sum, grad_term = self._sum, grad_outputs
        grad_sum.fill(0)
        for layer in reversed(range(len(self._active))):
            grad_active = np.matmul(grad_term, factors_after[layer].T, out=self._term)
            _activate_backward(
                grad_sum, grad_active, self._normalized[layer], self._inverse_std[layer], grad_biases[layer]
            )
            grad_term = grad_sum  # since the sum after a layer is that before it plus the term of the layer
            inputs = self._active[layer - 1] if layer else self._x
            np.matmul(inputs.T, grad_term, out=grad_factors[layer])


@kernel(fastmath={"contract", "reassoc", "nsz"})
def _activate(
    total: Floats, term: Floats, bias: Floats, normalized: Floats, active: Floats, inverse_std: Floats
) -> None:
    """Add a term and a bias to the sum (B, H); write its layer normalization, 1 / std (B,), and the rectified one."""
    size = np.float32(total.shape[1])
    for b in range(len(total)):
        mean = square = np.float32(0)
        for i in range(total.shape[1]):
            total[b, i] += term[b, i] + bias[i]
            mean += total[b, i]
        mean /= size
        for i in range(total.shape[1]):
            square += (total[b, i] - mean) * (total[b, i] - mean)
        inverse_std[b] = np.float32(1) / np.sqrt(square / size + np.float32(EPSILON))
        for i in range(total.shape[1]):
            normalized[b, i] = (total[b, i] - mean) * inverse_std[b]
            active[b, i] = max(normalized[b, i], np.float32(0))


@kernel(fastmath={"contract", "reassoc", "nsz"})
def _activate_backward(
    grad_sum: Floats, grad_active: Floats, normalized: Floats, inverse_std: Floats, grad_bias: Floats
) -> None:
    """Add the gradient that passes an activation to that by its sum (B, H); write that by its bias (H,).

    With z the normalization and g the gradient by z, which is 0 where z < 0, (g - mean(g) - z mean(g z)) / std passes.
    """
    size = np.float32(grad_sum.shape[1])
    grad_bias[:] = 0
    for b in range(len(grad_sum)):
        mean = projection = np.float32(0)
        for i in range(grad_sum.shape[1]):
            g = grad_active[b, i] if normalized[b, i] > 0 else np.float32(0)
            grad_active[b, i] = g
            mean += g
            projection += g * normalized[b, i]
        mean, projection = mean / size, projection / size
        for i in range(grad_sum.shape[1]):
            grad_sum[b, i] += inverse_std[b] * (grad_active[b, i] - mean - projection * normalized[b, i])
            grad_bias[i] += grad_sum[b, i]
