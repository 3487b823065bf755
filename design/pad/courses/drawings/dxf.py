"""Curves of DXF files: lines, arcs, polylines, splines and ellipses of the modelspace, by layer."""

# pyright: reportPrivateImportUsage=false
# ezdxf does not mark what its own manual imports as exported.

from pathlib import Path
from typing import Any

import numpy as np
from padforge.design.common.errors import InputError, shown
from padforge.design.common.files import require_file

from .strokes import FARTHEST, MOST_BYTES, MOST_POINTS, Drawing, Pen, reason

_KINDS = ("LINE", "ARC", "LWPOLYLINE", "POLYLINE", "SPLINE", "ELLIPSE")
_MOST_DEGREE = 9


def read_dxf(path: Path) -> Drawing:
    """The curves of a DXF; blocks, hatches and writing are left out. Its unit is that of $INSUNITS, mm without.

    Raises:
        InputError: it cannot be read, or is of a kind that no drawing of fibres is.
    """
    import ezdxf
    from ezdxf import path as paths
    from ezdxf import units

    path = require_file(path, MOST_BYTES)
    try:
        document = ezdxf.readfile(path)
        unit, millimetre = document.units, units.InsertUnits.Millimeters
        unit_mm = float(units.conversion_factor(units.InsertUnits(unit), millimetre)) if unit else 1.0
    except MemoryError:
        raise
    except Exception as error:  # ezdxf raises whatever a torn file leads it to
        raise InputError(f"{path}: not a DXF file that can be read ({reason(error)})") from error
    drawing = Drawing(note="" if unit else "the file says no unit: mm")
    drawing.unit_mm = unit_mm
    for number, entity in enumerate(document.modelspace(), 1):
        drawing.looked_at()
        if entity.dxftype() not in _KINDS:
            continue
        name = f"{entity.dxftype()} {number} of layer {shown(entity.dxf.layer)}"
        try:
            _require_bounded(entity)
            pen = Pen()
            for part in paths.make_path(entity).sub_paths():
                _draw(part, pen)
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
        except (ValueError, TypeError, ArithmeticError, LookupError, AttributeError, ezdxf.DXFError) as error:
            raise InputError(f"{name}: no curve ({reason(error)})") from error
        for points, closed in pen.lines:
            drawing.add(name, points, (str(entity.dxf.layer),), closed)
    return drawing


def _require_bounded(entity: Any) -> None:
    """Refuse what would take long to draw before it is tried."""
    kind = entity.dxftype()
    places: Any = []
    if kind == "LINE":
        places = [entity.dxf.start, entity.dxf.end]
    elif kind in ("ARC", "ELLIPSE"):
        places = [entity.dxf.center, [entity.dxf.radius] if kind == "ARC" else entity.dxf.major_axis]
    elif kind == "LWPOLYLINE":
        places = list(entity.get_points("xyb"))
    elif kind == "POLYLINE":
        places = [vertex.dxf.location for vertex in entity.vertices]
    else:
        if entity.dxf.degree > _MOST_DEGREE:
            raise InputError(f"of degree {entity.dxf.degree}, allowed are up to {_MOST_DEGREE}")
        places = [*entity.control_points, *entity.fit_points]
    if len(places) > MOST_POINTS // 10:
        raise InputError(f"it has {len(places)} points, allowed are {MOST_POINTS // 10}")
    for place in places:
        if not (np.abs(np.array(list(place), dtype=float)) <= FARTHEST).all():
            raise InputError(f"coordinates that are no numbers or beyond {FARTHEST:g}")


def _draw(part: Any, pen: Pen) -> None:
    pen.begin(part.start[:2] if isinstance(part.start, tuple) else (part.start.x, part.start.y))
    for command in part.commands():
        controls = [getattr(command, name) for name in ("ctrl", "ctrl1", "ctrl2") if hasattr(command, name)]
        pen.curve(*((place.x, place.y) for place in (*controls, command.end)))
    pen.end(False)
