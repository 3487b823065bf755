"""`[rules]`: what makes a pad buildable."""

from typing import Annotated

from padforge.design.common.settings import Settings, none_as
from pydantic import Field

TRACK_WIDTH_MM = 0.4
"""Width of a track where the mould does not say another."""
MIN_COMMON_MM = 2.5 * TRACK_WIDTH_MM
"""Least limit on what two tracks have in common: two that cross straight and at a right angle have two widths."""

MaxCommon = Annotated[Annotated[float, Field(ge=MIN_COMMON_MM, le=1000)] | None, *none_as("any")]
MaxCrossings = Annotated[Annotated[int, Field(ge=0)] | None, *none_as("any")]


class RulesSettings(Settings):
    """`[rules]`: what makes a pad buildable, checked exactly on the finished curves (`check_rules` has the formulas).

    Attributes:
        max_crossings: greatest number of crossings of a horizontal with a vertical fibre, or None for any number
            ("any" in pad.toml). Every horizontal has to cross every vertical, so a limit below grid^2 cannot be met.
        max_common_track_mm: greatest length in which a horizontal and a vertical fibre run nearer to each other than
            the width of a track, 0.4 mm, or None for any ("any" in pad.toml). There the shallow track has no floor of
            silicone, and the adhesive alone keeps the fibres apart. At the default straight fibres may cross at 23.6
            degrees or more: they have 0.8 mm / sin(angle) in common.
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
    max_common_track_mm: MaxCommon = Field(
        default=2.0, description='length for which a horizontal may run on a vertical, within 0.4 mm, mm, or "any"'
    )
    border_mm: float = Field(default=2.0, ge=0, le=1000, description="least distance of a fibre to the border, mm")
    keep_out_mm: float = Field(
        default=1.5, ge=0, le=1000, description="least distance of a fibre to a keep-out of [pad], mm"
    )
    max_length_mm: float = Field(default=500.0, gt=0, le=1e6, description="greatest length of a fibre, mm")
