"""How the inputs of presses become numbers of about 1, and what the network gives becomes mm."""

from dataclasses import dataclass

import numpy as np

from design.common.errors import InputError
from sense.recordings.processing.limits import LEAST_SPREAD_V, Array, Floats, Indices, Mask

from .features import Inputs
from .response_model import STEPS, ResponseModel, settled

MAX_INPUT = 1e4
"""Greatest scaled input, in spreads: what lies further off is no press, and is held there."""


@dataclass(frozen=True)
class Scaled:
    """Presses as the network takes them.

    Attributes:
        inputs: (Q, C, F). alive: (Q, C) whether the fibre gave enough readings to count.
    """

    inputs: Floats
    alive: Mask

    def __getitem__(self, rows: slice | Indices) -> "Scaled":
        return Scaled(self.inputs[rows], self.alive[rows])

    def __len__(self) -> int:
        return len(self.inputs)


@dataclass(frozen=True)
class Normalization:
    """Fitted on the presses of training.

    Attributes:
        centre, spread: (C, F) V; an input enters as (input - centre) / spread.
        memory: (C, J, F) V/V, what of a volt of history shows in the inputs; usual: (C, J) V, the usual history.
        middle_mm: (2,) place that the network calls 0. span_mm: distance that it calls 1.
    """

    centre: Array
    spread: Array
    memory: Array
    usual: Array
    middle_mm: Array
    span_mm: float

    @classmethod
    def fit(cls, inputs: Inputs, places_mm: Array) -> tuple["Normalization", Floats]:
        """From the inputs and the places (Q, 2) of the presses of training.

        A window is scaled by the geometric mean of its own spread and its fibre's: the fine windows of a touch keep
        some of their smallness, and so of their noise. What never varied is left as large as it is.

        Returns:
            The scaling, and the scaled inputs by place (S, S, C, F), see `ResponseModel.table`.
        """
        low, high = places_mm.min(axis=0), places_mm.max(axis=0)
        middle, span = (low + high) / 2, float((high - low).max() / 2) or 1.0
        response = ResponseModel.fit((places_mm - middle) / span, inputs.windows, inputs.history, inputs.alive)
        windows = settled(inputs.windows, inputs.history, response.memory, response.usual)
        there = np.broadcast_to(inputs.alive[:, :, None], windows.shape)
        centre = _mean(windows, there)
        variance = _mean((windows - centre) ** 2, there)
        spread = (variance * variance.mean(axis=1, keepdims=True)) ** 0.25
        scaling = cls(
            centre, np.where(spread >= LEAST_SPREAD_V, spread, 1.0), response.memory, response.usual, middle, span
        )
        return scaling, scaling.scaled(response.table)

    def refuse_unsound(self, table: Floats) -> None:
        """Raise InputError unless `table` is one of scaled inputs by place, see `fit`."""
        expected = (STEPS + 1, STEPS + 1, *self.centre.shape)
        if table.shape != expected or table.dtype != np.float32 or not np.abs(table).max(initial=0) <= MAX_INPUT:
            raise InputError(
                f"table of inputs by place is {table.dtype} of shape {table.shape}, "
                f"expected float32 {expected} up to {MAX_INPUT:g}"
            )

    def entries(self, method: str) -> int:
        """D, the numbers that enter the network: the inputs, and, if masked, one a fibre that says whether it lives."""
        return self.centre.size + (len(self.centre) if method == "masked" else 0)

    def inputs(self, inputs: Inputs) -> Scaled:
        """What the network takes."""
        return Scaled(self.scaled(settled(inputs.windows, inputs.history, self.memory, self.usual)), inputs.alive)

    def scaled(self, windows: Array) -> Floats:
        """(..., C, F) volts after the usual history to numbers of about 1."""
        return np.clip((windows - self.centre) / self.spread, -MAX_INPUT, MAX_INPUT).astype(np.float32)

    def targets(self, places_mm: Array) -> Floats:
        """(Q, 2) mm to what the network gives."""
        return ((places_mm - self.middle_mm) / self.span_mm).astype(np.float32)

    def places_mm(self, targets: Floats) -> Array:
        """What the network gives to mm."""
        return targets * self.span_mm + self.middle_mm


def _mean(windows: Array, there: Mask) -> Array:
    """(C, F) means over the presses in which a fibre was there; 0 for one that never was."""
    return np.where(there, windows, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
