"""Settings of a mould: `[mould]`, `[printer]` and `[dispenser]` of `pad.toml`, and the sections it depends on."""

import math
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator

from padforge.common.settings import Settings, Spec, as_tuple
from padforge.common.validation import InputError, check_type
from padforge.design.settings import (
    SILICONE_MM,
    TRACK_DEPTHS_MM,
    TRACK_WIDTH_MM,
    Contact,
    Layout,
    PadSettings,
    RulesSettings,
    fill_cast,
    read_contact,
    scale_keep_out,
)

from .materials import FibreSettings, SiliconeSettings


class MouldSettings(Settings):
    """`[mould]`: the tray the silicone is cast in and the ridges that leave the tracks.

    The pad is cast with its tracks down, so that a taller ridge makes a deeper track. The defaults leave 0.5 mm between
    two crossing fibres of 0.3 mm, and are multiples of 0.1 mm and 0.2 mm layers.

    Attributes:
        levels: "as_needed": one ridge height a family, and further ones if fibres of one family cross, spaced by the
            difference of the families' heights; "two": pads with such crossings are refused.
        exit_mm: length of the slots in the wall around the ridge ends; they form tongues of silicone on the pad, for
            strain relief of the leads.
        exit_width_mm: width of these slots.
        holder: a shallow tray without ridges, printed last and left on the bed, which holds the finished pad while the
            printer presses it; `frame` in fabrication.json is the pose of the pad.
        conductive: a second mould with a well at every ridge end, for casting a conductive material into the tracks
            in place of fibres.
    """

    floor_mm: float = Field(default=2.0, ge=0.4, le=50, description="thickness of the tray's floor, mm")
    wall_mm: float = Field(default=2.0, ge=0.8, le=50, description="minimum thickness of the tray's walls, mm")
    wall_draft_deg: float = Field(default=2.0, ge=0, le=30, description="lean of the walls, for demoulding, degrees")
    silicone_mm: float = Field(default=SILICONE_MM, gt=0, le=100, description="thickness of the cast pad, mm")
    border_mm: float = Field(default=0.0, ge=0, le=100, description="silicone beyond the fibre ends, mm")
    ridge_width_mm: float = Field(default=TRACK_WIDTH_MM, ge=0.1, le=20, description="width of a ridge at its top, mm")
    ridge_draft_deg: float = Field(default=0.0, ge=0, le=20, description="taper of a ridge on either side, degrees")
    deep_ridge_height_mm: float = Field(
        default=TRACK_DEPTHS_MM[0], gt=0, le=50, description="ridge height of the deep family, mm"
    )
    shallow_ridge_height_mm: float = Field(
        default=TRACK_DEPTHS_MM[1], gt=0, le=50, description="ridge height of the other family, mm"
    )
    levels: Literal["as_needed", "two"] = Field(
        default="as_needed", description="more ridge heights where a family crosses itself, or refuse such a pad"
    )
    min_silicone_mm: float = Field(default=0.4, ge=0, le=10, description="minimum silicone between tracks, mm")
    exit_mm: float = Field(default=2.0, ge=0, le=50, description="length of the lead's slot in the wall (0: none), mm")
    exit_width_mm: float = Field(default=3.0, gt=0, le=50, description="width of the lead's slot in the wall, mm")
    number_mm: float = Field(default=2.5, ge=0, le=20, description="height of the sensor numbers (0: none), mm")
    pins: bool = Field(default=False, description="registration pins on the wall, with holes in the lid")
    lid: bool = Field(default=False, description="a lid that levels the silicone")
    spout: bool = Field(default=False, description="a pour spout in the lid")
    holder: bool = Field(default=False, description="a tray that holds the pad on the bed while a printer presses it")
    conductive: bool = Field(default=False, description="a second mould with wells for conductive material")
    lead_mm: float = Field(default=30.0, ge=0, le=1000, description="length of the lead at each end of a fibre, mm")
    tolerance_mm: float = Field(default=0.01, ge=1e-3, le=0.1, description="maximum deviation of a ridge's outline, mm")

    @property
    def level_step_mm(self) -> float:
        """Difference of ridge height from one layer to the next, mm."""
        return self.deep_ridge_height_mm - self.shallow_ridge_height_mm


