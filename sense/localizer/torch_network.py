"""The masked heteroscedastic ensemble in torch, for training; `network` is the same in NumPy, for inference."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from padforge.sense.localizer.network import EPSILON, Weights
from padforge.sense.settings import LocalizerSettings


class _Affine(nn.Module):
    def __init__(self, w: Tensor, b: Tensor) -> None:
        super().__init__()
        self.w, self.b = nn.Parameter(w), nn.Parameter(b)


class EnsembleMlp(nn.Module):
    """Ensemble of residual MLPs.

    Its parameters are those of `network.Weights`, but with an array for each hidden layer, such as `hidden.0.w`: a step
    would take a twentieth longer if it copied the gradients of all layers into one array.
    """

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.first, self.last = (
            _Affine(weights[f"{name}.w"].clone(), weights[f"{name}.b"].clone()) for name in ("first", "last")
        )
        layers = zip(weights["hidden.w"], weights["hidden.b"], strict=True)
        self.hidden = nn.ModuleList(_Affine(w.clone(), b.clone()) for w, b in layers)

    @classmethod
    def random(
        cls, n_inputs: int, n_outputs: int, options: LocalizerSettings, generator: torch.Generator
    ) -> "EnsembleMlp":
        """Draw the first weights of one member of the size in `options`."""
        hidden, layers = options.hidden, options.layers

        def normal(*shape: int, gain: float = 1.0) -> Tensor:
            return torch.randn(*shape, generator=generator) * (gain / shape[-2] ** 0.5)

        return cls(
            {
                "first.w": normal(1, n_inputs, hidden),
                "first.b": torch.zeros(1, 1, hidden),
                "hidden.w": normal(layers, 1, hidden, hidden, gain=0.5),
                "hidden.b": torch.zeros(layers, 1, 1, hidden),
                "last.w": normal(1, hidden, n_outputs, gain=0.3),
                "last.b": torch.zeros(1, 1, n_outputs),
            }
        )

    @classmethod
    def from_numpy(cls, weights: Weights) -> "EnsembleMlp":
        """Convert the weights of an ensemble."""
        return cls({name: torch.from_numpy(weight) for name, weight in weights.items()})

    @staticmethod
    def join(parameters: Weights) -> Weights:
        """Return the weights of an ensemble from its parameters by name: hidden layers are stacked."""
        weights = {name: weight for name, weight in parameters.items() if not name.startswith("hidden.")}
        for kind in "w", "b":
            layers = [weight for name, weight in parameters.items() if name.startswith("hidden.") and name[-1] == kind]
            weights[f"hidden.{kind}"] = np.stack(layers)
        return weights

    @property
    def n_members(self) -> int:
        """Number of members, E."""
        return self.first.w.shape[0]

    def forward(self, x: Tensor) -> Tensor:
        """Return (E, B, 2 N) outputs for (E, B, I) inputs, as `network.forward`."""
        h = torch.baddbmm(self.first.b, x, self.first.w)
        for layer in self.hidden:
            h = h + torch.baddbmm(layer.b, _activate(h), layer.w)
        return torch.baddbmm(self.last.b, _activate(h), self.last.w)

    def forward_bfloat16(self, x: Tensor) -> Tensor:
        """Return the outputs to about 1 %, four times as fast, if the processor has bfloat16; or `forward`."""
        supported = getattr(torch.cpu, "get_capabilities", dict)().get("avx512_bf16", False)
        with torch.autocast("cpu", torch.bfloat16, enabled=supported):
            return self.forward(x).float()


def _activate(h: Tensor) -> Tensor:
    width = int(h.shape[-1])  # a plain number also where the network is traced for export
    return functional.relu(functional.layer_norm(h, (width,), eps=EPSILON))
