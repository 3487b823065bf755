"""Which changes of level are touches and which are releases.

A release takes back the step that its touch made, and goes against the way of touches: fibres that a press stretches
drive their dividers all one way. Where a change fits neither, the next one decides. A pad whose rests differ from
press to press, as only levels under presses do, has been taken the wrong way round and is set right.

Steps are compared fibre by fibre in spreads (see `level_tracking`). The size of a step is the sum of their squares;
counted, no fibre enters it with more than `STRONGEST`.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from padforge.sense.recordings.processing.kernels.level_tracking import FIRST_LOOKS, advance, changes, follow, learn_unrest, restart, take

STALL_S = 0.5
"""A change that goes no farther for so long has ended."""
SETTLED = 0.1
"""A change has settled when two looks differ by no more than this share of it."""
RELEASE_S = 1.0
"""What goes on the way of a release for so long belongs to it."""
STRONGEST = 20.0
"""Spreads beyond which a fibre counts no more: a broken one would drown the others."""
CLEAR = 5.0
"""Spreads from which on a fibre's step adds to the typical press in volts."""
LEARNT, AGREEING = 3, 0.5
"""Touches, and their agreement, from which on their way tells anything."""
RECENT = 0.05
"""Share of the newest touch in what is known of touches."""
RECENT_LEVELS, INVERTED, LEAST_INVERTED = 0.15, 1.2, 0.4
"""Share of the newest level in the spreads of levels; the spread of rests that says that presses are taken for rests:
over that of levels under presses, and over the size of a typical press."""

NOTHING, TOUCH, RELEASE, MORE = 0, 1, 2, 3
"""What a change is told to be: nothing yet, or more of the release before."""
FREE, PRESSED, ODD = 0, 1, 2
"""States of a pad: at rest, under a press, and after a change against the way of touches, which was the release of a
press that was missed, or a touch of a rare kind."""


@njit(cache=True, error_model="numpy", nogil=True)
def _spreads(fibres: Any, f: int, volts: float) -> float:
    """A step of fibre f in spreads; 0 if the largest of as many fibres has it by chance, or it is not known."""
    z = volts / fibres[f].spread
    return z if abs(z) > math.sqrt(2 * math.log(len(fibres))) else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _counted(fibres: Any, f: int, volts: float) -> float:
    """The same, counted."""
    return min(max(_spreads(fibres, f, volts), -STRONGEST), STRONGEST)


@njit(cache=True, error_model="numpy", nogil=True)
def _size(fibres: Any, step: Any) -> float:
    total = 0.0
    for f in range(len(fibres)):
        total += _spreads(fibres, f, step[f]) ** 2
    return total


@njit(cache=True, error_model="numpy", nogil=True)
def _counted_size(fibres: Any, step: Any) -> float:
    total = 0.0
    for f in range(len(fibres)):
        total += _counted(fibres, f, step[f]) ** 2
    return total


@njit(cache=True, error_model="numpy", nogil=True)
def _share(fibres: Any, step: Any) -> float:
    """How far the present deviation goes along `step`, as a share of it; 0 where that is none."""
    along, total = 0.0, 0.0
    for f in range(len(fibres)):
        z = _counted(fibres, f, step[f])
        along += z * _counted(fibres, f, fibres[f].deviation)
        total += z**2
    return along / total if total > 0 else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _agreement(fibres: Any) -> float:
    """How far the present deviation goes the way of touches: 1 if all of it does, -1 if all goes against it."""
    along, total = 0.0, 0.0
    for f in range(len(fibres)):
        z = _counted(fibres, f, fibres[f].deviation)
        along += z * abs(z) * fibres[f].way
        total += z**2 * abs(fibres[f].way)
    return along / total if total > 0 else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _common(fibre: Any) -> float:
    """What the deviations of the present look and the one before have in common, V."""
    one, other = fibre.deviation, fibre.before - fibre.origin
    return min(one, other) if one > 0 and other > 0 else max(one, other) if one < 0 and other < 0 else 0.0


