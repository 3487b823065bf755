"""The sections of `pad.toml` that design owns: the pad, the contact, the search and the rules."""

import math
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeGuard

from pydantic import BeforeValidator, Discriminator, Field, Tag, ValidationInfo, field_validator, model_validator

from padforge.common.settings import Settings, Spec, as_tuple, null_as, to_builtins, validate
from padforge.common.validation import InputError, check_float, check_int, short_repr

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray
    from scipy.interpolate import CubicSpline

DEFAULT_PITCH_MM = 11.25  # pitch of the built pad
MAX_FIBRES = 1024  # fibres of one family, also of a pad made of tiles
FAMILIES = ("horizontal", "vertical")

Pair = tuple[float, float]
Tool = Literal["dome", "ball", "flat", "finger"]  # shapes of tools that press a layer
Base = Literal["bonded", "slipping"]  # boundary condition at the bottom of a layer
Counts = int | tuple[int, int]  # M horizontals and M verticals, or (horizontals, verticals)
Pitch = float | Pair  # distance of neighbouring fibre ends, mm: in both directions, or along x and along y


@dataclass(frozen=True)
class Layout:
    """H horizontal and V vertical fibres whose ends are evenly spaced along the edges of a rectangle.

    Horizontal fibre i runs along x at a height of i pitches along y, i = 1..H; vertical fibre i runs along y at i
    pitches along x, i = 1..V. The pad is V + 1 pitches wide and H + 1 high. Positions are in grid units, equally long
    in both directions: the pitch, or the geometric mean of two, so that a pad turned by 90 degrees responds alike.
    """

    horizontals: int  # H, 0 to MAX_FIBRES; one fibre or more in all
    verticals: int  # V, 0 to MAX_FIBRES
    pitch_x_mm: float  # distance of the ends of neighbouring verticals, 0.1 to 1000 mm
    pitch_y_mm: float  # distance of the ends of neighbouring horizontals, 0.1 to 1000 mm

    def __post_init__(self) -> None:
        for name in ("horizontals", "verticals"):
            object.__setattr__(self, name, check_int(name, getattr(self, name), 0, MAX_FIBRES))
        for name in ("pitch_x_mm", "pitch_y_mm"):
            object.__setattr__(self, name, check_float(name.removesuffix("_mm"), getattr(self, name), 0.1, 1000))
        if not self.fibres:
            raise InputError("a pad of 0 horizontals and 0 verticals has no fibre, allowed is 1 or more in all")

    @classmethod
    def create(cls, fibres: "Counts | Layout", pitch_mm: Pitch = DEFAULT_PITCH_MM) -> "Layout":
        """Create a layout of M or (H, V) fibres and a pitch or (along x, along y); return a layout as it is."""
        if isinstance(fibres, Layout):
            return fibres
        if not isinstance(fibres, tuple | list):
            fibres = (check_int("grid", fibres, 1, MAX_FIBRES),) * 2
        if not isinstance(pitch_mm, tuple | list):
            pitch_mm = (check_float("pitch_mm", pitch_mm, 0.1, 1000),) * 2
        for name, values in (("fibres", fibres), ("pitch_mm", pitch_mm)):
            if len(values) != 2:
                raise InputError(f"{name} is {short_repr(values)}, expected one number or two")
        return cls(*fibres, *pitch_mm)

    @property
    def fibres(self) -> int:
        """H + V."""
        return self.horizontals + self.verticals

    @property
    def counts(self) -> tuple[int, int]:
        """(H, V)."""
        return self.horizontals, self.verticals

    @property
    def families(self) -> tuple[slice, slice]:
        """Rows of the horizontals and of the verticals among all fibres."""
        return slice(0, self.horizontals), slice(self.horizontals, self.fibres)

    def family(self, fibre: int) -> int:
        """Family of a fibre by its index: 0 horizontal, 1 vertical. It is also the axis that the fibre runs along."""
        return int(fibre >= self.horizontals)

    def fibre_name(self, fibre: int) -> str:
        """Name of a fibre by its index, such as "horizontal 1"; each family counts from 1."""
        family = self.family(fibre)
        return f"{FAMILIES[family]} {fibre - self.families[family].start + 1}"

    @property
    def is_square(self) -> bool:
        """Whether there are as many horizontals as verticals, of one pitch."""
        return self.horizontals == self.verticals and self.pitch_x_mm == self.pitch_y_mm

    @property
    def pitch_mm(self) -> Pitch:
        """One pitch where both are equal, else (along x, along y)."""
        return self.pitch_x_mm if self.pitch_x_mm == self.pitch_y_mm else (self.pitch_x_mm, self.pitch_y_mm)

    @cached_property
    def unit_mm(self) -> float:
        """Grid unit, mm."""
        # without the rounding of a root if there is one pitch
        return self.pitch_mm if isinstance(self.pitch_mm, float) else math.sqrt(self.pitch_x_mm * self.pitch_y_mm)

    @cached_property
    def spacing(self) -> Pair:
        """Pitches along x and along y, grid units."""
        return self.pitch_x_mm / self.unit_mm, self.pitch_y_mm / self.unit_mm

    @cached_property
    def extent(self) -> Pair:
        """Width and height of the pad, grid units; its corners are (0, 0) and this point."""
        return (self.verticals + 1) * self.spacing[0], (self.horizontals + 1) * self.spacing[1]

    @property
    def size_mm(self) -> Pair:
        """Width and height of the pad from fibre end to fibre end, mm."""
        return (self.verticals + 1) * self.pitch_x_mm, (self.horizontals + 1) * self.pitch_y_mm

    @cached_property
    def levels(self) -> "NDArray[np.float64]":
        """Coordinate across its family at which each fibre ends; shape (F,), grid units."""
        import numpy as np  # reading settings does not need NumPy

        rows = np.concatenate([np.arange(1.0, count + 1) for count in self.counts])
        levels = rows * np.repeat(self.spacing[::-1], self.counts)
        levels.setflags(write=False)
        return levels

    @property
    def settings(self) -> Mapping[str, Any]:
        """The layout as keys of `[pad]`."""
        if self.horizontals == self.verticals:
            counts = {"grid": self.horizontals, "horizontals": "grid", "verticals": "grid"}
        else:
            counts = {"horizontals": self.horizontals, "verticals": self.verticals}
        return counts | {"pitch_mm": self.pitch_mm, "size_mm": "pitch"}

    def __str__(self) -> str:
        """Describe the layout: `4 + 4 fibres, pitch 11.25 mm`."""
        pitches = dict.fromkeys((f"{self.pitch_x_mm:g}", f"{self.pitch_y_mm:g}"))
        return f"{self.horizontals} + {self.verticals} fibres, pitch {' and '.join(pitches)} mm"


