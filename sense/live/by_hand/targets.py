"""Where a person is asked to press, in an order that is kind to the hand and fair to what is learnt."""

import numpy as np

from padforge.design.common.validation import InputError
from padforge.sense.recordings.press_plan import free_of, planned, size_of
from padforge.sense.recordings.processing.limits import Array
from padforge.sense.rig.planning.setup import Setup

ROUND = 25
"""Places of a uniform plan that are gone through by a short way, before the next ones. Whoever stops early has been
all over the pad, and what drifts with time is not taken for what changes with the place."""


def targets_of(setup: Setup) -> Array:
    """(Q, 2) places in mm as `[rig]` asks for them: of a grid or a file in that order, or uniform ones in short rounds.

    Uniform places are whole millimetres: nobody hits fractions, and whole ones are found on squared paper.

    Raises:
        InputError: an adaptive plan, or a file of places that is none.
    """
    rig = setup.rig
    if rig.plan == "adaptive":
        raise InputError("[rig] plan is adaptive, by hand allowed are uniform, grid, boustrophedon or a .csv of places")
    places_mm = planned(setup.pad, rig, np.random.default_rng(rig.seed), setup.size).places_mm
    if rig.plan != "uniform":
        return places_mm
    whole_mm = np.rint(places_mm)
    free = free_of(setup.pad, size_of(setup.pad, setup.size))(whole_mm)
    return in_rounds(np.where(free[:, None], whole_mm, places_mm))


def in_rounds(places_mm: Array) -> Array:
    """(Q, 2) places, `ROUND` at a time, each round from where the last one ended always to the nearest that is left."""
    ordered = np.empty_like(places_mm)
    at = places_mm[0]
    for first in range(0, len(places_mm), ROUND):
        left = places_mm[first : first + ROUND]
        for row in range(first, first + len(left)):
            nearest = int(np.argmin(np.linalg.norm(left - at, axis=1)))
            at = ordered[row] = left[nearest]
            left = np.delete(left, nearest, axis=0)
    return ordered


def still_to_make(targets_mm: Array, made_mm: Array) -> Array:
    """(P, 2) those of the targets (Q, 2), in their order, that are not among the places (R, 2) of presses made."""
    made = [tuple(place) for place in made_mm.tolist()]
    left = []
    for place in targets_mm.tolist():
        if tuple(place) in made:
            made.remove(tuple(place))
        else:
            left.append(place)
    return np.array(left).reshape(-1, 2)
