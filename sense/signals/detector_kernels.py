"""Press detection as readings come: a Kalman filter for each fibre, a test for changes, and a state machine.

Means over blocks of BLOCK_S are tracked by a local linear trend (A. C. Harvey, "Forecasting, Structural Time Series
Models and the Kalman Filter", Cambridge 1989), whose noise is learnt. A change is a run of blocks that leave the
prediction and agree with each other (chi-square tests); a block that agrees with no other is a spike. A release takes
back the step of its touch, and is opposite to the direction of touches, since every fibre changes its voltage in one
direction when it is stretched. Steps are whitened: divided by `scale`, the noise of the fibre. The size of a step is
the sum of squares of the whitened steps of all fibres.
"""

import math
from enum import IntEnum
from typing import Any

import numpy as np

from padforge.common.compilation import kernel

FIBRE = np.dtype(
    [
        ("level", "f8"),  # prediction for the present block, V
        ("slope", "f8"),  # V/s
        *[(name, "f8") for name in ("level_var", "cross_var", "slope_var")],  # covariance, in units of scale^2
        ("noise", "f8"),  # standard deviation of a block mean, V
        ("scale", "f8"),  # the same with a lower limit, V
        ("innovation", "f8"),  # innovation of the last update, V
        ("autocov", "f8"),  # mean product of successive innovations, V^2
        ("random_walk_var", "f8"),  # variance of the level's own random walk, by `autocov`, V^2
        ("updated_s", "f8"),  # time of the last update
        ("reading", "f8"),  # the last one, V
        *[(name, "f8") for name in ("count", "lowest", "highest")],  # readings in the present block, their extremes
        *[("mean", "f8"), ("previous_mean", "f8")],  # means of the present block, and of the one before, V
        ("residual", "f8"),  # block mean minus the level, or minus `start_level` during a change, V
        *[(name, "f8") for name in ("run_sum", "run_square_sum")],  # sums of the residuals of a run, and of squares
        ("start_level", "f8"),  # level at which a change began, V
        ("peak_step", "f8"),  # largest step of a change, V
        ("press_step", "f8"),  # step that the press made, V
        ("direction", "f8"),  # mean whitened step of touches
        *[("rest_level", "f8"), ("press_level", "f8")],  # last levels at rest, and under a press, V
    ]
)
"""State of a fibre; NaN is unknown."""

PAD = np.dtype(
    [
        ("n_readings", "i8"),
        ("reading_s", "f8"),  # time of the last reading
        *[("block_first", "i8"), ("block_start_s", "f8"), ("block_count", "i8")],  # first reading, its time, and count
        ("block_s", "f8"),  # time of the last block
        ("n_blocks", "i8"),  # blocks that the noise was learnt from
        ("resolution_v", "f8"),  # resolution of the converter: least difference of two readings
        *[("run", "i8"), ("run_first", "i8"), ("run_s", "f8")],  # blocks in a row that leave the levels, and the first
        ("in_change", "?"),
        ("change", "i8"),  # a `Change`
        *[("peak_size", "f8"), ("peak_s", "f8"), ("after_peak", "i8")],  # size, time, first reading after it (or -1)
        ("state", "i8"),  # a `State`
        ("released_s", "f8"),  # time of the last release
        ("unclear_first", "i8"),  # first reading of the change that led to `UNCLEAR`
        ("n_presses", "i8"),  # presses that direction and size were learnt from
        ("typical_v", "f8"),  # root of the summed squares of a press's steps, V
        ("typical_size", "f8"),  # size of a press, clipped
        ("agreement", "f8"),  # agreement of touches with the direction of earlier ones, -1 to 1
        ("rest_scatter", "f8"),  # mean clipped size of the step from one rest level to the next
        ("press_scatter", "f8"),  # the same of levels under presses
    ]
)
"""State of the pad."""

