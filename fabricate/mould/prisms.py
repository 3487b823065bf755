"""What is printed, as prisms: a neutral description that mesh and CAD solid are both made from.

z = 0 is the underside of a body, which lies on the print bed. Lengths are mm.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import shapely
from shapely.geometry.base import BaseGeometry

COLOURS = {"mould": "#8FA3B8", "lid": "#D9C27E", "conductive": "#6F8F72", "holder": "#B0886E"}
"""The bodies that are printed, by the colour in which CAD programs and slicers show each."""


@dataclass(frozen=True)
class Prism:
    """An upright solid from `bottom_mm` to `top_mm`.

    Attributes:
        area: its outline at the bottom, mm.
        flare_mm: by how much the outline has grown on every side at the top; for rectangles and regular polygons.
    """

    area: BaseGeometry
    bottom_mm: float
    top_mm: float
    flare_mm: float = 0.0


@dataclass(frozen=True)
class Body:
    """The union of `base` without `cuts` and with `adds`, in this order."""

    base: tuple[Prism, ...]
    cuts: tuple[Prism, ...] = ()
    adds: tuple[Prism, ...] = ()

    def with_adds(self, adds: Iterable[Prism]) -> "Body":
        """The body with more on it."""
        return replace(self, adds=(*self.adds, *adds))


def cylinder(x: float, y: float, diameter_mm: float, sides: int = 64) -> shapely.Polygon:
    """The outline of an upright cylinder around (x, y), mm; with 64 sides within 0.13 % of the diameter."""
    return shapely.Point(x, y).buffer(diameter_mm / 2, quad_segs=sides // 4)
