"""Keep-outs: polygons of the pad that no fibre enters and that are not pressed, such as holes and a connector."""

import numpy as np
import shapely
from numpy.typing import NDArray
from padforge.design.common.errors import InputError
from padforge.design.settings import PadSettings, RulesSettings
from shapely import Polygon


def keep_outs(pad: PadSettings) -> list[Polygon]:
    """The polygons of `[pad] keep_out_mm`, in grid units from the pad's corner."""
    scale, middle = pad.layout.unit_mm, np.array(pad.layout.extent) / 2
    return [Polygon(np.array(corners) / scale + middle) for corners in pad.keep_out_mm]


def require_free_ends(pad: PadSettings, rules: RulesSettings) -> None:
    """Refuse keep-outs that come too near to the ends of fibres, which cannot move.

    Raises:
        InputError: naming the polygon, the fibre and the place of its end.
    """
    layout = pad.layout
    for number, polygon in enumerate(keep_outs(pad), 1):
        for fibre in range(layout.fibres):
            family, level = layout.family(fibre), layout.levels[fibre]
            for travel in (0.0, layout.extent[family]):
                end = (travel, level) if family == 0 else (level, travel)
                apart = polygon.distance(shapely.Point(end)) * layout.unit_mm
                if apart < rules.keep_out_mm or apart == 0:
                    x, y = ((a - size / 2) * layout.unit_mm for a, size in zip(end, layout.extent, strict=True))
                    raise InputError(
                        f"[pad] keep_out_mm: polygon {number} is {apart:.3g} mm from an end of fibre {fibre + 1}, at "
                        f"({x:.4g}, {y:.4g}) mm, allowed is {rules.keep_out_mm:g} or more ([rules] keep_out_mm)"
                    )


def outside(places: NDArray[np.float64], pad: PadSettings) -> NDArray[np.bool_]:
    """(Q,) which of the places (Q, 2), in grid units, lie in no keep-out."""
    free = np.ones(len(places), bool)
    for polygon in keep_outs(pad):
        free &= ~shapely.intersects_xy(polygon, places)
    return free
