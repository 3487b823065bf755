"""The sections of `pad.toml` that design owns: the pad, the contact, the search and the rules."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field, PlainSerializer, ValidationInfo, field_validator, model_validator

from design.common.settings import Settings


def _tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _side_lengths(value: object) -> object:
    if isinstance(value, str) and value not in ("beyond", "fibres"):
        raise ValueError('allowed are [width, height], "beyond" and "fibres"')
    return _tuple(value)


Millimetres = Annotated[float, Field(gt=0, le=1e6)]
Sensed = tuple[Millimetres, Millimetres] | Literal["beyond", "fibres"]
Rectangle = tuple[tuple[float, float], tuple[float, float]]
"""Low and high corner, grid units."""


def sensed_rectangle(grid: int, pitch_mm: float, sensed_mm: Sensed = "beyond") -> Rectangle:
    """Low and high corner, in grid units, of what is pressed on a pad of M = `grid`.

    Fibres run from 0 to M + 1, the outermost ones at 1 and M. "beyond" is 0.5 to M + 0.5 both ways, half a pitch beyond
    the outermost; "fibres" is 1 to M, as published (0.5 to 1.5 for M = 1); a size lies about the middle, (M + 1) / 2.
    """
    if isinstance(sensed_mm, str):
        width = height = grid if sensed_mm == "beyond" else max(grid - 1, 1)
    else:
        width, height = (side / pitch_mm for side in sensed_mm)
    middle = (grid + 1) / 2
    return (middle - width / 2, middle - height / 2), (middle + width / 2, middle + height / 2)


class PadSettings(Settings):
    """`[pad]`: what the pad is, and which part of it is pressed.

    Attributes:
        sensed_mm: (width, height), at most the pad's own, (M + 1) pitch_mm; "beyond": half a pitch beyond the outermost
            fibres, or "fibres": between them, as published. Designs are for presses there; `sensed_rectangle` says
            where that is.
    """

    MOVED: ClassVar[Mapping[str, str]] = {"fibre_diameter_mm": "[fibre] diameter_mm"}

    grid: int = Field(default=4, ge=1, le=256, description="fibres per family (M); the pad is M x M grid units")
    pitch_mm: float = Field(default=11.25, ge=0.1, le=1000, description="distance of neighbouring fibre ends, mm")
    deep_family: Literal["horizontal", "vertical"] = Field(
        default="horizontal", description="family whose tracks lie deeper in the silicone and are laid first"
    )
    sensed_mm: Annotated[Sensed, BeforeValidator(_side_lengths)] = Field(
        default="beyond",
        description='pressed [width, height] about the middle, mm; "beyond" the outermost fibres by half a pitch, or '
        'between "fibres"',
    )

    @property
    def sensed(self) -> Rectangle:
        """`sensed_rectangle` of this pad."""
        return sensed_rectangle(self.grid, self.pitch_mm, self.sensed_mm)

    @field_validator("sensed_mm")
    @classmethod
    def _on_the_pad(cls, sensed_mm: Sensed, info: ValidationInfo) -> Sensed:
        if isinstance(sensed_mm, tuple) and {"grid", "pitch_mm"} <= info.data.keys():
            most = (info.data["grid"] + 1) * info.data["pitch_mm"]
            if max(sensed_mm) > most * (1 + 1e-9):
                raise ValueError(f"the pad itself is {most:g} mm wide and high")
        return sensed_mm


def _circle(value: object) -> object:
    return None if isinstance(value, str) and value == "circle" else value


Sides = Annotated[
    Annotated[int, Field(ge=3, le=4096)] | None,
    BeforeValidator(_circle),
    PlainSerializer(lambda sides: "circle" if sides is None else sides),
]


MEASURED_REACH = (
    *((0.0, 1.0), (0.2, 0.936), (0.4, 0.768), (0.6, 0.551), (0.8, 0.346)),
    *((1.0, 0.188), (1.2, 0.085), (1.4, 0.029), (1.65, 0.0)),
)
"""How the built pad answers: about a Gaussian of standard deviation 0.55, with a smooth end in place of its tails."""

Point = tuple[Annotated[float, Field(ge=0, le=1e4)], Annotated[float, Field(ge=-1e3, le=1e3)]]


def _points(value: object) -> object:
    """Lists, as files have them, as the tuples that a frozen model holds."""
    return tuple(_tuple(point) for point in value) if isinstance(value, list | tuple) else value


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

Share = Annotated[float, Field(ge=0, le=1e6)]

Lost = Annotated[
    Annotated[int, Field(ge=0, le=8)] | Annotated[tuple[Share, ...], Field(min_length=1, max_length=9)],
    BeforeValidator(_tuple),
]


NOISE = 0.05
"""What an ambiguity can tell: the built pad's responses scatter by 0.01 to 0.02 of full scale, but at that
no confusions are left among presses a fifth of a grid unit apart."""


class SearchSettings(Settings):
    """`[search]`: how the fibres are found.

    Attributes:
        lost: how many fibres may fail; or the loss distribution, weights of 0, 1, 2, ... lost fibres.
        contacts: further contacts the pad must serve as well as that of `[contact]`, such as `{radius = 0.9}`.
    """

    method: Literal["descent", "error", "genetic"] = Field(
        default="descent", description="gradients of the ambiguity, or of the expected error; or as published"
    )
    knots: int = Field(default=21, ge=1, le=64, description="inner knots per fibre (N); the rules take 3 a turn")
    starts: int = Field(default=4, ge=1, le=10_000, description="random starts of the gradient search")
    steps: int = Field(default=1000, ge=1, le=1_000_000, description="steps of a start of the gradient search")
    population: int = Field(default=200, ge=4, le=100_000, description="pads per generation of the genetic search")
    generations: int = Field(default=50, ge=1, le=1_000_000, description="generations of the genetic search")
    seed: int = Field(default=0, ge=0, le=2**32 - 1, description="seed of every random choice")
    lost: Lost = Field(default=3, description="design for up to this many failed fibres, or weights of 0, 1, ... lost")
    noise: float = Field(
        default=NOISE, ge=1e-9, le=10, description="standard deviation of a signal's noise, of full scale"
    )
    sharpness: float = Field(default=0.0, ge=0, le=1e6, description="weight of the signals' mean second difference")
    contacts: Annotated[tuple[Contact, ...], BeforeValidator(_tuple)] = Field(
        default=(), description="further contacts to serve as well, each a table like [contact]"
    )
    device: Literal["cpu", "cuda"] = Field(default="cpu", description="where presses are told apart")

    @property
    def usual_contact(self) -> Contact:
        """What is designed for where nothing else is asked: the measured contact, by the published method its own."""
        return PUBLISHED_CONTACT if self.method == "genetic" else Contact()

    @field_validator("lost")
    @classmethod
    def _some_weight(cls, lost: int | tuple[float, ...]) -> int | tuple[float, ...]:
        if isinstance(lost, tuple) and sum(lost) == 0:
            raise ValueError("one of the weights must be above 0")
        return lost


PUBLISHED_PAD, PUBLISHED_SEARCH = PadSettings(sensed_mm="fibres"), SearchSettings(noise=0.11)
PUBLISHED: Mapping[str, Settings] = {
    "pad": PUBLISHED_PAD,
    "contact": PUBLISHED_CONTACT,
    "search": PUBLISHED_SEARCH,
}
"""The world of the paper, by section, as far as it is another than the default."""


def _any(value: object) -> object:
    return None if isinstance(value, str) and value == "any" else value


MaxCrossings = Annotated[
    Annotated[int, Field(ge=0)] | None,
    BeforeValidator(_any),
    PlainSerializer(lambda most: "any" if most is None else most),
]


class RulesSettings(Settings):
    """`[rules]`: what makes a pad buildable, checked exactly on the finished curves (`check_rules` has the formulas).

    Attributes:
        max_crossings: greatest number of crossings of a horizontal with a vertical fibre, or None for any number
            ("any" in pad.toml). Every horizontal has to cross every vertical, so a limit below grid^2 cannot be met.
    """

    enforce: bool = Field(
        default=True, description="false drops every rule: an explicit choice to design the unbuildable"
    )
    min_bend_radius_mm: float = Field(default=1.0, ge=0, le=1000, description="least bend radius of a fibre, mm")
    min_gap_mm: float = Field(
        default=0.8, ge=0, le=1000, description="least gap between centre lines of a family, or folds of a fibre, mm"
    )
    same_family_crossings: int = Field(default=0, ge=0, description="crossings allowed between fibres of one family")
    max_crossings: MaxCrossings = Field(
        default=None, description='crossings of horizontals with verticals allowed (at least grid^2), or "any"'
    )
    min_crossing_angle_deg: float = Field(
        default=0.0, ge=0, le=90, description="least angle at which horizontals cross verticals, degrees"
    )
    border_mm: float = Field(default=2.0, ge=0, le=1000, description="least distance of a fibre to the border, mm")
    max_length_mm: float = Field(default=500.0, gt=0, le=1e6, description="greatest length of a fibre, mm")