BLOCK_S = 0.03  # length of a block; a probe takes a tenth of a second to sink in
FADE_S = 2.5  # time in which a slope fades
SLOPE_S = 1.0  # time in which a slope is learnt
NOISE_S = 10.0  # time in which noise is learnt
GAP_S = 1.0  # a fibre that is missing for longer is reset
GIVE_UP_S = 1.0  # a run that lasts longer without agreement is noise that has grown
WARM_UP_BLOCKS = 8  # blocks before the first change
ROUGH_BLOCKS = 8  # noise learnt from n blocks is widened by ROUGH_BLOCKS / n
LEVEL_ERROR = 0.05  # error of the level after a step, relative to the step, while silicone settles
SLOPE_ERROR = 0.4  # error of the slope after a step, relative to the step, 1/s
MAX_INNOVATION = 2.5  # limit of the influence of a block on the level, standard deviations
MAX_GROWTH = 3.0  # limit of the influence of a block on the noise, standard deviations
MIN_SHARE = 0.01  # minimum noise, relative to a typical press
MIN_V = 1e-7  # minimum noise, V; smaller steps are rounding
MIN_CORRELATION = 0.25  # correlation of successive innovations above which a level is modelled as a random walk
MEAN_TO_STD = math.sqrt(math.pi / 2)  # standard deviation over mean absolute value of a normal distribution
STALL_S = 0.5  # a change that does not grow for longer has ended
SETTLED = 0.1  # a change that grows by a smaller share of itself in a block has ended
RELEASE_S = 1.0  # a step in the direction of a release, within this time after one, belongs to it
MAX_STEP = 20.0  # limit of a whitened step, so that a broken fibre does not outweigh the others
CLEAR_STEP = 5.0  # whitened step above which a fibre adds to the typical press in V
MIN_PRESSES = 3  # touches after which their direction is used
MIN_AGREEMENT = 0.5  # minimum agreement of touches for their direction to be used
TOUCH_RATE = 0.05  # weight of the newest touch in running means
LEVEL_RATE = 0.15  # weight of the newest level in running means
MIN_FURTHER = -0.1  # projection on the step of a press below which a change belongs to its release
FURTHER = 2  # event: a pad that is pressed is pressed further
# Rests and presses are confused if the scatter of rest levels exceeds both:
INVERTED = 1.2  # times the scatter of the levels under presses
MIN_INVERTED = 0.4  # times the size of a typical press


class State(IntEnum):
    """States of the pad; `classify_change` and `commit_change` hold the transitions.

    state      change                                           events            next state
    REST       in the direction of touches                      touch             PRESSED
    REST       the same, but gone when it settles (a tap)       touch, release    REST
    REST       takes back a step, soon after a release          -                 REST
    REST       against the direction of touches                 -                 UNCLEAR
    PRESSED    takes back the step of the touch                 release           REST
    PRESSED    further in the direction of touches              further           PRESSED
    PRESSED    any other                                        -                 PRESSED
    UNCLEAR    takes back the unclear step: that was a touch    touch, release    REST
    UNCLEAR    any other: that was a missed press's release     touch             PRESSED
    PRESSED    rest levels scatter as only presses do           release           REST
    """

    REST = 0
    PRESSED = 1
    UNCLEAR = 2


class Change(IntEnum):
    """Classes of a change.

    SETTLING is a later part of a release, FURTHER a press that deepens, moves or is joined by a second one, and may yet
    turn into a release; PARTIAL is the release of one of two presses.
    """

    UNKNOWN = 0
    TOUCH = 1
    RELEASE = 2
    SETTLING = 3
    FURTHER = 4
    PARTIAL = 5


def initial_state(n_fibres: int) -> tuple[Any, Any]:
    """Return the state before the first reading, to be overwritten: `FIBRE` of shape (C,), and a `PAD`."""
    fibres = np.zeros(n_fibres, FIBRE)
    for name in ("level", "reading", "mean", "previous_mean", "residual", "start_level", "rest_level", "press_level"):
        fibres[name] = np.nan
    fibres["updated_s"] = -np.inf
    pad = np.zeros(1, PAD)
    pad["resolution_v"] = np.inf
    pad["reading_s"] = pad["block_s"] = pad["released_s"] = -np.inf
    return fibres, pad[0]


