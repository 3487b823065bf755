"""What each channel of a recording answers to each press: one number, with what came before taken off."""

from dataclasses import dataclass

import numpy as np

from sense.localizer.features import DOWN, press_inputs
from sense.localizer.response_model import ResponseModel, settled
from sense.recordings.processing.limits import Array, Indices, Mask
from sense.recordings.recording import Recording

HELD = 3
"""First window of the press that counts as held: the tip has come to rest in the silicone."""


@dataclass(frozen=True)
class Responses:
    """Answers of C channels to Q presses of known places.

    Attributes:
        places_mm: (Q, 2) as the arm counts. volts: (Q, C) mean while held minus the rest before, as it would be after
            the channel's usual history. there: (Q, C) whether the channel gave enough readings.
    """

    places_mm: Array
    volts: Array
    there: Mask

    def __len__(self) -> int:
        return len(self.places_mm)

    def of(self, rows: Indices, channels: Indices | slice = slice(None)) -> "Responses":
        """Those of some presses and channels."""
        return Responses(self.places_mm[rows], self.volts[rows][:, channels], self.there[rows][:, channels])

    @property
    def spread(self) -> Array:
        """(C,) variance of each channel's answers; 1 where it gave none."""
        counts = np.maximum(self.there.sum(axis=0), 1)
        mean = np.where(self.there, self.volts, 0).sum(axis=0) / counts
        squares = np.where(self.there, (self.volts - mean) ** 2, 0).sum(axis=0) / counts
        return np.where(squares > 0, squares, 1.0)

    def explained(self, predicted: Array) -> Array:
        """(C,) share of the variance of the answers that a prediction (Q, C) explains."""
        counts = np.maximum(self.there.sum(axis=0), 1)
        left = np.where(self.there, (self.volts - predicted) ** 2, 0).sum(axis=0) / counts
        return 1 - left / self.spread


def responses(recording: Recording, learnt: Mask) -> Responses:
    """The answers to all presses of known places.

    Args:
        learnt: (Q,) of these presses, those from which is learnt what of its history a channel still shows.
    """
    known = recording.known
    inputs = press_inputs(recording.readings, recording.begun[known], recording.lifted[known], "causal")
    places = recording.presses_mm[known]
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    about = (places - middle) / np.abs(places - middle).max()
    model = ResponseModel.fit(about[learnt], inputs.windows[learnt], inputs.history[learnt], inputs.alive[learnt])
    windows = settled(inputs.windows, inputs.history, model.memory, model.usual)
    widths = np.array([end - first for first, end in DOWN[HELD:]], float)
    return Responses(places, windows[:, :, HELD:] @ (widths / widths.sum()), inputs.alive)
