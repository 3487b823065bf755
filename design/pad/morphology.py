"""The morphology of a pad: the knots its fibres run through.

A pad of M x M grid units carries 2M fibres in two families. Horizontal fibre i is a curve y(x) from (0, i) to
(M+1, i), vertical fibre i a curve x(y) from (i, 0) to (i, M+1), i = 1..M; between knots both are PCHIP curves.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from design.common.errors import InputError, mapping, real, reals, shown, whole
from design.common.errors import path as as_path
from design.common.files import read_json, write_json

from .knots import FARTHEST, LEAST_SPAN, MARGIN, Array, assemble, of_parameters

FORMAT = "padforge-morphology/1"

MOST_GRID = 1024
"""Most fibres of a family of a pad that is made of tiles."""
MOST_KNOTS = 2**22
"""Most knots of a pad, over all its fibres."""


@dataclass(frozen=True)
class Morphology:
    """The fibres of a pad.

    Attributes:
        knots: (2M, N+2, 2) x and y in grid units, 0..M+1: horizontals bottom to top, then verticals left to right;
            each fibre's knots ascend along its travel axis (x for horizontals, y for verticals), its ends are fixed.
        pitch_mm: distance of neighbouring fibre ends, mm.
        provenance: where the morphology came from; free JSON.

    Raises:
        InputError: knots of the wrong shape, not finite, outside the pad, not ascending, or with ends moved.
    """

    knots: Array
    pitch_mm: float = 11.25
    provenance: Mapping[str, Any] = field(default_factory=dict, compare=False)

    def __post_init__(self) -> None:
        knots = reals("knots", self.knots)
        _validate(knots)
        knots.setflags(write=False)
        object.__setattr__(self, "knots", knots)
        object.__setattr__(self, "pitch_mm", real("pitch_mm", self.pitch_mm, 0.1, 1000))
        try:
            json.dumps(dict(mapping("provenance", self.provenance)), allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError(f"provenance is {shown(self.provenance)}, expected JSON ({error})") from error

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Morphology):
            return NotImplemented
        return self.pitch_mm == other.pitch_mm and np.array_equal(self.knots, other.knots)

    __hash__ = None  # type: ignore[assignment]

    @property
    def grid(self) -> int:
        """M, the number of fibres per family."""
        return len(self.knots) // 2

    @property
    def size_mm(self) -> float:
        """Side of the square pad from fibre end to fibre end, mm."""
        return (self.grid + 1) * self.pitch_mm

    @classmethod
    def straight(cls, grid: int, pitch_mm: float = 11.25) -> "Morphology":
        """The square grid: M straight fibres per family, N = 0."""
        grid, _ = _counts(grid, 0)
        return cls(assemble(np.empty((2 * grid, 0, 2))), pitch_mm)

    @classmethod
    def random(
        cls, grid: int, knots: int, seed: int | np.random.Generator = 0, pitch_mm: float = 11.25
    ) -> "Morphology":
        """Knots drawn uniformly over the pad, as the published search starts from."""
        grid, knots = _counts(grid, knots)
        known = seed if isinstance(seed, np.random.Generator) else whole("seed", seed, 0, 2**64 - 1)
        rng = np.random.default_rng(known)
        inner = rng.uniform(MARGIN, grid + 1 - MARGIN, (2 * grid, knots, 2))
        return cls(assemble(inner), pitch_mm)

    @classmethod
    def from_parameters(cls, parameters: ArrayLike, pitch_mm: float = 11.25) -> "Morphology":
        """From the published parameter matrix `para`, (N, 4M): x of horizontals, their y, x of verticals, their y."""
        return cls(of_parameters(parameters), pitch_mm)

    def tiled(self, times: int) -> "Morphology":
        """A pad of M `times` fibres a family, this one's course repeated over its surface, times x times.

        A tile of M + 1 grid units along a fibre is compressed to M, so that fibre ends stay one unit apart throughout.

        Raises:
            InputError: not a whole number of times, or more fibres than MOST_GRID.
        """
        times = whole("times", times, 1, MOST_GRID // self.grid)
        _counts(self.grid * times, times * (self.knots.shape[1] - 1) + 1)
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
            from .published_files.published_pads import PITCH_MM, read_knots

            try:
                return cls(read_knots(path), PITCH_MM)
            except InputError as error:
                raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
        document = read_json(path, FORMAT)
        try:
            return cls.of_document(document)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "Morphology":
        """From what `document` gave.

        Raises:
            InputError: something is missing, or breaks the rules of the class.
        """
        try:
            knots = np.array(document["knots"], dtype=np.float64)
            pad = cls(knots, float(document["pitch_mm"]), document.get("provenance", {}))
        except InputError:
            raise
        except (KeyError, TypeError, OverflowError) as error:
            raise InputError(f"no valid morphology ({error!r})") from error
        except ValueError as error:
            raise InputError(error) from error
        if document.get("grid", pad.grid) != pad.grid:
            raise InputError(f"grid is {document['grid']}, but there are {len(knots)} fibres")
        return pad

    def document(self) -> dict[str, Any]:
        """All of it as JSON."""
        return {
            "format": FORMAT,
            "grid": self.grid,
            "pitch_mm": self.pitch_mm,
            "knots": self.knots.tolist(),
            "provenance": dict(self.provenance),
        }

    def save(self, path: str | Path) -> None:
        """Write a `morphology.json`, atomically; reading it back gives the same knots to the last bit."""
        write_json(as_path("path", path), self.document())

    def to_mm(self, places: ArrayLike) -> Array:
        """Grid units to mm with the origin at the pad's centre, the frame presses are recorded in."""
        return (reals("places", places, FARTHEST) - (self.grid + 1) / 2) * self.pitch_mm

    def to_grid(self, places_mm: ArrayLike) -> Array:
        """mm from the pad's centre to grid units."""
        return reals("places_mm", places_mm, FARTHEST) / self.pitch_mm + (self.grid + 1) / 2


def _counts(grid: int, knots: int) -> tuple[int, int]:
    """Fibres of a family and inner knots of a fibre, as far as there may be so many."""
    grid = whole("grid", grid, 1, MOST_GRID)
    return grid, whole("knots", knots, 0, MOST_KNOTS // (2 * grid) - 2)


def _validate(knots: Array) -> None:
    if knots.ndim != 3 or knots.shape[2] != 2 or knots.shape[0] < 2 or knots.shape[0] % 2 or knots.shape[1] < 2:
        raise InputError(f"knots have shape {knots.shape}, expected (2 M, N + 2, 2)")
    grid = len(knots) // 2
    _counts(grid, knots.shape[1] - 2)
    if knots.min() < 0 or knots.max() > grid + 1:
        worst = knots.min() if knots.min() < 0 else knots.max()
        raise InputError(f"a knot lies at {worst:g}, allowed is 0 to {grid + 1} grid units")
    for family, name in enumerate(("horizontal", "vertical")):
        fibres = knots[family * grid : (family + 1) * grid]
        travel, cross = fibres[..., family], fibres[..., 1 - family]
        near = (np.diff(travel, axis=1) < LEAST_SPAN).any(axis=1)
        if near.any():
            fibre = int(np.argmax(near)) + 1
            raise InputError(
                f"{name} fibre {fibre}: knots do not ascend by {LEAST_SPAN:g} or more along its travel axis"
            )
        ends = np.stack([travel[:, 0], travel[:, -1] - grid - 1])
        if ends.any() or (cross[:, [0, -1]] != np.arange(1, grid + 1)[:, None]).any():
            raise InputError(f"{name} fibres must run from (0, i) to ({grid + 1}, i) along their travel axis, i = 1..M")
