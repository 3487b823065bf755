import numpy as np

from padforge.design import Morphology, RulesSettings

NONE = RulesSettings(
    min_mean_bend_radius_mm=0,
    min_gap_mm=0,
    same_family_crossings=10**6,
    border_mm=0,
    max_length_mm=1e6,
    max_common_track_mm=None,
)


def only(**limits):
    """Rules of which all but these hold whatever a pad is like."""
    return NONE.model_copy(update=limits)


def square(x, y, side):
    """The corners of a keep-out, mm."""
    half = side / 2
    return ((x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half))


def bent(across, along=2.5, fibre=0):
    """A 4 x 4 grid with one knot of one fibre moved."""
    knots = Morphology.straight(4).knots
    middle = knots.mean(axis=1, keepdims=True)
    knots = np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1)
    knots[fibre, 1] = (along, across) if fibre < 4 else (across, along)
    return Morphology(knots)


def swung():
    """Two fibres that cross at a slope of 1.5: half-way up a span as high as long, between two turning points."""
    rising = np.array([[0, 1], [0.5, 0.5], [1.5, 1.5], [2, 1]])
    return Morphology(np.stack([rising, [[1, 0], [1, 0.5], [1, 1.5], [1, 2]]]))


def climbing(rise, family, end):
    """Two fibres, one of which climbs straight from its end on, as a PCHIP keeps to, and then comes back."""
    at = np.array([0, 0.4, 0.8, 1.4, 2.0])
    cross = np.array([1, 1 + 0.4 * rise, 1 + 0.8 * rise, 1, 1])
    line = np.column_stack([at, cross] if end == 0 else [2 - at[::-1], cross[::-1]])
    level = np.column_stack([np.ones(5), at])
    return Morphology(np.stack([line, level] if family == 0 else [level[:, ::-1], line[:, ::-1]]))
