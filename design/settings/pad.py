"""`[pad]`: what the pad is, and which part of it is pressed."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from padforge.design.common.settings import Settings, as_tuple, none_as
from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from .layout import DEFAULT_PITCH_MM, Layout

Millimetres = Annotated[float, Field(gt=0, le=1e6)]
Sensed = tuple[Millimetres, Millimetres] | Literal["beyond", "fibres"]
Rectangle = tuple[tuple[float, float], tuple[float, float]]
"""Low and high corner, grid units."""
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Polygon = tuple[tuple[Coordinate, Coordinate], ...]
"""Its corners, mm from the middle of the pad."""


def sensed_rectangle(layout: Layout, sensed_mm: Sensed = "beyond") -> Rectangle:
    """Low and high corner, in grid units, of what is pressed on a pad.

    Of V verticals the outermost lie at 1 and V pitches of a pad of V + 1, and so along y for horizontals. "beyond" is
    0.5 to V + 0.5 pitches, half a pitch beyond the outermost; "fibres" is 1 to V, as published. It is never less than
    half the pad: 0.5 to 1.5 for V = 1, 0.25 to 0.75 for V = 0. A size lies about the middle.
    """
    sides = []
    for axis, count in enumerate((layout.verticals, layout.horizontals)):
        if isinstance(sensed_mm, str):
            side = (count if sensed_mm == "beyond" else count - 1) * layout.spacing[axis]
            sides.append(max(side, layout.extent[axis] / 2) if count < 2 else side)
        else:
            sides.append(sensed_mm[axis] / layout.unit_mm)
    width, height = sides
    x, y = (extent / 2 for extent in layout.extent)
    return (x - width / 2, y - height / 2), (x + width / 2, y + height / 2)


def between_fibres(layout: Layout) -> Rectangle:
    """What is pressed as published: between the outermost fibres, grid units."""
    return sensed_rectangle(layout, "fibres")


def _side_lengths(value: object) -> object:
    if isinstance(value, str) and value not in ("beyond", "fibres"):
        raise ValueError('allowed are [width, height], "beyond" and "fibres"')
    return as_tuple(value)


BentRadius = Annotated[Annotated[float, Field(ge=1, le=1e6)] | None, *none_as("flat")]
Count = Annotated[Annotated[int, Field(ge=0, le=256)] | None, *none_as("grid")]
PitchMm = Annotated[float, Field(ge=0.1, le=1000)]


def _pitches(value: object) -> object:
    value = as_tuple(value)
    each = value if isinstance(value, tuple) else (value,)
    if any(isinstance(pitch, int | float) and (pitch < 0.1 or pitch > 1000) for pitch in each):
        raise ValueError("allowed is 0.1 to 1000, or [along x, along y] of these")
    if isinstance(value, tuple) and len(value) != 2:
        raise ValueError("allowed is a number or two, [along x, along y]")
    return value


def _polygons(value: object) -> object:
    """Lists, as files have them, as the tuples that a frozen model holds."""
    if not isinstance(value, list | tuple):
        return value
    return tuple(
        tuple(as_tuple(corner) for corner in polygon) if isinstance(polygon, list | tuple) else polygon
        for polygon in value
    )


class PadSettings(Settings):
    """`[pad]`: what the pad is, and which part of it is pressed.

    Attributes:
        horizontals, verticals: of either family, where `grid` says nothing of it; None: as `grid`. 0 leaves it out: the
            pad is then a strip one pitch wide, and the fibres of the other family run across it, one pitch long.
        pitch_mm: of neighbouring fibre ends, both ways, or (along x, along y).
        leads: "one side": the lower edge, as a connector wants; they come down beside the pad, nested.
        sensed_mm: (width, height), at most the pad's own; "beyond": half a pitch beyond the outermost fibres, or
            "fibres": between them, as published. Designs are for presses there; `sensed_rectangle` says where that is.
        keep_out_mm: polygons, of 3 corners or more, that no fibre enters: holes, screws, a connector. Each has an area
            and no crossing of its own sides, and lies on the pad at least in part.
        bent_radius_mm: None for a pad that stays flat. It is cast flat either way.
    """

    MOVED: ClassVar[Mapping[str, str]] = {"fibre_diameter_mm": "[fibre] diameter_mm"}

    grid: int = Field(default=4, ge=1, le=256, description="fibres per family (M), where the next two do not say")
    horizontals: Count = Field(
        default=None,
        description='fibres along x, or as "grid"; 0: a strip along x, its fibres run across, one pitch long',
    )
    verticals: Count = Field(
        default=None,
        description='fibres along y, or as "grid"; 0: a strip along y, its fibres run across, one pitch long',
    )
    pitch_mm: Annotated[PitchMm | tuple[PitchMm, PitchMm], BeforeValidator(_pitches)] = Field(
        default=DEFAULT_PITCH_MM, description="distance of neighbouring fibre ends, mm, or [along x, along y]"
    )
    deep_family: Literal["horizontal", "vertical"] = Field(
        default="horizontal", description="family whose tracks lie deeper in the silicone and are laid first"
    )
    leads: Literal["edges", "one side"] = Field(
        default="edges", description='ends of fibres leave on all four "edges", or all of them on "one side", the lower'
    )
    sensed_mm: Annotated[Sensed, BeforeValidator(_side_lengths)] = Field(
        default="beyond",
        description='pressed [width, height] about the middle, mm; "beyond" the outermost fibres by half a pitch, or '
        'between "fibres"',
    )
    keep_out_mm: Annotated[tuple[Polygon, ...], BeforeValidator(_polygons), Field(max_length=64)] = Field(
        default=(), description="polygons [[x, y], ...] from the middle, mm, that no fibre enters"
    )
    bent_radius_mm: BentRadius = Field(
        default=None, description='radius of the cylinder about y that the pad is worn on, mm, or "flat"'
    )

    @property
    def layout(self) -> Layout:
        """Where its fibres end."""
        horizontals = self.grid if self.horizontals is None else self.horizontals
        verticals = self.grid if self.verticals is None else self.verticals
        return Layout.of((horizontals, verticals), self.pitch_mm)

    @property
    def sensed(self) -> Rectangle:
        """`sensed_rectangle` of this pad."""
        return sensed_rectangle(self.layout, self.sensed_mm)

    def of(self, layout: Layout) -> "PadSettings":
        """These settings of a pad of that layout.

        Raises:
            InputError: what they ask for is not on that pad.
        """
        return type(self)(**{**self.model_dump(), **layout.settings})

    @model_validator(mode="after")
    def _of_some_fibres(self) -> "PadSettings":
        if self.horizontals == 0 and self.verticals == 0:
            raise ValueError("horizontals and verticals are both 0, allowed is one fibre or more in all")
        return self

    @field_validator("sensed_mm")
    @classmethod
    def _on_the_pad(cls, sensed_mm: Sensed, info: ValidationInfo) -> Sensed:
        layout = _stated_layout(info.data)
        if isinstance(sensed_mm, tuple) and layout is not None:
            for name, side, most in zip(("wide", "high"), sensed_mm, layout.size_mm, strict=True):
                if side > most * (1 + 1e-9):
                    width, height = layout.size_mm
                    size = f"{width:g} mm wide and high" if width == height else f"{most:g} mm {name}"
                    raise ValueError(f"the pad itself is {size}")
        return sensed_mm

    @field_validator("keep_out_mm")
    @classmethod
    def _proper_polygons(cls, keep_out_mm: tuple[Polygon, ...], info: ValidationInfo) -> tuple[Polygon, ...]:
        import shapely  # takes a while, and few pads have keep-outs

        layout = _stated_layout(info.data)
        for number, corners in enumerate(keep_out_mm, 1):
            if not 3 <= len(corners) <= 1000:
                raise ValueError(f"polygon {number} has {len(corners)} corners, allowed are 3 to 1000")
            polygon = shapely.Polygon(corners)
            if not polygon.is_valid or polygon.area == 0:
                raise ValueError(f"polygon {number} crosses or touches itself or has no area")
            if layout is not None:
                width, height = layout.size_mm
                if not polygon.intersects(shapely.box(-width / 2, -height / 2, width / 2, height / 2)):
                    raise ValueError(
                        f"polygon {number} lies beside the pad, which is {width:g} by {height:g} mm about (0, 0)"
                    )
        return keep_out_mm


def _stated_layout(stated: Mapping[str, Any]) -> Layout | None:
    """Of the keys of `[pad]` that hold, None if one of them is missing for it does not."""
    if not {"grid", "horizontals", "verticals", "pitch_mm"} <= stated.keys():
        return None
    counts = [stated["grid"] if stated[name] is None else stated[name] for name in ("horizontals", "verticals")]
    return Layout.of((counts[0], counts[1]), stated["pitch_mm"]) if any(counts) else None
