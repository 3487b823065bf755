"""Materials: the silicone of a pad (`[silicone]`), its fibres (`[fibre]`), and the plastics of its mould.

Data of silicones are from the manufacturer's technical bulletins, at room temperature; those of the published pads are
from the paper. None means unknown. A new material is one line in its table.

- Smooth-On, Ecoflex Series, technical bulletin, https://www.smooth-on.com/tb/files/ECOFLEX_SERIES_TB.pdf
- Smooth-On, Dragon Skin Series, technical bulletin, https://www.smooth-on.com/tb/files/DRAGON_SKIN_SERIES_TB.pdf
- Adafruit, Conductive Rubber Cord Stretch Sensor, https://www.adafruit.com/product/519
"""

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from padforge.common.settings import Settings, as_tuple, null_as

PUBLISHED = "published"


@dataclass(frozen=True)
class Silicone:
    """A two-part silicone."""

    name: str  # of the product
    density_g_per_ml: float  # of the mix
    parts: tuple[float, float]  # A and B by mass
    pot_life_min: float  # time for which the mix can be poured
    cure_h: float  # time until the casting can be demoulded
    shrinkage: float  # relative difference in length between the mould and the cured casting
    modulus_kpa: float | None = None  # stress over strain at 100 % strain; None if unknown


@dataclass(frozen=True)
class Fibre:
    """A fibre for the tracks; None is unknown."""

    name: str  # of the material
    diameter_mm: float
    ohm_per_mm: float | None = None  # at rest
    min_bend_radius_mm: float | None = None
    max_strain: float | None = None


_EQUAL = (1.0, 1.0)
_SHRINKAGE = 0.001  # the bulletins state "< .001 in./in." for all of these grades
_GRADES = (  # the bulletins state moduli of 8, 8, 10 and 12 psi, then 22, 49 and 86 psi
    Silicone("Ecoflex 00-10", 1.04, _EQUAL, 30, 4, _SHRINKAGE, 55),
    Silicone("Ecoflex 00-20", 1.07, _EQUAL, 30, 4, _SHRINKAGE, 55),
    Silicone("Ecoflex 00-30", 1.07, _EQUAL, 45, 4, _SHRINKAGE, 69),
    Silicone("Ecoflex 00-50", 1.07, _EQUAL, 18, 3, _SHRINKAGE, 83),
    Silicone("Dragon Skin 10 Fast", 1.07, _EQUAL, 8, 1.25, _SHRINKAGE, 152),
    Silicone("Dragon Skin 10 Medium", 1.07, _EQUAL, 20, 5, _SHRINKAGE, 152),
    Silicone("Dragon Skin 10 Slow", 1.07, _EQUAL, 45, 7, _SHRINKAGE, 152),
    Silicone("Dragon Skin 20", 1.08, _EQUAL, 25, 4, _SHRINKAGE, 338),
    Silicone("Dragon Skin 30", 1.08, _EQUAL, 45, 16, _SHRINKAGE, 593),
)
SILICONES = {PUBLISHED: replace(_GRADES[1], shrinkage=0.0), **{grade.name: grade for grade in _GRADES}}
"""Presets by name; "published": Ecoflex 00-20 without shrinkage, as the moulds of the published pads had their size."""

_CORD = Fibre("conductive rubber cord 2 mm", 2.0, ohm_per_mm=350 / 25.4, max_strain=0.5)
FIBRES = {PUBLISHED: Fibre("carbon-black TPE", 0.3, max_strain=0.8), _CORD.name: _CORD}
"""Presets by name; "published" is from the paper, which states no resistance. The cord's data are from Adafruit."""

PLASTICS = {False: ("PLA", 1.24), True: ("resin", 1.1)}
"""Common material of a filament (False) and a resin printer (True), and its density, g/ml."""

PRODUCTS = {
    "fibre": (
        "conductive and elastic",
        "extruded from carbon-black TPE or TPU; a cord of 2 mm, such as Adafruit 519, needs a mould of its own",
    ),
    "silicone": ("two parts, cures at room temperature", "grades of Smooth-On Ecoflex and Dragon Skin"),
    "adhesive": ("one part, sticks to cured silicone", "Smooth-On Sil-Poxy, DOWSIL 732"),
    "filament": ("1.75 mm", "Prusament PLA"),
    "resin": ("for 405 nm; test that silicone cures on it", "Formlabs Clear"),
    "connectors": (
        "crimped on both ends of a fibre, to wire of 0.14 mm²",
        "ferrules without collar, 0.25 mm², 5 to 8 mm long; 4 mm² for a cord of 2 mm",
    ),
    "wire": ("stranded, 0.14 mm² (AWG 26)", "LiY 0.14 mm²"),
    "resistors": ("metal film, 1 %, 0.25 W", "Yageo MFR-25"),
    "capacitors": ("ceramic; 10 to 100 nF on a Due, 1 nF at an input of a multiplexer", "Kemet C320"),
    "board": (
        "12 or more bits; an input a fibre, 3.3 V",
        "Arduino Due (12 fibres); Teensy 4.1 or ESP32 with a 74HC4067 multiplexer (16)",
    ),
}
"""Items to order, by kind: properties, and example products."""

