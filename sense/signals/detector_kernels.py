"""

Levels that fibres keep between presses: followed reading by reading, and told when they change.
At rest a fibre keeps a level that drifts, under a press another that creeps. Each is followed by a Kalman filter of
level and slope (the local linear trend of A. C. Harvey, "Forecasting, Structural Time Series Models and the Kalman
Filter", Cambridge 1989), whose slope fades as silicone settles. A change is a run of looks that leave what the filters
predict and agree with each other; one that agrees with no other is a spike. How far a level wanders beyond its slope is
learnt from looks in a row that are off the same way.
A look is a reading, or the mean of as many as come in `LOOK_S`: slow converters are looked at reading by reading, of
fast ones the noise is averaged out.

Which changes of level are touches and which are releases.
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

FIBRE = np.dtype(
    [
        ("level", "f8"),  # as predicted for now, V,
        ("slope", "f8"),  # and how fast it changes, V/s
        ("level_var", "f8"),  # their covariance, in squares of `spread`
        ("cross_var", "f8"),
        ("slope_var", "f8"),
        ("noise", "f8"),  # standard deviation of a look, V;
        ("spread", "f8"),  # the same, widened to what counts as noise
        ("off", "f8"),  # deviation of the look last followed, V,
        ("common", "f8"),  # mean product of two such in a row, V^2,
        ("wander", "f8"),  # and the variance of the level's own wandering that it speaks of, V^2
        ("seen_s", "f8"),  # when the fibre was last seen at its level
        ("reading", "f8"),  # the last one, V
        ("count", "f8"),  # readings in the present look,
        ("low", "f8"),  # and the extremes among them
        ("high", "f8"),
        ("look", "f8"),  # the present look, V,
        ("before", "f8"),  # and the one before
        ("deviation", "f8"),  # of the look from the level, or from where a change began
        ("run", "f8"),  # sum of the deviations of a run,
        ("run_square", "f8"),  # and of their squares
        ("origin", "f8"),  # level at which a change began, V,
        ("farthest", "f8"),  # and how far it went at its farthest
        ("press", "f8"),  # step that the press made, V
        ("way", "f8"),  # mean step of touches, in spreads
        ("rest", "f8"),  # last level without a press, V,
        ("held", "f8"),  # and under one
    ]
)
"""What is known of a fibre; NaN where nothing is."""

PAD = np.dtype(
    [
        ("reading", "i8"),  # readings taken so far
        ("reading_s", "f8"),  # time of the last one
        ("look_first", "i8"),  # first reading of the present look,
        ("look_from_s", "f8"),  # its time,
        ("look_readings", "i8"),  # and how many there are
        ("look_s", "f8"),  # time of the last look
        ("looks", "i8"),  # from which noise was learnt
        ("step_v", "f8"),  # of the converter: least difference of two readings
        ("run", "i8"),  # looks in a row that leave the levels,
        ("run_first", "i8"),  # first reading of the first,
        ("run_s", "f8"),  # and its time
        ("changing", "?"),  # whether a change is under way,
        ("told", "i8"),  # what it was told to be, see `press_detection`,
        ("farthest", "f8"),  # its size at its farthest,
        ("farthest_s", "f8"),  # when that was,
        ("after_farthest", "i8"),  # and the first reading after it; -1 before
        ("state", "i8"),  # see `press_detection`
        ("released_s", "f8"),  # when a press was last let go
        ("odd_first", "i8"),  # where a change began that is not yet understood
        ("presses", "i8"),  # learnt from
        ("typical_v", "f8"),  # step that a press makes, all fibres together, V
        ("typical_size", "f8"),  # the same as a counted size, see `press_detection`
        ("agreement", "f8"),  # how far touches go the same way, -1 to 1
        ("rest_spread", "f8"),  # mean counted size of the way from one rest to the next,
        ("held_spread", "f8"),  # and from one level under a press to the next
    ]
)
"""What is known of the pad as a whole."""


def unknown(fibres: int) -> tuple[Any, Any]:
    """What is known before the first reading: (C,) `FIBRE` and a `PAD`, overwritten as readings come."""
    known = np.zeros(fibres, FIBRE)
    for name in ("level", "reading", "look", "before", "deviation", "origin", "rest", "held"):
        known[name] = np.nan
    known["seen_s"] = -np.inf
    pad = np.zeros(1, PAD)
    pad["step_v"] = np.inf
    pad["reading_s"] = pad["look_s"] = pad["released_s"] = -np.inf
    return known, pad[0]


LOOK_S = 0.03
"""Length of a look; a probe takes a tenth of a second to sink in."""

FADE_S = 2.5
"""Time in which a slope fades: the overshoot after a release comes back within seconds."""

MEMORY_S = 1.0
"""Time over which a slope is learnt."""

NOISE_S = 10.0
"""Time over which the noise is learnt."""

GAP_S = 1.0
"""A fibre that was missing for longer is taken as it comes back."""

GIVE_UP_S = 1.0
"""Looks that leave the levels for longer without agreeing are no change: the noise has grown."""

FIRST_LOOKS = 8
"""Looks that the noise is learnt from before any change is told."""

ROUGH_LOOKS = 8
"""How rough the first estimates of the noise are: of n looks it is widened by the share ROUGH_LOOKS / n."""

OFF, OFF_PER_S = 0.05, 0.4
"""Shares of a step by which the level after it, and its slope, may still be off: silicone has not settled then."""

OUTLIER, GROWTH = 2.5, 3.0
"""Standard deviations beyond which a look moves a level (OUTLIER) and the noise (GROWTH) no further."""

LEAST_SHARE = 0.01
"""Least noise, share of a typical press: less means nothing, however quiet the converter."""

LEAST_V = 1e-7
"""Least noise, and least difference of two readings that is no rounding, V."""

TOLERATED = 0.25
"""Share of the noise's variance that two looks in a row may have in common before a level is taken to wander."""

