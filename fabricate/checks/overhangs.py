"""Faces that lean over what is below them: a printer needs support there, and a casting stays in the mould."""

import math
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from padforge.fabricate.settings import PrinterSettings

from .findings import Finding, verdict
from .slices import Slab, enclosed, section
from .surface import Surface

STEEPEST_DEG = 45.0
"""Faces that lean farther from upright than this need support."""
_SPARE_DEG = 1.0
"""By how much a face may lean more and still count as what it was drawn."""
_UPRIGHT_DEG = 0.1
"""Faces that lean by less are upright but for the rounding of their corners."""
_SPECK_MM2 = 0.01
"""Smaller faces hold nothing back and need no support."""
_OFF_FACE_MM = 5e-3
"""How far before a face it is looked whether silicone would lie there."""
_HEIGHTS = 32
"""Heights at which that is looked up, at most."""


def overhang(surface: Surface, printer: PrinterSettings) -> Finding:
    """Whether no face leans so far that it is printed on air; the first layer lies on the bed."""
    high = surface.corners[:, :, 2].max(axis=1) > surface.bottom_top[0, 2] + printer.layer_mm
    leaning = _leaning(surface, STEEPEST_DEG + _SPARE_DEG) & high
    steepest = _lean_deg(surface, high & (surface.rise < 0))
    message = f"faces lean over by up to {steepest:.0f}°, and print without support up to {STEEPEST_DEG:g}°"
    return verdict("overhang", not leaning.any(), steepest, STEEPEST_DEG, message, surface.patch_places(leaning))


def undercut(surface: Surface, slices: Sequence[Slab]) -> Finding:
    """Whether no face leans over the casting, which could not be pulled out upwards then."""
    holding = _before_void(surface, _leaning(surface, _UPRIGHT_DEG), slices[0])
    steepest = _lean_deg(surface, holding)
    message = f"faces lean over the casting by up to {steepest:.1f}°" if holding.any() else "the casting comes out"
    return verdict("undercut", not holding.any(), steepest, 0.0, message, surface.patch_places(holding))


def _leaning(surface: Surface, least_deg: float) -> NDArray[np.bool_]:
    """Which faces (m,) lean over by more than an angle from upright, patches of next to no area left out."""
    leaning = surface.rise < -math.sin(math.radians(least_deg))
    _, patch = surface.patches(leaning)
    large = np.bincount(patch, surface.areas[leaning]) > _SPECK_MM2
    leaning[leaning] = large[patch]
    return leaning


def _lean_deg(surface: Surface, which: NDArray[np.bool_]) -> float:
    """The greatest lean of the faces `which` (m,), degrees from upright; 0 without such faces."""
    return math.degrees(math.asin(np.maximum(-surface.rise[which], 0.0).max(initial=0.0)))


def _before_void(surface: Surface, which: NDArray[np.bool_], lowest: Slab) -> NDArray[np.bool_]:
    """Of the faces `which` (m,), those with silicone before their middles: surrounded by solid, a floor beneath.

    At many heights it is looked up where the faces are largest.
    """
    faces = np.flatnonzero(which & (surface.middles[:, 2] > lowest.middle_mm + _OFF_FACE_MM))
    crosses = np.cross(*np.moveaxis(np.diff(surface.corners[faces], axis=1), 1, 0))
    normals = crosses / np.linalg.norm(crosses, axis=1, keepdims=True)
    x, y, z = (surface.middles[faces] + _OFF_FACE_MM * normals).T
    which_height = np.unique(np.round(z / _OFF_FACE_MM), return_inverse=True)[1]
    largest = np.argsort(-np.bincount(which_height, surface.areas[faces]), kind="stable")[:_HEIGHTS]
    found = np.zeros(len(surface.triangles), dtype=bool)
    floor = shapely.contains_xy(lowest.base, x, y)
    for height in largest:
        here = which_height == height
        area = section(surface.solid, float(z[here].min()))
        surrounded = shapely.contains_xy(enclosed(area), x[here], y[here])
        found[faces[here]] = surrounded & ~shapely.contains_xy(area, x[here], y[here]) & floor[here]
    return found
