"""The morphology of a pad: the knots its fibres run through.

A pad of V + 1 by H + 1 pitches carries fibres in two families. Horizontal fibre i is a curve y(x) from (0, i) to
(V+1, i), i = 1..H, vertical fibre i a curve x(y) from (i, 0) to (i, H+1), i = 1..V, in pitches; between knots both are
PCHIP curves. Places are in grid units, equally long both ways: the pitch, or where there are two their geometric mean.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.design.common.files import read_json, write_json
from padforge.design.common.mat_files import load_mat
from padforge.design.common.validation import InputError, check_array, check_int, check_mapping, check_type, short_repr
from padforge.design.common.validation import check_path as as_path
from padforge.design.kernels.geometry import INVERSE_SQUARE, MANHATTAN, UNIFORM, Ends, WeightLaw, frames
from padforge.design.kernels.published import quantized_signals
from padforge.design.settings import MAX_FIBRES, Contact, Counts, Layout, Pitch

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MIN_SPAN = 1e-12
"""Least distance of knots along a fibre's travel axis, grid units: slopes stay numbers that can be squared."""
MAX_COORDINATE = 1e6
"""Greatest coordinate of a place, by amount, in grid units or mm."""
MARGIN = 1e-3
"""Least distance of a free knot to the pad's edge, grid units, as in the published optimiser."""


