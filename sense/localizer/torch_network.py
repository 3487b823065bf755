"""The masked heteroscedastic ensemble in torch, for training; `network` is the same in NumPy, for inference."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from padforge.sense.localizer.bayes import BayesianLocalizer
from padforge.sense.localizer.network import EPSILON, Weights
from padforge.sense.settings import LocalizerSettings

FULL_SHARE = 0.25
"""Share of training presses that keep all fibres; others lose 1 .. `max_failures`, each number as often."""


class _Affine(nn.Module):
    def __init__(self, w: Tensor, b: Tensor) -> None:
        super().__init__()
        self.w, self.b = nn.Parameter(w), nn.Parameter(b)


class EnsembleMlp(nn.Module):
    """Ensemble of residual MLPs; the names and shapes of its parameters are those of `network.Weights`."""

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.first, self.hidden, self.last = (
            _Affine(weights[f"{name}.w"].clone(), weights[f"{name}.b"].clone()) for name in ("first", "hidden", "last")
        )

    @classmethod
    def random(
        cls, n_inputs: int, n_outputs: int, options: LocalizerSettings, generator: torch.Generator
    ) -> "EnsembleMlp":
        """Draw the first weights of one member of the size in `options`, on the device of the generator."""
        hidden, layers, device = options.hidden, options.layers, generator.device

        def normal(*shape: int, gain: float = 1.0) -> Tensor:
            return torch.randn(*shape, generator=generator, device=device) * (gain / shape[-2] ** 0.5)

        return cls(
            {
                "first.w": normal(1, n_inputs, hidden),
                "first.b": torch.zeros(1, 1, hidden, device=device),
                "hidden.w": normal(layers, 1, hidden, hidden, gain=0.5),
                "hidden.b": torch.zeros(layers, 1, 1, hidden, device=device),
                "last.w": normal(1, hidden, n_outputs, gain=0.3),
                "last.b": torch.zeros(1, 1, n_outputs, device=device),
            }
        )

    @classmethod
    def from_numpy(cls, weights: Weights) -> "EnsembleMlp":
        """Convert the weights of an ensemble."""
        return cls({name: torch.from_numpy(weight) for name, weight in weights.items()})

    @property
    def n_members(self) -> int:
        """E."""
        return self.first.w.shape[0]

    def forward(self, x: Tensor) -> Tensor:
        """Return (E, B, 2 N) outputs for (E, B, D) inputs, as `network.forward`."""
        h = torch.baddbmm(self.first.b, x, self.first.w)
        for w, b in zip(self.hidden.w, self.hidden.b, strict=True):
            h = h + torch.baddbmm(b, _activate(h), w)
        return torch.baddbmm(self.last.b, _activate(h), self.last.w)

    def forward_bfloat16(self, x: Tensor) -> Tensor:
        """Return the outputs to about 1 %, four times as fast, if the processor has bfloat16; or `forward`."""
        supported = getattr(torch.cpu, "get_capabilities", dict)().get("avx512_bf16", False)
        with torch.autocast("cpu", torch.bfloat16, enabled=supported):
            return self.forward(x).float()


def _activate(h: Tensor) -> Tensor:
    width = int(h.shape[-1])  # a plain number also where the network is traced for export
    return functional.gelu(functional.layer_norm(h, (width,), eps=EPSILON))


def sample_fibre_dropout(batch: int, fibres: int, max_failures: int, generator: torch.Generator) -> Tensor:
    """Sample (B, C) masks in which all fibres are kept, or 1 .. `max_failures` are masked, each set equally likely."""
    device = generator.device
    count = torch.randint(1, max(max_failures, 1) + 1, (batch, 1), generator=generator, device=device)
    full = torch.rand(batch, 1, generator=generator, device=device) < (FULL_SHARE if max_failures else 1.0)
    rank = torch.rand(batch, fibres, generator=generator, device=device).argsort(dim=1)
    return (rank >= count) | full


def network_inputs(
    features: Tensor, fibre_mask: Tensor, seen: Tensor, bayes: BayesianLocalizer | None
) -> tuple[Tensor, Tensor]:
    """Return the (B, D) inputs of a network and the (B, 2) position that it corrects, or 0 without `bayes`.

    The posterior summary of `bayes`, which is in tensors, is an input beside features (B, C, F) and masks (B, C) and
    (B, K).
    """
    timed = functional.pad(seen, (0, features.shape[2] - seen.shape[1]), value=True)
    masked = torch.where(fibre_mask[..., None] & timed[:, None], features, 0.0)
    x = torch.cat([masked.flatten(1), fibre_mask.to(features.dtype), seen.to(features.dtype)], dim=1)
    if bayes is None:
        return x, x.new_zeros(())
    with torch.no_grad():
        position, summary = bayes.predict(features, fibre_mask, torch)
    return torch.cat([x, summary], dim=1), position
