"""The sections of `pad.toml` that fabricate owns, and everything a mould depends on gathered in one object."""

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from design.errors import InputError
from design.settings import Pad, Rules, Section, Spec


class Mould(Section):
    """`[mould]`: the tray the silicone is cast in and the ridges that leave the tracks.

    The pad is cast with its tracks down: a taller ridge leaves a track deeper in the silicone. The defaults keep
    0.5 mm between two 0.3 mm fibres that cross, and are whole numbers of 0.1 mm and of 0.2 mm layers.
    """

    floor_mm: float = Field(default=2.0, ge=0.4, le=50, description="thickness of the tray's floor, mm")
    wall_mm: float = Field(default=2.0, ge=0.8, le=50, description="thickness of the tray's walls, mm")
    silicone_mm: float = Field(default=6.0, gt=0, le=100, description="thickness of the cast pad, mm")
    border_mm: float = Field(default=0.0, ge=0, le=100, description="silicone beyond the fibre ends, mm")
    ridge_width_mm: float = Field(default=0.4, ge=0.1, le=20, description="width of a ridge, and so of a track, mm")
    deep_ridge_height_mm: float = Field(default=1.2, gt=0, le=50, description="ridge height of the deep family, mm")
    shallow_ridge_height_mm: float = Field(default=0.4, gt=0, le=50, description="ridge height of the other family, mm")
    min_silicone_mm: float = Field(default=0.4, ge=0, le=10, description="least silicone between tracks, mm")
    lead_mm: float = Field(default=30.0, ge=0, le=1000, description="fibre left over at each end, mm")
    tolerance_mm: float = Field(default=0.01, ge=1e-3, le=0.1, description="greatest deviation of a ridge, mm")


class Printer(Section):
    """`[printer]`: what the mould is printed on."""

    nozzle_mm: float = Field(default=0.4, gt=0, le=5, description="nozzle diameter (resin: pixel size), mm")
    layer_mm: float = Field(default=0.1, gt=0, le=2, description="layer height, mm")
    bed_mm: list[Annotated[float, Field(gt=0, le=1e4)]] = Field(
        default=[220.0, 220.0, 250.0],
        min_length=3,
        max_length=3,
        description="width, depth and height of the space, mm",
    )
    resin: bool = Field(default=False, description="true for a resin printer")


MODELS: dict[str, type[Section]] = {"mould": Mould, "printer": Printer}


@dataclass(frozen=True)
class Settings:
    """All that shapes a mould beside the morphology; of `[pad]` only the fibre and the deep family are used."""

    mould: Mould = field(default_factory=Mould)
    printer: Printer = field(default_factory=Printer)
    pad: Pad = field(default_factory=Pad)
    rules: Rules = field(default_factory=Rules)

    @classmethod
    def from_spec(cls, spec: Spec) -> "Settings":
        """The sections of one `pad.toml`."""
        return cls(spec.section(Mould), spec.section(Printer), spec.section(Pad), spec.section(Rules))

    @property
    def ridge_heights_mm(self) -> tuple[float, float]:
        """Ridge height of the horizontal and of the vertical family, mm above the tray's floor."""
        deep, shallow = self.mould.deep_ridge_height_mm, self.mould.shallow_ridge_height_mm
        return (deep, shallow) if self.pad.deep_family == "horizontal" else (shallow, deep)

    def require_consistent(self, pitch_mm: float) -> None:
        """Refuse settings that contradict each other or the pitch of the pad.

        Raises:
            InputError: names the key, its value and what is allowed.
        """
        mould = self.mould
        _require_less("ridge_width_mm", mould.ridge_width_mm, pitch_mm, "the pitch")
        _require_less("tolerance_mm", mould.tolerance_mm, mould.ridge_width_mm / 4, "a quarter of ridge_width_mm")
        shallow, deep = mould.shallow_ridge_height_mm, mould.deep_ridge_height_mm
        _require_less("shallow_ridge_height_mm", shallow, deep, "deep_ridge_height_mm")
        _require_less("deep_ridge_height_mm", deep, mould.silicone_mm, "silicone_mm")


DEFAULTS = Settings()


def _require_less(key: str, value: float, bound: float, name: str) -> None:
    if value >= bound:
        raise InputError(f"[mould] {key}: got {value:g}, allowed is less than {name}, {bound:g} mm")