@kernel(inline="always")
def ingest(fibres: Any, pad: Any, row: Any, time_s: float) -> bool:
    """Add a reading (C,) to the present block; return whether that completes it with some fibre in it."""
    if pad.block_count == 0:
        pad.block_first, pad.block_start_s = pad.n_readings, time_s
        for fibre in fibres:
            fibre.mean, fibre.count, fibre.lowest, fibre.highest = 0.0, 0.0, np.inf, -np.inf
    for f in range(len(fibres)):
        fibre, volts = fibres[f], row[f]
        if np.isnan(volts):
            continue
        if MIN_V < abs(volts - fibre.reading) < pad.resolution_v:
            pad.resolution_v = abs(volts - fibre.reading)
        fibre.reading = volts
        fibre.mean += volts
        fibre.count += 1
        fibre.lowest, fibre.highest = min(fibre.lowest, volts), max(fibre.highest, volts)
    pad.block_count += 1
    complete = time_s - pad.block_start_s + (time_s - pad.reading_s) >= BLOCK_S  # the next reading would be too late
    present = False
    if complete:
        pad.block_count = 0
        for fibre in fibres:
            present |= fibre.count > 0
            if fibre.count >= 3:  # the lowest and the highest may be spikes
                fibre.mean = (fibre.mean - fibre.lowest - fibre.highest) / (fibre.count - 2)
            else:
                fibre.mean /= fibre.count  # NaN without a reading
    pad.n_readings += 1
    pad.reading_s = time_s
    return complete and present


@kernel(inline="always")
def kalman_predict(fibres: Any, pad: Any, time_s: float) -> None:
    """Predict all levels for `time_s`; forget fibres that were missing for long."""
    floor = max(MIN_SHARE * pad.typical_v, MIN_V, pad.resolution_v / 2 if pad.resolution_v < np.inf else 0.0)
    widening = 1 + ROUGH_BLOCKS / max(pad.n_blocks, 1)
    dt = min(max(time_s - pad.block_s, 0.0), GAP_S)
    fade = math.exp(-dt / FADE_S)
    gain = FADE_S * (1 - fade)  # integral of the fading slope
    for fibre in fibres:
        fibre.scale = widening * max(fibre.noise, floor)
        fibre.random_walk_var = max(fibre.autocov - MIN_CORRELATION * fibre.noise**2, 0.0)
        if time_s - fibre.updated_s > GAP_S:
            fibre.level = np.nan
        fibre.level += gain * fibre.slope
        fibre.slope *= fade
        fibre.level_var += gain * (2 * fibre.cross_var + gain * fibre.slope_var)
        fibre.cross_var = fade * (fibre.cross_var + gain * fibre.slope_var)
        fibre.slope_var = fade**2 * fibre.slope_var + dt**2 / SLOPE_S**4


@kernel
def _start_track(fibre: Any, time_s: float, step: float) -> None:
    """Start the filter of a fibre at the present block, after a whitened step."""
    fibre.level, fibre.slope, fibre.innovation, fibre.updated_s = fibre.mean, 0.0, 0.0, time_s
    fibre.level_var = 1 + (LEVEL_ERROR * step) ** 2
    fibre.cross_var = 0.0
    fibre.slope_var = 1 + (SLOPE_ERROR * step) ** 2


