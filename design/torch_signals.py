"""The fibres and their signals in torch: what the gradient search differentiates."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padforge.design.common import profiling
from padforge.design.contact import press_shape, record_visits
from padforge.design.kernels.exact_gradient import signals_gradient
from padforge.design.kernels.exact_signals import exact_signals
from padforge.design.kernels.geometry import Ends, WeightLaw, max_offsets
from padforge.design.kernels.measured_signals import element_signals, element_spacing, elements_gradient, fibre_elements
from padforge.design.settings import Contact

Array = NDArray[np.float64]
PressShape = tuple[tuple[Array, Array], Array, WeightLaw]
"""Chains, extents and law of a press, as `press_shape` gives them."""


def pchip_slopes(t: Tensor, v: Tensor) -> Tensor:
    """PCHIP slopes (..., n) of values v at ascending t, both (..., n); differentiable almost everywhere.

    The same rule as `pchip_slopes` of the kernels, to rounding.
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


def span_samples(t: Tensor, v: Tensor, per_span: int) -> tuple[Tensor, Tensor]:
    """Places (..., P, 2) and slopes (..., P) of the PCHIP curves through (t, v), (..., n), P = (n - 1) per_span + 1.

    Every span gets as many samples, closer to its ends, since that is where a steep one bends.
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


def arc_lengths(travel: Tensor, cross: Tensor, slope: Tensor) -> Tensor:
    """Return the arc lengths (F,) of PCHIP curves by Gauss-Legendre quadrature, to 1e-3 where they are steep.

    Args:
        travel, cross, slope: (F, n) knots and slopes.
    """
    nodes, weights = (torch.from_numpy(each) for each in np.polynomial.legendre.leggauss(8))
    s = (nodes + 1) / 2
    h, d0, d1 = travel.diff(dim=-1)[..., None], slope[:, :-1, None], slope[:, 1:, None]
    m = cross.diff(dim=-1)[..., None] / h
    along = d0 + s * (2 * (3 * m - 2 * d0 - d1) + 3 * s * (d0 + d1 - 2 * m))
    return (h * (1 + along**2).sqrt() @ (weights / 2)).sum(dim=-1)


def press_signals(
    travel: Tensor, cross: Tensor, slope: Tensor, presses: Array, contact: Contact, ends: Ends, unit_mm: float
) -> Tensor:
    """Signals of one pad with their analytic gradient: exact, but for a measured reach within the kernel's PRECISION.

    Args:
        travel, cross, slope: (F, n) float64 knots and slopes, held independent. presses: (Q, 2) in grid units.
        ends: where the fibres end.
        unit_mm: the pad's grid unit, mm.

    Returns:
        (F, Q), with the default weight and length in grid units.
    """
    given, shape = (travel, cross, slope, presses, ends), press_shape(contact, unit_mm)
    if contact.sensitivity_profile:
        spaced = shape, element_spacing(contact.profile_points(unit_mm))
        return MeasuredSignals.apply(*given, spaced)  # pyright: ignore[reportReturnType]
    return ExactSignals.apply(*given, shape)  # pyright: ignore[reportReturnType]


class ExactSignals(torch.autograd.Function):
    """The exact signals of one pad as a torch function of its knots and slopes: `press_signals` of a disc."""

    @staticmethod
    def forward(
        ctx: Any, travel: Tensor, cross: Tensor, slope: Tensor, presses: Array, ends: Ends, shape: PressShape
    ) -> Tensor:
        """Signals (F, Q)."""
        t, v, d = (x.detach().numpy() for x in (travel, cross, slope))
        strays, none = max_offsets(v[None], ends), np.empty(0, np.int64)
        ctx.inputs = (t, v, d, strays[0], ends, presses, shape)
        out = np.zeros(len(presses) * len(t))
        begin, end = 0, len(presses)
        visited = exact_signals(t[None], v[None], d[None], strays, ends, presses, *shape, begin, end, none, none, out)
        if profiling.is_profiling():
            record_visits(t[None], strays, ends, presses, shape[1], visited)
        return torch.from_numpy(out.reshape(-1, len(t)).T)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient by travel, cross and slope."""
        t, v, d, strays, ends, presses, shape = ctx.inputs
        found = signals_gradient(t, v, d, strays, ends, presses, np.ascontiguousarray(upstream[0].numpy().T), *shape)
        return (*torch.from_numpy(found), None, None, None)


class MeasuredSignals(torch.autograd.Function):
    """The signals of one pad under a measured reach, from elements laid once a call: `press_signals` of a reach."""

    @staticmethod
    def forward(
        ctx: Any,
        travel: Tensor,
        cross: Tensor,
        slope: Tensor,
        presses: Array,
        ends: Ends,
        spaced: Any,
    ) -> Tensor:
        """Signals (F, Q)."""
        t, v, d = (x.detach().numpy() for x in (travel, cross, slope))
        (_, extents, law), spacing = spaced
        elements = fibre_elements(t, v, d, ends.horizontals, presses, law.radius, spacing, law.length)
        ctx.inputs = (t, v, d, elements, presses, law)
        out = np.empty((len(presses), len(t)))
        looked_at = element_signals(t, v, elements, presses, law.radius, law.profile, out)
        if profiling.is_profiling():
            record_visits(t[None], max_offsets(v[None], ends), ends, presses, extents, looked_at)
        return torch.from_numpy(out.T)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient by travel, cross and slope."""
        t, v, d, elements, presses, law = ctx.inputs
        up = np.ascontiguousarray(upstream[0].numpy().T)
        found = elements_gradient(t, v, d, elements, presses, up, law.radius, law.profile, law.length)
        return (*torch.from_numpy(found), None, None, None)