MEAN_TO_SD = math.sqrt(math.pi / 2)
"""Standard deviation over mean amount of what is normally distributed."""


@njit(cache=True, error_model="numpy", nogil=True)
def take(fibres: Any, pad: Any, row: Any, time_s: float) -> bool:
    """Take a reading (C,) in V, NaN where missing; True if it completes a look.

    A look without any fibre is none. Of three readings or more, the lowest and the highest of each fibre are left out
    of a look, since they may be spikes.
    """
    if pad.look_readings == 0:
        pad.look_first, pad.look_from_s = pad.reading, time_s
        for fibre in fibres:
            fibre.look, fibre.count, fibre.low, fibre.high = 0.0, 0.0, np.inf, -np.inf
    for f in range(len(fibres)):
        fibre, volts = fibres[f], row[f]
        if np.isnan(volts):
            continue
        step = abs(volts - fibre.reading)
        if LEAST_V < step < pad.step_v:
            pad.step_v = step
        fibre.reading = volts
        fibre.look += volts
        fibre.count += 1
        fibre.low, fibre.high = min(fibre.low, volts), max(fibre.high, volts)
    pad.look_readings += 1
    complete = time_s - pad.look_from_s + (time_s - pad.reading_s) >= LOOK_S  # the next reading would be too late
    seen = False
    if complete:
        pad.look_readings = 0
        for fibre in fibres:
            seen |= fibre.count > 0
            if fibre.count >= 3:
                fibre.look = (fibre.look - fibre.low - fibre.high) / (fibre.count - 2)
            else:
                fibre.look /= fibre.count  # NaN where there was none
    pad.reading += 1
    pad.reading_s = time_s
    return complete and seen


@njit(cache=True, error_model="numpy", nogil=True)
def advance(fibres: Any, pad: Any, time_s: float) -> None:
    """Predict all levels for `time_s`, and how far looks may be from them; forget fibres not seen for long."""
    least = max(LEAST_SHARE * pad.typical_v, LEAST_V, pad.step_v / 2 if pad.step_v < np.inf else 0.0)
    rough = 1 + ROUGH_LOOKS / max(pad.looks, 1)
    dt = min(max(time_s - pad.look_s, 0.0), GAP_S)
    fade = math.exp(-dt / FADE_S)
    reach = FADE_S * (1 - fade)
    for fibre in fibres:
        fibre.spread = rough * max(fibre.noise, least)
        fibre.wander = max(fibre.common - TOLERATED * fibre.noise**2, 0.0)
        if time_s - fibre.seen_s > GAP_S:
            fibre.level = np.nan
        fibre.level += reach * fibre.slope
        fibre.slope *= fade
        fibre.level_var += reach * (2 * fibre.cross_var + reach * fibre.slope_var)
        fibre.cross_var = fade * (fibre.cross_var + reach * fibre.slope_var)
        fibre.slope_var = fade**2 * fibre.slope_var + dt**2 / MEMORY_S**4


@njit(cache=True, error_model="numpy", nogil=True)
def _begin(fibre: Any, time_s: float, step: float) -> None:
    """Follow a fibre from its present look on, after a step of so many spreads."""
    fibre.level, fibre.slope, fibre.off, fibre.seen_s = fibre.look, 0.0, 0.0, time_s
    fibre.level_var = 1 + (OFF * step) ** 2
    fibre.cross_var = 0.0
    fibre.slope_var = 1 + (OFF_PER_S * step) ** 2


@njit(cache=True, error_model="numpy", nogil=True)
def restart(fibres: Any, pad: Any, time_s: float) -> None:
    """Follow all fibres from the present look on, their deviations being steps."""
    for fibre in fibres:
        _begin(fibre, time_s, 0.0 if np.isnan(fibre.deviation) else fibre.deviation / fibre.spread)
    pad.run = 0