@njit(cache=True, error_model="numpy", nogil=True)
def _go_far(fibres: Any, pad: Any, time_s: float) -> None:
    """Remember where a change has gone farthest, as two looks in a row have it: one alone may be a spike."""
    size = 0.0
    for f in range(len(fibres)):
        size += _spreads(fibres, f, _common(fibres[f])) ** 2
    if size > pad.farthest:
        pad.farthest, pad.farthest_s, pad.after_farthest = size, time_s, -1
        for fibre in fibres:
            fibre.farthest = _common(fibre)
    elif pad.after_farthest < 0:
        pad.after_farthest = pad.look_first


@njit(cache=True, error_model="numpy", nogil=True)
def _settled(fibres: Any, doubt: Any) -> bool:
    """Whether the present look is as the one before."""
    seen, total = 0, 0.0
    for fibre in fibres:
        off = fibre.look - fibre.before
        if not np.isnan(off):
            seen += 1
            total += (off / fibre.spread) ** 2 / 2
    return total <= max(doubt[seen], SETTLED**2 / 2 * _size(fibres, fibres.deviation))


@njit(cache=True, error_model="numpy", nogil=True)
def _learn(fibres: Any, pad: Any) -> None:
    """Learn from a touch that has settled."""
    pad.presses += 1
    share = max(1 / pad.presses, RECENT)
    if pad.presses > 1:
        pad.agreement += max(1 / (pad.presses - 1), RECENT) * (_agreement(fibres) - pad.agreement)
    square = 0.0
    for f in range(len(fibres)):
        fibre = fibres[f]
        fibre.way += share * (_counted(fibres, f, fibre.deviation) - fibre.way)
        if abs(_spreads(fibres, f, fibre.deviation)) > CLEAR:
            square += fibre.deviation**2
    pad.typical_v += share * (math.sqrt(square) - pad.typical_v)
    pad.typical_size += share * (_counted_size(fibres, fibres.deviation) - pad.typical_size)


@njit(cache=True, error_model="numpy", nogil=True)
def _way_from(fibres: Any, last: Any) -> float:
    """Counted size of the way from the last level of a kind to the present look, which then is the last."""
    total = 0.0
    for f in range(len(fibres)):
        total += _counted(fibres, f, fibres[f].look - last[f]) ** 2
        if not np.isnan(fibres[f].look):
            last[f] = fibres[f].look
    return total


@njit(cache=True, error_model="numpy", nogil=True)
def _tell(events: Any, count: Any, down: bool, reading: int) -> int:
    events[count, 0], events[count, 1] = down, reading
    return count + 1


@njit(cache=True, error_model="numpy", nogil=True)
def _judge(fibres: Any, pad: Any, time_s: float, settled: bool, events: Any, count: Any) -> int:
    """Tell a change that is under way, as soon as it is clear what it is; the new count of events."""
    known = pad.presses >= LEARNT and pad.agreement > AGREEING
    along = _agreement(fibres) if known else 1.0
    back = _share(fibres, fibres.press)
    ratio = _counted_size(fibres, fibres.deviation) / _counted_size(fibres, fibres.press)
    if pad.state == FREE and time_s - pad.released_s < RELEASE_S and back < -0.5 * math.sqrt(ratio):
        pad.told = MORE
    elif pad.state == FREE and along >= 0:
        pad.told = TOUCH
        count = _tell(events, count, True, pad.run_first)
    elif pad.state == PRESSED and (back < -0.5 or (along < 0 and ratio > 0.25)):
        pad.told = RELEASE
        count = _tell(events, count, False, pad.run_first)
    elif pad.state == ODD and settled:
        odd_was_touch = along < 0 or (-2 < back < -0.5 and ratio < 4)
        count = _tell(events, count, True, pad.odd_first if odd_was_touch else pad.run_first)
        if odd_was_touch:
            count = _tell(events, count, False, pad.run_first)
        pad.told = RELEASE if odd_was_touch else TOUCH
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _press(fibres: Any, kept: float) -> None:
    """Take the present deviation for the step of the press, besides a share of what it was."""
    for fibre in fibres:
        fibre.press = kept * fibre.press + (0.0 if np.isnan(fibre.deviation) else fibre.deviation)


