"""What is drawn, whatever the file: polylines with names, and the border of the pad where that is drawn as well."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from padforge.design.common.errors import InputError
from padforge.design.pad.courses.curves import cubic
from padforge.design.pad.knots import Array

MOST_BYTES = 2**22
"""Of a drawing: one of more is none of fibres."""
MOST_POINTS = 200_000
MOST_PARTS = 20_000
"""Elements of a drawing that are looked at."""
MOST_CURVES = 5000
"""Before those that end in one point are put together."""
FARTHEST = 1e6
"""Greatest coordinate by amount, in units of the drawing."""
STEPS = 48
"""Straight pieces of a cubic: off by less than 5e-5 of its length."""

_LONGEST_REASON = 120
_FIBRES = re.compile(r"(fibre|fiber|horizontal|vertical)", re.IGNORECASE)
_PAD = "pad"
_TOGETHER = 1e-6
"""Share of a drawing's size within which ends are one point."""


@dataclass(frozen=True)
class Stroke:
    """One piece of a drawing.

    Attributes:
        name: as the file has it, or its kind and number.
        points: (n, 2) in units of the drawing, y upwards.
        groups: names of it and of all groups or layers it lies in.
        closed: whether it ends where it begins.
    """

    name: str
    points: Array
    groups: tuple[str, ...] = ()
    closed: bool = False


@dataclass
class Drawing:
    """A drawing as it is read.

    Attributes:
        unit_mm: a unit of it. note: what had to be taken for granted.
    """

    unit_mm: float = 1.0
    note: str = ""
    strokes: list[Stroke] = field(default_factory=list)
    parts: int = 0
    points: int = 0

    def looked_at(self) -> None:
        """One more element.

        Raises:
            InputError: there are too many.
        """
        self.parts += 1
        if self.parts > MOST_PARTS:
            raise InputError(f"more than {MOST_PARTS} elements, which is more than a drawing of fibres has")

    def add(self, name: str, points: Array, groups: Sequence[str] = (), closed: bool = False) -> None:
        """One more stroke, unless it is but a point.

        Raises:
            InputError: coordinates that are not finite or beyond FARTHEST, or too many points.
        """
        self.points += len(points)
        if self.points > MOST_POINTS:
            raise InputError(f"more than {MOST_POINTS} points, which is more than a drawing of fibres has")
        if not (np.abs(points) <= FARTHEST).all():
            raise InputError(f"{name}: coordinates that are no numbers or beyond {FARTHEST:g}")
        points = points[np.append(True, (np.diff(points, axis=0) != 0).any(axis=1))]
        if len(points) > 1:
            closed = closed or bool((points[0] == points[-1]).all())
            self.strokes.append(Stroke(name, points, tuple(filter(None, groups)), closed))

    @property
    def border(self) -> Array | None:
        """(2, 2) low and high corner of what is named "pad", None where nothing is."""
        found = [stroke.points for stroke in self.strokes if _PAD in (each.lower() for each in stroke.groups)]
        return np.array([np.vstack(found).min(axis=0), np.vstack(found).max(axis=0)]) if found else None

    @property
    def fibres(self) -> list[Stroke]:
        """The curves that are fibres, pieces that end where another begins put together.

        They are what is named so (fibre, horizontal, vertical), or where nothing is all that is open.
        """
        named = [stroke for stroke in self.strokes if any(map(_FIBRES.match, stroke.groups))]
        for stroke in named:
            if stroke.closed:
                raise InputError(f"{stroke.name}: closed, expected a curve from one border of the pad to the other")
        open_ones = [each for each in self.strokes if not each.closed and _PAD not in map(str.lower, each.groups)]
        chosen = named or open_ones
        if len(chosen) > MOST_CURVES:
            raise InputError(f"{len(chosen)} open curves, which is more than a drawing of fibres has")
        return list(_joined(chosen))


def reason(error: Exception) -> str:
    """What a library has against a file, in one line that is not as long as the file."""
    return " ".join(str(error).split())[:_LONGEST_REASON] or type(error).__name__


class Pen:
    """Takes what a curve is made of and gives polylines."""

    def __init__(self) -> None:
        self.lines: list[tuple[Array, bool]] = []
        self._points: list[Array] = []

    def begin(self, place: Sequence[float]) -> None:
        """A new polyline begins."""
        self.end()
        self._points = [np.array([place], dtype=float)]

    def line(self, place: Sequence[float]) -> None:
        """Straight on to a place."""
        self._points.append(np.array([place], dtype=float))

    def curve(self, *control: Sequence[float]) -> None:
        """A Bezier curve on by one, two or three control points, the last of them its end."""
        points = np.array([self._points[-1][-1], *control], dtype=float)
        if len(points) == 3:
            a, b, c = points
            points = np.array([a, a + (b - a) * 2 / 3, c + (b - c) * 2 / 3, c])
        self._points.append(cubic(points, np.arange(1, STEPS + 1) / STEPS) if len(points) == 4 else points[1:])

    def end(self, closed: bool = False) -> None:
        """The polyline is done."""
        if self._points:
            points = np.vstack(self._points)
            self.lines.append((np.vstack([points, points[:1]]) if closed else points, closed))
        self._points = []


def _joined(strokes: list[Stroke]) -> Iterator[Stroke]:
    """Strokes, those put together whose ends are one point."""
    if not strokes:
        return
    from scipy.spatial import KDTree

    ends = np.array([stroke.points[end] for stroke in strokes for end in (0, -1)])
    near = _TOGETHER * max(float(np.ptp(ends, axis=0).max()), 1e-9)
    found = KDTree(ends).query(ends, k=min(3, len(ends)), distance_upper_bound=near)
    apart, others = (np.asarray(each).tolist() for each in found)
    partners: dict[int, int] = {}
    for end, row in enumerate(zip(apart, others, strict=True)):
        close = [other for distance, other in zip(*row, strict=True) if distance <= near and other != end]
        if len(close) > 1:
            x, y = ends[end]
            raise InputError(f"{strokes[end // 2].name}: more than two curves end at ({x:g}, {y:g})")
        if close:
            partners[end] = close[0]
    left = set(range(len(strokes)))
    free = [end for end in range(len(ends)) if end not in partners]
    for end in free:
        if end // 2 not in left:
            continue
        pieces: list[Array] = []
        names: list[Stroke] = []
        at: int | None = end
        while at is not None:
            stroke = strokes[at // 2]
            left.discard(at // 2)
            names.append(stroke)
            pieces.append(stroke.points if at % 2 == 0 else stroke.points[::-1])
            at = partners.get(at ^ 1)
        name = names[0].name if len(names) == 1 else f"{names[0].name} to {names[-1].name}"
        yield Stroke(name, np.vstack(pieces), names[0].groups)
    if left:
        raise InputError(
            f"{strokes[min(left)].name}: part of a ring, or drawn twice, expected curves from border to border"
        )