@kernel
def kalman_update(fibres: Any, pad: Any, time_s: float) -> None:
    """Correct levels, slopes and noise by the present block, robustly."""
    share = max(1 / (pad.n_blocks + 1), 1 - math.exp(-min(time_s - pad.block_s, GAP_S) / NOISE_S))
    for fibre in fibres:
        if np.isnan(fibre.mean):
            continue
        if np.isnan(fibre.level):
            _start_track(fibre, time_s, 0.0)
            continue
        innovation, total_var = fibre.mean - fibre.level, fibre.level_var + 1
        std = MEAN_TO_STD * abs(innovation) / math.sqrt(total_var)
        if pad.n_blocks >= WARM_UP_BLOCKS:
            std = min(std, MAX_GROWTH * fibre.scale)
            limit = MAX_INNOVATION * fibre.scale * math.sqrt(total_var)
            innovation = min(max(innovation, -limit), limit)
        fibre.noise += share * (std - fibre.noise)
        fibre.autocov += share * (innovation * fibre.innovation - fibre.autocov)
        fibre.innovation = innovation
        gain, slope_gain = fibre.level_var / total_var, fibre.cross_var / total_var
        fibre.level += gain * innovation
        fibre.slope += slope_gain * innovation
        fibre.slope_var -= slope_gain * fibre.cross_var
        fibre.cross_var *= 1 - gain
        fibre.level_var *= 1 - gain
        fibre.updated_s = time_s
    pad.n_blocks += 1


@kernel
def _learn_run_noise(fibres: Any, pad: Any, time_s: float) -> None:
    """Learn the noise of a run, if there is one, that was no change."""
    if pad.run > 0:
        share = 1 - math.exp(-(time_s - pad.run_s) / NOISE_S)
        for fibre in fibres:
            std = min(math.sqrt(fibre.run_square_sum / pad.run), MAX_GROWTH * fibre.scale)
            fibre.noise += share * (std - fibre.noise)


@kernel
def _start_run(fibres: Any, pad: Any, time_s: float) -> None:
    """Start a run at the present block, or at the single block before it, since a touch may have two steps."""
    if pad.run != 2:
        pad.run_first, pad.run_s = pad.block_first, time_s
    pad.run = 1
    for fibre in fibres:
        fibre.run_sum = 0.0 if np.isnan(fibre.residual) else fibre.residual
        fibre.run_square_sum = fibre.run_sum**2


@kernel(inline="always")
def _extend_run(fibres: Any, pad: Any) -> tuple[float, float]:
    """Extend the run; return its common signal (mean product of two blocks) and the distance of the last block."""
    common, distance = 0.0, 0.0
    n_before, pad.run = pad.run, pad.run + 1
    for fibre in fibres:
        if np.isnan(fibre.residual):  # counts like the blocks before, so that the sums keep their weight
            fibre.run_sum += fibre.run_sum / n_before
            fibre.run_square_sum += fibre.run_square_sum / n_before
            continue
        distance += ((fibre.residual - fibre.run_sum / n_before) / fibre.scale) ** 2 / (1 + 1 / n_before)
        fibre.run_sum += fibre.residual
        fibre.run_square_sum += fibre.residual**2
        product = (fibre.run_sum**2 - fibre.run_square_sum) / (pad.run * n_before)
        common += product / (fibre.scale**2 * (1 / pad.run + fibre.level_var) + fibre.random_walk_var)
    return common, distance


@kernel(inline="always")
def has_changed(fibres: Any, pad: Any, time_s: float, reject_limit: Any, accept_limit: Any) -> bool:
    """Test the present block; return whether the levels have changed since reading `pad.run_first`."""
    n_present, chi_square = 0, 0.0
    for fibre in fibres:
        fibre.residual = fibre.mean - fibre.level
        if not np.isnan(fibre.residual):
            n_present += 1
            chi_square += fibre.residual**2 / (fibre.scale**2 * (1 + fibre.level_var) + fibre.random_walk_var)
    if chi_square <= reject_limit[n_present]:
        _learn_run_noise(fibres, pad, time_s)
        pad.run = 0
        kalman_update(fibres, pad, time_s)
        return False
    if pad.run == 0:
        _start_run(fibres, pad, time_s)
        return False
    common, distance = _extend_run(fibres, pad)
    if common > accept_limit[n_present]:
        return True
    if distance > accept_limit[n_present]:  # the blocks before belonged to something else
        _start_run(fibres, pad, time_s)
    elif time_s - pad.run_s > GIVE_UP_S:
        _learn_run_noise(fibres, pad, time_s)
        pad.run = 0
        for fibre in fibres:
            fibre.residual = 0.0
            _start_track(fibre, time_s, 0.0)
    return False


