"""Adapting a trained network to a pad that has changed a little, by few presses: needs torch.

So few presses would drag a network of thousands of weights after their own noise. So every step looks at two sets of
presses: the new ones, moved by a few millimetres as in `training`, whose places are known; and the new ones moved
anywhere on the pad, whose places the network is to go on finding where it found them before (Li & Hoiem 2016, Learning
without forgetting). The more presses there are, the more the first count. Expected errors stay as they were.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from padforge.design.common.parallel import one_torch_thread
from padforge.sense.health.trained_model import one_cycle
from padforge.sense.localizer.network import Weights
from padforge.sense.localizer.response.observer import Observer
from padforge.sense.recordings.processing.limits import Floats

from padforge.sense.localizer.calibration.networks.masked_network import draw_alive, entries, forward, inputs_at, misses
from padforge.sense.localizer.calibration.networks.training_presses import TrainingPresses
from padforge.sense.localizer.calibration.training import INPUT_NOISE

STEPS, BATCH, RATE = 200, 128, 1e-4
"""Enough to follow what drifts and too little to forget: errors hardly change for half and twice as much."""
OLD_PRESSES = 100
"""New presses that count as much as what was learnt before."""
MOVED = 0.09
"""Standard deviation of the way a press is moved, in units of the span: 2 mm on a pad of 45 mm."""
FAR_NOISE = 0.1
"""Noise on the scaled inputs of presses moved anywhere, which is less sure than a move by millimetres."""
SPREAD_KEPT = 0.02
"""Weight of keeping the logarithms of expected errors, beside the places."""


def adapt(
    weights: Weights,
    samples: TrainingPresses,
    table: Floats,
    lost: int,
    rng: np.random.Generator,
    progress: Callable[[int], None] = lambda steps: None,
    observer: Observer | None = None,
) -> Weights:
    """Adapt the members of a network of method "masked", or the network that corrects an observer.

    Args:
        weights: as `network.forward` takes them.
        samples: presses of known place, depth and force, where these were learnt.
        table: (S, S, C, F) scaled inputs by place, over [-1, 1] in x and y.
        lost: fibres that are lost at once, at most, while adapting.
        rng: source of the seed of torch's generator, which draws all that is random here.
        progress: called with the steps done since it was last called.
        observer: what they correct, if anything; it stays as it is.

    Returns:
        Weights of the same shapes.
    """
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    before = {name: torch.from_numpy(weight) for name, weight in weights.items()}
    now = {name: weight.clone().requires_grad_() for name, weight in before.items()}
    presses = _Presses(samples, table, min(lost, samples.inputs.shape[1] - 1), generator, observer)
    members = len(now["first.w"])
    trust = len(samples.inputs) / (len(samples.inputs) + OLD_PRESSES)
    optimizer = torch.optim.Adam(now.values(), lr=RATE)
    with one_torch_thread():
        for number in range(1, STEPS + 1):
            optimizer.param_groups[0]["lr"] = RATE * one_cycle(number / STEPS)
            optimizer.zero_grad()
            known, left = presses.nearby()
            off = forward(now, known.expand(members, -1, -1))[..., : left.shape[1]] - left
            loss = trust * misses(off).mean(dim=1).sum()
            known = presses.anywhere().expand(members, -1, -1)
            with torch.no_grad():
                found = forward(before, known)
            loss = loss + (1 - trust) * _change(forward(now, known), found)
            loss.backward()
            optimizer.step()
            progress(1)
    return {name: weight.detach().numpy() for name, weight in now.items()}


class _Presses:
    """Draws presses that resemble the known ones."""

    def __init__(
        self,
        samples: TrainingPresses,
        table: Floats,
        lost: int,
        generator: torch.Generator,
        observer: Observer | None,
    ) -> None:
        self._x, self._alive, self._y = (torch.from_numpy(a) for a in (samples.inputs, samples.alive, samples.targets))
        self._table, self._stretch = torch.from_numpy(table).flatten(2), samples.stretch
        self._at_home = inputs_at(self._table, self._y, self._stretch)
        self._lost, self._generator = lost, generator
        self._observer = observer and observer.changed(torch.from_numpy)

    def nearby(self) -> tuple[Tensor, Tensor]:
        """Entries (1, B, D) and what is to be found of them (B, 2 + T), of presses moved by a few millimetres."""
        rows = self._rows()
        targets = self._at(rows, (self._y[rows, :2] + MOVED * self._normal(BATCH, 2)).clamp(-1, 1))
        known, found = self._entries(rows, targets, INPUT_NOISE)
        return known, targets - found

    def anywhere(self) -> Tensor:
        """Entries (1, B, D) of presses moved to any place of the pad."""
        rows = self._rows()
        anywhere = 2 * torch.rand(BATCH, 2, generator=self._generator) - 1
        return self._entries(rows, self._at(rows, anywhere), FAR_NOISE)[0]

    def _rows(self) -> Tensor:
        return torch.randint(len(self._x), (BATCH,), generator=self._generator)

    def _at(self, rows: Tensor, places: Tensor) -> Tensor:
        """(B, 2 + T) targets of presses at other places, as deep and forceful as they were."""
        return torch.cat([places, self._y[rows, 2:]], dim=1)

    def _entries(self, rows: Tensor, targets: Tensor, noise: float) -> tuple[Tensor, Tensor]:
        moved = (inputs_at(self._table, targets, self._stretch) - self._at_home[rows]).view_as(self._x[rows])
        inputs = self._x[rows] + moved
        inputs = inputs + noise * self._normal(*inputs.shape)
        alive = self._alive[rows] & draw_alive(BATCH, self._x.shape[1], self._lost, self._generator)
        known, found = entries(inputs, alive, self._observer)
        return known[None], found

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator)


def _change(found: Tensor, before: Tensor) -> Tensor:
    """How far what is found and expected errors (E, B, 2 N) moved, summed over members."""
    change, logs = (found - before).chunk(2, dim=2)
    return (misses(change) + SPREAD_KEPT * logs.abs().mean(dim=2)).mean(dim=1).sum()
