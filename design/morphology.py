"""The morphology of a pad: the knots that its fibres run through.

A pad of V + 1 by H + 1 pitches carries fibres in two families. Horizontal fibre i is a curve y(x) from (0, i) to
(V + 1, i), i = 1..H; vertical fibre i is a curve x(y) from (i, 0) to (i, H + 1), i = 1..V, in pitches. Between knots
both are PCHIP curves. Positions are in grid units, equally long in both directions: the pitch, or the geometric mean
of two. A fibre runs along one axis (x for horizontals) and deviates across it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from padforge.common.files import read_json, write_json
from padforge.common.mat_files import load_mat
from padforge.common.validation import InputError, check_array, check_int, check_mapping, check_path, naming_file
from padforge.design.kernels.geometry import INVERSE_SQUARE, MANHATTAN, UNIFORM, Ends, WeightLaw, frame_shape
from padforge.design.published.kernels import quantized_signals
from padforge.design.settings import DEFAULT_PITCH_MM, FAMILIES, MAX_FIBRES, Contact, Counts, Layout, Pitch

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

FORMAT = "padforge-morphology/1"
MIN_SPAN = 1e-12  # smallest distance of knots along an axis, grid units: slopes remain numbers that can be squared
MAX_COORDINATE = 1e6  # largest absolute coordinate of a position, grid units or mm
MAX_KNOTS = 2**22  # knots of a pad, over all its fibres
MAX_SAMPLES = 2**20  # points that a fibre is sampled at
MARGIN = 1e-3  # smallest distance of an inner knot to the pad's edge, grid units, as in the published optimiser


def check_layout(n_fibres: int, layout: Layout | None = None) -> Layout:
    """Return the layout if it is one of `n_fibres`; for None that of a square pad of the default pitch."""
    if layout is None:
        if n_fibres % 2 or not n_fibres:
            raise InputError(f"these are {n_fibres} fibres, expected 2 M: as many horizontals as verticals")
        return Layout.create(n_fibres // 2)
    if n_fibres != layout.fibres:
        raise InputError(f"these are {n_fibres} fibres, expected {layout}")
    return layout


def fibre_ends(layout: Layout) -> Ends:
    """Return the positions of the fibre ends as kernels take them."""
    return Ends(*layout.counts, *layout.spacing[::-1])


def split_axes(knots: Array, horizontals: int) -> tuple[Array, Array]:
    """Return the coordinates along and across each fibre's axis, both (P, F, n), of knots (P, F, n, 2)."""
    along, across = (
        np.concatenate([knots[:, :horizontals, :, axis], knots[:, horizontals:, :, 1 - axis]], axis=1)
        for axis in (0, 1)
    )
    return along, across


def assemble_knots(inner: Array, layout: Layout | None = None) -> Array:
    """Complete fibres from inner knots: sort them along the axis, separate coincident ones, add the fixed ends.

    Knots (..., F, N, 2) in any order become (..., F, N + 2, 2) that satisfy `Morphology`; the layout is square if None.
    Those at one coordinate are moved by the least step that keeps the curve a graph, far below a printer's resolution.
    """
    layout = check_layout(inner.shape[-3], layout)
    knots = np.empty((*inner.shape[:-2], inner.shape[-2] + 2, 2))
    for axis, rows in enumerate(layout.families):
        fibres = inner[..., rows, :, :]
        rank = np.argsort(fibres[..., axis], axis=-1, kind="stable")[..., None]
        knots[..., rows, 1:-1, :] = np.take_along_axis(fibres, rank, axis=-2)
        knots[..., rows, 0, axis], knots[..., rows, -1, axis] = 0, layout.extent[axis]
        knots[..., rows, 0, 1 - axis] = knots[..., rows, -1, 1 - axis] = layout.levels[rows]
        _separate(knots[..., rows, :, axis])
    return knots


def _separate(along: Array, step: float = 1e-9) -> None:
    """Separate ascending coordinates (..., N + 2) in place; the first and the last are fixed."""
    if (np.diff(along, axis=-1) >= step).all():
        return
    for k in range(1, along.shape[-1] - 1):
        along[..., k] = np.maximum(along[..., k], along[..., k - 1] + step)
    for k in range(along.shape[-1] - 2, 0, -1):
        along[..., k] = np.minimum(along[..., k], along[..., k + 1] - step)


