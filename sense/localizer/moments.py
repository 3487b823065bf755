"""Timeline of a press: windows of its readings, which of them are complete, and which networks answer then.

Windows are counted in frames (see `recording.frames`) from a command of the probe. For a press of 20 frames, up to its
release::

    frame    -10     0       4       8       12      16      20      24      28      32      36      40
    command          down_command                            up_command
    REST     |       |
    PRESS_WINDOWS      |0|1|2|3|4| 5 |   6   |   7   |   8   |
    RELEASE_WINDOWS                                          |0|1|2|3| 4 |  5  |    6    |     7     |
    LATEST_WINDOWS                                       |1|0|

Windows of the press and the release are complete one after the other, so that their number, 0 to N_TIMED, says how far
a press is. K is the number of those windows that a localizer uses: N_TIMED, N_PRESS_WINDOWS, or 0. The two phases of
a press have a network each (`PHASES`), since one network for both learns each of them less well::

    complete     phase               network
    0            -                   none: the press may be anywhere
    1 .. 8       touch               "touched"
    9 .. 17      rest and release    "pressed", from 12 on together with the Bayesian localizer of the last of
                                     `BAYES_STAGES` that is complete, corrected by the network "residual"; or "touched"
                                     alone, if the finger slid since `EARLY_WINDOWS`
"""

from bisect import bisect_right
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from padforge.sense.arrays import Indices

Window = tuple[int, int]

REST: Window = (-10, 0)  # frames at rest before the probe is sent down; their mean is the baseline of the other windows
PRESS_WINDOWS: tuple[Window, ...] = ((1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 8), (8, 12), (12, 16), (16, 20))
"""Windows after the probe was sent down: fine while it sinks in, broad while it rests in the silicone."""
RELEASE_WINDOWS: tuple[Window, ...] = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 6), (6, 9), (9, 14), (14, 20))
"""Windows after the probe was sent up: the release depends on the position as much as the press does."""
LATEST_WINDOWS: tuple[Window, ...] = ((-1, 0), (-2, -1))
"""Windows before the latest reading, or before the release if that is earlier: they locate a finger that moves."""
PRESS_MIDDLES = np.array([(first + end - 1) / 2 for first, end in PRESS_WINDOWS])  # middles of `PRESS_WINDOWS`
N_PRESS_WINDOWS = len(PRESS_WINDOWS)
N_TIMED = len(PRESS_WINDOWS) + len(RELEASE_WINDOWS)  # windows of a press that are complete one after the other
MODULATED = slice(2, 5), slice(5, 9), slice(12, 17)
"""Groups of windows; the sensitivity of a group is modulated as one (see `response_model`)."""


@dataclass(frozen=True)
class Moment:
    """Time in a press, in readings after the first that shows the touch, or after the probe was sent up."""

    since: Literal["touch", "lift"]
    readings: int

    def until(self, touched: Indices, up_command: Indices) -> Indices:
        """Return the first readings (Q,) after the moment; `touched` (Q,) are the first that show the touch."""
        return np.minimum(touched + self.readings, up_command) if self.since == "touch" else up_command + self.readings


MOMENTS = (
    *(Moment("touch", readings) for readings in (1, 2, 3, 4, 6, 9, 12)),
    *(Moment("lift", readings) for readings in (0, 1, 2, 3, 5, 8, 15)),
)
"""Moments at which a localizer is evaluated."""


@dataclass(frozen=True)
class Phase:
    """Numbers of complete windows, from `first` on, that a network is trained for."""

    first: int
    shares: tuple[float, ...]  # share of the training at each of these numbers
    length: float = 1.0  # relative length of the training
    sliding: float = 0.0  # share of presses that slide in the training

    def __contains__(self, n_complete: object) -> bool:
        return isinstance(n_complete, int) and self.first <= n_complete < self.first + len(self.shares)


