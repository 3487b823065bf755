"""Responses of fibres to the presses of a study: without noise as in the paper, or with the scatter of a built pad."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from padforge.design.contact import relative_stretch, signals
from padforge.design.morphology import Morphology
from padforge.design.objectives.criterion import scatter_of_full_scale, straight_full_scale
from padforge.design.settings import PUBLISHED_CONTACT, Contact, Scatter, SearchSettings
from padforge.sense.arrays import Array, Mask


@dataclass(frozen=True)
class PressModel:
    """Contact of the presses of a study, and how responses to it scatter.

    Attributes:
        contact: the contact model. Under a shape, responses are exact signals, as in the paper; under a layer or a
            profile they are the relative stretch of fibres, in units of full scale.
        scatter: of the responses under a layer or a profile.
    """

    contact: Contact = PUBLISHED_CONTACT
    scatter: Scatter = SearchSettings().response_scatter

    @property
    def is_scattered(self) -> bool:
        """Whether responses scatter."""
        return self.contact.model != "shape"

    def respond(self, pad: Morphology, presses: Array, rng: np.random.Generator, present: Mask | None = None) -> Array:
        """Sample the responses (Q, F) to presses (Q, 2), or to C simultaneous ones (Q, C, 2), whose strains add.

        Positions are in grid units. `present` (Q, C) is false for simultaneous presses that are left out, if any.
        """
        compute = relative_stretch if self.is_scattered else signals
        response = compute(pad, presses.reshape(-1, 2), self.contact).reshape(*presses.shape[:-1], -1)
        if presses.ndim == 3:
            response = (response if present is None else response * present[:, :, None]).sum(axis=1)
        if not self.is_scattered:
            return response
        full_scale = straight_full_scale(pad.layout, self.contact, "fibres")
        return scatter_of_full_scale(self.scatter, self.contact, full_scale).sample(response / full_scale, rng)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings that the results of a study depend on."""
        scatter = self.scatter._asdict() if self.is_scattered else None
        return {"contact": self.contact.model_dump(mode="json"), "scatter": scatter}

    def describe(self) -> str:
        """Describe contact and scatter in a sentence."""
        if not self.is_scattered:
            return "Responses are the signals of a shape, without noise."
        return (
            f"Responses are those under a {self.contact.model}; they scatter by {100 * self.scatter.share:g} % and "
            f"have noise of {100 * self.scatter.floor:g} % of full scale."
        )


PUBLISHED_PRESSES = PressModel()