# profile measured on the built pad: a Gaussian with a smooth end instead of tails
MEASURED_PROFILE = (
    *((0.0, 1.0), (2.25, 0.936), (4.5, 0.768), (6.75, 0.551), (9.0, 0.346)),
    *((11.25, 0.188), (13.5, 0.085), (15.75, 0.029), (18.5625, 0.0)),
)
MEASURED_STD_MM = 6.2  # standard deviation of that Gaussian
MAX_OVERSHOOT = 0.15
"""Largest excursion of a spline from the range of the two points it connects, as a share of the largest weight. Smooth
profiles stay far below; beyond it a signal would depend on weights that nobody measured."""

Point = tuple[Annotated[float, Field(ge=0, le=1e4)], Annotated[float, Field(ge=-1e3, le=1e3)]]
Sides = Annotated[Annotated[int, Field(ge=3, le=4096)] | None, *null_as("circle")]
FibreDepths = tuple[Annotated[float, Field(gt=0, le=100)], Annotated[float, Field(gt=0, le=100)]]
_KEYS = {
    "layer": (
        *("tool", "tool_radius_mm", "depth_mm", "thickness_mm", "base"),
        *("fibre_depths_mm", "squeeze", "stretch", "scale"),
    ),
    "profile": ("sensitivity_profile",),
    "shape": ("radius", "sides", "weight"),
}
"""Keys of `[contact]` by the model that they belong to; all other keys belong to every model."""

PRESS_DEPTH_MM = 5.0  # default depth of a press
SILICONE_MM = 6.0  # default thickness of the cast pad
FIBRE_MM = 0.3  # default diameter of a fibre
TRACK_DEPTHS_MM = (1.2, 0.4)  # default depths of the tracks of the deep family and of the other one
_CAST_KEYS = "thickness_mm", "fibre_depths_mm"  # of `[contact]`, of the pad as it is cast
CAST_SHARE = 0.02  # largest difference of lengths of the pad and of its contact, as a share of the thickness
_RIDGES = ("deep_ridge_height_mm", "shallow_ridge_height_mm")  # keys of `[mould]`, in that order
FIBRE_DEPTHS_MM = (TRACK_DEPTHS_MM[0] - FIBRE_MM / 2, TRACK_DEPTHS_MM[1] - FIBRE_MM / 2)  # centre lines, at the bottom


def _as_tuples(value: object) -> object:
    """Convert lists of lists, as files have them, to the tuples of a frozen model."""
    return tuple(as_tuple(item) for item in value) if isinstance(value, list | tuple) else value


