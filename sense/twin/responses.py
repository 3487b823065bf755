"""What each channel of a recording answers to each press: one number, with what came before taken off.

That number scatters, but the other windows of the press, of the probe's sinking in and of its release, tell of the
place once more. By how much is told by Fisher's information: J' S^-1 J, with J the change of the windows with the
place by the response model, and S the covariance of what that model leaves of presses it has not seen.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from padforge.sense.localizer.features import DOWN, press_inputs
from padforge.sense.localizer.response.response_model import STEPS, ResponseModel, settled
from padforge.sense.recordings.processing.limits import Array, Indices, Mask
from padforge.sense.recordings.recording import Recording

ALIKE = 0.15
"""Share of its depth by which another press may differ that counts as deep as one."""
HELD = 3
"""First window of the press that counts as held: the tip has come to rest in the silicone."""
HOLD = np.array([(end - first) * (k >= HELD) for k, (first, end) in enumerate(DOWN)], float)
HOLD /= HOLD.sum()
"""(9,) what makes one number of the windows of a press."""


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


def of_one_depth(recording: Recording) -> Recording:
    """The recording, the places of presses unknown that are not about as deep as most: a deeper one gives more.

    They stay in what came before the others. Where no depth is known, all are taken to be alike.
    """
    deep_mm = np.where(recording.known, recording.deep_mm, np.nan)
    known = np.sort(deep_mm[deep_mm > 0])[::-1]
    if not len(known):
        return recording
    as_deep = np.searchsorted(-known, -(1 - ALIKE) * known, "right")
    deeper = np.searchsorted(-known, -(1 + ALIKE) * known, "left")
    usual = known[np.argmax(as_deep - deeper)]  # the deepest of the most common, as it is heard best
    alike = np.abs(deep_mm - usual) <= ALIKE * usual
    return replace(recording, presses_mm=np.where(alike[:, None], recording.presses_mm, np.nan))


def responses(recording: Recording, learnt: Mask) -> Responses:
    """The answers to all presses of known places.

    Args:
        learnt: (Q,) of these presses, those from which is learnt what of its history a channel still shows.
    """
    known = recording.known
    inputs = press_inputs(recording.readings, recording.begun[known], recording.lifted[known], "causal")
    places = recording.presses_mm[known]
    about = _about(places)
    model = ResponseModel.fit(about[learnt], inputs.windows[learnt], inputs.history[learnt], inputs.alive[learnt])
    windows = settled(inputs.windows, inputs.history, model.memory, model.usual)
    return Responses(places, windows @ HOLD, inputs.alive)


def information(recording: Recording, channels: Indices) -> Array:
    """(C',) 1/mm^2, what all windows of a press tell of its place: Fisher's information, mean over all places.

    Args:
        channels: (C',) which ones, each by the presses in which it gave enough readings.
    """
    known = recording.known
    inputs = press_inputs(recording.readings, recording.begun[known], recording.lifted[known], "full")
    places = _about(recording.presses_mm[known])
    side_mm = np.ptp(recording.presses_mm[known], axis=0).max()
    told = []
    for channel in channels.tolist():
        there = inputs.alive[:, channel]
        told.append(_told(places[there], inputs.windows[there, channel], inputs.history[there, channel]))
    return np.array(told) * (2 / side_mm) ** 2


def _told(places: Array, windows: Array, history: Array) -> float:
    """Fisher's information, of places (Q, 2) within [-1, 1], in windows (Q, F) V after a history (Q, J) V.

    Of two response models, each of half the presses, what is left over of the other half and the product of their
    slopes are taken: noise that a model takes for a slope is not in the other one.
    """
    windows, history, alive = windows[:, None], history[:, None], np.ones((len(places), 1), bool)
    grid, odd = np.linspace(-1, 1, STEPS + 1), np.arange(len(places)) % 2 == 1
    left, tables = np.empty_like(windows), []
    for seen in (odd, ~odd):
        model = ResponseModel.fit(places[seen], windows[seen], history[seen], alive[seen])
        expected = RegularGridInterpolator((grid, grid), model.table)(places[~seen])
        left[~seen] = settled(windows[~seen], history[~seen], model.memory, model.usual) - expected
        tables.append(model.table[:, :, 0])
    precision, told = np.linalg.pinv(np.cov(left[:, 0].T), hermitian=True), 0.0  # short presses have readings twice
    for axis in (0, 1):
        one, other = (np.asarray(np.gradient(table, 2 / STEPS, axis=axis)) for table in tables)
        told += float(np.einsum("xyf,fg,xyg->xy", one, precision, other).mean())
    return max(told, 0.0)


def _about(places_mm: Array) -> Array:
    """(Q, 2) places to the square [-1, 1] about all of them."""
    middle = (places_mm.min(axis=0) + places_mm.max(axis=0)) / 2
    return (places_mm - middle) / np.abs(places_mm - middle).max()
