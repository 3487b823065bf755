"""Fibres and their signals in torch, for gradients in the search."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from padforge.design.common import profiling
from padforge.design.contact import element_spacings, press_shape, record_visits
from padforge.design.kernels.exact_gradient import signals_gradient
from padforge.design.kernels.exact_signals import exact_signals
from padforge.design.kernels.geometry import Ends
from padforge.design.kernels.geometry import max_offsets as compute_max_offsets
from padforge.design.kernels.measured_signals import element_signals, elements_gradient, fibre_elements
from padforge.design.morphology import Array
from padforge.design.settings import Contact


def pchip_slopes(t: Tensor, v: Tensor) -> Tensor:
    """Compute slopes of PCHIP interpolants of values v at ascending t, all (..., n), as the kernels do to rounding."""
    h = t.diff(dim=-1)
    m = v.diff(dim=-1) / h
    if t.shape[-1] == 2:
        return m.expand(*m.shape[:-1], 2)
    h0, h1, m0, m1 = h[..., :-1], h[..., 1:], m[..., :-1], m[..., 1:]
    w0, w1 = 2 * h1 + h0, h1 + 2 * h0
    is_monotone = m0 * m1 > 0
    safe0, safe1 = torch.where(is_monotone, m0, 1.0), torch.where(is_monotone, m1, 1.0)
    inner = torch.where(is_monotone, (w0 + w1) / (w0 / safe0 + w1 / safe1), 0.0)
    first = _end_slope(h[..., 0], h[..., 1], m[..., 0], m[..., 1])
    last = _end_slope(h[..., -1], h[..., -2], m[..., -1], m[..., -2])
    return torch.cat([first[..., None], inner, last[..., None]], dim=-1)


def _end_slope(h0: Tensor, h1: Tensor, m0: Tensor, m1: Tensor) -> Tensor:
    d = ((2 * h0 + h1) * m0 - h0 * m1) / (h0 + h1)
    limited = torch.where((m0 * m1 <= 0) & (d.abs() > 3 * m0.abs()), 3 * m0, d)
    return torch.where(d * m0 <= 0, torch.zeros_like(d), limited)


def pchip_sample(t: Tensor, v: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Return values and slopes (..., F), at coordinates (F,), of PCHIP interpolants of v at ascending t (..., n)."""
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


def span_samples(t: Tensor, v: Tensor, per_span: int) -> tuple[Tensor, Tensor]:
    """Return points (..., P, 2) and slopes (..., P) of PCHIP interpolants of v at ascending t (..., n).

    They are `per_span` for each span, denser towards its ends, where it bends, and the last knot.
    """
    d = pchip_slopes(t, v)
    t0, v0, d0, d1 = (x[..., None] for x in (t[..., :-1], v[..., :-1], d[..., :-1], d[..., 1:]))
    h = t.diff(dim=-1)[..., None]
    m = v.diff(dim=-1)[..., None] / h
    s = (1 - torch.cos(torch.arange(per_span, dtype=t.dtype) * (math.pi / per_span))) / 2
    c2, c3 = 3 * m - 2 * d0 - d1, d0 + d1 - 2 * m
    columns = t0 + h * s, v0 + h * s * (d0 + s * (c2 + s * c3)), d0 + s * (2 * c2 + 3 * s * c3)
    at, value, slope = (
        torch.cat([x.flatten(-2), y[..., -1:]], dim=-1) for x, y in zip(columns, (t, v, d), strict=True)
    )
    return torch.stack([at, value], dim=-1), slope


def arc_lengths(along: Tensor, across: Tensor, slope: Tensor) -> Tensor:
    """Compute the arc lengths (F,) of PCHIP curves by Gauss-Legendre quadrature, to 1e-3 where they are steep."""
    nodes, weights = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(8))
    s = (nodes + 1) / 2
    h, d0, d1 = along.diff(dim=-1)[..., None], slope[:, :-1, None], slope[:, 1:, None]
    m = across.diff(dim=-1)[..., None] / h
    dv_dt = d0 + s * (2 * (3 * m - 2 * d0 - d1) + 3 * s * (d0 + d1 - 2 * m))
    return (h * (1 + dv_dt**2).sqrt() @ (weights / 2)).sum(dim=-1)


def press_signals(
    along: Tensor, across: Tensor, slope: Tensor, presses: Array, contact: Contact, ends: Ends, unit_mm: float
) -> Tensor:
    """Compute the signals (F, Q) of one pad, grid units for weights without unit, with their analytic gradient.

    They are exact for a shape, and within PRECISION of `measured_signals` for a layer or a profile. Slopes at the
    knots are independent of them, all (F, n) in float64; `presses` are (Q, 2).
    """
    return _PressSignals.apply(along, across, slope, presses, contact, ends, unit_mm)  # pyright: ignore[reportReturnType]


class _PressSignals(torch.autograd.Function):
    """`press_signals` as a torch function of knots and slopes."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        t, v, d = (x.detach().numpy() for x in inputs[:3])
        presses, contact, ends, unit_mm = inputs[3:]
        shape, max_offsets = press_shape(contact, unit_mm), compute_max_offsets(v[None], ends)
        out = np.zeros((len(presses), len(t)))
        if contact.model != "shape":  # elements are cut once for both directions
            law, spacings = shape[2], element_spacings(contact, unit_mm)
            elements = fibre_elements(t, v, d, ends.horizontals, presses, law, spacings)
            visited = element_signals(t, v, elements, presses, law, out)
            ctx.gradient = lambda upstream: elements_gradient(t, v, d, elements, presses, upstream, law)
        else:
            curves, none = (t[None], v[None], d[None]), np.empty(0, np.int64)
            where = max_offsets, ends, presses, shape, 0, len(presses), (none, none)
            visited = exact_signals(curves, *where, out.reshape(-1))
            ctx.gradient = lambda upstream: signals_gradient(t, v, d, max_offsets[0], ends, presses, upstream, shape)
        if profiling.is_profiling():
            record_visits(t[None], max_offsets, ends, presses, shape[1], visited)
        return torch.from_numpy(out.T)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        gradient = ctx.gradient(np.ascontiguousarray(upstream[0].numpy().T))
        return (*torch.from_numpy(gradient), None, None, None, None)