class Contact(Settings, frozen=True):
    """`[contact]`: the contact model of a press, by which each fibre responds.

    The signal of a fibre is the line integral of a weight along it. The model "layer" computes the weight from the
    press: the silicone is an elastic layer under a tool (`padforge.design.layer`), and an element of a fibre responds
    by

        squeeze (-eps_zz) + stretch (cos^2 phi du/dr + sin^2 phi u/r),

    the strain that presses it flat and the strain along it, with phi the angle between the fibre and the direction to
    the press. In "profile" the weight is a measured function of the distance d to the press centre. In "shape" it is
    `weight` inside a regular polygon or circle (paper, formulas (1) and (2)), in grid units, as published: there, and
    only there, the press grows with the pitch. Stating keys of one model selects it; `sensitivity_profile = []` is a
    shape as well.

    Attributes:
        model: "layer" if no key of another model is stated.
        tool: "dome" is a paraboloid of that tip radius, "finger" one as soft as the pad, "flat" the end of a rod.
        depth_mm: of the tool's tip, less than the thickness.
        base: "slipping" if the pad lies on a table, as readings of the built pad say; "bonded" if it is glued.
        fibre_depths_mm: centre lines of the horizontal and of the vertical fibres, below the pressed face. If a
            settings file does not state them or the thickness, they follow from the mould, with the face of the tracks
            pressed (`read_contact`).
        sides: number of sides D; None for a circle ("circle" in pad.toml).
        weight: "inverse" is 1 / max(d, K / 100), the paper's 1 / d kept finite within a hundredth of the radius.
        length: "manhattan" is the default of shapes, "euclidean" that of the others.
        sensitivity_profile: points from distance 0 to the distance from which the weight is 0, interpolated by a cubic
            spline over d^2, which may leave their range by MAX_OVERSHOOT. Weights may be negative.
    """

    model: Literal["layer", "profile", "shape"] = Field(
        default="layer", description="layer: from the press in mm; profile: as measured; shape: as published"
    )
    tool: Tool = Field(default="dome", description="what presses, of a layer")
    tool_radius_mm: float = Field(default=8.4, ge=0.1, le=1000, description="tip radius of the tool, mm")
    depth_mm: float = Field(default=PRESS_DEPTH_MM, ge=0.01, le=100, description="depth of the press, of a layer, mm")
    thickness_mm: float = Field(default=SILICONE_MM, ge=0.1, le=1000, description="thickness of the pad, mm")
    base: Base = Field(default="slipping", description="boundary condition between the pad and what it lies on")
    fibre_depths_mm: Annotated[FibreDepths, BeforeValidator(as_tuple)] = Field(
        default=FIBRE_DEPTHS_MM, description="depth of the [horizontal, vertical] fibres below the pressed face, mm"
    )
    squeeze: float = Field(default=1.0, ge=0, le=100, description="response of a fibre to being pressed flat")
    stretch: float = Field(default=1.0, ge=0, le=100, description="response of a fibre to being stretched")
    scale: float = Field(
        default=1.0, ge=0.1, le=10, description="width of the press, as measured, over that of the layer"
    )
    radius: float = Field(default=0.6, ge=1e-9, le=1e4, description="object radius K, grid units, of a shape")
    sides: Sides = Field(default=30, description='sides D of the object, or "circle", of a shape')
    weight: Literal["uniform", "inverse_square", "inverse"] = Field(
        default="uniform", description="weight of a fibre element in a shape: 1, 1/(K + d^2) or 1/d"
    )
    length: Literal["manhattan", "euclidean"] = Field(
        default="euclidean", description="length of a fibre element: euclidean, or |dx| + |dy| as published"
    )
    sensitivity_profile: Annotated[tuple[Point, ...], Field(max_length=64), BeforeValidator(_as_tuples)] = Field(
        default=MEASURED_PROFILE, description="measured weight by distance, mm, [[0, 1], ..., [d, 0]], of a profile"
    )

    @model_validator(mode="before")
    @classmethod
    def _infer_model(cls, stated: object) -> object:
        """Fill in the model and the length from the keys that are stated."""
        stated = to_builtins(stated)  # `Settings` does so later
        if not isinstance(stated, Mapping):
            return stated
        model = _stated_model(stated)
        if stated.get("sensitivity_profile") in ([], ()):
            stated = {name: value for name, value in stated.items() if name != "sensitivity_profile"}
        return {"model": model, "length": "manhattan" if model == "shape" else "euclidean", **stated}

    @model_validator(mode="after")
    def _check_model(self) -> "Contact":
        for model, names in _KEYS.items():
            for name in names if model != self.model else ():
                value = getattr(self, name)
                # else a radius set beside the layer that `padforge init` has written would have no effect
                if value != type(self).model_fields[name].default:
                    raise ValueError(f"{name} is {short_repr(value)}, which counts where model is {model}")
        if self.model == "layer":
            if self.length == "manhattan":
                raise ValueError("length is manhattan, a layer stretches along the fibre: allowed is euclidean")
            for name, depth in (("depth_mm", self.depth_mm), ("fibre_depths_mm", max(self.fibre_depths_mm))):
                if depth >= self.thickness_mm:
                    raise ValueError(f"{name} is {depth:g}, the pad is {self.thickness_mm:g} mm thick")
            if self.squeeze + self.stretch == 0:
                raise ValueError("squeeze and stretch are both 0, one of them must be above")
        return self

    @field_validator("sensitivity_profile")
    @classmethod
    def _check_profile(cls, profile: tuple[Point, ...]) -> tuple[Point, ...]:
        distances, weights = zip(*profile, strict=True) if profile else ((), ())
        if len(profile) < 3 or distances[0] != 0 or any(a >= b for a, b in pairwise(distances)):
            raise ValueError("it must be of 3 points or more, whose distances ascend from 0")
        if weights[-1] != 0 or not any(weights):
            raise ValueError("the last weight must be 0, and some other one not")
        if profile != MEASURED_PROFILE:  # so that the default does not import SciPy, which takes a while
            _check_overshoot(profile)
        return profile


def _stated_model(stated: Mapping[str, Any]) -> Any:
    """Return the model of the contact with the keys that are stated."""
    profile = to_builtins(stated.get("sensitivity_profile"))  # the truth value of an array is ambiguous
    if profile is not None and profile not in ([], ()):
        model = "profile"
    else:
        model = "shape" if profile is not None or stated.keys() & set(_KEYS["shape"]) else "layer"
    return stated.get("model", model)


