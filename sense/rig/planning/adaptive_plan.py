"""Pressing where a localizer is least certain: an adaptive plan moves its presses there as the recording goes on."""

from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from padforge.sense.localizer.localizer import Localizer
from padforge.sense.localizer.locating import locate
from padforge.sense.recordings.press_plan import Free, PressPlan, uniform
from padforge.sense.recordings.processing.limits import Array
from padforge.sense.recordings.recording import Recording

EVERY = 20
"""Presses between two looks at how well the localizer finds them."""
_CANDIDATES = 500
_NEIGHBOURS = 5


class Steering:
    """Chooses presses: those candidates where errors nearby, times the way to the nearest press, are largest.

    Args:
        localizer: calibrated on an earlier recording of the pad. run: run directory that is being written, synced after
            every press. rng: of the candidates. free: which of them may be pressed.
    """

    def __init__(self, localizer: Localizer, run: Path, rng: np.random.Generator, free: Free) -> None:
        self._localizer, self._run, self._rng, self._free = localizer, run, rng, free

    def __call__(self, plan: PressPlan, press: int) -> PressPlan:
        """The plan with its next presses, from `press` on, moved; unchanged between two looks."""
        if press == 0 or press % EVERY:
            return plan
        recording = Recording.open(self._run)
        errors = np.linalg.norm(locate(self._localizer, recording).places_mm - recording.presses_mm, axis=1)
        places = plan.places_mm.copy()
        high = np.abs(plan.places_mm).max(axis=0)
        candidates = uniform(np.array([-high, high]), _CANDIDATES, self._rng, self._free)
        pressed = recording.presses_mm
        for number in range(press, min(press + EVERY, len(plan))):
            places[number] = candidates[np.argmax(uncertainty(candidates, recording.presses_mm, errors, pressed))]
            pressed = np.vstack([pressed, places[number]])
        return PressPlan(places, plan.depths_mm)


def uncertainty(candidates: Array, known: Array, errors: Array, pressed: Array) -> Array:
    """(K,) how much there is to learn at candidates (K, 2): mean error of the nearest presses times the way to any.

    Args:
        known, errors: (Q, 2) places whose errors (Q,) are known. pressed: (P, 2) all places, of which none is repeated.
    """
    _, near = KDTree(known).query(candidates, k=min(_NEIGHBOURS, len(known)))
    way, _ = KDTree(pressed).query(candidates)
    return errors[near].reshape(len(candidates), -1).mean(axis=1) * way