@dataclass(frozen=True)
class Morphology:
    """The fibres of a pad.

    Attributes:
        knots: x and y from the pad's lower left corner; shape (H + V, N + 2, 2), grid units. Horizontals from the
            bottom, then verticals from the left. The knots of a fibre ascend along its axis; its ends are fixed.
        pitch_mm: distance of neighbouring fibre ends, mm; (along x, along y) where they differ.
        provenance: origin of the morphology; free JSON.
        fibres: (H, V); as many horizontals as verticals if None.
        layout: positions of the fibre ends.

    Raises:
        InputError: knots of the wrong shape, not finite, outside the pad, not ascending, or with moved ends.
    """

    knots: Array
    pitch_mm: Pitch = DEFAULT_PITCH_MM
    provenance: Mapping[str, Any] = field(default_factory=dict, compare=False)
    fibres: tuple[int, int] | None = None
    layout: Layout = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        knots = check_array("knots", self.knots)
        if knots.ndim != 3 or knots.shape[2] != 2 or knots.shape[0] < 1 or knots.shape[1] < 2:
            raise InputError(f"knots have shape {knots.shape}, expected (H + V, N + 2, 2)")
        half, odd = divmod(len(knots), 2)
        if self.fibres is None and odd:
            raise InputError(f"knots have shape {knots.shape}, expected (2 M, N + 2, 2), or stated fibres")
        layout = Layout.create((half, half) if self.fibres is None else self.fibres, self.pitch_mm)
        _validate(knots, layout)
        if not layout.is_square:
            # rounded as in a file, whose unit is the pitch, so that reading it gives the same knots
            knots = _to_pitches(knots, layout) * layout.spacing
        knots.setflags(write=False)
        self.__dict__.update(knots=knots, pitch_mm=layout.pitch_mm, fibres=layout.counts, layout=layout)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Morphology):
            return NotImplemented
        return self.layout == other.layout and np.array_equal(self.knots, other.knots)

    __hash__ = None  # type: ignore[assignment]

    @property
    def grid(self) -> int:
        """M of a pad of M + M fibres.

        Raises:
            InputError: the families have different numbers of fibres.
        """
        horizontals, verticals = self.layout.counts
        if horizontals != verticals:
            raise InputError(f"the pad has {horizontals} + {verticals} fibres, expected as many of either family")
        return horizontals

    @property
    def unit_mm(self) -> float:
        """Grid unit, mm."""
        return self.layout.unit_mm

    @classmethod
    def from_layout(cls, knots: Array, layout: Layout, provenance: Mapping[str, Any] | None = None) -> "Morphology":
        """Create a morphology of a layout.

        Args:
            knots: shape (H + V, N + 2, 2), grid units; its ends are the layout's.
            layout: positions of the fibre ends.
            provenance: origin of the morphology; free JSON.
        """
        return cls(knots, layout.pitch_mm, {} if provenance is None else provenance, layout.counts)

    @classmethod
    def straight(cls, fibres: Counts | Layout, pitch_mm: Pitch = DEFAULT_PITCH_MM) -> "Morphology":
        """Create straight fibres, N = 0.

        Args:
            fibres: M of either family, (H, V), or a layout, which has its own pitch.
            pitch_mm: one pitch, or (along x, along y), mm.
        """
        layout = Layout.create(fibres, pitch_mm)
        return cls.from_layout(assemble_knots(np.empty((layout.fibres, 0, 2)), layout), layout)

    @classmethod
    def random(
        cls,
        fibres: Counts | Layout,
        knots: int,
        seed: int | np.random.Generator = 0,
        pitch_mm: Pitch = DEFAULT_PITCH_MM,
    ) -> "Morphology":
        """Create fibres with knots drawn uniformly over the pad, from which the published search starts.

        Args:
            fibres: as in `straight`.
            knots: inner knots per fibre.
            seed: seed, or generator, of random numbers.
            pitch_mm: as in `straight`.
        """
        layout = Layout.create(fibres, pitch_mm)
        _check_knot_count(layout, knots)
        inner = np.random.default_rng(seed).uniform(MARGIN, np.array(layout.extent) - MARGIN, (layout.fibres, knots, 2))
        return cls.from_layout(assemble_knots(inner, layout), layout)

    def tiled(self, times: int) -> "Morphology":
        """Repeat this square pad over the surface of a pad of `times` as many fibres in both families.

        A tile of M + 1 grid units along a fibre is compressed to M, so that fibre ends stay one unit apart.

        Args:
            times: tiles in either direction.

        Raises:
            InputError: too many fibres, or a pad that is not square or has two pitches.
        """
        if not self.layout.is_square:
            raise InputError(f"a pad of {self.layout} is no tile, expected M + M fibres of one pitch")
        grid, n_knots = self.grid, self.knots.shape[1]
        times = check_int("times", times, 1, MAX_FIBRES // grid)
        size = grid * times
        _check_knot_count(Layout.create(size), times * (n_knots - 1) + 1)
        out = np.empty((2 * size, times * (n_knots - 1) + 3, 2))
        for axis in (0, 1):
            fibres = self.knots[axis * grid : (axis + 1) * grid]
            along, across = 0.5 + fibres[..., axis] * grid / (grid + 1), fibres[..., 1 - axis]
            # the last knot of a tile is the first of the next one
            repeated = [along[:, :-1] + grid * tile for tile in range(times)]
            inner = np.concatenate([*repeated, along[:, -1:] + grid * (times - 1)], axis=1)
            level = np.concatenate([np.tile(across[:, :-1], times), across[:, -1:]], axis=1)
            for tile in range(times):
                rows = out[axis * size + tile * grid : axis * size + (tile + 1) * grid]
                rows[:, 1:-1, axis], rows[:, 1:-1, 1 - axis] = inner, level + grid * tile
                rows[:, [0, -1], axis] = 0, size + 1
                rows[:, [0, -1], 1 - axis] = (np.arange(1, grid + 1) + grid * tile)[:, None]
        return type(self)(out, self.pitch_mm)

    @classmethod
    def load(cls, path: str | Path) -> "Morphology":
        """Read a morphology.

        Args:
            path: a `morphology.json` or a published `.mat`.

        Raises:
            InputError: the file is missing, torn, of another kind, or its knots break the rules of the class.
        """
        path = check_path("path", path)
        kind = path.suffix.lower()
        if kind not in (".json", ".mat"):
            raise InputError(f"{path}: no morphology, allowed are a .json and a published .mat")
        content = read_json(path, FORMAT) if kind == ".json" else load_mat(path, ("para",))
        with naming_file(path):
            return cls.from_dict(content) if kind == ".json" else cls(_published_knots(content))

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "Morphology":
        """Create a morphology from a document.

        Args:
            document: what `to_dict` returned.

        Raises:
            InputError: a key is missing, or a value breaks the rules of the class.
        """
        check_mapping("document", document)
        try:
            layout = Layout.create(document["fibres"], document["pitch_mm"])
            knots = np.array(document["knots"], dtype=np.float64) * layout.spacing  # pitches to grid units
            return cls.from_layout(knots, layout, document.get("provenance", {}))
        except (KeyError, TypeError, OverflowError) as error:
            raise InputError(f"no valid morphology ({error!r})") from error
        except ValueError as error:
            raise InputError(error) from error

    def to_dict(self) -> dict[str, Any]:
        """Return the morphology as JSON; knots are in pitches, those along x for x and those along y for y."""
        return {
            "format": FORMAT,
            "fibres": list(self.layout.counts),
            "pitch_mm": [self.layout.pitch_x_mm, self.layout.pitch_y_mm],
            "knots": _to_pitches(self.knots, self.layout).tolist(),
            "provenance": dict(self.provenance),
        }

    def save(self, path: str | Path) -> None:
        """Write the morphology atomically; reading it gives the same knots to the last bit.

        Args:
            path: a `morphology.json`.
        """
        write_json(check_path("path", path), self.to_dict())

    def to_mm(self, positions: ArrayLike) -> Array:
        """Convert grid units to mm from the pad's centre, the frame that presses are recorded in.

        Args:
            positions: shape (..., 2), grid units.
        """
        return (_check_positions("positions", positions) - np.array(self.layout.extent) / 2) * self.unit_mm

    def to_grid(self, positions_mm: ArrayLike) -> Array:
        """Convert mm from the pad's centre to grid units.

        Args:
            positions_mm: shape (..., 2), mm.
        """
        return _check_positions("positions_mm", positions_mm) / self.unit_mm + np.array(self.layout.extent) / 2


def _check_positions(name: str, values: ArrayLike) -> Array:
    positions = check_array(name, values, MAX_COORDINATE)
    if positions.shape == (0,):
        return positions.reshape(0, 2)
    if positions.shape[-1:] != (2,):
        raise InputError(f"{name} have shape {positions.shape}, expected (..., 2)")
    return positions


def _check_knot_count(layout: Layout, knots: int) -> int:
    return check_int("knots", knots, 0, MAX_KNOTS // layout.fibres - 2)


def _to_pitches(knots: Array, layout: Layout) -> Array:
    """Convert knots from grid units to pitches; the pad's edges and fibre ends are at whole pitches exactly."""
    pitches = np.where(knots == layout.extent, [layout.verticals + 1, layout.horizontals + 1], knots / layout.spacing)
    for axis, rows in enumerate(layout.families):
        pitches[rows][:, [0, -1], 1 - axis] = np.arange(1, layout.counts[axis] + 1)[:, None]
    return pitches


def _validate(knots: Array, layout: Layout) -> None:
    if len(knots) != layout.fibres:
        raise InputError(f"knots have shape {knots.shape}, expected {layout.fibres} fibres: {layout}")
    _check_knot_count(layout, knots.shape[1] - 2)
    for axis, limit in enumerate(layout.extent):
        low, high = knots[..., axis].min(), knots[..., axis].max()
        if low < 0 or high > limit:
            worst = low if low < 0 else high
            raise InputError(f"a knot lies at {'xy'[axis]} = {worst:g}, allowed is 0 to {limit:g} grid units")
    for axis, (rows, name) in enumerate(zip(layout.families, FAMILIES, strict=True)):
        along, across = knots[rows, :, axis], knots[rows, :, 1 - axis]
        coincident = (np.diff(along, axis=1) < MIN_SPAN).any(axis=1)
        if coincident.any():
            fibre = int(np.argmax(coincident)) + 1
            raise InputError(f"{name} fibre {fibre}: knots do not ascend by {MIN_SPAN:g} or more along its axis")
        has_moved = along[:, 0].any() or (along[:, -1] != layout.extent[axis]).any()
        if has_moved or (across[:, [0, -1]] != layout.levels[rows, None]).any():
            end = f"({layout.extent[axis]:g}, i)"
            raise InputError(f"{name} fibres must run from (0, i) to {end} along their axis, i = 1..M, in pitches")


def _published_knots(content: dict[str, Any]) -> Array:
    """Return the knots (2 M, N + 2, 2) of a published `.mat`.

    Files of the square grid carry a `para` that was never used: their samples fit straight fibres and not `para`.
    """
    para = check_array("parameters", content["para"])
    if para.size == 0 or para.ndim != 2 or para.shape[1] % 4:
        raise InputError(f"parameters have shape {para.shape}, expected (N, 4 M)")
    columns = para.T.reshape(2, 2, -1, len(para))  # family, coordinate, fibre, knot
    knots = assemble_knots(columns.transpose(0, 2, 3, 1).reshape(-1, len(para), 2))
    straight = assemble_knots(np.empty((len(knots), 0, 2)))
    try:
        return straight if _max_misfit(straight, content) < 1e-9 < _max_misfit(knots, content) else knots
    except (ValueError, TypeError, IndexError, KeyError, AttributeError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"K, loc_all and sens_raw_all are not as published ({reason})") from error


def _max_misfit(knots: Array, content: dict[str, Any], n_presses: int = 32) -> float:
    """Return the largest error of fibres' signals to those in a published file, by the better weight; 0 if none are."""
    if not {"K", "loc_all", "sens_raw_all"} <= content.keys():
        return 0.0
    settings, expected = content["K"], content["sens_raw_all"][:n_presses]
    contact = Contact(radius=float(settings["object_size"].item()), sides=int(settings["str_shp"].item()))
    presses = check_array("loc_all", content["loc_all"][:n_presses], MAX_COORDINATE)
    if presses.ndim != 2 or presses.shape[1] != 2:
        raise InputError(f"loc_all has shape {content['loc_all'].shape}, expected (Q, 2)")
    samples = check_int("fineness", int(settings["fineness"].item()), 2, MAX_SAMPLES)
    horizontals = len(knots) // 2
    along, across = split_axes(knots[None], horizontals)
    misfits = []
    for weight in (UNIFORM, INVERSE_SQUARE):  # files do not say which of the two they used
        signals = np.zeros((1, len(presses), len(knots)))
        shape = (*frame_shape(contact.radius, contact.sides), WeightLaw(contact.radius, weight, MANHATTAN))
        quantized_signals(along, across, horizontals, presses, shape, samples, 0, len(knots), signals)
        misfits.append(float(np.abs(signals[0] - expected).max()))
    return min(misfits)