def read_contact(spec: Spec) -> Contact:
    """Read `[contact]` of a settings file; lengths of the pad that it does not state are those of the pad as cast.

    These are `thickness_mm`, by `[mould]`, and `fibre_depths_mm`, by the ridges of `[mould]`, the diameter of `[fibre]`
    and the deep family of `[pad]`, as far as the settings state them.

    Raises:
        InputError: an unknown key or a value out of range, or a pad that is too thin for the press or its fibres.
    """
    stated = spec.stated(Contact)
    if _stated_model(stated) != "layer":
        return spec.section(Contact)
    radius_mm = _stated_mm(spec, "fibre", "diameter_mm", FIBRE_MM) / 2
    depths_mm = [
        _stated_mm(spec, "mould", key, default) - radius_mm
        for key, default in zip(_RIDGES, TRACK_DEPTHS_MM, strict=True)
    ]
    if spec.stated(PadSettings).get("deep_family") == "vertical":
        depths_mm.reverse()
    as_cast = {"thickness_mm": _stated_mm(spec, "mould", "silicone_mm", SILICONE_MM), "fibre_depths_mm": depths_mm}
    return spec.section(Contact, **{key: value for key, value in as_cast.items() if key not in stated})


def contact_designed_for(provenance: Mapping[str, Any]) -> Contact | None:
    """Return the contact that a pad was designed for, by the provenance of its morphology; None if that has none."""
    settings = provenance.get("settings")
    stated = settings.get("contact") if isinstance(settings, Mapping) else None
    if not isinstance(stated, Mapping):
        return None
    with suppress(InputError):
        return validate(Contact, stated, "the pad's contact")


def cast_as_contact(spec: Spec, keys: Collection[str]) -> Spec:
    """Return settings whose mould makes the pad that `[contact]` describes, the inverse of `read_contact`.

    The mould follows the lengths of the pad among the `keys` of `[contact]`.
    """
    return spec.replaced(_tables_of_cast(spec, keys))


def fill_cast(spec: Spec) -> Spec:
    """Return settings whose mould makes the pad that `[contact]` states, where they leave it open.

    Raises:
        InputError: the settings state another pad.
    """
    stated, tables = spec.stated(Contact), {}
    if _stated_model(stated) != "layer":
        return spec
    slack_mm = CAST_SHARE * read_contact(spec).thickness_mm
    for key in (name for name in _CAST_KEYS if name in stated):
        for section, values in _tables_of_cast(spec, [key]).items():
            of_section = spec.stated(section)
            for name, value in values.items():
                got = of_section.get(name, value)
                is_length = isinstance(value, float)
                if abs(_stated_mm(spec, section, name, value) - value) > slack_mm if is_length else got != value:
                    allowed = f"allowed is {value}, as [contact] {key} says, or only one of these keys"
                    raise InputError(f"{spec.source}: [{section}] {name}: got {short_repr(got)}, {allowed}")
            tables[section] = tables.get(section, {}) | values | of_section
    return spec.replaced(tables)


