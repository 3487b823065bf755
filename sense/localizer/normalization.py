"""How the inputs of presses become numbers of about 1, and what the network gives becomes mm and N.

Where presses of several depths were learnt from, the network gives depths (and forces) as well, and inputs are measured
from no press at all, so that they are in proportion to the depth.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from padforge.design.common.validation import InputError
from padforge.sense.recordings.processing.limits import LEAST_SPREAD_V, Array, Floats, Indices, Mask

from padforge.sense.localizer.features import Inputs
from padforge.sense.localizer.response.response_model import STEPS, ResponseModel, settled

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
class Target:
    """What the network gives beside the place.

    Attributes:
        name: one of `Recording.measures`. middle: the value that the network calls 0. span: the difference that it
            calls 1; both in the unit that the name ends in.
    """

    name: str
    middle: float
    span: float

    @classmethod
    def of(cls, name: str, values: Array) -> "Target":
        """The one that puts (Q,) known values within [-1, 1]."""
        low, high = float(values.min()), float(values.max())
        return cls(name, (low + high) / 2, (high - low) / 2 or 1.0)

    def scaled(self, values: Array) -> Array:
        """(Q,) values to what the network gives."""
        return (values - self.middle) / self.span

    def values(self, scaled: Array) -> Array:
        """What the network gives to values."""
        return scaled * self.span + self.middle


@dataclass(frozen=True)
class Normalization:
    """Fitted on the presses of training.

    Attributes:
        centre, spread: (C, F + G) V; an input enters as (input - centre) / spread. The G gains enter as they are.
        memory: (C, J, F + G) V/V, what of a volt of history shows in the inputs, see `ResponseModel`.
        usual: (C, J) V, the usual history.
        middle_mm: (2,) place that the network calls 0. span_mm: distance that it calls 1.
        measures: what the network gives beside the place; none, the depth, or depth and force, in this order.
        half_mm: (2,) half the width and height of what was pressed; None where nobody has kept it.
    """

    centre: Array
    spread: Array
    memory: Array
    usual: Array
    middle_mm: Array
    span_mm: float
    measures: Sequence[Target] = ()
    half_mm: Array | None = None

    @classmethod
    def fit(
        cls,
        inputs: Inputs,
        places_mm: Array,
        measures: Mapping[str, Array] | None = None,
        phases: Sequence[slice] = (),
    ) -> tuple["Normalization", Floats]:
        """From the inputs and the places (Q, 2) of the presses of training, and (Q,) of each measure to be learnt.

        For each of `phases`, windows that are stronger together, what came before a press tells a gain. A window is
        scaled by the geometric mean of its own spread and its fibre's: the fine windows of a touch keep some of their
        smallness, and so of their noise. What never varied is left as large as it is.

        Returns:
            The scaling, and the scaled inputs by place (S, S, C, F + G), see `ResponseModel.table`; of several depths,
            for the one that the network calls 0.
        """
        targets = tuple(Target.of(name, values) for name, values in (measures or {}).items())
        low, high = places_mm.min(axis=0), places_mm.max(axis=0)
        middle, span = (low + high) / 2, float((high - low).max() / 2) or 1.0
        strengths = measures["depth_mm"] / targets[0].middle if measures else None
        response = ResponseModel.fit(
            (places_mm - middle) / span, inputs.windows, inputs.history, inputs.alive, strengths, phases
        )
        size = inputs.windows.shape[2]
        windows = settled(inputs.windows, inputs.history, response.memory, response.usual)[:, :, :size]
        there = np.broadcast_to(inputs.alive[:, :, None], windows.shape)
        centre = _mean(windows, there)
        variance = _mean((windows - centre) ** 2, there)
        spread = (variance * variance.mean(axis=1, keepdims=True)) ** 0.25
        spread = np.where(spread >= LEAST_SPREAD_V, spread, 1.0)
        centre = np.zeros_like(centre) if targets else centre
        gains = ((0, 0), (0, len(phases)))
        centre, spread = np.pad(centre, gains), np.pad(spread, gains, constant_values=1.0)
        scaling = cls(centre, spread, response.memory, response.usual, middle, span, targets, (high - low) / 2)
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
        """(..., C, F + G) volts after the usual history, and gains, to numbers of about 1."""
        return np.clip((windows - self.centre) / self.spread, -MAX_INPUT, MAX_INPUT).astype(np.float32)

    @property
    def stretch(self) -> float:
        """By how much a press grows stronger, as a share of one of the middle depth, for a depth that is 1 greater."""
        return self.measures[0].span / self.measures[0].middle if self.measures else 0.0

    def targets(self, places_mm: Array, measures: Mapping[str, Array] | None = None) -> Floats:
        """(Q, 2) mm, and (Q,) of each measure that is learnt, to what the network gives, (Q, 2 + T)."""
        more = [each.scaled((measures or {})[each.name]) for each in self.measures]
        return np.column_stack([(places_mm - self.middle_mm) / self.span_mm, *more]).astype(np.float32)

    def places_mm(self, targets: Floats) -> Array:
        """What the network gives of places, (Q, 2), to mm."""
        return targets * self.span_mm + self.middle_mm


def _mean(windows: Array, there: Mask) -> Array:
    """(C, F) means over the presses in which a fibre was there; 0 for one that never was."""
    return np.where(there, windows, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
