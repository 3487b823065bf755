"""Where the fibres of a pad end: so many horizontals and verticals, so far apart."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from padforge.design.common.errors import InputError, real, shown, whole

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DEFAULT_PITCH_MM = 11.25
"""Of the built pad."""
MOST_FIBRES = 1024
"""Most fibres of a family, of a pad that is made of tiles too."""

Pair = tuple[float, float]
Counts = int | tuple[int, int]
"""M horizontals and M verticals, or (horizontals, verticals)."""
Pitch = float | Pair
"""Distance of neighbouring fibre ends, mm: both ways, or along x and along y."""


@dataclass(frozen=True)
class Layout:
    """H horizontal and V vertical fibres, whose ends lie evenly along the edges of a rectangle.

    Horizontal fibre i runs along x at the height of i pitches along y, i = 1..H, vertical fibre i along y at i pitches
    along x, i = 1..V. The pad is V + 1 pitches wide and H + 1 high. Places are in grid units, which are equally long
    both ways: the pitch, or the geometric mean of two, so that a pad turned by 90 degrees answers alike.

    Attributes:
        horizontals, verticals: H and V, 0 to MOST_FIBRES each, one fibre or more in all.
        pitch_x_mm: distance of neighbouring verticals' ends. pitch_y_mm: of horizontals'. Both 0.1 to 1000 mm.

    Raises:
        InputError: no fibre, too many, or a pitch out of range.
    """

    horizontals: int
    verticals: int
    pitch_x_mm: float
    pitch_y_mm: float

    def __post_init__(self) -> None:
        for name in ("horizontals", "verticals"):
            object.__setattr__(self, name, whole(name, getattr(self, name), 0, MOST_FIBRES))
        for name in ("pitch_x_mm", "pitch_y_mm"):
            object.__setattr__(self, name, real(name.removesuffix("_mm"), getattr(self, name), 0.1, 1000))
        if not self.fibres:
            raise InputError("a pad of 0 horizontals and 0 verticals has no fibre, allowed is 1 or more in all")

    @classmethod
    def of(cls, fibres: "Counts | Layout", pitch_mm: Pitch = DEFAULT_PITCH_MM) -> "Layout":
        """From what is short: M or (H, V), and one pitch or (along x, along y); a layout is itself.

        Raises:
            InputError: anything else, or what the class refuses.
        """
        if isinstance(fibres, Layout):
            return fibres
        if isinstance(fibres, tuple | list):
            horizontals, verticals = _two("fibres", fibres)
        else:
            horizontals = verticals = whole("grid", fibres, 1, MOST_FIBRES)
        if isinstance(pitch_mm, tuple | list):
            along_x, along_y = _two("pitch_mm", pitch_mm)
        else:
            along_x = along_y = real("pitch_mm", pitch_mm, 0.1, 1000)
        return cls(horizontals, verticals, along_x, along_y)

    @property
    def fibres(self) -> int:
        """H + V."""
        return self.horizontals + self.verticals

    @property
    def counts(self) -> tuple[int, int]:
        """(H, V)."""
        return self.horizontals, self.verticals

    @property
    def families(self) -> tuple[slice, slice]:
        """The rows of the horizontals and of the verticals among all fibres."""
        return slice(0, self.horizontals), slice(self.horizontals, self.fibres)

    def family(self, fibre: int) -> int:
        """Of the fibre of that index: 0 of a horizontal, 1 of a vertical. It is the axis that it travels along."""
        return int(fibre >= self.horizontals)

    @property
    def is_square(self) -> bool:
        """Whether it is of as many fibres both ways, of one pitch."""
        return self.horizontals == self.verticals and self.pitch_x_mm == self.pitch_y_mm

    @property
    def pitch_mm(self) -> Pitch:
        """The pitch where there is one, else (along x, along y)."""
        return self.pitch_x_mm if self.pitch_x_mm == self.pitch_y_mm else (self.pitch_x_mm, self.pitch_y_mm)

    @cached_property
    def unit_mm(self) -> float:
        """A grid unit, mm."""
        one = self.pitch_x_mm == self.pitch_y_mm
        return self.pitch_x_mm if one else math.sqrt(self.pitch_x_mm * self.pitch_y_mm)

    @cached_property
    def spacing(self) -> Pair:
        """The pitches along x and along y, grid units."""
        return self.pitch_x_mm / self.unit_mm, self.pitch_y_mm / self.unit_mm

    @cached_property
    def extent(self) -> Pair:
        """Width and height of the pad, grid units: places on it are between (0, 0) and these."""
        return (self.verticals + 1) * self.spacing[0], (self.horizontals + 1) * self.spacing[1]

    @property
    def size_mm(self) -> Pair:
        """Width and height of the pad from fibre end to fibre end, mm."""
        return (self.verticals + 1) * self.pitch_x_mm, (self.horizontals + 1) * self.pitch_y_mm

    @cached_property
    def levels(self) -> "NDArray[np.float64]":
        """(F,) cross coordinate at which each fibre ends, grid units."""
        import numpy as np  # settings alone take none

        rows = np.concatenate([np.arange(1.0, count + 1) for count in self.counts])
        found = rows * np.repeat(self.spacing[::-1], self.counts)
        found.setflags(write=False)
        return found

    @property
    def settings(self) -> Mapping[str, Any]:
        """It as keys of `[pad]`."""
        counts: dict[str, Any] = {"horizontals": self.horizontals, "verticals": self.verticals}
        if self.horizontals == self.verticals:
            counts = {"grid": self.horizontals, "horizontals": "grid", "verticals": "grid"}
        return {**counts, "pitch_mm": self.pitch_mm}

    def __str__(self) -> str:
        """It in words: `4 + 4 fibres, pitch 11.25 mm`."""
        pitch = (
            f"{self.pitch_x_mm:g}"
            if self.pitch_x_mm == self.pitch_y_mm
            else (f"{self.pitch_x_mm:g} and {self.pitch_y_mm:g}")
        )
        return f"{self.horizontals} + {self.verticals} fibres, pitch {pitch} mm"


def _two(name: str, values: Sequence[Any]) -> tuple[Any, Any]:
    if len(values) != 2:
        raise InputError(f"{name} is {shown(values)}, expected one number or two")
    return values[0], values[1]
