"""`[contact]`: what a press does to a fibre."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from design.common.settings import Settings, as_tuple, none_as

Sides = Annotated[Annotated[int, Field(ge=3, le=4096)] | None, *none_as("circle")]


MEASURED_REACH = (
    *((0.0, 1.0), (0.2, 0.936), (0.4, 0.768), (0.6, 0.551), (0.8, 0.346)),
    *((1.0, 0.188), (1.2, 0.085), (1.4, 0.029), (1.65, 0.0)),
)
"""How the built pad answers: about a Gaussian of standard deviation 0.55, with a smooth end in place of its tails."""

Point = tuple[Annotated[float, Field(ge=0, le=1e4)], Annotated[float, Field(ge=-1e3, le=1e3)]]


def _points(value: object) -> object:
    """Lists, as files have them, as the tuples that a frozen model holds."""
    return tuple(as_tuple(point) for point in value) if isinstance(value, list | tuple) else value


class Contact(Settings):
    """`[contact]`: what a press does to a fibre: by a reach that was measured, or as published by a shape around it.

    The signal of a fibre is the integral of a weight over its length: that of `reach` by distance d to the press
    centre; or, where `reach` is empty, `weight` inside a regular polygon or circle (paper, formulas (1), (2)), which is
    meant as well where `radius`, `sides` or `weight` are given and `reach` is not. Lengths are in grid units.

    Attributes:
        radius: circumradius K of the shape, > 0.
        sides: D >= 3, or None for a circle ("circle" in pad.toml).
        weight: "uniform" (1), "inverse_square" (1 / (K + d^2)) or "inverse" (1 / max(d, K / 100), which is the
            paper's 1 / d kept finite within a hundredth of the radius).
        length: "manhattan" (|dx| + |dy|, as the published code has it, and the default of shapes) or "euclidean", the
            default of a reach.
        reach: points (distance, weight) from distance 0 to where the weight is 0 and stays so, joined by a cubic spline
            over d^2. A weight may be below 0. MEASURED_REACH if nothing of the contact is given.
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
        default=MEASURED_REACH, description="measured weight by distance, [[0, 1], ..., [d, 0]]; [] for a shape"
    )

    @model_validator(mode="before")
    @classmethod
    def _of_one_kind(cls, given: object) -> object:
        """What is left out, by what is given: a shape as published, or a reach."""
        if not isinstance(given, Mapping):
            return given
        reach = given.get("reach", () if _SHAPE & given.keys() else MEASURED_REACH)
        return {"reach": reach, "length": "euclidean" if reach else "manhattan", **given}

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
        return reach


_SHAPE = {"radius", "sides", "weight"}

PUBLISHED_CONTACT = Contact(radius=0.6)
"""The paper's: a polygon of 30 sides, Manhattan lengths. Functions that restate the paper take it for None."""
