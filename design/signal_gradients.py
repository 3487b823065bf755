"""Fibres at a step of a search: their lengths and signals, with the gradients of both."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from padforge.design.contact import contact_law, element_spacings, press_shape, search_precision, weight_table
from padforge.design.kernels.element_signals import element_signals, elements_gradient, fibre_elements
from padforge.design.kernels.exact_gradient import signals_gradient
from padforge.design.kernels.exact_signals import exact_signals
from padforge.design.kernels.geometry import max_offsets as compute_max_offsets
from padforge.design.kernels.pchip import arc_lengths_gradient, fibre_slopes_gradient, population_slopes
from padforge.design.morphology import Array, fibre_ends
from padforge.design.settings import Contact, Layout

Differentiate = Callable[[Array], Array]
"""Takes the gradient (F, Q) of a value by the signals; returns that (3, F, n) by along, across and slope."""


@dataclass(frozen=True)
class FibreCurves:
    """The PCHIP curves of a pad's fibres, grid units.

    Gradients (3, F, n) are by the knots along and across the fibres and by the slopes there, treated as independent;
    `by_knots` adds the part of the gradient by the slopes to that by the knots.
    """

    along: Array  # coordinates of the knots along the fibres; float64, shape (F, n)
    across: Array  # coordinates of the knots across them; shape (F, n)
    layout: Layout  # positions of the fibre ends

    @cached_property
    def slope(self) -> Array:
        """Slopes at the knots; shape (F, n)."""
        return population_slopes(self.along[None], self.across[None])[0]

    def by_knots(self, gradient: Array) -> Array:
        """Return the gradient (2, F, n) by knots, on which slopes depend, of a value with the gradient (3, F, n)."""
        return gradient[:2] + fibre_slopes_gradient(self.along, self.across, self.slope, gradient[2])

    def lengths(self) -> tuple[Array, Array]:
        """Compute the arc lengths (F,), to 1e-3 where fibres are steep, and the gradient of each; shape (3, F, n)."""
        gradient = np.empty((3, *self.along.shape))
        return arc_lengths_gradient(self.along, self.across, self.slope, gradient), gradient

    def signals(self, presses: Array, contact: Contact) -> tuple[Array, Differentiate]:
        """Compute the signals (F, Q) of presses (Q, 2), and return them with the function of their reverse pass.

        Signals are exact for a shape, and have the `search_precision` for a layer or a profile.
        """
        t, v, d, unit_mm = self.along, self.across, self.slope, self.layout.unit_mm
        out = np.zeros((len(presses), len(t)))
        if contact.model != "shape":  # elements are cut once for both directions
            law, precision = contact_law(contact, unit_mm), search_precision(contact)
            table, spacings = weight_table(contact, unit_mm, precision), element_spacings(contact, unit_mm, precision)
            elements = fibre_elements(t, v, d, self.layout.horizontals, presses, law, spacings)
            element_signals(t, v, elements, presses, law, table, out)
            pull_back = lambda upstream: elements_gradient(t, v, d, elements, presses, upstream, law, table)  # noqa: E731
        else:
            shape, ends = press_shape(contact, unit_mm), fibre_ends(self.layout)
            curves, max_offsets = (t[None], v[None], d[None]), compute_max_offsets(v[None], self.layout)
            exact_signals(curves, max_offsets, ends, presses, shape, 0, len(presses), out[None])
            offsets = max_offsets[0]
            pull_back = lambda upstream: signals_gradient(t, v, d, offsets, ends, presses, upstream, shape)  # noqa: E731
        return out.T, lambda grad_signals: np.asarray(pull_back(np.ascontiguousarray(grad_signals.T)))