class PrinterSettings(Settings):
    """`[printer]`: the 3D printer of the mould."""

    nozzle_mm: float = Field(default=0.4, ge=0.01, le=5, description="nozzle diameter (resin: pixel size), mm")
    layer_mm: float = Field(default=0.1, ge=0.01, le=2, description="layer height, mm")
    bed_mm: list[Annotated[float, Field(gt=0, le=1e4)]] = Field(
        default=[220.0, 220.0, 250.0],
        min_length=3,
        max_length=3,
        description="width, depth and height of the build volume, mm",
    )
    resin: bool = Field(default=False, description="true for a resin printer")

    @property
    def line_mm(self) -> float:
        """Minimum width of a printed line: the nozzle, or two pixels of a resin printer."""
        return self.nozzle_mm * (2 if self.resin else 1)

    def is_whole_layers(self, height_mm: float) -> bool:
        """Return whether a height is a whole number of layers.

        Args:
            height_mm: height.
        """
        layers = height_mm / self.layer_mm
        return round(layers) > 0 and abs(layers - round(layers)) <= 1e-6


Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]
Box = Annotated[
    tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate], BeforeValidator(as_tuple)
]


class DispenserSettings(Settings):
    """`[dispenser]`: the needle on a gantry that places the fibres by machine.

    The pad lies turned over, with its tracks up; z is 0 at its upper face. By default the needle is a thin-walled tube
    for a fibre of 0.3 mm that fits into a track of 0.4 mm. It is slow, since hands are near and it pulls on a spool.

    Attributes:
        travel_height_mm: height of travel moves above the pad and anything that protrudes from it.
        acceleration_mm_s2: maximum acceleration; it limits the speed in a bend of radius r to sqrt(acceleration r).
        origin_mm: position of the pad's middle on the machine.
        box_mm: limits of the tip in the machine's x, y and z.
    """

    tip_mm: float = Field(default=0.37, gt=0, le=20, description="outer diameter of the needle's tip, mm")
    travel_height_mm: float = Field(default=5.0, ge=0.5, le=500, description="height between fibres, mm over the pad")
    travel_mm_s: float = Field(default=30.0, ge=0.1, le=500, description="speed between fibres, mm/s")
    feed_mm_s: float = Field(default=10.0, ge=0.1, le=500, description="speed along a straight fibre, mm/s")
    acceleration_mm_s2: float = Field(default=100.0, ge=1, le=1e5, description="maximum acceleration, mm/s^2")
    origin_mm: Annotated[tuple[Coordinate, Coordinate], BeforeValidator(as_tuple)] = Field(
        default=(110.0, 110.0), description="the pad's middle [x, y] on the machine, mm"
    )
    box_mm: Box = Field(
        default=(0.0, 220.0, 0.0, 220.0, -20.0, 50.0),
        description="limits of the tip on the machine, [x0, x1, y0, y1, z0, z1], mm",
    )

    @field_validator("box_mm")
    @classmethod
    def _check_ascending(cls, box_mm: Box) -> Box:
        if any(low >= high for low, high in zip(box_mm[::2], box_mm[1::2], strict=True)):
            raise ValueError("each axis goes from low to high: [x0, x1, y0, y1, z0, z1]")
        return box_mm


WELL_MM = 3.0  # diameter of the wells for conductive material
WELL_RIM_MM = 1.0  # silicone around a well
WELL_SLOT_MM = WELL_MM + 2 * WELL_RIM_MM  # length and width of the slots of a mould with wells
_MAX_TERRACE_STEP_MM = 0.03  # width of the terraces of a tapered ridge, the positioning accuracy of printers


