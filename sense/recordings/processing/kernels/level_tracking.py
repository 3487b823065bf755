"""Levels that fibres keep between presses: followed reading by reading, and told when they change.

At rest a fibre keeps a level that drifts, under a press another that creeps. Each is followed by a Kalman filter of
level and slope (the local linear trend of A. C. Harvey, "Forecasting, Structural Time Series Models and the Kalman
Filter", Cambridge 1989), whose slope fades as silicone settles. A change is a run of looks that leave what the filters
predict and agree with each other; one that agrees with no other is a spike. How far a level wanders beyond its slope is
learnt from looks in a row that are off the same way.

A look is a reading, or the mean of as many as come in `LOOK_S`: slow converters are looked at reading by reading, of
fast ones the noise is averaged out.
"""

import math
from typing import Any

import numpy as np
from numba import njit

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