@kernel
def _whiten(fibres: Any, f: int, volts: float, limit: float) -> float:
    """Whiten a step of fibre f, clipped to the limit; 0 for NaN, or for one that noise of C fibres makes by chance."""
    z = volts / fibres[f].scale
    return min(max(z, -limit), limit) if abs(z) > math.sqrt(2 * math.log(len(fibres))) else 0.0


@kernel
def _size(fibres: Any, steps: Any, limit: float) -> float:
    """Return the sum of squares of whitened steps (C,), each clipped to the limit."""
    total = 0.0
    for f in range(len(fibres)):
        total += _whiten(fibres, f, steps[f], limit) ** 2
    return total


@kernel
def _projection(fibres: Any, steps: Any) -> float:
    """Project the residual on steps (C,), relative to them; 0 if all steps are 0."""
    product, total = 0.0, 0.0
    for f in range(len(fibres)):
        z = _whiten(fibres, f, steps[f], MAX_STEP)
        product += z * _whiten(fibres, f, fibres[f].residual, MAX_STEP)
        total += z**2
    return product / total if total > 0 else 0.0


@kernel
def _agreement(fibres: Any) -> float:
    """Return the agreement of the residual with the direction of touches, from -1 (opposite) to 1."""
    product, total = 0.0, 0.0
    for f in range(len(fibres)):
        z = _whiten(fibres, f, fibres[f].residual, MAX_STEP)
        product += z * abs(z) * fibres[f].direction
        total += z**2 * abs(fibres[f].direction)
    return product / total if total > 0 else 0.0


@kernel
def _confirmed_step(fibre: Any) -> float:
    """Return the part of the step, V, that the present block and the one before have in common."""
    now, before = fibre.residual, fibre.previous_mean - fibre.start_level
    if now > 0 and before > 0:
        return min(now, before)
    return max(now, before) if now < 0 and before < 0 else 0.0


@kernel(inline="always")
def track_peak(fibres: Any, pad: Any, time_s: float) -> None:
    """Store the largest step of a change in two blocks in a row; a single block may be a spike."""
    size = 0.0
    for f in range(len(fibres)):
        size += _whiten(fibres, f, _confirmed_step(fibres[f]), np.inf) ** 2
    if size > pad.peak_size:
        pad.peak_size, pad.peak_s, pad.after_peak = size, time_s, -1
        for fibre in fibres:
            fibre.peak_step = _confirmed_step(fibre)
    elif pad.after_peak < 0:
        pad.after_peak = pad.block_first


@kernel(inline="always")
def _has_settled(fibres: Any, pad: Any, time_s: float, reject_limit: Any) -> bool:
    """Return whether a change has ended."""
    n_present, chi_square = 0, 0.0
    for fibre in fibres:
        difference = fibre.mean - fibre.previous_mean
        if not np.isnan(difference):
            n_present += 1
            chi_square += (difference / fibre.scale) ** 2 / 2
    if chi_square <= max(reject_limit[n_present], SETTLED**2 / 2 * _size(fibres, fibres.residual, np.inf)):
        return True
    if time_s - pad.peak_s <= STALL_S:
        return False
    # Noise has grown if a change stalls unsettled. Half of it is learnt, since this may be a slow press after all.
    for fibre in fibres:
        std = MEAN_TO_STD * abs(fibre.mean - fibre.previous_mean) / math.sqrt(2)
        if std > fibre.noise:
            fibre.noise += (std - fibre.noise) / 2
    return True


