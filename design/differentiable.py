"""The fibres and a smoothed contact model in torch: what the gradient search differentiates."""

import torch
from torch import Tensor


def pchip_slopes(t: Tensor, v: Tensor) -> Tensor:
    """PCHIP slopes (..., n) of values v at ascending t, both (..., n); differentiable almost everywhere.

    The same rule as `kernels.pchip.pchip_slopes`, to rounding.
    """
    h = t.diff(dim=-1)
    m = v.diff(dim=-1) / h
    if t.shape[-1] == 2:
        return m.expand(*m.shape[:-1], 2)
    h0, h1, m0, m1 = h[..., :-1], h[..., 1:], m[..., :-1], m[..., 1:]
    w0, w1 = 2 * h1 + h0, h1 + 2 * h0
    alike = m0 * m1 > 0
    safe0, safe1 = torch.where(alike, m0, 1.0), torch.where(alike, m1, 1.0)
    inner = torch.where(alike, (w0 + w1) / (w0 / safe0 + w1 / safe1), 0.0)
    first = _end_slope(h[..., 0], h[..., 1], m[..., 0], m[..., 1])
    last = _end_slope(h[..., -1], h[..., -2], m[..., -1], m[..., -2])
    return torch.cat([first[..., None], inner, last[..., None]], dim=-1)


def _end_slope(h0: Tensor, h1: Tensor, m0: Tensor, m1: Tensor) -> Tensor:
    d = ((2 * h0 + h1) * m0 - h0 * m1) / (h0 + h1)
    limited = torch.where((m0 * m1 <= 0) & (d.abs() > 3 * m0.abs()), 3 * m0, d)
    return torch.where(d * m0 <= 0, torch.zeros_like(d), limited)


def pchip_sample(t: Tensor, v: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Values and slopes, both (..., F), of the PCHIP curves through (t, v), (..., n), at the points `at` (F,)."""
    d = pchip_slopes(t, v)
    inner = t[..., 1:-1].detach().contiguous()
    j = torch.searchsorted(inner, at.expand(*t.shape[:-1], -1).contiguous(), right=True)
    t0, v0, d0 = (x.gather(-1, j) for x in (t, v, d))
    t1, v1, d1 = (x.gather(-1, j + 1) for x in (t, v, d))
    h = t1 - t0
    m = (v1 - v0) / h
    s = (at - t0) / h
    c2, c3 = 3 * m - 2 * d0 - d1, d0 + d1 - 2 * m
    return v0 + h * s * (d0 + s * (c2 + s * c3)), d0 + s * (2 * c2 + 3 * s * c3)


def smooth_signals(cross: Tensor, step: float, presses: Tensor, radius: float, softness: float) -> Tensor:
    """Signals of sampled fibres with a soft edge of the press: uniform Manhattan length, a disc of `radius`.

    Args:
        cross: (B, 2M, F) cross coordinates at travel 0, step, 2 step, ...
        presses: (Q, 2) places.
        softness: width of the edge, grid units; towards 0 the signals become the quantised ones of a circle.

    Returns:
        (B, 2M, Q) signals in grid units.
    """
    grid = cross.shape[1] // 2
    travel = torch.arange(cross.shape[2], dtype=cross.dtype) * step
    run = step + cross.diff(dim=-1).abs()
    families = []
    for family in range(2):
        rows = slice(family * grid, (family + 1) * grid)
        near = (travel[:-1] + step / 2 - presses[:, family, None]) ** 2  # (Q, F-1)
        middle = (cross[:, rows, 1:] + cross[:, rows, :-1]) / 2
        square = near + (middle[:, :, None, :] - presses[:, 1 - family, None]) ** 2
        # sqrt-free edge: K^2 - r^2 over 2 K is the distance to the edge to first order
        share = torch.sigmoid((radius**2 - square) / (2 * radius * softness))
        families.append((share * run[:, rows, None, :]).sum(dim=-1))
    return torch.cat(families, dim=1)
