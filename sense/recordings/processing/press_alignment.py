"""The presses of a recording as they would be found in its readings, beside those that were commanded.

A probe takes up to 0.4 s from its command to the pad, more or less; a press found in the readings is aligned by what
it does to them. What is learnt from commanded presses alone is lost on such that were found, and so when it follows a
pad live: a release that is off by one reading costs several millimetres.
"""

import numpy as np

from padforge.sense.recordings.processing.limits import Array, Indices
from padforge.sense.recordings.processing.press_detection import as_commanded, find_presses

EARLY = 2
"""Readings before its command at which a press may show: commands are noted a little late."""


def as_detected(readings: Array, times_s: Array, begun: Indices, lifted: Indices) -> tuple[Indices, Indices]:
    """Presses as one who follows the readings live would have them.

    Args:
        readings: (R, C) volts, NaN where missing. times_s: (R,) s.
        begun, lifted: (Q,) first reading after the probe was sent down, and up.

    Returns:
        The same as found in the readings; of a press that is not found, as given.
    """
    found = find_presses(readings, times_s)
    downs, ups = as_commanded(found, times_s)
    if len(downs) == 0:
        return begun, lifted
    nearest = np.minimum(np.searchsorted(found.touched, begun - EARLY), len(downs) - 1)
    touched, released = found.touched[nearest], found.released[nearest]
    following = np.append(begun[1:], len(readings))
    sure = (touched >= begun - EARLY) & (touched < lifted) & (released >= lifted - EARLY) & (released < following)
    return np.where(sure, downs[nearest], begun), np.where(sure, ups[nearest], lifted)
