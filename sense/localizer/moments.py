"""Phases of a press: how much of it has been read, and which network answers then.

The windows of a press are complete one after the other, those of the touch first, then those of the release: their
number says how far it is. Each phase has a network of its own, as one for all of them learns each of them less well.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from padforge.sense.arrays import Indices, Mask
from padforge.sense.localizer.features import DOWN, N_TIMED, UP


@dataclass(frozen=True)
class Moment:
    """A time in a press: so many readings after the first that shows it, or after the probe was sent up."""

    since: Literal["touch", "lift"]
    readings: int

    def until(self, touched: Indices, up_command: Indices) -> Indices:
        """Return the first readings (Q,) of presses that are not looked at; `touched` (Q,) are those that show them."""
        return np.minimum(touched + self.readings, up_command) if self.since == "touch" else up_command + self.readings


MOMENTS = (
    *(Moment("touch", readings) for readings in (1, 2, 3, 4, 6, 9, 12)),
    *(Moment("lift", readings) for readings in (0, 1, 2, 3, 5, 8, 15)),
)
"""Moments at which a localizer is evaluated."""


@dataclass(frozen=True)
class Phase:
    """Numbers of complete windows, from `first` on, that a network is trained for, and how."""

    first: int
    shares: tuple[float, ...]  # of the training that looks at each of these numbers
    length: float = 1.0  # of the training
    sliding: float = 0.0  # share of presses in it that slide

    def __contains__(self, n_complete: object) -> bool:
        return isinstance(n_complete, int) and self.first <= n_complete < self.first + len(self.shares)


N_DOWN = len(DOWN)
PHASES: Mapping[int, Mapping[str, Phase]] = {
    N_TIMED: {
        "touched": Phase(1, (0.05, 0.12, 0.26, 0.15, 0.11, 0.09, 0.08, 0.07, 0.07), 1.4, sliding=0.3),
        "settled": Phase(N_DOWN, (1.0,), 1.3),
        "released": Phase(N_DOWN + 1, (*(0.5 / (len(UP) - 1),) * (len(UP) - 1), 0.5), 1.7),
    },
    N_DOWN: {"held": Phase(1, (*(0.5 / (N_DOWN - 1),) * (N_DOWN - 1), 0.5), sliding=0.2)},
    0: {"press": Phase(0, (1.0,))},
}
"""Networks by K, the number of windows that are complete one after the other: all of them, those of the touch alone, or
none, if features know no moment. The last one that is trained for a moment answers."""
FOLLOWING = "touched"  # the network that follows a finger which slides; others know fingers at rest alone
SOON = 5  # complete windows soon after the touch: where a finger was then shows whether it slid later
CORRECTED = Phase(N_DOWN + 3, (0.15, 0.1, 0.15, 0.1, 0.05, 0.45))
"""When the Bayesian localizer answers, with the network that corrects it."""


def complete_at(n_complete: int, down_command: Indices, up_command: Indices) -> Indices:
    """Return the first readings (Q,) at which so many windows of presses, 1 or more, are complete."""
    if n_complete <= N_DOWN:
        return down_command + DOWN[n_complete - 1][1]
    return up_command + UP[n_complete - N_DOWN - 1][1]


def count_complete(seen: Mask) -> Indices:
    """Return the number (Q,) of complete windows of presses."""
    return seen.sum(axis=1)