@njit(cache=True, error_model="numpy", nogil=True)
def follow(fibres: Any, pad: Any, time_s: float) -> None:
    """Correct levels, slopes and noise by the present look."""
    share = max(1 / (pad.looks + 1), 1 - math.exp(-min(time_s - pad.look_s, GAP_S) / NOISE_S))
    for fibre in fibres:
        if np.isnan(fibre.look):
            continue
        if np.isnan(fibre.level):
            _begin(fibre, time_s, 0.0)
            continue
        off, total = fibre.look - fibre.level, fibre.level_var + 1
        amount = MEAN_TO_SD * abs(off) / math.sqrt(total)
        if pad.looks >= FIRST_LOOKS:
            amount = min(amount, GROWTH * fibre.spread)
            limit = OUTLIER * fibre.spread * math.sqrt(total)
            off = min(max(off, -limit), limit)
        fibre.noise += share * (amount - fibre.noise)
        fibre.common += share * (off * fibre.off - fibre.common)
        fibre.off = off
        gain, slope_gain = fibre.level_var / total, fibre.cross_var / total
        fibre.level += gain * off
        fibre.slope += slope_gain * off
        fibre.slope_var -= slope_gain * fibre.cross_var
        fibre.cross_var *= 1 - gain
        fibre.level_var *= 1 - gain
        fibre.seen_s = time_s
    pad.looks += 1


@njit(cache=True, error_model="numpy", nogil=True)
def learn_run(fibres: Any, pad: Any, time_s: float) -> None:
    """Learn the noise of a run that was no change."""
    if pad.run > 0:
        share = 1 - math.exp(-(time_s - pad.run_s) / NOISE_S)
        for fibre in fibres:
            amount = min(math.sqrt(fibre.run_square / pad.run), GROWTH * fibre.spread)
            fibre.noise += share * (amount - fibre.noise)


@njit(cache=True, error_model="numpy", nogil=True)
def learn_unrest(fibres: Any) -> None:
    """Learn the noise of a change that does not settle: half of it, since it may have been a slow press after all."""
    for fibre in fibres:
        amount = MEAN_TO_SD * abs(fibre.look - fibre.before) / math.sqrt(2)
        if amount > fibre.noise:
            fibre.noise += (amount - fibre.noise) / 2


@njit(cache=True, error_model="numpy", nogil=True)
def changes(fibres: Any, pad: Any, time_s: float, doubt: Any, sure: Any) -> bool:
    """Take the present look; True if the levels have changed, since reading `pad.run_first`.

    Args:
        doubt, sure: (C + 1,) by the number of fibres seen, sums of squared deviations, in spreads, that chance exceeds
            rarely, and hardly ever.
    """
    seen, total = 0, 0.0
    for fibre in fibres:
        fibre.deviation = fibre.look - fibre.level
        if not np.isnan(fibre.deviation):
            seen += 1
            total += fibre.deviation**2 / (fibre.spread**2 * (1 + fibre.level_var) + fibre.wander)
    if total <= doubt[seen]:
        learn_run(fibres, pad, time_s)
        pad.run = 0
        follow(fibres, pad, time_s)
        return False
    if pad.run == 0:
        _run_anew(fibres, pad, time_s)
        return False
    agreeing, apart = _run_on(fibres, pad)
    if agreeing > sure[seen]:
        return True
    if apart > sure[seen]:  # the looks before this one were of something else
        _run_anew(fibres, pad, time_s)
    elif time_s - pad.run_s > GIVE_UP_S:
        learn_run(fibres, pad, time_s)
        for fibre in fibres:
            fibre.deviation = 0.0
        restart(fibres, pad, time_s)
    return False


@njit(cache=True, error_model="numpy", nogil=True)
def _run_anew(fibres: Any, pad: Any, time_s: float) -> None:
    """Begin a run with the present look, or, since a touch may have two paces, with the one look before it."""
    if pad.run != 2:
        pad.run_first, pad.run_s = pad.look_first, time_s
    pad.run = 1
    for fibre in fibres:
        fibre.run = 0.0 if np.isnan(fibre.deviation) else fibre.deviation
        fibre.run_square = fibre.run**2


@njit(cache=True, error_model="numpy", nogil=True)
def _run_on(fibres: Any, pad: Any) -> tuple[float, float]:
    """Add the present look to the run.

    Returns:
        What its looks have in common, and how far the present one is from those before, both as sums of squares in
        spreads. Common is the mean product of two different looks: spikes, being apart from each other, add nothing.
    """
    agreeing, apart = 0.0, 0.0
    before, pad.run = pad.run, pad.run + 1
    for fibre in fibres:
        if np.isnan(fibre.deviation):  # as the looks before, so that they count no less
            fibre.run += fibre.run / before
            fibre.run_square += fibre.run_square / before
            continue
        apart += ((fibre.deviation - fibre.run / before) / fibre.spread) ** 2 / (1 + 1 / before)
        fibre.run += fibre.deviation
        fibre.run_square += fibre.deviation**2
        common = (fibre.run**2 - fibre.run_square) / (pad.run * before)
        agreeing += common / (fibre.spread**2 * (1 / pad.run + fibre.level_var) + fibre.wander)
    return agreeing, apart


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