@kernel(inline="always")
def _learn_touch(fibres: Any, pad: Any) -> None:
    """Learn direction and size from a touch that has settled."""
    pad.n_presses += 1
    share = max(1 / pad.n_presses, TOUCH_RATE)
    if pad.n_presses > 1:
        pad.agreement += max(1 / (pad.n_presses - 1), TOUCH_RATE) * (_agreement(fibres) - pad.agreement)
    square = 0.0
    for f in range(len(fibres)):
        fibre = fibres[f]
        fibre.direction += share * (_whiten(fibres, f, fibre.residual, MAX_STEP) - fibre.direction)
        if abs(_whiten(fibres, f, fibre.residual, np.inf)) > CLEAR_STEP:
            square += fibre.residual**2
    pad.typical_v += share * (math.sqrt(square) - pad.typical_v)
    pad.typical_size += share * (_size(fibres, fibres.residual, MAX_STEP) - pad.typical_size)


@kernel
def _replace_levels(fibres: Any, levels: Any) -> float:
    """Set the last levels (C,) of a kind to the present block; return the clipped size of that step."""
    total = 0.0
    for f in range(len(fibres)):
        total += _whiten(fibres, f, fibres[f].mean - levels[f], MAX_STEP) ** 2
        if not np.isnan(fibres[f].mean):
            levels[f] = fibres[f].mean
    return total


@kernel(inline="always")
def emit(events: Any, count: Any, kind: int, reading: int) -> int:
    """Append an event; return their number."""
    events[count, 0], events[count, 1] = kind, reading
    return count + 1


@kernel(inline="always")
def classify_change(fibres: Any, pad: Any, time_s: float, settled: bool, events: Any, count: Any) -> int:
    """Classify the present change, if its class is clear by now; return the number of events."""
    has_direction = pad.n_presses >= MIN_PRESSES and pad.agreement > MIN_AGREEMENT
    agreement = _agreement(fibres) if has_direction else 1.0
    projection = _projection(fibres, fibres.press_step)  # -1 if the step of the press is taken back
    size_ratio = _size(fibres, fibres.residual, MAX_STEP) / _size(fibres, fibres.press_step, MAX_STEP)
    if pad.state == State.REST and time_s - pad.released_s < RELEASE_S and projection < -0.5 * math.sqrt(size_ratio):
        pad.change = Change.SETTLING
    elif pad.state == State.REST and agreement >= 0:
        pad.change = Change.TOUCH
        count = emit(events, count, True, pad.run_first)
    elif pad.state == State.PRESSED and (projection < -0.5 or (agreement < 0 and size_ratio > 0.25)):
        pad.change = Change.RELEASE
        count = emit(events, count, False, pad.run_first)
    elif pad.state == State.PRESSED and pad.change == Change.UNKNOWN and agreement > 0 and projection > MIN_FURTHER:
        pad.change = Change.FURTHER
        count = emit(events, count, FURTHER, pad.run_first)
    elif pad.state == State.UNCLEAR and settled:
        was_touch = agreement < 0 or (-2 < projection < -0.5 and size_ratio < 4)
        count = emit(events, count, True, pad.unclear_first if was_touch else pad.run_first)
        if was_touch:
            count = emit(events, count, False, pad.run_first)
        pad.change = Change.RELEASE if was_touch else Change.TOUCH
    return count


@kernel(inline="always")
def _set_press_step(fibres: Any, keep: float) -> None:
    """Add the residual to a share of the step of the press."""
    for fibre in fibres:
        fibre.press_step = keep * fibre.press_step + (0.0 if np.isnan(fibre.residual) else fibre.residual)