def _tables_of_cast(spec: Spec, keys: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return the settings, by section, of a mould that makes the pad that some keys of `[contact]` describe."""
    contact, tables = read_contact(spec), {}
    if "thickness_mm" in keys:
        tables["mould"] = {"silicone_mm": contact.thickness_mm}
    if "fibre_depths_mm" in keys:
        horizontal, vertical = contact.fibre_depths_mm
        if min(horizontal, vertical) > contact.thickness_mm / 2:  # the face without tracks is pressed
            horizontal, vertical = contact.thickness_mm - horizontal, contact.thickness_mm - vertical
        radius_mm = _stated_mm(spec, "fibre", "diameter_mm", FIBRE_MM) / 2
        heights_mm = [round(depth + radius_mm, 9) for depth in (max(horizontal, vertical), min(horizontal, vertical))]
        tables["mould"] = tables.get("mould", {}) | dict(zip(_RIDGES, heights_mm, strict=True))
        tables["pad"] = {"deep_family": "horizontal" if horizontal > vertical else "vertical"}
    return tables


def _stated_mm(spec: Spec, section: str, key: str, default: float) -> float:
    """Return a length that a section states; the default if it is no number, which the section's model refuses."""
    value = spec.stated(section).get(key, default)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else default


def profile_spline(distances: "ArrayLike", weights: "ArrayLike") -> "CubicSpline":
    """Fit a cubic spline to weights at distances (n,) over the squared distance, which makes it smooth at the centre.

    It ends at weight 0, that of the last point, without a kink.
    """
    import numpy as np
    from scipy.interpolate import CubicSpline

    squares = np.asarray(distances, dtype=float) ** 2
    return CubicSpline(squares, weights, bc_type=((2, 0.0), (1, 0.0)))  # pyright: ignore[reportArgumentType]


def _check_overshoot(points: tuple[Point, ...]) -> None:
    """Refuse points between which their spline leaves their range by more than MAX_OVERSHOOT."""
    spline = profile_spline(*zip(*points, strict=True))
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


PUBLISHED_CONTACT = Contact(radius=0.6)  # of the paper: a polygon of 30 sides, Manhattan lengths
TRACK_WIDTH_MM = 0.4  # default width of a track

# two straight tracks that cross at a right angle have two widths in common
MaxCommon = Annotated[Annotated[float, Field(ge=2.5 * TRACK_WIDTH_MM, le=1000)] | None, *null_as("any")]
MaxCrossings = Annotated[Annotated[int, Field(ge=0)] | None, *null_as("any")]
RuleMm = Annotated[float, Field(ge=0, le=1000)]


class RulesSettings(Settings):
    """`[rules]`: what makes a pad buildable, checked exactly on the finished curves (`check_rules` has the formulas).

    Attributes:
        min_mean_bend_radius_mm: R, by which a fibre turns by no more than half a radian (29 degrees) in any length of
            R / 2. Within that length it may bend more tightly.
        max_crossings: greatest number of crossings of a horizontal with a vertical fibre, or None for any number
            ("any" in pad.toml). Every horizontal has to cross every vertical, so a limit below grid^2 cannot be met.
        max_common_track_mm: greatest length in which a horizontal and a vertical fibre run nearer to each other than
            the width of a track, 0.4 mm, or None for any ("any" in pad.toml). There the shallow track has no floor of
            silicone, and the adhesive alone keeps the fibres apart. At the default straight fibres may cross at 23.6
            degrees or more: they have 0.8 mm / sin(angle) in common.
    """

    enforce: bool = Field(default=True, description="false disables all rules: the pad may then not be buildable")
    min_mean_bend_radius_mm: RuleMm = Field(
        default=1.0, description="minimum bend radius of a fibre, as the mean over half that length, mm"
    )
    min_gap_mm: RuleMm = Field(
        default=0.8, description="minimum gap of centre lines in a family, or within a folded fibre, mm"
    )
    same_family_crossings: int = Field(default=0, ge=0, description="maximum crossings between fibres of one family")
    max_crossings: MaxCrossings = Field(
        default=None, description='maximum crossings of the families (at least grid^2), or "any"'
    )
    min_crossing_angle_deg: float = Field(default=0.0, ge=0, le=90, description="minimum angle of crossings, degrees")
    max_common_track_mm: MaxCommon = Field(
        default=2.0, description='maximum length of a horizontal within 0.4 mm of a vertical, mm, or "any"'
    )
    border_mm: RuleMm = Field(default=2.0, description="minimum distance of a fibre to the border, mm")
    keep_out_mm: RuleMm = Field(default=1.5, description="minimum distance of a fibre to a keep-out of [pad], mm")
    max_length_mm: float = Field(default=500.0, gt=0, le=1e6, description="maximum length of a fibre, mm")


def _check_contacts(value: object) -> object:
    if isinstance(value, str) and value not in ("plausible", "assumed"):
        raise ValueError('allowed are "plausible", "assumed" and a list of tables like [contact]')
    return as_tuple(value)


Weight = Annotated[float, Field(ge=0, le=1e6)]
Contacts = Annotated[tuple[Contact, ...] | Literal["plausible", "assumed"], BeforeValidator(_check_contacts)]
Weights = Annotated[tuple[Weight, Weight, Weight], BeforeValidator(as_tuple)]
Steps = Annotated[Annotated[int, Field(ge=1, le=1_000_000)] | None, *null_as("contact")]
MaxFailures = Annotated[
    Annotated[int, Field(ge=0, le=8)] | Annotated[tuple[Weight, ...], Field(min_length=1, max_length=9)],
    BeforeValidator(as_tuple),
]

WEIGHTS = (1.0, 1e-7, 5e-6)  # published alpha, beta and gamma: weights of entropy, sharpness and disorder (formula (5))
SIDE = 7  # presses per row and column in the published search
LEVELS = 4096  # levels of the published 12-bit converter
MAX_LEVELS = 2**24
Entropy = Literal["families", "joint"]
"""Entropy in the published objective: of either family, summed, as the published code has it, or of all fibres."""


class Scatter(NamedTuple):
    """Scatter of a fibre's response from press to press at one position."""

    floor: float  # standard deviation of the additive part, as a share of a straight fibre's full scale, > 0
    share: float = 0.0  # standard deviation of the part proportional to the response, as a share of it
    common: float = 0.0  # share of the proportional part's variance that all fibres have in common

    def sample_gains(self, shape: tuple[int, ...], rng: "np.random.Generator") -> "NDArray[np.float64]":
        """Sample the factor, about 1, on each response; the shape is (presses, fibres)."""
        individual, common = rng.standard_normal(shape), rng.standard_normal((shape[0], 1))
        return 1 + self.share * (math.sqrt(1 - self.common) * individual + math.sqrt(self.common) * common)

    def sample(self, responses: "NDArray[np.float64]", rng: "np.random.Generator") -> "NDArray[np.float64]":
        """Sample responses (presses, fibres), in units of full scale, as they scatter from press to press."""
        gains = self.sample_gains(responses.shape, rng)
        return responses * gains + self.floor * rng.standard_normal(responses.shape)

    def scaled(self, factor: float) -> "Scatter":
        """Return the scatter with its standard deviations multiplied by a factor."""
        return Scatter(self.floor * factor, self.share * factor, self.common)


class SearchSettings(Settings):
    """`[search]`: how the fibres are optimised.

    Attributes:
        noise: additive scatter; this and the next two default to the scatter measured on a built pad. It is a share of
            the full scale of straight fibres: of the default pad under the default press for a layer, whose responses
            are strains, of the pad itself for other contacts, whose responses have no unit.
        contacts: further contacts that the pad is optimised for beside `[contact]`: "plausible" ones, which it may
            really meet (`padforge.design.contact_set`); none, if "assumed"; or a list of tables such as
            `{radius = 0.9}`.
    """

    method: Literal["descent", "genetic"] = Field(
        default="descent", description="gradients of the expected error, or the genetic search as published"
    )
    knots: int = Field(default=21, ge=1, le=64, description="inner knots per fibre (N); the rules take 3 a turn")
    starts: int = Field(default=2, ge=1, le=10_000, description="random starts of the gradient search")
    steps: Steps = Field(
        default=None, description="steps of a start of the gradient search, by its contact: 1200, of a shape 3000"
    )
    population: int = Field(default=200, ge=4, le=100_000, description="pads per generation of the genetic search")
    generations: int = Field(default=50, ge=1, le=1_000_000, description="generations of the genetic search")
    weights: Weights = Field(default=WEIGHTS, description="weights of entropy, sharpness and disorder, genetic search")
    entropy: Entropy = Field(
        default="families", description='summed over "families" as published, or "joint" as in (5), genetic search'
    )
    presses: int = Field(default=SIDE, ge=2, le=64, description="side of the square of presses of the genetic search")
    levels: int = Field(default=LEVELS, ge=1, le=MAX_LEVELS, description="levels of a signal in the genetic search")
    seed: int = Field(default=0, ge=0, le=2**32 - 1, description="seed of every random choice")
    max_failures: MaxFailures = Field(
        default=3, description="failed fibres designed for, each number as likely as none, or weights of 0, 1, ..."
    )
    noise: float = Field(
        default=0.02, ge=1e-9, le=10, description="standard deviation of noise, share of straight fibres' full scale"
    )
    scatter: float = Field(default=0.18, ge=0, le=1, description="scatter of a response between presses, share of it")
    scatter_common: float = Field(default=0.36, ge=0, le=0.99, description="share of its variance common to all fibres")
    sharpness: float = Field(default=0.0, ge=0, le=1e6, description="weight of the signals' mean second difference")
    contacts: Contacts = Field(
        default="plausible",
        description='contacts to serve as well: "plausible" ones, none if "assumed", or tables like [contact]',
    )

    @property
    def default_contact(self) -> Contact:
        """Contact to design for if none is stated: the default layer, or the published one for the genetic search."""
        return PUBLISHED_CONTACT if self.method == "genetic" else Contact()

    @property
    def response_scatter(self) -> Scatter:
        """Scatter of responses that is designed for."""
        return Scatter(self.noise, self.scatter, self.scatter_common)

    @field_validator("max_failures", "weights")
    @classmethod
    def _check_weights(cls, weights: int | tuple[float, ...]) -> int | tuple[float, ...]:
        if isinstance(weights, tuple) and sum(weights) == 0:
            raise ValueError("one of the weights must be above 0")
        return weights


Millimetres = Annotated[float, Field(gt=0, le=1e6)]
Sensed = tuple[Millimetres, Millimetres] | Literal["beyond", "fibres"]
Rectangle = tuple[tuple[float, float], tuple[float, float]]  # low and high corner, grid units
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Corners = tuple[tuple[Coordinate, Coordinate], ...]  # corners of a polygon, mm from the middle of the pad
Hole = tuple[Coordinate, ...]  # centre x and y, diameter, and diameter of a screw's head if it has one, mm
KeepOut = Corners | Hole


def is_hole(keep_out: KeepOut) -> TypeGuard[Hole]:
    """Return whether a keep-out is a round hole, no polygon."""
    return isinstance(keep_out, tuple) and len(keep_out) > 0 and isinstance(keep_out[0], int | float)


_StatedKeepOut = Annotated[
    Annotated[Corners, Tag("corners")] | Annotated[Hole, Field(min_length=3, max_length=4), Tag("hole")],
    Discriminator(lambda shape: "hole" if is_hole(shape) else "corners"),
    BeforeValidator(_as_tuples),
]
BentRadius = Annotated[Annotated[float, Field(ge=1, le=1e6)] | None, *null_as("flat")]
_HOLE_SIDES = 64  # sides of the polygon that stands for a round hole where paths and presses avoid it
Count = Annotated[Annotated[int, Field(ge=0, le=256)] | None, *null_as("grid")]
PitchMm = Annotated[float, Field(ge=0.1, le=1000)]


def sensed_rectangle(layout: Layout, sensed_mm: Sensed = "beyond") -> Rectangle:
    """Return the low and the high corner of the pressed area, grid units.

    The outermost of V verticals lie at 1 and V pitches of a pad of V + 1, and so along y for horizontals. The rectangle
    is never less than half the pad: 0.5 to 1.5 pitches for V = 1, 0.25 to 0.75 for V = 0. Otherwise "beyond" is 0.5 to
    V + 0.5 pitches, and "fibres" 1 to V, as published.
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
    """Return the rectangle pressed in the paper, between the outermost fibres; grid units."""
    return sensed_rectangle(layout, "fibres")


def _check_sensed(value: object) -> object:
    if isinstance(value, str) and value not in ("beyond", "fibres"):
        raise ValueError('allowed are [width, height], "beyond" and "fibres"')
    return as_tuple(value)


def _check_pitches(value: object) -> object:
    value = as_tuple(value)
    pitches = value if isinstance(value, tuple) else (value, value)
    if len(pitches) != 2 or any(isinstance(pitch, int | float) and (pitch < 0.1 or pitch > 1000) for pitch in pitches):
        raise ValueError("allowed is 0.1 to 1000, or [along x, along y] of these")
    return value


class PadSettings(Settings):
    """`[pad]`: the pad, and the part of it that is pressed.

    Attributes:
        horizontals: `grid` if None; with 0 the pad is a strip one pitch wide, and the verticals run across it.
        verticals: in the same way.
        leads: "one side" is the lower edge, for a connector; leads come down beside the pad, nested.
        size_mm: of the pad from fibre end to fibre end, in place of `pitch_mm`, which follows from it: the model holds
            the pitch alone. `[mould] border_mm` and leads to one side add to it.
        sensed_mm: as of `sensed_rectangle`, at most the pad's size. Designs are for presses there.
        keep_out_mm: holes, screws, a connector. Each polygon has 3 corners or more and an area, does not cross itself,
            and lies on the pad at least in part. A hole is round and lies on the pad wholly; with a fourth number, the
            diameter of a screw's head, all of that is kept free, and the head sinks into the pad by half of its
            thickness, on the face with the tracks.
        bent_radius_mm: None for a flat pad. It is cast flat in either case.
    """

    grid: int = Field(default=4, ge=1, le=256, description="fibres per family (M), unless the next two state it")
    horizontals: Count = Field(default=None, description='fibres along x, or as "grid"; 0: a strip of fibres across it')
    verticals: Count = Field(default=None, description='fibres along y, or as "grid"; 0: a strip of fibres across it')
    pitch_mm: Annotated[PitchMm | tuple[PitchMm, PitchMm], BeforeValidator(_check_pitches)] = Field(
        default=DEFAULT_PITCH_MM, description="distance of neighbouring fibre ends, mm, or [along x, along y]"
    )
    size_mm: Annotated[tuple[Millimetres, Millimetres] | None, BeforeValidator(as_tuple), *null_as("pitch")] = Field(
        default=None, description='[width, height] of the pad, mm, in place of pitch_mm; or by its "pitch"'
    )
    deep_family: Literal["horizontal", "vertical"] = Field(
        default="horizontal", description="family whose tracks lie deeper in the silicone and are laid first"
    )
    leads: Literal["edges", "one side"] = Field(
        default="edges", description='ends of fibres leave on all four "edges", or all of them on "one side", the lower'
    )
    sensed_mm: Annotated[Sensed, BeforeValidator(_check_sensed)] = Field(
        default="beyond", description='pressed [width, height], mm; half a pitch "beyond" fibres, or between "fibres"'
    )
    keep_out_mm: Annotated[tuple[_StatedKeepOut, ...], Field(max_length=64), BeforeValidator(as_tuple)] = Field(
        default=(),
        description="keep-outs: holes [x, y, diameter], polygons [[x, y], ...]; mm from the middle",
    )
    bent_radius_mm: BentRadius = Field(default=None, description='radius of a cylinder about y it is on, mm, or "flat"')

    @property
    def layout(self) -> Layout:
        """Positions of the fibre ends."""
        return _layout(vars(self))

    @property
    def sensed(self) -> Rectangle:
        """`sensed_rectangle` of this pad, grid units."""
        return sensed_rectangle(self.layout, self.sensed_mm)

    @property
    def keep_out_corners_mm(self) -> tuple[Corners, ...]:
        """Polygons of all keep-outs; those of holes, or of their screws' heads, are regular ones around the circle."""
        return tuple(_hole_corners(shape) if is_hole(shape) else shape for shape in self.keep_out_mm)

    def for_layout(self, layout: Layout) -> "PadSettings":
        """Return these settings for a pad of another layout.

        Args:
            layout: positions of its fibre ends.

        Raises:
            InputError: a setting that does not fit that pad.
        """
        return type(self)(**{**self.model_dump(), **layout.settings})

    @model_validator(mode="before")
    @classmethod
    def _size_to_pitch(cls, stated: object) -> object:
        """Replace a size by the pitches that make a pad of it; an invalid size or count is left to the fields."""
        stated = to_builtins(stated)  # `Settings` does so later
        if not isinstance(stated, Mapping) or not isinstance(size_mm := stated.get("size_mm"), list | tuple):
            return stated
        if "pitch_mm" in stated:
            pitch = f"pitch_mm is {short_repr(stated['pitch_mm'])}"
            raise ValueError(f"size_mm is {short_repr(size_mm)} and {pitch}, allowed is one of them")
        grid = stated.get("grid", cls.model_fields["grid"].default)
        counts = [
            grid if (count := stated.get(name)) in (None, "grid") else count for name in ("verticals", "horizontals")
        ]
        if len(size_mm) != 2 or not all(
            isinstance(number, int | float) and number >= 0 for number in (*size_mm, *counts)
        ):
            return stated
        pitches = tuple(side / (count + 1) for side, count in zip(size_mm, counts, strict=True))
        if not all(0.1 <= pitch <= 1000 for pitch in pitches):
            wanted = " and ".join(f"{pitch:.3g}" for pitch in pitches)
            raise ValueError(
                f"size_mm is {short_repr(size_mm)}, which makes pitches of {wanted} mm, allowed is 0.1 to 1000"
            )
        return {**stated, "size_mm": None, "pitch_mm": pitches}

    @model_validator(mode="after")
    def _check_fibres(self) -> "PadSettings":
        if self.horizontals == 0 and self.verticals == 0:
            raise ValueError("horizontals and verticals are both 0, allowed is one fibre or more in all")
        return self

    @field_validator("sensed_mm")
    @classmethod
    def _check_size(cls, sensed_mm: Sensed, info: ValidationInfo) -> Sensed:
        layout = _validated_layout(info.data)
        if isinstance(sensed_mm, tuple) and layout is not None:
            for name, side, limit in zip(("wide", "high"), sensed_mm, layout.size_mm, strict=True):
                if side > limit * (1 + 1e-9):
                    raise ValueError(f"the pad itself is {limit:g} mm {name}")
        return sensed_mm

    @field_validator("keep_out_mm")
    @classmethod
    def _check_keep_outs(cls, keep_out_mm: tuple[KeepOut, ...], info: ValidationInfo) -> tuple[KeepOut, ...]:
        layout = _validated_layout(info.data)
        width, height = layout.size_mm if layout else (2e6, 2e6)  # of a refused layout: all that coordinates reach
        size = f"the pad, which is {width:g} by {height:g} mm about (0, 0)"
        for number, shape in enumerate(keep_out_mm, 1):
            if is_hole(shape):
                x, y, *diameters = shape
                if min(diameters) < 0.1 or diameters != sorted(diameters):
                    allowed = "allowed are diameters from 0.1 mm, of a head no less than of its hole"
                    raise ValueError(f"hole {number} is {short_repr(shape)}, {allowed}")
                if max(abs(x) - width / 2, abs(y) - height / 2) + diameters[-1] / 2 > 1e-9:
                    raise ValueError(f"hole {number} reaches beyond {size}")
            else:
                _check_polygon(shape, number, width, height, size)
        return keep_out_mm


def scale_keep_out(keep_out: KeepOut, factor: float) -> KeepOut:
    """Return a keep-out that is larger by a factor about the middle of the pad."""
    if is_hole(keep_out):
        return tuple(factor * number for number in keep_out)
    return tuple((factor * x, factor * y) for x, y in keep_out)


def _hole_corners(hole: Hole) -> Corners:
    """Return the corners of the regular polygon around a hole, or around its screw's head."""
    x, y, *diameters = hole
    radius = diameters[-1] / 2 / math.cos(math.pi / _HOLE_SIDES)
    angles = [2 * math.pi * side / _HOLE_SIDES for side in range(_HOLE_SIDES)]
    return tuple((x + radius * math.cos(angle), y + radius * math.sin(angle)) for angle in angles)


def _check_polygon(corners: Corners, number: int, width: float, height: float, size: str) -> None:
    """Refuse a polygon that has no area, or none on a pad of a width and height, mm."""
    import shapely  # takes a while, and few pads have keep-outs

    if not 3 <= len(corners) <= 1000:
        raise ValueError(f"polygon {number} has {len(corners)} corners, allowed are 3 to 1000")
    polygon = shapely.Polygon(corners)
    if not polygon.is_valid or polygon.area == 0:
        raise ValueError(f"polygon {number} crosses or touches itself or has no area")
    if not polygon.intersects(shapely.box(-width / 2, -height / 2, width / 2, height / 2)):
        raise ValueError(f"polygon {number} lies beside {size}")


def _layout(fields: Mapping[str, Any]) -> Layout:
    """Return the layout of the fields of `[pad]`."""
    horizontals, verticals = (fields["grid"] if fields[x] is None else fields[x] for x in ("horizontals", "verticals"))
    return _create_layout((horizontals, verticals), fields["pitch_mm"])


_create_layout = lru_cache(Layout.create)  # a search asks for the layout of its pad many times a step


def _validated_layout(fields: Mapping[str, Any]) -> Layout | None:
    """Return the layout of the fields validated so far; None if one of them was refused."""
    is_complete = fields.keys() >= {"grid", "horizontals", "verticals", "pitch_mm"}
    return _layout(fields) if is_complete and (fields["horizontals"], fields["verticals"]) != (0, 0) else None


PUBLISHED_PAD, PUBLISHED_SEARCH = PadSettings(sensed_mm="fibres"), SearchSettings(noise=0.005, scatter=0.0)
# settings of the paper, by section, where they differ from the defaults
PUBLISHED: Mapping[str, Settings] = {
    **{"pad": PUBLISHED_PAD, "contact": PUBLISHED_CONTACT, "search": PUBLISHED_SEARCH},
    "rules": RulesSettings(max_common_track_mm=None),
}
# settings of the pad that the authors built, pressed by a dome of 0.75 pitches, 5 mm deep by their code; which family
# lies deeper, and that the pad slips on its table, is what their readings say
BUILT: Mapping[str, Settings] = {
    "pad": PadSettings(deep_family="vertical"),
    "contact": Contact(base="slipping", fibre_depths_mm=FIBRE_DEPTHS_MM[::-1]),
}
