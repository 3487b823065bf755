"""The materials of a pad: `[silicone]`, which it is cast of, and `[fibre]`, which is laid in; presets of both by name.

What its mould is printed of stands here as well.

Figures of silicones are those of the maker's technical bulletins (Smooth-On), at room temperature; of the published
pads those of the paper. What nobody has stated is None, unknown, and what follows from it is left out.
"""

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import BeforeValidator, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from padforge.design.common.settings import Settings, as_tuple, null_as

PUBLISHED = "published"


@dataclass(frozen=True)
class Silicone:
    """What a pad is cast of: two parts that cure once they are mixed.

    Attributes:
        parts: of A and B, by mass.
        pot_life_min: how long the mix can be poured. cure_h: until it can be pulled from the mould.
        shrinkage: by which share of its length it is shorter, cured, than the mould.
    """

    name: str
    density_g_per_ml: float
    parts: tuple[float, float]
    pot_life_min: float
    cure_h: float
    shrinkage: float


@dataclass(frozen=True)
class Fibre:
    """What is laid into the tracks; None is unknown.

    Attributes:
        ohm_per_mm: resistance at rest, of each mm of its length.
        min_bend_radius_mm: radius of the tightest bend that it bears.
        max_strain: share of its length by which it may be made longer.
    """

    name: str
    diameter_mm: float
    ohm_per_mm: float | None = None
    min_bend_radius_mm: float | None = None
    max_strain: float | None = None


AB = (1.0, 1.0)
"""Equal masses of both parts."""
SHEET_SHRINKAGE = 0.001
"""The bulletins say "< 0.001 in/in" of every grade here: the most that it may be."""
_GRADES = (
    Silicone("EcoFlex 00-10", 1.04, AB, 30, 4, SHEET_SHRINKAGE),
    Silicone("EcoFlex 00-20", 1.07, AB, 30, 4, SHEET_SHRINKAGE),
    Silicone("EcoFlex 00-30", 1.07, AB, 45, 4, SHEET_SHRINKAGE),
    Silicone("EcoFlex 00-50", 1.07, AB, 18, 3, SHEET_SHRINKAGE),
    Silicone("Dragon Skin 10 fast", 1.07, AB, 8, 1.25, SHEET_SHRINKAGE),
    Silicone("Dragon Skin 10 medium", 1.07, AB, 20, 5, SHEET_SHRINKAGE),
    Silicone("Dragon Skin 10 slow", 1.07, AB, 45, 7, SHEET_SHRINKAGE),
    Silicone("Dragon Skin 20", 1.08, AB, 25, 4, SHEET_SHRINKAGE),
    Silicone("Dragon Skin 30", 1.08, AB, 45, 16, SHEET_SHRINKAGE),
)
SILICONES = {PUBLISHED: replace(_GRADES[1], shrinkage=0.0), **{grade.name: grade for grade in _GRADES}}
"""By name; "published": EcoFlex 00-20 in moulds of the pad's own size, as the published pads were cast."""

_CORD = Fibre("conductive rubber cord 2 mm", 2.0, ohm_per_mm=350 / 25.4, max_strain=0.5)
FIBRES = {PUBLISHED: Fibre("carbon-black TPE", 0.3, max_strain=0.8), _CORD.name: _CORD}
"""By name; "published": of the paper, which has no resistance. The cord's figures are its seller's (Adafruit)."""

PLASTICS = {False: ("PLA", 1.24), True: ("resin", 1.1)}
"""What a filament and a resin printer commonly print, and its density, g/ml."""

Material = TypeVar("Material", Silicone, Fibre)


Name = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[^|\x00-\x1f]*$")]
"""One line, and a cell of a table."""
Positive = Annotated[float, Field(gt=0, le=1e6)]
OfPreset = BeforeValidator(as_tuple), *null_as("preset")
"""A key that is "preset" where it is not set, None in the model."""