@kernel(inline="always")
def commit_change(fibres: Any, pad: Any, time_s: float, events: Any, count: Any) -> int:
    """Change the state by a change that has settled; return the number of events."""
    if pad.change == Change.TOUCH and _projection(fibres, fibres.peak_step) < 0.5:  # a tap, which has been released
        pad.state = State.REST
        return emit(events, count, False, pad.after_peak if pad.after_peak >= 0 else pad.block_first)
    if pad.change == Change.TOUCH:
        pad.state = State.PRESSED
        _set_press_step(fibres, 0.0)
        _learn_touch(fibres, pad)
        pad.press_scatter += LEVEL_RATE * (_replace_levels(fibres, fibres.press_level) - pad.press_scatter)
        bound = max(INVERTED * pad.press_scatter, MIN_INVERTED * pad.typical_size)
        if pad.n_presses >= MIN_PRESSES and pad.rest_scatter > bound:
            pad.state, pad.n_presses, pad.rest_scatter, pad.press_scatter = State.REST, 0, 0.0, 0.0
            count = emit(events, count, False, pad.block_first)
    elif pad.change == Change.RELEASE:
        pad.state, pad.released_s = State.REST, time_s
        pad.rest_scatter += LEVEL_RATE * (_replace_levels(fibres, fibres.rest_level) - pad.rest_scatter)
    elif pad.change == Change.UNKNOWN and pad.state == State.REST:
        pad.state, pad.unclear_first = State.UNCLEAR, pad.run_first
        _set_press_step(fibres, 0.0)
    elif pad.change == Change.UNKNOWN or pad.change == Change.FURTHER:
        larger = _size(fibres, fibres.residual, np.inf) > _size(fibres, fibres.press_step, np.inf)
        _set_press_step(fibres, 0.0 if larger else 1.0)
    return count


@kernel(inline="always")
def _process_block(
    fibres: Any, pad: Any, time_s: float, reject_limit: Any, accept_limit: Any, events: Any, count: Any
) -> int:
    """Process a complete block; return the number of events."""
    if not pad.in_change:
        kalman_predict(fibres, pad, time_s)
        if pad.n_blocks < WARM_UP_BLOCKS:
            kalman_update(fibres, pad, time_s)
        elif has_changed(fibres, pad, time_s, reject_limit, accept_limit):
            pad.in_change, pad.change = True, Change.UNKNOWN
            pad.peak_size, pad.peak_s, pad.after_peak = 0.0, time_s, -1
            for fibre in fibres:  # one by one, since assigning a slice compiles code that formats an error message
                fibre.start_level = fibre.level
    if pad.in_change:
        for fibre in fibres:
            if np.isnan(fibre.mean):  # a missing fibre stays as last read in this change
                fibre.mean = fibre.start_level + fibre.residual
            fibre.residual = fibre.mean - fibre.start_level
        track_peak(fibres, pad, time_s)
        settled = _has_settled(fibres, pad, time_s, reject_limit)
        if pad.change == Change.UNKNOWN or pad.change == Change.FURTHER:
            count = classify_change(fibres, pad, time_s, settled, events, count)
        if settled:
            count = commit_change(fibres, pad, time_s, events, count)
            pad.run, pad.in_change = 0, False
            for fibre in fibres:
                _start_track(fibre, time_s, 0.0 if np.isnan(fibre.residual) else fibre.residual / fibre.scale)
    for fibre in fibres:
        fibre.previous_mean = fibre.mean
    pad.block_s = time_s
    return count


@kernel
def detect(
    fibres: Any, pad: Any, times_s: Any, readings: Any, reject_limit: Any, accept_limit: Any, events: Any
) -> Any:
    """Detect presses in further readings (n, C), V, from the `initial_state`, which is overwritten.

    By the number of fibres present, `reject_limit` (C + 1,) is the chi-square that noise exceeds rarely, `accept_limit`
    hardly ever. Returns the number of `events` (2 n, 2): 1 (touch), 0 (release) or `FURTHER`, and the first reading
    that shows it.
    """
    count = np.int64(0)
    for r in range(len(times_s)):
        if ingest(fibres, pad, readings[r], times_s[r]):
            count = _process_block(fibres, pad, times_s[r], reject_limit, accept_limit, events, count)
    return count
