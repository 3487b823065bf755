"""Moments of a press: the windows of its readings, which of them are complete, and who answers then.

Windows are counted in frames (see `recording.frames`) from a command of the probe; here of a press of 20, up to its
release::

    frame    -10     0       4       8       12      16      20      24      28      32      36      40
    command          down_command                            up_command
    REST     |       |
    DOWN               |0|1|2|3|4| 5 |   6   |   7   |   8   |
    UP                                                       |0|1|2|3| 4 |  5  |    6    |     7     |
    NOW                                                  |1|0|

They are complete one after the other, so that their number K = 0 .. N_TIMED says how far a press is. Each phase of it
has a network of its own (`PHASES`), as one for all of them learns each of them less well::

    complete     what is known        network                       and
    0                                                               the press may be anywhere
    1 .. 8       the touch            "touched"
    9            it rests             "settled"                     "touched", where the finger has slid since SOON
    10 .. 17     the release          "released"                    from 12 on the Bayesian localizer of the last of
                                                                    `STAGES`, corrected by the network "residual"
"""

from bisect import bisect_right
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from padforge.sense.arrays import Indices, Mask

Window = tuple[int, int]

REST: Window = (-10, 0)  # frames before the probe is sent down; the other windows are measured from their mean
DOWN: tuple[Window, ...] = ((1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 8), (8, 12), (12, 16), (16, 20))
"""Windows after the probe was sent down: fine while it sinks in, broad while it rests in the silicone."""
UP: tuple[Window, ...] = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 6), (6, 9), (9, 14), (14, 20))
"""Windows after the probe was sent up: the release depends on the position as much as the press does."""
NOW: tuple[Window, ...] = ((-1, 0), (-2, -1))
"""Windows before the moment, or before the release if that is earlier: where the finger is now if it moves."""
N_DOWN, N_TIMED = len(DOWN), len(DOWN) + len(UP)  # K, windows of a press in the order in which they are complete
MODULATED = slice(2, 5), slice(5, 9), slice(12, 17)  # windows whose sensitivity is modulated together


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
FOLLOWING, RESIDUAL = "touched", "residual"
"""The network that follows a finger which slides, as others know fingers at rest alone; and the one that corrects the
Bayesian localizers."""
SOON, LEAST_SLIDE = 5, 3.0
"""Complete windows soon after the touch: a finger that is farther from where it was then than so many standard
deviations is believed to have slid. Of presses at rest, hardly one is."""
MAY_SLIDE = 1.75
"""The same from which on it may have slid, and is not taken for two fingers: 5 % of pairs of fingers look like that."""
STAGES = (12, 13, 14, 15, 17)
"""Numbers of complete windows of a press from which on a Bayesian localizer of its own answers, the first one after the
release has shown: before, it errs a third more than a network."""
CORRECTED = Phase(N_DOWN + 3, (0.15, 0.1, 0.15, 0.1, 0.05, 0.45))
"""When the Bayesian localizer answers, with the network that corrects it."""


def complete_windows(down_command: Indices, up_command: Indices, until: Indices) -> Mask:
    """Return (Q, K) which windows of `DOWN` and `UP` are complete before the readings `until` (Q,).

    A press that is shorter than `DOWN` has all of it once it has ended: its last reading is repeated.
    """
    released = (until > up_command)[:, None]
    down = (down_command[:, None] + [end for _, end in DOWN] <= until[:, None]) | released
    return np.hstack([down, released & (up_command[:, None] + [end for _, end in UP] <= until[:, None])])


def complete_at(n_complete: int, down_command: Indices, up_command: Indices) -> Indices:
    """Return the first readings (Q,) at which so many windows of presses, 1 or more, are complete."""
    if n_complete <= N_DOWN:
        return down_command + DOWN[n_complete - 1][1]
    return up_command + UP[n_complete - N_DOWN - 1][1]


def count_complete(complete: Mask) -> Indices:
    """Return the number (Q,) of complete windows of presses."""
    return complete.sum(axis=1)


def stage_of(n_complete: int, n_timed: int) -> int | None:
    """Return which of the Bayesian localizers answers when so many of K windows are complete, if any."""
    if not n_timed:
        return 0
    return bisect_right(STAGES, n_complete) - 1 if n_complete >= STAGES[0] else None


def answering(networks: Container[str], n_complete: int, n_timed: int, has_bayes: bool) -> list[str]:
    """Return the names of the networks that answer when so many of K windows are complete, in their order."""
    names = [name for name, phase in PHASES[n_timed].items() if n_complete in phase and name in networks][-1:]
    return [*names, RESIDUAL] if has_bayes and stage_of(n_complete, n_timed) is not None else names