def layout_of(fibres: int, layout: Layout | None = None) -> Layout:
    """The layout of so many fibres: that told, or where none is that of a square pad of one pitch.

    Raises:
        InputError: fibres of another number than those of the layout, or none, or not of two equal families.
    """
    if layout is None:
        if fibres % 2 or not fibres:
            raise InputError(f"these are {fibres} fibres, expected 2 M: as many horizontals as verticals")
        return Layout.create(fibres // 2)
    if fibres != layout.fibres:
        raise InputError(f"these are {fibres} fibres, expected {layout}")
    return layout


def fibre_ends(layout: Layout) -> Ends:
    """Where its fibres end, as kernels take it."""
    return Ends(*layout.counts, *layout.spacing[::-1])


def assemble_knots(inner: Array, layout: Layout | None = None) -> Array:
    """Whole fibres from free knots: sort along the travel axis, keep knots apart, add the fixed ends.

    Args:
        inner: (..., F, N, 2) knots in any order, grid units on the pad.
        layout: of the F fibres; a square one if None.

    Returns:
        (..., F, N+2, 2) knots that satisfy `Morphology`. Knots at the same travel coordinate are moved apart by
        the least step that keeps the curve a graph (1e-9 grid units, far below any printer).
    """
    layout = layout_of(inner.shape[-3], layout)
    knots = np.empty((*inner.shape[:-2], inner.shape[-2] + 2, 2))
    for travel, rows in enumerate(layout.families):
        cross = 1 - travel
        fibres = inner[..., rows, :, :]
        rank = np.argsort(fibres[..., travel], axis=-1, kind="stable")[..., None]
        knots[..., rows, 1:-1, :] = np.take_along_axis(fibres, rank, axis=-2)
        knots[..., rows, 0, travel], knots[..., rows, -1, travel] = 0, layout.extent[travel]
        knots[..., rows, 0, cross] = knots[..., rows, -1, cross] = layout.levels[rows]
        _separate(knots[..., rows, :, travel])
    return knots


def _separate(travel: Array, step: float = 1e-9) -> None:
    """Move ascending coordinates (..., N+2) apart in place, the first and last staying where they are."""
    if (np.diff(travel, axis=-1) >= step).all():
        return
    for k in range(1, travel.shape[-1] - 1):
        travel[..., k] = np.maximum(travel[..., k], travel[..., k - 1] + step)
    for k in range(travel.shape[-1] - 2, 0, -1):
        travel[..., k] = np.minimum(travel[..., k], travel[..., k + 1] - step)


def knots_from_parameters(parameters: ArrayLike) -> Array:
    """Knots (2M, N+2, 2) of the published parameter matrix `para`, (N, 4M): x of horizontals, their y, x of verticals,
    their y.

    Raises:
        InputError: a matrix of another shape, or not of finite numbers.
    """
    para = check_array("parameters", parameters)
    if para.size == 0 or para.ndim != 2 or para.shape[1] == 0 or para.shape[1] % 4:
        raise InputError(f"parameters have shape {para.shape}, expected (N, 4 M)")
    columns = para.T.reshape(2, 2, -1, len(para))  # family, coordinate, fibre, knot
    return assemble_knots(columns.transpose(0, 2, 3, 1).reshape(-1, len(para), 2))


def split_axes(knots: Array, horizontals: int) -> tuple[Array, Array]:
    """Travel and cross coordinates (P, F, n) of knots (P, F, n, 2), of which so many, from the first, run along x."""
    travel, cross = (
        np.concatenate([knots[:, :horizontals, :, axis], knots[:, horizontals:, :, 1 - axis]], axis=1)
        for axis in (0, 1)
    )
    return travel, cross


PITCH_MM = 11.25
"""Pitch of the built pads."""
MAX_SAMPLES = 2**20
"""Most points a fibre is sampled at."""


def read_knots(path: Path) -> Array:
    """Knots (2M, N+2, 2) of a published `.mat`: `para`, or straight fibres where the file's own signals say so.

    The square-grid files carry a `para` that was never used; their samples fit straight fibres and not `para`.

    Raises:
        InputError: the file is missing, torn, of another kind, or its variables are not as published.
    """
    content = load_mat(path, ("para",))
    try:
        knots = knots_from_parameters(content["para"])
    except (InputError, ValueError, TypeError) as error:
        raise InputError(f"{path}: {error}") from error
    straight = assemble_knots(np.empty((len(knots), 0, 2)))
    try:
        return straight if _misfit(straight, content) < 1e-9 < _misfit(knots, content) else knots
    except (InputError, ValueError, TypeError, IndexError, KeyError, AttributeError) as error:
        said = str(error).splitlines()[0]
        raise InputError(f"{path}: K, loc_all and sens_raw_all are not as published ({said})") from error


def _misfit(knots: Array, content: dict[str, Any], presses: int = 32) -> float:
    """Largest difference of the published samples to those of fibres; 0 where the file has no samples."""
    if not {"K", "loc_all", "sens_raw_all"} <= content.keys():
        return 0.0
    settings = content["K"]
    contact = Contact(radius=float(settings["object_size"].item()), sides=int(settings["str_shp"].item()))
    places, expected = (
        check_array("loc_all", content["loc_all"][:presses], MAX_COORDINATE),
        content["sens_raw_all"][:presses],
    )
    if places.ndim != 2 or places.shape[1] != 2:
        raise InputError(f"loc_all has shape {content['loc_all'].shape}, expected (Q, 2)")
    samples = check_int("fineness", int(settings["fineness"].item()), 2, MAX_SAMPLES)
    horizontals = len(knots) // 2
    travel, cross = split_axes(knots[None], horizontals)
    misfits = []
    for weight in (UNIFORM, INVERSE_SQUARE):
        found = np.zeros((1, len(places), len(knots)))
        shape = (*frames(contact.radius, contact.sides), WeightLaw(contact.radius, weight, MANHATTAN))
        quantized_signals(travel, cross, horizontals, places, shape, samples, 0, len(knots), found)
        misfits.append(float(np.abs(found[0] - expected).max()))
    return min(misfits)


SQUARE_FORMAT, FORMAT = "padforge-morphology/1", "padforge-morphology/2"
"""Of a square pad of one pitch, which every version reads, and of any other one."""

MAX_KNOTS = 2**22
"""Most knots of a pad, over all its fibres."""


@dataclass(frozen=True)
class Morphology:
    """The fibres of a pad.

    Attributes:
        knots: (H + V, N+2, 2) x and y in grid units from the pad's corner: horizontals bottom to top, then verticals
            left to right; each fibre's knots ascend along its travel axis (x for horizontals, y for verticals), its
            ends are fixed.
        pitch_mm: distance of neighbouring fibre ends, mm; two, along x and along y, where they differ.
        provenance: where the morphology came from; free JSON.
        fibres: (H, V), as many horizontals as verticals if None.

    Raises:
        InputError: knots of the wrong shape, not finite, outside the pad, not ascending, or with ends moved.
    """

    knots: Array
    pitch_mm: Pitch = 11.25
    provenance: Mapping[str, Any] = field(default_factory=dict, compare=False)
    fibres: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        knots = check_array("knots", self.knots)
        if knots.ndim != 3 or knots.shape[2] != 2 or knots.shape[0] < 1 or knots.shape[1] < 2:
            raise InputError(f"knots have shape {knots.shape}, expected (H + V, N + 2, 2)")
        if self.fibres is None and len(knots) % 2:
            raise InputError(f"knots have shape {knots.shape}, expected (2 M, N + 2, 2), or fibres that are told")
        half = len(knots) // 2
        layout = Layout.create((half, half) if self.fibres is None else self.fibres, self.pitch_mm)
        _validate(knots, layout)
        if not layout.is_square:
            knots = _kept(knots, layout)
        knots.setflags(write=False)
        object.__setattr__(self, "knots", knots)
        object.__setattr__(self, "pitch_mm", layout.pitch_mm)
        object.__setattr__(self, "fibres", layout.counts)
        object.__setattr__(self, "layout", layout)
        try:
            json.dumps(dict(check_mapping("provenance", self.provenance)), allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError(f"provenance is {short_repr(self.provenance)}, expected JSON ({error})") from error

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Morphology):
            return NotImplemented
        return self.layout == other.layout and np.array_equal(self.knots, other.knots)

    __hash__ = None  # type: ignore[assignment]

    layout: Layout = field(init=False, repr=False, compare=False)
    """Where its fibres end."""

    @property
    def grid(self) -> int:
        """M of a pad of M + M fibres.

        Raises:
            InputError: a pad of any other.
        """
        horizontals, verticals = self.layout.counts
        if horizontals != verticals:
            raise InputError(f"the pad has {horizontals} + {verticals} fibres, expected as many of either family")
        return horizontals

    @property
    def unit_mm(self) -> float:
        """A grid unit, mm."""
        return self.layout.unit_mm

    @classmethod
    def straight(cls, fibres: Counts | Layout, pitch_mm: Pitch = 11.25) -> "Morphology":
        """Straight fibres, N = 0: M of either family, or (H, V), or those of a layout, whose pitch counts."""
        layout = Layout.create(fibres, pitch_mm)
        return cls.from_layout(assemble_knots(np.empty((layout.fibres, 0, 2)), layout), layout)

    @classmethod
    def from_layout(cls, knots: Array, layout: Layout, provenance: Mapping[str, Any] | None = None) -> "Morphology":
        """Of knots (H + V, N+2, 2) in grid units, whose ends lie as the layout says."""
        check_type("layout", layout, Layout)
        return cls(knots, layout.pitch_mm, {} if provenance is None else provenance, layout.counts)

    @classmethod
    def random(
        cls, fibres: Counts | Layout, knots: int, seed: int | np.random.Generator = 0, pitch_mm: Pitch = 11.25
    ) -> "Morphology":
        """Knots drawn uniformly over the pad, as the published search starts from; fibres as `straight` takes them."""
        layout = Layout.create(fibres, pitch_mm)
        knots = _knot_count(layout, knots)
        known = seed if isinstance(seed, np.random.Generator) else check_int("seed", seed, 0, 2**64 - 1)
        rng = np.random.default_rng(known)
        inner = rng.uniform(MARGIN, np.array(layout.extent) - MARGIN, (layout.fibres, knots, 2))
        return cls.from_layout(assemble_knots(inner, layout), layout)

    @classmethod
    def from_parameters(cls, parameters: ArrayLike, pitch_mm: Pitch = 11.25) -> "Morphology":
        """From the published parameter matrix `para`, (N, 4M): x of horizontals, their y, x of verticals, their y."""
        return cls(knots_from_parameters(parameters), pitch_mm)

    def tiled(self, times: int) -> "Morphology":
        """A pad of M `times` fibres a family, this one's course repeated over its surface, times x times.

        A tile of M + 1 grid units along a fibre is compressed to M, so that fibre ends stay one unit apart throughout.

        Raises:
            InputError: not a whole number of times, too many fibres, or a pad that is not square or of two pitches.
        """
        if not self.layout.is_square:
            raise InputError(f"a pad of {self.layout} is no tile, expected M + M fibres of one pitch")
        times = check_int("times", times, 1, MAX_FIBRES // self.grid)
        _knot_count(Layout.create(self.grid * times), times * (self.knots.shape[1] - 1) + 1)
        grid, size = self.grid, self.grid * times
        out = np.empty((2 * size, times * (self.knots.shape[1] - 1) + 3, 2))
        for family in (0, 1):
            travel = 0.5 + self.knots[family * grid : (family + 1) * grid, :, family] * grid / (grid + 1)
            cross = self.knots[family * grid : (family + 1) * grid, :, 1 - family]
            # The last knot of a tile is the first of the next one.
            along = [travel[:, :-1] + grid * tile for tile in range(times)]
            inner = np.concatenate([*along, travel[:, -1:] + grid * (times - 1)], axis=1)
            level = np.concatenate([np.tile(cross[:, :-1], times), cross[:, -1:]], axis=1)
            for tile in range(times):
                rows = out[family * size + tile * grid : family * size + (tile + 1) * grid]
                rows[:, 1:-1, family], rows[:, 1:-1, 1 - family] = inner, level + grid * tile
                rows[:, [0, -1], family] = 0, size + 1
                rows[:, [0, -1], 1 - family] = (np.arange(1, grid + 1) + grid * tile)[:, None]
        return type(self)(out, self.pitch_mm)

    @classmethod
    def load(cls, path: str | Path) -> "Morphology":
        """Read a `morphology.json` or a published `.mat`.

        Raises:
            InputError: the file is missing, torn, of another kind, or its knots break the rules of the class.
        """
        path = as_path("path", path)
        if path.suffix.lower() == ".mat":
            try:
                return cls(read_knots(path), PITCH_MM)
            except InputError as error:
                raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
        document = read_json(path, SQUARE_FORMAT, FORMAT)
        try:
            return cls.from_dict(document)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "Morphology":
        """From what `document` gave.

        Raises:
            InputError: something is missing, or breaks the rules of the class.
        """
        check_mapping("document", document)
        try:
            knots = np.array(document["knots"], dtype=np.float64)
            square = document.get("format", SQUARE_FORMAT) == SQUARE_FORMAT
            fibres = _fibres_of(document, len(knots)) if square else document["fibres"]
            layout = Layout.create(fibres, document["pitch_mm"])
            if not square:
                knots = _from_pitches(knots, layout)
            return cls.from_layout(knots, layout, document.get("provenance", {}))
        except InputError:
            raise
        except (KeyError, TypeError, OverflowError) as error:
            raise InputError(f"no valid morphology ({error!r})") from error
        except ValueError as error:
            raise InputError(error) from error

    def to_dict(self) -> dict[str, Any]:
        """All of it as JSON: knots in pitches, those along x for x and those along y for y."""
        if self.layout.is_square:
            kind, knots = {"format": SQUARE_FORMAT, "grid": self.grid, "pitch_mm": self.pitch_mm}, self.knots
        else:
            pitch = [self.layout.pitch_x_mm, self.layout.pitch_y_mm]
            kind = {"format": FORMAT, "fibres": list(self.layout.counts), "pitch_mm": pitch}
            knots = _in_pitches(self.knots, self.layout)
        return {**kind, "knots": knots.tolist(), "provenance": dict(self.provenance)}

    def save(self, path: str | Path) -> None:
        """Write a `morphology.json`, atomically; reading it back gives the same knots to the last bit."""
        write_json(as_path("path", path), self.to_dict())

    def to_mm(self, places: ArrayLike) -> Array:
        """Grid units to mm with the origin at the pad's centre, the frame presses are recorded in."""
        return (_as_places("places", places) - self._middle) * self.unit_mm

    def to_grid(self, places_mm: ArrayLike) -> Array:
        """mm from the pad's centre to grid units."""
        return _as_places("places_mm", places_mm) / self.unit_mm + self._middle

    @property
    def _middle(self) -> Array:
        return np.array(self.layout.extent) / 2


def _as_places(name: str, values: ArrayLike) -> Array:
    """(..., 2) places, none of them too."""
    places = check_array(name, values, MAX_COORDINATE)
    if places.shape == (0,):
        return places.reshape(0, 2)
    if places.shape[-1:] != (2,):
        raise InputError(f"{name} have shape {places.shape}, expected (..., 2)")
    return places


def _knot_count(layout: Layout, knots: int) -> int:
    """Inner knots of a fibre, as far as there may be so many."""
    return check_int("knots", knots, 0, MAX_KNOTS // layout.fibres - 2)


def _fibres_of(document: Mapping[str, Any], count: int) -> tuple[int, int]:
    """(H, V) of a square pad of that many fibres."""
    if count % 2 or document.get("grid", count // 2) != count // 2:
        raise InputError(f"grid is {short_repr(document.get('grid'))}, but there are {count} fibres")
    return count // 2, count // 2


def _kept(knots: Array, layout: Layout) -> Array:
    """Knots as they are once written and read, which is by a rounding error beside those in grid units at most."""
    return _from_pitches(_in_pitches(knots, layout), layout)


def _in_pitches(knots: Array, layout: Layout) -> Array:
    """Knots in pitches of those in grid units; what lies on the pad's edge, and every end, is of whole pitches."""
    pitches = np.where(knots == layout.extent, [layout.verticals + 1, layout.horizontals + 1], knots / layout.spacing)
    for family, rows in enumerate(layout.families):
        pitches[rows][:, [0, -1], 1 - family] = np.arange(1, layout.counts[family] + 1)[:, None]
    return pitches


def _from_pitches(knots: Array, layout: Layout) -> Array:
    """Knots in grid units of those in pitches."""
    if knots.ndim != 3 or knots.shape[2] != 2:
        raise InputError(f"knots have shape {knots.shape}, expected (H + V, N + 2, 2)")
    return knots * layout.spacing


def _validate(knots: Array, layout: Layout) -> None:
    if len(knots) != layout.fibres:
        raise InputError(f"knots have shape {knots.shape}, expected {layout.fibres} fibres: {layout}")
    _knot_count(layout, knots.shape[1] - 2)
    for axis, most in enumerate(layout.extent):
        places = knots[..., axis]
        if places.min() < 0 or places.max() > most:
            worst = places.min() if places.min() < 0 else places.max()
            raise InputError(f"a knot lies at {'xy'[axis]} = {worst:g}, allowed is 0 to {most:g} grid units")
    for family, (rows, name) in enumerate(zip(layout.families, ("horizontal", "vertical"), strict=True)):
        fibres = knots[rows]
        travel, cross = fibres[..., family], fibres[..., 1 - family]
        near = (np.diff(travel, axis=1) < MIN_SPAN).any(axis=1)
        if near.any():
            fibre = int(np.argmax(near)) + 1
            raise InputError(f"{name} fibre {fibre}: knots do not ascend by {MIN_SPAN:g} or more along its travel axis")
        moved = np.stack([travel[:, 0], travel[:, -1] - layout.extent[family]])
        if moved.any() or (cross[:, [0, -1]] != layout.levels[rows, None]).any():
            raise InputError(
                f"{name} fibres must run from (0, i) to ({layout.extent[family]:g}, i) along their travel axis, "
                "i = 1..M, in pitches"
            )