class _MaterialSettings(Settings):
    """A preset by `name`, with every other key that is set in place of the preset's.

    A name of one's own is fine as well, if all is set that cannot be unknown.
    """

    PRESETS: ClassVar[Mapping[str, Any]]

    name: Name

    @field_validator("name")
    @classmethod
    def _as_listed(cls, name: str) -> str:
        """The preset's own way to write it, if it is one."""
        return {_plain(preset): preset for preset in cls.PRESETS}.get(_plain(name), name)

    @model_validator(mode="after")
    def _known(self) -> "_MaterialSettings":
        if self.name not in self.PRESETS and (missing := _needed(self.PRESETS[PUBLISHED]) - self.set_here.keys()):
            own = f"or a material of your own with {', '.join(sorted(missing))} set"
            message = f"name: got {self.name!r}, allowed are {', '.join(self.PRESETS)}; {own}"
            raise PydanticCustomError("name", "{message}", {"message": message})
        return self

    @property
    def set_here(self) -> dict[str, Any]:
        """The keys that are set, beside the name."""
        return {key: value for key, value in self if key != "name" and value is not None}

    def _merged(self, kind: type[Material]) -> Material:
        preset = self.PRESETS.get(self.name)
        return replace(preset, **self.set_here) if preset else kind(name=self.name, **self.set_here)


class SiliconeSettings(_MaterialSettings):
    """`[silicone]`: what the pad is cast of: a preset of `SILICONES`, and what is to be another than there.

    Attributes:
        shrinkage: the mould is made larger than the pad by 1 / (1 - shrinkage), so that the pad comes out as designed.
    """

    PRESETS = SILICONES

    name: Name = Field(
        default=PUBLISHED,
        description=f"{', '.join(SILICONES)}; published: EcoFlex 00-20 in a mould as large as the pad",
    )
    density_g_per_ml: Annotated[Positive | None, *OfPreset] = Field(
        default=None, le=30, description='density, g/ml; "preset": as of the name'
    )
    parts: Annotated[tuple[Positive, Positive] | None, *OfPreset] = Field(
        default=None, description='parts A and B by mass, as [1, 1]; or "preset"'
    )
    pot_life_min: Annotated[Positive | None, *OfPreset] = Field(
        default=None, description='how long the mix can be poured, minutes; or "preset"'
    )
    cure_h: Annotated[Positive | None, *OfPreset] = Field(
        default=None, description='how long it cures at room temperature, hours; or "preset"'
    )
    shrinkage: Annotated[float | None, *OfPreset] = Field(
        default=None, ge=0, le=0.2, description='by which share of its length it shrinks; or "preset"'
    )

    @property
    def material(self) -> Silicone:
        """The preset with what is set here."""
        return self._merged(Silicone)


class FibreSettings(_MaterialSettings):
    """`[fibre]`: what is laid into the tracks: a preset of `FIBRES`, and what is to be another than there."""

    PRESETS = FIBRES

    name: Name = Field(
        default=PUBLISHED,
        description=f"{', '.join(FIBRES)}; published: carbon-black TPE",
    )
    diameter_mm: Annotated[float | None, *OfPreset] = Field(
        default=None, gt=0, le=10, description='diameter, mm; "preset": as of the name'
    )
    ohm_per_mm: Annotated[Positive | None, *OfPreset] = Field(
        default=None, description='resistance at rest, Ohm per mm of length; or "preset"'
    )
    min_bend_radius_mm: Annotated[float | None, *OfPreset] = Field(
        default=None, ge=0, le=1000, description='radius of the tightest bend it bears, mm; or "preset"'
    )
    max_strain: Annotated[float | None, *OfPreset] = Field(
        default=None, gt=0, le=100, description='share of its length by which it bears to be stretched; or "preset"'
    )

    @property
    def material(self) -> Fibre:
        """The preset with what is set here."""
        return self._merged(Fibre)


_E24 = (10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30, 33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91)
"""The values of a decade in which resistors of 5 % are sold (IEC 60063)."""


def divider_ohm(fibre_ohm: float) -> float:
    """The fixed resistor with which a fibre's divider shows a small change by the most, of the E24 series.

    The divider gives U = Us F / (F + R) for a fibre of R beside a fixed F. A small change of R by the share e moves it
    by Us e F R / (F + R)^2, which is largest, Us e / 4, where F = R, and falls alike for F = x R and F = R / x: the
    value whose ratio to R is nearest to 1.
    """
    decade = 10.0 ** (math.floor(math.log10(fibre_ohm)) - 1)
    near = [*(step * decade for step in _E24), 100 * decade]
    return float(f"{min(near, key=lambda ohm: abs(math.log(ohm / fibre_ohm))):.2g}")


def _plain(name: str) -> str:
    """A name without case, spaces and hyphens."""
    return "".join(letter for letter in name.lower() if letter.isalnum())


def _needed(preset: Any) -> set[str]:
    """What a material has to have."""
    return {field.name for field in fields(preset) if field.default is MISSING} - {"name"}
