from typing import Any

import numpy as np

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