@dataclass(frozen=True)
class FabricationSettings:
    """All settings of a mould and of fibre placement, except the paths of the fibres, which the morphology has.

    `pad` has the deep family, keep-outs, leads and bending radius. `contact`, if settings state one, is assumed for a
    morphology that does not state the contact that it was designed for.
    """

    mould: MouldSettings = field(default_factory=MouldSettings)
    printer: PrinterSettings = field(default_factory=PrinterSettings)
    pad: PadSettings = field(default_factory=PadSettings)
    rules: RulesSettings = field(default_factory=RulesSettings)
    silicone: SiliconeSettings = field(default_factory=SiliconeSettings)
    fibre: FibreSettings = field(default_factory=FibreSettings)
    dispenser: DispenserSettings = field(default_factory=DispenserSettings)
    contact: Contact | None = None

    def __post_init__(self) -> None:
        for name, model in self._models().items():
            check_type(name, getattr(self, name), model)
        if self.contact is not None:
            check_type("contact", self.contact, Contact)

    @classmethod
    def _models(cls) -> dict[str, Any]:
        return {section.name: section.default_factory for section in fields(cls) if section.name != "contact"}

    @classmethod
    def from_spec(cls, spec: Spec) -> "FabricationSettings":
        """Read the sections of a `pad.toml`.

        Args:
            spec: settings file.

        Raises:
            InputError: a key is unknown or a value out of range, or the mould contradicts `[contact]`.
        """
        spec = fill_cast(check_type("spec", spec, Spec))
        sections = map(spec.section, cls._models().values())
        return cls(*sections, contact=read_contact(spec) if spec.stated(Contact) else None)

    @property
    def ridge_slope(self) -> float:
        """Widening of a ridge on either side per mm of height, downwards."""
        return math.tan(math.radians(self.mould.ridge_draft_deg))

    @property
    def terrace_mm(self) -> float:
        """Height of a tapered ridge's terraces: as many layers as `_MAX_TERRACE_STEP_MM` allows, at least one."""
        layer = self.printer.layer_mm
        step = self.ridge_slope * layer
        return layer * max(1, int(_MAX_TERRACE_STEP_MM / step)) if step else math.inf

    @property
    def shrinkage_factor(self) -> float:
        """Ratio of the pad's size to that of its mould: 1 - shrinkage."""
        return 1 - self.silicone.material.shrinkage

    def shrinkage_compensated(self) -> "FabricationSettings":
        """Return the settings of the mould: lengths of the pad divided by `shrinkage_factor`, without shrinkage.

        Floor and walls are unchanged. Heights of ridges or cavity that are whole layers remain so, since slicers differ
        in the treatment of fractions; the pad then deviates by up to half a layer (`Plan.depths_mm`).
        """
        ridges, depth = ("deep_ridge_height_mm", "shallow_ridge_height_mm"), ("silicone_mm",)
        horizontal = ("border_mm", "ridge_width_mm", "exit_mm", "exit_width_mm", "number_mm")
        factor, layer = self.shrinkage_factor, self.printer.layer_mm
        larger = {key: getattr(self.mould, key) / factor for key in (*horizontal, *ridges, *depth)}
        for keys in (ridges, depth):
            if all(self.printer.is_whole_layers(getattr(self.mould, key)) for key in keys):
                larger |= {key: round(round(larger[key] / layer) * layer, 9) for key in keys}
        keep_outs = tuple(scale_keep_out(keep_out, 1 / factor) for keep_out in self.pad.keep_out_mm)
        return replace(
            self,
            mould=self.mould.model_copy(update=larger),
            pad=self.pad.model_copy(update={"keep_out_mm": keep_outs}),
            silicone=self.silicone.model_copy(update={"shrinkage": 0.0}),
        )

    @property
    def min_bend_radius_mm(self) -> float:
        """Minimum bend radius by the rules and the fibre, mm, as the mean over half that length of fibre."""
        return max(self.rules.min_mean_bend_radius_mm, self.fibre.material.min_bend_radius_mm or 0)

    def require_consistent(self, layout: Layout) -> None:
        """Check that settings do not contradict each other or the pitch of the pad.

        Args:
            layout: fibres and pitch.

        Raises:
            InputError: settings contradict each other.
        """
        mould = self.mould
        pitches = (layout.pitch_y_mm, layout.horizontals), (layout.pitch_x_mm, layout.verticals)
        pitch_mm = min(pitch for pitch, count in pitches if count)
        _check_less("ridge_width_mm", mould.ridge_width_mm, pitch_mm, "the pitch")
        _check_less("tolerance_mm", mould.tolerance_mm, mould.ridge_width_mm / 4, "a quarter of ridge_width_mm")
        shallow, deep = mould.shallow_ridge_height_mm, mould.deep_ridge_height_mm
        _check_less("shallow_ridge_height_mm", shallow, deep, "deep_ridge_height_mm")
        _check_less("deep_ridge_height_mm", deep, mould.silicone_mm, "silicone_mm")
        if mould.exit_mm:
            if self.pad.leads == "one side":  # the leads of horizontals have a spacing of their own
                pitch_mm = layout.pitch_x_mm if layout.verticals else math.inf
            if mould.exit_width_mm <= mould.ridge_width_mm:
                allowed = f"more than ridge_width_mm, {mould.ridge_width_mm:g} mm"
                raise InputError(f"[mould] exit_width_mm: got {mould.exit_width_mm:g}, allowed is {allowed}")
            flare_mm = 2 * mould.silicone_mm * math.tan(math.radians(mould.wall_draft_deg))  # of both walls
            if pitch_mm - flare_mm <= mould.ridge_width_mm:
                lean = f"the walls lean outwards by {flare_mm:.3g} mm, the pitch is {pitch_mm:g} mm"
                raise InputError(f"[mould] exit_mm: got {mould.exit_mm:g}, allowed is 0 only: {lean}")
            _check_less("exit_width_mm", mould.exit_width_mm, pitch_mm - flare_mm, "the pitch between slots")
        if mould.spout and not mould.lid:
            raise InputError("[mould] spout: got true, allowed only with lid = true, which it is a part of")


DEFAULTS = FabricationSettings()


def _check_less(key: str, value: float, bound: float, name: str) -> None:
    if value >= bound:
        raise InputError(f"[mould] {key}: got {value:g}, allowed is less than {name}, {bound:g} mm")
