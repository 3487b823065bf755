"""The sections of `pad.toml` that fabricate owns, and everything a mould depends on gathered in one object."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field

from design.common.errors import InputError, instance
from design.common.settings import Settings, Spec
from design.settings import PadSettings, RulesSettings


class MouldSettings(Settings):
    """`[mould]`: the tray the silicone is cast in and the ridges that leave the tracks.

    The pad is cast with its tracks down: a taller ridge leaves a track deeper in the silicone. The defaults keep
    0.5 mm between two 0.3 mm fibres that cross, and are whole numbers of 0.1 mm and of 0.2 mm layers.

    Attributes:
        levels: "as_needed": one ridge height a family, and further ones where fibres of one family cross, each as
            much taller as the deep family is than the shallow one; "two": a pad with such crossings is refused.
        exit_mm, exit_width_mm: slots in the wall around every ridge end; they leave a tongue of silicone on the pad
            that relieves the lead of strain.
        holder: a shallow tray without ridges, to be printed last and left on the bed, in which the finished pad lies as
            it was cast while the printer presses it; its place is then known (`frame` in fabrication.json).
        conductive: a second mould with a well at every ridge end, for casting a conductive material into the tracks
            in place of laid fibres.
    """

    floor_mm: float = Field(default=2.0, ge=0.4, le=50, description="thickness of the tray's floor, mm")
    wall_mm: float = Field(default=2.0, ge=0.8, le=50, description="least thickness of the tray's walls, mm")
    wall_draft_deg: float = Field(default=2.0, ge=0, le=30, description="lean of the walls, for demoulding, degrees")
    silicone_mm: float = Field(default=6.0, gt=0, le=100, description="thickness of the cast pad, mm")
    border_mm: float = Field(default=0.0, ge=0, le=100, description="silicone beyond the fibre ends, mm")
    ridge_width_mm: float = Field(default=0.4, ge=0.1, le=20, description="width of a ridge at its top, mm")
    ridge_draft_deg: float = Field(default=0.0, ge=0, le=20, description="taper of a ridge on either side, degrees")
    deep_ridge_height_mm: float = Field(default=1.2, gt=0, le=50, description="ridge height of the deep family, mm")
    shallow_ridge_height_mm: float = Field(default=0.4, gt=0, le=50, description="ridge height of the other family, mm")
    levels: Literal["as_needed", "two"] = Field(
        default="as_needed", description="more ridge heights where a family crosses itself, or refuse such a pad"
    )
    min_silicone_mm: float = Field(default=0.4, ge=0, le=10, description="least silicone between tracks, mm")
    exit_mm: float = Field(default=2.0, ge=0, le=50, description="length of the lead's slot in the wall (0: none), mm")
    exit_width_mm: float = Field(default=3.0, gt=0, le=50, description="width of the lead's slot in the wall, mm")
    number_mm: float = Field(default=2.5, ge=0, le=20, description="height of the sensor numbers (0: none), mm")
    pins: bool = Field(default=False, description="registration pins on the wall, with holes in the lid")
    lid: bool = Field(default=False, description="a lid that levels the silicone")
    spout: bool = Field(default=False, description="a pour spout in the lid")
    holder: bool = Field(default=False, description="a tray that holds the pad on the bed while a printer presses it")
    conductive: bool = Field(default=False, description="a second mould with wells for conductive material")
    lead_mm: float = Field(default=30.0, ge=0, le=1000, description="fibre left over at each end, mm")
    tolerance_mm: float = Field(default=0.01, ge=1e-3, le=0.1, description="greatest deviation of a ridge, mm")

    @property
    def level_step_mm(self) -> float:
        """How much taller the ridges of one level are than those of the level below, mm."""
        return self.deep_ridge_height_mm - self.shallow_ridge_height_mm


class PrinterSettings(Settings):
    """`[printer]`: what the mould is printed on."""

    nozzle_mm: float = Field(default=0.4, ge=0.01, le=5, description="nozzle diameter (resin: pixel size), mm")
    layer_mm: float = Field(default=0.1, ge=0.01, le=2, description="layer height, mm")
    bed_mm: list[Annotated[float, Field(gt=0, le=1e4)]] = Field(
        default=[220.0, 220.0, 250.0],
        min_length=3,
        max_length=3,
        description="width, depth and height of the space, mm",
    )
    resin: bool = Field(default=False, description="true for a resin printer")


STEP_MM = 0.03
"""Width of the terraces of a tapered ridge: no wider than what printers place a line by."""


_SECTIONS: dict[str, type[Any]] = {"mould": MouldSettings, "printer": PrinterSettings}
_SECTIONS |= {"pad": PadSettings, "rules": RulesSettings}


@dataclass(frozen=True)
class FabricationSettings:
    """All that shapes a mould beside the morphology; of `[pad]` only the fibre and the deep family are used."""

    mould: MouldSettings = field(default_factory=MouldSettings)
    printer: PrinterSettings = field(default_factory=PrinterSettings)
    pad: PadSettings = field(default_factory=PadSettings)
    rules: RulesSettings = field(default_factory=RulesSettings)

    def __post_init__(self) -> None:
        for name, model in _SECTIONS.items():
            instance(name, getattr(self, name), model)

    @classmethod
    def from_spec(cls, spec: Spec) -> "FabricationSettings":
        """The sections of one `pad.toml`."""
        return cls(*map(spec.section, _SECTIONS.values()))

    @property
    def flare_mm(self) -> float:
        """How much wider the cavity is at the top than at the floor, both sides together, at least, mm."""
        return 2 * self.mould.silicone_mm * math.tan(math.radians(self.mould.wall_draft_deg))

    @property
    def ridge_slope(self) -> float:
        """How much a ridge widens on either side per mm of height, downwards."""
        return math.tan(math.radians(self.mould.ridge_draft_deg))

    @property
    def terrace_mm(self) -> float:
        """Height of the terraces that taper a ridge: as many layers as keep their steps within `STEP_MM`, or one."""
        layer = self.printer.layer_mm
        step = self.ridge_slope * layer
        return layer * max(1, int(STEP_MM / step)) if step else math.inf

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
        if mould.exit_mm:
            if mould.exit_width_mm <= mould.ridge_width_mm:
                allowed = f"more than ridge_width_mm, {mould.ridge_width_mm:g} mm"
                raise InputError(f"[mould] exit_width_mm: got {mould.exit_width_mm:g}, allowed is {allowed}")
            room = pitch_mm - self.flare_mm
            if room <= mould.ridge_width_mm:
                lean = f"the walls lean outwards by {self.flare_mm:.3g} mm, the pitch is {pitch_mm:g} mm"
                raise InputError(f"[mould] exit_mm: got {mould.exit_mm:g}, allowed is 0 only: {lean}")
            _require_less("exit_width_mm", mould.exit_width_mm, room, "the pitch between slots")
        if mould.spout and not mould.lid:
            raise InputError("[mould] spout: got true, allowed only with lid = true, which it is a part of")


DEFAULTS = FabricationSettings()


def _require_less(key: str, value: float, bound: float, name: str) -> None:
    if value >= bound:
        raise InputError(f"[mould] {key}: got {value:g}, allowed is less than {name}, {bound:g} mm")