Name = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[^|\x00-\x1f]*$")]
"""One line, which fits into a cell of a table."""
Positive = Annotated[float, Field(gt=0, le=1e6)]
_or_preset = BeforeValidator(as_tuple), *null_as("preset")  # for keys whose default is "preset" in files, None here
AnyOrPreset = Annotated[float | None, *_or_preset]
PositiveOrPreset = Annotated[Positive | None, *_or_preset]


class _MaterialSettings(Settings):
    """A preset by `name`, whose properties other keys override; or another name with all required properties."""

    PRESETS: ClassVar[Mapping[str, Any]]

    name: Name

    @field_validator("name")
    @classmethod
    def _normalise_name(cls, name: str) -> str:
        """Return the preset's spelling of a name; case, spaces and hyphens are ignored."""
        return {_simplify(preset): preset for preset in cls.PRESETS}.get(_simplify(name), name)

    @model_validator(mode="after")
    def _check_complete(self) -> "_MaterialSettings":
        required = {entry.name for entry in fields(self.PRESETS[PUBLISHED]) if entry.default is MISSING} - {"name"}
        if self.name not in self.PRESETS and (missing := required - self._overrides.keys()):
            custom = f"or a material of your own with {', '.join(sorted(missing))} set"
            message = f"name: got {self.name!r}, allowed are {', '.join(self.PRESETS)}; {custom}"
            raise PydanticCustomError("name", "{message}", {"message": message})
        return self

    @property
    def _overrides(self) -> dict[str, Any]:
        return {key: value for key, value in self if key != "name" and value is not None}

    def _material(self) -> Any:
        preset = self.PRESETS.get(self.name)
        kind = type(self.PRESETS[PUBLISHED])
        return replace(preset, **self._overrides) if preset else kind(self.name, **self._overrides)


def _simplify(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


class SiliconeSettings(_MaterialSettings):
    """`[silicone]`: the silicone of the pad, a preset of `SILICONES` with the properties that differ from it.

    Attributes:
        shrinkage: the mould is larger than the pad by 1 / (1 - shrinkage), so that the pad has its design size.
    """

    PRESETS = SILICONES

    name: Name = Field(
        default=PUBLISHED,
        description=f"{', '.join(SILICONES)}; published: Ecoflex 00-20 in a mould as large as the pad",
    )
    density_g_per_ml: PositiveOrPreset = Field(
        default=None, le=30, description='density, g/ml; "preset": that of the name'
    )
    parts: Annotated[tuple[Positive, Positive] | None, *_or_preset] = Field(
        default=None, description='parts A and B by mass, as [1, 1]; or "preset"'
    )
    pot_life_min: PositiveOrPreset = Field(default=None, description='pot life of the mix, minutes; or "preset"')
    cure_h: PositiveOrPreset = Field(default=None, description='cure time at room temperature, hours; or "preset"')
    shrinkage: AnyOrPreset = Field(
        default=None, ge=0, le=0.2, description='shrinkage, as a fraction of the length; or "preset"'
    )
    modulus_kpa: PositiveOrPreset = Field(
        default=None, description='modulus at 100 % strain, kPa, for the force of presses; or "preset"'
    )

    @property
    def material(self) -> Silicone:
        """The preset with the properties that are set here."""
        return self._material()


class FibreSettings(_MaterialSettings):
    """`[fibre]`: the fibre in the tracks, a preset of `FIBRES` with the properties that differ from it."""

    PRESETS = FIBRES

    name: Name = Field(default=PUBLISHED, description=f"{', '.join(FIBRES)}; published: carbon-black TPE")
    diameter_mm: AnyOrPreset = Field(default=None, gt=0, le=10, description='diameter, mm; "preset": that of the name')
    ohm_per_mm: PositiveOrPreset = Field(
        default=None, description='resistance at rest, Ohm per mm of length; or "preset"'
    )
    min_bend_radius_mm: AnyOrPreset = Field(
        default=None, ge=0, le=1000, description='minimum bend radius, mm; or "preset"'
    )
    max_strain: AnyOrPreset = Field(
        default=None, gt=0, le=100, description='maximum strain, as a fraction of the length; or "preset"'
    )

    @property
    def material(self) -> Fibre:
        """The preset with the properties that are set here."""
        return self._material()


_E24 = (10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30, 33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91)  # IEC 60063


def divider_ohm(fibre_ohm: float) -> float:
    """Return the fixed resistor of the E24 series for the most sensitive voltage divider with a fibre."""
    # U = Us F / (F + R) changes by Us e F R / (F + R)^2 for a small relative change e of R, equally for F = x R and
    # F = R / x, and most, by Us e / 4, for F = R. So the best F has the smallest |log(F / R)|.
    decade = 10.0 ** (math.floor(math.log10(fibre_ohm)) - 1)
    candidates = [*(value * decade for value in _E24), 100 * decade]
    return float(f"{min(candidates, key=lambda ohm: abs(math.log(ohm / fibre_ohm))):.2g}")