@njit(cache=True, error_model="numpy", nogil=True)
def _conclude(fibres: Any, pad: Any, time_s: float, events: Any, count: Any) -> int:
    """Take a change that has settled as what it was told to be; the new count of events."""
    if pad.told == TOUCH and _share(fibres, fibres.farthest) < 0.5:  # a tap: it was released meanwhile
        pad.state = FREE
        return _tell(events, count, False, pad.after_farthest if pad.after_farthest >= 0 else pad.look_first)
    if pad.told == TOUCH:
        pad.state = PRESSED
        _press(fibres, 0.0)
        _learn(fibres, pad)
        pad.held_spread += RECENT_LEVELS * (_way_from(fibres, fibres.held) - pad.held_spread)
        bound = max(INVERTED * pad.held_spread, LEAST_INVERTED * pad.typical_size)
        if pad.presses >= LEARNT and pad.rest_spread > bound:
            pad.state, pad.presses, pad.rest_spread, pad.held_spread = FREE, 0, 0.0, 0.0
            count = _tell(events, count, False, pad.look_first)
    elif pad.told == RELEASE:
        pad.state, pad.released_s = FREE, time_s
        pad.rest_spread += RECENT_LEVELS * (_way_from(fibres, fibres.rest) - pad.rest_spread)
    elif pad.told == NOTHING and pad.state == FREE:
        pad.state, pad.odd_first = ODD, pad.run_first
        _press(fibres, 0.0)
    elif pad.told == NOTHING:  # pressed deeper or elsewhere
        _press(fibres, 0.0 if _size(fibres, fibres.deviation) > _size(fibres, fibres.press) else 1.0)
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def _look(fibres: Any, pad: Any, time_s: float, doubt: Any, sure: Any, events: Any, count: Any) -> int:
    """Take a look that is complete; the new count of events."""
    if not pad.changing:
        advance(fibres, pad, time_s)
        if pad.looks < FIRST_LOOKS:
            follow(fibres, pad, time_s)
        elif changes(fibres, pad, time_s, doubt, sure):
            pad.changing, pad.told = True, NOTHING
            pad.farthest, pad.farthest_s, pad.after_farthest = 0.0, time_s, -1
            for fibre in fibres:  # one by one: assigning slices compiles what words an error about their shapes
                fibre.origin = fibre.level
    if pad.changing:
        for fibre in fibres:
            if np.isnan(fibre.look):  # missing now: as it was last seen in this change
                fibre.look = fibre.origin + fibre.deviation
            fibre.deviation = fibre.look - fibre.origin
        _go_far(fibres, pad, time_s)
        settled = _settled(fibres, doubt)
        if not settled and time_s - pad.farthest_s > STALL_S:
            settled = True
            learn_unrest(fibres)
        if pad.told == NOTHING:
            count = _judge(fibres, pad, time_s, settled, events, count)
        if settled:
            count = _conclude(fibres, pad, time_s, events, count)
            restart(fibres, pad, time_s)
            pad.changing = False
    for fibre in fibres:
        fibre.before = fibre.look
    pad.look_s = time_s
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def find(fibres: Any, pad: Any, times_s: Any, readings: Any, doubt: Any, sure: Any, events: Any) -> Any:
    """Take (n,) times and (n, C) readings in V, NaN where missing, going on from those before.

    Args:
        fibres, pad: what is known, see `pad_state`; overwritten. doubt, sure: as in `level_tracking.changes`.
        events: (2 n, 2) overwritten with whether the pad was touched (1) or let go (0), and the reading from which on.

    Returns:
        How many events there are.
    """
    count = np.int64(0)
    for r in range(len(times_s)):
        if take(fibres, pad, readings[r], times_s[r]):
            count = _look(fibres, pad, times_s[r], doubt, sure, events, count)
    return count
