"""Fibres and their signals in torch, for gradients in the search."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padforge.design.common import profiling
from padforge.design.contact import PressShape, press_shape, record_visits
from padforge.design.kernels.exact_gradient import signals_gradient
from padforge.design.kernels.exact_signals import exact_signals
from padforge.design.kernels.geometry import Ends
from padforge.design.kernels.geometry import max_offsets as compute_max_offsets
from padforge.design.kernels.measured_signals import element_signals, element_spacing, elements_gradient, fibre_elements
from padforge.design.settings import Contact

Array = NDArray[np.float64]


def pchip_slopes(t: Tensor, v: Tensor) -> Tensor:
    """Compute the slopes of PCHIP interpolants; differentiable almost everywhere.

    The same rule as `pchip_slopes` of the kernels, to rounding.

    Args:
        t: ascending coordinates; shape (..., n).
        v: values; shape (..., n).

    Returns:
        Slopes; shape (..., n).
    """
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
    """Evaluate PCHIP interpolants.

    Args:
        t: ascending coordinates; shape (..., n).
        v: values; shape (..., n).
        at: coordinates to evaluate at; shape (F,).

    Returns:
        Values and slopes, both (..., F).
    """
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
    """Sample PCHIP interpolants, denser towards the ends of each span, where steep spans bend.

    Args:
        t: ascending coordinates; shape (..., n).
        v: values; shape (..., n).
        per_span: samples per span.

    Returns:
        Points (..., P, 2) and slopes (..., P), P = (n - 1) per_span + 1.
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
    """Compute the arc lengths of PCHIP curves by Gauss-Legendre quadrature, to 1e-3 where they are steep.

    Args:
        along: knots along the axis; shape (F, n).
        across: knots across it; shape (F, n).
        slope: slopes at the knots; shape (F, n).

    Returns:
        Arc lengths; shape (F,).
    """
    nodes, weights = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(8))
    s = (nodes + 1) / 2
    h, d0, d1 = along.diff(dim=-1)[..., None], slope[:, :-1, None], slope[:, 1:, None]
    m = across.diff(dim=-1)[..., None] / h
    dv_dt = d0 + s * (2 * (3 * m - 2 * d0 - d1) + 3 * s * (d0 + d1 - 2 * m))
    return (h * (1 + dv_dt**2).sqrt() @ (weights / 2)).sum(dim=-1)


def press_signals(
    along: Tensor, across: Tensor, slope: Tensor, presses: Array, contact: Contact, ends: Ends, unit_mm: float
) -> Tensor:
    """Compute the signals of one pad with their analytic gradient.

    They are exact for a shape, and within PRECISION of `measured_signals` for a sensitivity profile.

    Args:
        along: knots along the axis; shape (F, n), float64.
        across: knots across it; shape (F, n).
        slope: slopes at the knots, held independent; shape (F, n).
        presses: centres; shape (Q, 2), grid units.
        contact: contact model.
        ends: positions of the fibre ends.
        unit_mm: the pad's grid unit, mm.

    Returns:
        Signals; shape (F, Q), grid units for weights without unit.
    """
    inputs, shape = (along, across, slope, presses, ends), press_shape(contact, unit_mm)
    if contact.sensitivity_profile:
        shape_and_spacing = shape, element_spacing(contact.profile_points(unit_mm))
        return MeasuredSignals.apply(*inputs, shape_and_spacing)  # pyright: ignore[reportReturnType]
    return ExactSignals.apply(*inputs, shape)  # pyright: ignore[reportReturnType]


class ExactSignals(torch.autograd.Function):
    """Exact signals of one pad, as a torch function of its knots and slopes."""

    @staticmethod
    def forward(
        ctx: Any, along: Tensor, across: Tensor, slope: Tensor, presses: Array, ends: Ends, shape: PressShape
    ) -> Tensor:
        """Compute signals (F, Q)."""
        t, v, d = (x.detach().numpy() for x in (along, across, slope))
        max_offsets, none = compute_max_offsets(v[None], ends), np.empty(0, np.int64)
        ctx.inputs = (t, v, d, max_offsets[0], ends, presses, shape)
        out = np.zeros(len(presses) * len(t))
        curves = t[None], v[None], d[None]
        visited = exact_signals(curves, max_offsets, ends, presses, shape, 0, len(presses), (none, none), out)
        if profiling.is_profiling():
            record_visits(t[None], max_offsets, ends, presses, shape[1], visited)
        return torch.from_numpy(out.reshape(-1, len(t)).T)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradient with respect to along, across and slope."""
        t, v, d, max_offsets, ends, presses, shape = ctx.inputs
        up = np.ascontiguousarray(upstream[0].numpy().T)
        gradient = signals_gradient(t, v, d, max_offsets, ends, presses, up, shape)
        return (*torch.from_numpy(gradient), None, None, None)


class MeasuredSignals(torch.autograd.Function):
    """Signals of one pad under a sensitivity profile, from elements cut once a call."""

    @staticmethod
    def forward(
        ctx: Any,
        along: Tensor,
        across: Tensor,
        slope: Tensor,
        presses: Array,
        ends: Ends,
        shape_and_spacing: tuple[PressShape, float],
    ) -> Tensor:
        """Compute signals (F, Q)."""
        t, v, d = (x.detach().numpy() for x in (along, across, slope))
        (_, extents, law), spacing = shape_and_spacing
        elements = fibre_elements(t, v, d, ends.horizontals, presses, law, spacing)
        ctx.inputs = (t, v, d, elements, presses, law)
        out = np.empty((len(presses), len(t)))
        visited = element_signals(t, v, elements, presses, law, out)
        if profiling.is_profiling():
            record_visits(t[None], compute_max_offsets(v[None], ends), ends, presses, extents, visited)
        return torch.from_numpy(out.T)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Compute the gradient with respect to along, across and slope."""
        t, v, d, elements, presses, law = ctx.inputs
        up = np.ascontiguousarray(upstream[0].numpy().T)
        gradient = elements_gradient(t, v, d, elements, presses, up, law)
        return (*torch.from_numpy(gradient), None, None, None)