def _half_at_last(n: int, total: float = 1.0) -> tuple[float, ...]:
    """Return n shares of a total: 0.5 at the last number of complete windows, the rest divided among the others."""
    return (*((total - 0.5) / (n - 1),) * (n - 1), 0.5)


PHASES: Mapping[int, Mapping[str, Phase]] = {
    N_TIMED: {
        "touched": Phase(1, (0.05, 0.12, 0.26, 0.15, 0.11, 0.09, 0.08, 0.07, 0.07), 1.4, sliding=0.3),
        "pressed": Phase(N_PRESS_WINDOWS, (0.2, *_half_at_last(len(RELEASE_WINDOWS), 0.8)), 2.0),
    },
    N_PRESS_WINDOWS: {"held": Phase(1, _half_at_last(N_PRESS_WINDOWS), sliding=0.2)},
    0: {"press": Phase(0, (1.0,))},
}
"""Phases by the name of their network, for each number K of timed windows: of press and release, of the press alone, or
none if the features do not depend on the moment. Where phases overlap, the last one answers."""
SLIDE_NETWORK = "touched"  # network that follows a sliding finger; the others know fingers at rest alone
RESIDUAL = "residual"  # network that corrects the Bayesian localizers
EARLY_WINDOWS = 5  # complete windows soon after the touch, when a finger has not slid far
SLIDE_THRESHOLD = 3.0
"""Distance from the position at `EARLY_WINDOWS`, in its standard deviations, above which a press counts as sliding;
rarely exceeded at rest."""
POSSIBLE_SLIDE_THRESHOLD = 1.75
"""The same, above which a press may be sliding and is not taken for two fingers; 5 % of pairs of fingers exceed it."""
BAYES_STAGES = (12, 13, 14, 15, 17)
"""Numbers of complete windows from which on the next Bayesian localizer answers. Before 12 the
release has not shown yet, and one errs by a third more than a network."""
RESIDUAL_PHASE = Phase(BAYES_STAGES[0], (0.15, 0.1, 0.15, 0.1, 0.05, 0.45))
"""Phase of the network that corrects the Bayesian localizers."""


def complete_windows(down_command: Any, up_command: Any, until: Any, xp: Any = np) -> Any:
    """Return (Q, K) which of `PRESS_WINDOWS` and `RELEASE_WINDOWS` are complete before readings `until` (Q,).

    After the release all `PRESS_WINDOWS` are complete, also those of a shorter press, whose last reading is repeated.
    All arrays are of the module `xp`, numpy or torch.
    """
    released = (until > up_command)[:, None]
    press_ends, release_ends = (xp.asarray([end for _, end in each]) for each in (PRESS_WINDOWS, RELEASE_WINDOWS))
    pressed = (down_command[:, None] + press_ends <= until[:, None]) | released
    return xp.hstack([pressed, released & (up_command[:, None] + release_ends <= until[:, None])])


def complete_at(n_complete: int, down_command: Indices, up_command: Indices) -> Indices:
    """Return the first readings (Q,) at which `n_complete` windows of a press, 1 or more, are complete."""
    if n_complete <= N_PRESS_WINDOWS:
        return down_command + PRESS_WINDOWS[n_complete - 1][1]
    return up_command + RELEASE_WINDOWS[n_complete - N_PRESS_WINDOWS - 1][1]


def bayes_stage(n_complete: int, n_timed: int) -> int | None:
    """Return the index of the Bayesian localizer that answers when `n_complete` windows of K are complete, if any."""
    if not n_timed:
        return 0
    return bisect_right(BAYES_STAGES, n_complete) - 1 if n_complete >= BAYES_STAGES[0] else None


def active_networks(networks: Container[str], n_complete: int, n_timed: int, has_bayes: bool) -> list[str]:
    """Return the names of the networks that answer when `n_complete` windows of K are complete, `RESIDUAL` last."""
    names = [name for name, phase in PHASES[n_timed].items() if n_complete in phase and name in networks][-1:]
    return [*names, RESIDUAL] if has_bayes and bayes_stage(n_complete, n_timed) is not None else names
