"""Fibres and their signals in torch, for gradients in the search."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from padforge.design.common import profiling
from padforge.design.contact import element_spacings, press_shape, record_visits, weight_table
from padforge.design.kernels.exact_gradient import signals_gradient
from padforge.design.kernels.exact_signals import exact_signals
from padforge.design.kernels.geometry import Ends
from padforge.design.kernels.geometry import max_offsets as compute_max_offsets
from padforge.design.kernels.measured_signals import element_signals, elements_gradient, fibre_elements
from padforge.design.kernels.pchip import arc_lengths_gradient, fibre_slopes_gradient, population_slopes
from padforge.design.morphology import Array
from padforge.design.settings import Contact


def pchip_slopes(along: Tensor, across: Tensor) -> Tensor:
    """Compute the slopes (F, n) at their knots of the PCHIP curves of a pad, all in float64."""
    return _Slopes.apply(along, across)  # pyright: ignore[reportReturnType]


class _Slopes(torch.autograd.Function):
    """`pchip_slopes` as a torch function."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        t, v = (x.detach().contiguous().numpy() for x in inputs)
        d = population_slopes(t[None], v[None])[0]
        ctx.curves = t, v, d
        return torch.from_numpy(d)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(fibre_slopes_gradient(*ctx.curves, upstream[0].contiguous().numpy())))


def arc_lengths(along: Tensor, across: Tensor, slope: Tensor) -> Tensor:
    """Compute the arc lengths (F,) of PCHIP curves by Gauss-Legendre quadrature, to 1e-3 where they are steep."""
    return _Lengths.apply(along, across, slope)  # pyright: ignore[reportReturnType]


class _Lengths(torch.autograd.Function):
    """`arc_lengths` as a torch function."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        curves = [x.detach().contiguous().numpy() for x in inputs]
        ctx.gradient = np.empty((3, *curves[0].shape))
        return torch.from_numpy(arc_lengths_gradient(*curves, ctx.gradient))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(ctx.gradient * upstream[0].numpy()[:, None]))


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
            law, spacings, table = shape[2], element_spacings(contact, unit_mm), weight_table(contact, unit_mm)
            elements = fibre_elements(t, v, d, ends.horizontals, presses, law, spacings)
            visited = element_signals(t, v, elements, presses, law, table, out)
            ctx.gradient = lambda upstream: elements_gradient(t, v, d, elements, presses, upstream, law, table)
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
