"""What a training draws: presses at random moments, moved to other positions, held still or sliding.

A press moved elsewhere responds as the table of the response says there, with its own residual. The response to a
finger that slides is the superposition of those to where it was, each as old as that is: so strokes are learnt from
presses.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from padforge.sense.arrays import Floats
from padforge.sense.localizer.bayes import N_SUMMARY, BayesianLocalizer, stage_of
from padforge.sense.localizer.features import DOWN, NOW
from padforge.sense.localizer.moments import N_DOWN, Phase
from padforge.sense.localizer.response_model import interpolate_grid
from padforge.sense.localizer.scaler import TrainingPresses
from padforge.sense.localizer.torch_network import network_inputs, sample_fibre_dropout

NOW_NOISE = 0.05  # of single readings, beside that of means
SPEEDS_MM_S = 2.0, 60.0  # range of their speeds, logarithmically uniform
LONGER = 40  # readings beyond `DOWN` for which a finger slides
RESIDUAL_MM = 10.0  # distance over which what a press leaves unexplained becomes another
SUDDEN = 4  # window of `DOWN` up to which a response follows the finger; what changes later follows as much later


class PressSampler:
    """Presses at random moments of a phase, whose features follow the response model to other targets."""

    def __init__(
        self,
        presses: TrainingPresses,
        table: Floats,
        max_failures: int,
        generator: torch.Generator,
        phase: Phase,
        bayes: Sequence[BayesianLocalizer],
    ) -> None:
        self.generator, self._device = generator, generator.device
        x, self.fibre_mask, self.targets = map(self._tensor, (presses.inputs, presses.fibre_mask, presses.targets))
        self.fibres, self.depth_gain = x.shape[1], presses.depth_gain
        self._table, self._max_failures = self._tensor(table).flatten(2), min(max_failures, self.fibres - 1)
        self._by_window = self._tensor(table).flatten(0, 1).swapaxes(1, 2)[:, :N_DOWN].contiguous()
        self._residual = x - self._expected(self.targets).view_as(x)
        self._seen, self._n_timed = self._tensor(presses.seen), presses.seen.shape[1]
        self._bayes = tuple(stage.map_arrays(self._tensor) for stage in bayes)
        self.n_inputs = self.fibres * (x.shape[2] + 1) + self._n_timed + (N_SUMMARY if bayes else 0)
        self._first, self._shares = phase.first, self._tensor(phase.shares)
        self._sliding = phase.sliding if presses.speed else 0.0
        self._speed, self._per_mm = presses.speed, presses.per_mm
        self._now_factor, self._now_offset = self._tensor(presses.now_factor), self._tensor(presses.now_offset)
        ends = [end for _, end in DOWN]
        self._ends = self._tensor([0, *ends, ends[-1] + 1])
        self._middle = self._tensor([(first + end - 1) / 2 for first, end in DOWN])
        self._window = self._tensor([max(sum(first <= n for first, _ in DOWN) - 1, 0) for n in range(ends[-1])])

    def draw(self, batch: int) -> Tensor:
        """Draw (B,) rows of presses."""
        return torch.randint(len(self.targets), (batch,), generator=self.generator, device=self._device)

    def normal(self, *shape: int) -> Tensor:
        """Draw normal numbers."""
        return torch.randn(*shape, generator=self.generator, device=self._device)

    def inputs(self, rows: Tensor, targets: Tensor, noise: float) -> tuple[Tensor, Tensor]:
        """Network inputs (1, B, D), and positions to correct, of presses moved to (B, 2 + T) targets."""
        residual, seen, bayes = self._residual[rows], self._seen[rows], None
        residual = residual + noise * self.normal(*residual.shape)
        features = self._expected(targets).view_as(residual) + residual
        n_complete = 0
        if self._n_timed:
            # With a Bayesian localizer a batch is at one moment, of which only one of these is needed.
            counts = self._draw_moments(1 if self._bayes else len(rows)).expand(len(rows))
            n_complete = int(counts[0])
            features = self._at(counts, features, residual, targets)
            seen = seen & (torch.arange(self._n_timed, device=self._device) < counts[:, None])
        if self._bayes:
            bayes = self._bayes[stage_of(n_complete, self._n_timed) or 0]
        dropout = sample_fibre_dropout(len(rows), self.fibres, self._max_failures, self.generator)
        x, position = network_inputs(features, self.fibre_mask[rows] & dropout, seen, bayes)
        return x[None], position

    def _draw_moments(self, batch: int) -> Tensor:
        """Draw (B,) numbers of complete windows."""
        return self._first + torch.multinomial(self._shares, batch, replacement=True, generator=self.generator)

    def _at(self, counts: Tensor, features: Tensor, residual: Tensor, targets: Tensor) -> Tensor:
        """Return features (B, C, F + G) at the moments when so many windows (B,) are complete.

        A finger that rests is now where it was in the windows of the latest readings.
        """
        begin, end = (self._ends[(counts + k).clamp(max=N_DOWN + 1)] for k in (0, 1))
        share = torch.rand(len(begin), generator=self.generator, device=self._device)
        last = begin + (share * (end - begin)).long() - 1  # reading of the press
        back = torch.arange(len(NOW), device=self._device)
        windows = self._window[(last[:, None] - back).clamp(0, len(self._window) - 1)]
        now = torch.take_along_dim(features[:, :, :N_DOWN], windows[:, None], dim=2)
        is_mapped = counts <= N_DOWN
        if n_sliding := round(self._sliding * len(counts)):
            is_mapped = is_mapped | (torch.arange(len(counts), device=self._device) < n_sliding)
            sliding = slice(n_sliding)
            down, of_now = self._slide(last[sliding], windows[sliding], residual[sliding], targets[sliding])
            features = torch.cat([torch.cat([down, features[sliding, :, N_DOWN:]], dim=2), features[n_sliding:]])
            now = torch.cat([of_now, now[n_sliding:]])
        timed = self._n_timed
        channels = torch.arange(self.fibres, device=self._device)[:, None]
        factor, offset = (
            each[channels, torch.arange(len(NOW), device=self._device), windows[:, None]]
            for each in (self._now_factor, self._now_offset)
        )
        now = now * factor + offset + NOW_NOISE * self.normal(*now.shape)
        now = torch.where(is_mapped[:, None, None], now, features[:, :, timed : timed + len(NOW)])
        return torch.cat([features[:, :, :timed], now, features[:, :, timed + len(NOW) :]], dim=2)

    def _slide(self, last: Tensor, windows: Tensor, residual: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
        """Return the windows (B, C, len(DOWN)) of a finger that slides to the targets, and those of now (B, C, n)."""
        low, high = torch.log(torch.tensor(SPEEDS_MM_S))
        batch, down = len(last), torch.arange(N_DOWN, device=self._device)
        speed, angle, longer = torch.rand(3, batch, 1, generator=self.generator, device=self._device)
        speed, angle = self._speed * torch.exp(low + speed * (high - low)), 2 * torch.pi * angle
        velocity = speed * torch.cat([torch.cos(angle), torch.sin(angle)], dim=1)
        end = last[:, None] + torch.where(last[:, None] >= self._ends[N_DOWN] - 1, longer.square() * LONGER, 0.0)
        back = torch.arange(len(NOW), device=self._device)
        time = torch.cat([self._middle.expand(batch, -1), end - back], dim=1)
        windows = torch.cat([down.expand(batch, -1), windows], dim=1)

        def distance(time: Tensor) -> Tensor:
            """(B, n, 2) from the targets back to where the finger was, from the touch on."""
            behind = (end - time.clamp(min=float(self._middle[1]))).clamp(min=0)
            return behind[:, :, None] * velocity[:, None]

        def response(window: Tensor, time: Tensor) -> Tensor:
            return self._window_response((targets[:, None, :2] - distance(time)).clamp(-1, 1), window)

        expected = response(windows.clamp(max=SUDDEN), time)
        for later in range(SUDDEN + 1, N_DOWN):
            # Windows of `DOWN` before it have not seen the change; those of now may have.
            behind = time[:, later:] - (self._middle[later] - self._middle[SUDDEN])
            window = torch.full_like(windows[:, later:], later)
            change = response(window, behind) - response(window - 1, behind)
            expected[:, later:] += torch.where((windows[:, later:] >= later)[:, :, None], change, 0.0)
        if self.depth_gain:
            expected = (1 + self.depth_gain * targets[:, None, 2:3]) * expected
        squared_mm = distance(time).square().sum(dim=2) / self._per_mm**2
        correlation = torch.exp(squared_mm / (-2 * RESIDUAL_MM**2))[:, None]
        of_down = residual[:, :, :N_DOWN]
        near, far = (torch.take_along_dim(each, windows[:, None], dim=2) for each in (of_down, of_down.roll(1, 0)))
        slid = expected.swapaxes(1, 2) + correlation * near + (1 - correlation.square()).sqrt() * far
        return slid[:, :, :N_DOWN], slid[:, :, N_DOWN:]

    def _window_response(self, positions: Tensor, windows: Tensor) -> Tensor:
        """Interpolate the responses (B, n, C) in single windows (B, n) at positions (B, n, 2)."""
        side = self._table.shape[0]
        cell = ((positions + 1) * ((side - 1) / 2)).clamp(0, side - 1 - 1e-3)
        lower = cell.floor()
        x, y = (cell - lower).unbind(-1)
        corner = (lower[..., 0] * side + lower[..., 1]).long() * self._by_window.shape[1] + windows
        flat, right, up = self._by_window.flatten(0, 1), self._by_window.shape[1], side * self._by_window.shape[1]
        x, y = x[..., None], y[..., None]
        near = (1 - y) * flat[corner] + y * flat[corner + right]
        return (1 - x) * near + x * ((1 - y) * flat[corner + up] + y * flat[corner + up + right])

    def _expected(self, targets: Tensor) -> Tensor:
        expected = interpolate_grid(self._table, targets[:, :2], torch)
        return expected if targets.shape[1] == 2 else (1 + self.depth_gain * targets[:, 2:3]) * expected

    def _tensor(self, values: Any) -> Tensor:
        return torch.as_tensor(values, device=self._device)
