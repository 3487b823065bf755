"""`[contact]`: what a press does to a fibre."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal

from padforge.design.common.settings import Settings, as_python, as_tuple, none_as
from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Sides = Annotated[Annotated[int, Field(ge=3, le=4096)] | None, *none_as("circle")]


MEASURED_REACH = (
    *((0.0, 1.0), (2.25, 0.936), (4.5, 0.768), (6.75, 0.551), (9.0, 0.346)),
    *((11.25, 0.188), (13.5, 0.085), (15.75, 0.029), (18.5625, 0.0)),
)
"""How the built pad answers: about a Gaussian of standard deviation 6.2 mm, with a smooth end in place of its tails."""
MAX_OVERSHOOT = 0.15
"""By which a spline may leave the range of the two points it runs between, share of the largest weight: smooth profiles
stay far below it, one that leaves its points would count for what nobody has measured."""

Point = tuple[Annotated[float, Field(ge=0, le=1e4)], Annotated[float, Field(ge=-1e3, le=1e3)]]


def _points(value: object) -> object:
    """Lists, as files have them, as the tuples that a frozen model holds."""
    return tuple(as_tuple(point) for point in value) if isinstance(value, list | tuple) else value


class Contact(Settings):
    """`[contact]`: what a press does to a fibre: by a reach that was measured, or as published by a shape around it.

    The signal of a fibre is the integral of a weight over its length: that of `reach` by distance d to the press
    centre; or, where `reach` is empty, `weight` inside a regular polygon or circle (paper, formulas (1), (2)), which is
    meant as well where `radius`, `sides` or `weight` are given and `reach` is not. Shapes are in grid units, as
    published; a press that was measured is as wide in mm on pads of any pitch.

    Attributes:
        radius: circumradius K of the shape, > 0.
        sides: D >= 3, or None for a circle ("circle" in pad.toml).
        weight: "uniform" (1), "inverse_square" (1 / (K + d^2)) or "inverse" (1 / max(d, K / 100), which is the
            paper's 1 / d kept finite within a hundredth of the radius).
        length: "manhattan" (|dx| + |dy|, as the published code has it, and the default of shapes) or "euclidean", the
            default of a reach.
        reach: points (distance in mm, weight) from distance 0 to where the weight is 0 and stays so, joined by a cubic
            spline over d^2, which may leave their range by MAX_OVERSHOOT. A weight may be below 0. MEASURED_REACH if
            nothing of the contact is given.
    """

    radius: float = Field(default=0.6, ge=1e-9, le=1e4, description="object radius K, grid units, where reach is []")
    sides: Sides = Field(default=30, description='sides D of the object, or "circle", where reach is []')
    weight: Literal["uniform", "inverse_square", "inverse"] = Field(
        default="uniform", description="weight of a fibre element where reach is []: 1, 1/(K + d^2) or 1/d"
    )
    length: Literal["manhattan", "euclidean"] = Field(
        default="euclidean", description="length of a fibre element: euclidean, or |dx| + |dy| as published"
    )
    reach: Annotated[tuple[Point, ...], BeforeValidator(_points), Field(max_length=64)] = Field(
        default=MEASURED_REACH, description="measured weight by distance, mm, [[0, 1], ..., [d, 0]]; [] for a shape"
    )

    @model_validator(mode="before")
    @classmethod
    def _of_one_kind(cls, given: object) -> object:
        """What is left out, by what is given: a shape as published, or a reach."""
        given = as_python(given)  # `Settings` does so later, and an array says not whether it is empty
        if not isinstance(given, Mapping):
            return given
        reach = given.get("reach", () if _SHAPE & given.keys() else MEASURED_REACH)
        shape = isinstance(reach, list | tuple) and not reach
        return {"reach": reach, "length": "manhattan" if shape else "euclidean", **given}

    @field_validator("reach")
    @classmethod
    def _ends_in_nothing(cls, reach: tuple[Point, ...], info: ValidationInfo) -> tuple[Point, ...]:
        if not reach:
            return reach
        for name, value in info.data.items():
            # else a radius that is set beside the reach `padforge init` has written would change nothing
            if name in _SHAPE and value != cls.model_fields[name].default:
                raise ValueError(f"{name} is {value}, which counts where reach is []")
        distances, weights = zip(*reach, strict=True)
        if len(reach) < 3 or distances[0] != 0 or any(a >= b for a, b in pairwise(distances)):
            raise ValueError("it must be of 3 points or more, whose distances ascend from 0")
        if weights[-1] != 0 or not any(weights):
            raise ValueError("the last weight must be 0, and some other one not")
        if reach != MEASURED_REACH:  # so that the default needs no SciPy, which takes a while to load
            _check_overshoot(reach)
        return reach

    def profile_points(self, unit_mm: float) -> tuple[Point, ...]:
        """Return the measured profile as the kernels take it, on a pad of some grid unit.

        Args:
            unit_mm: the pad's grid unit, mm.

        Returns:
            Points (distance in grid units, weight) of `reach`.
        """
        return tuple((distance_mm / unit_mm, weight) for distance_mm, weight in self.reach)


def profile_spline(points: tuple[Point, ...]) -> "CubicSpline":
    """Fit the cubic spline of a measured profile over the squared distance, so that it is smooth at the centre as well.

    It meets 0 without a kink at its end.

    Args:
        points: (distance, weight), the last of weight 0.
    """
    import numpy as np  # settings alone take none
    from scipy.interpolate import CubicSpline

    distance, weight = np.array(points).T
    return CubicSpline(distance**2, weight, bc_type=((2, 0.0), (1, 0.0)))  # pyright: ignore[reportArgumentType]


def _check_overshoot(points: tuple[Point, ...]) -> None:
    """Refuse points between which their spline swings far beyond them."""
    spline = profile_spline(points)
    slack = MAX_OVERSHOOT * max(abs(weight) for _, weight in points)
    extremes = [square for square in spline.derivative().roots(extrapolate=False).tolist() if math.isfinite(square)]
    for (begin, first), (end, second) in pairwise(points):
        low, high = min(first, second) - slack, max(first, second) + slack
        for weight in (float(spline(square)) for square in extremes if begin**2 < square < end**2):
            if not low <= weight <= high:
                raise ValueError(
                    f"between the points at {begin:g} and {end:g} mm their spline comes to {weight:.3g}, "
                    f"allowed is {low:.3g} to {high:.3g}; points closer together keep it there"
                )


_SHAPE = {"radius", "sides", "weight"}

PUBLISHED_CONTACT = Contact(radius=0.6)
"""The paper's: a polygon of 30 sides, Manhattan lengths. Functions that restate the paper take it for None."""
