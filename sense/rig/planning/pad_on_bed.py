"""Where the pad lies on a printer's bed: in the holder, which was printed there and left, so that nobody teaches it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from padforge.design.common.files import read_json
from padforge.design.common.validation import InputError, short_repr
from padforge.sense.rig.devices.protocols import RigFault
from padforge.sense.settings import RigSettings

FILE, FORMAT = "fabrication.json", "padforge-fabrication/2"
_LENGTHS = {"bed_mm": 3, "centre_mm": 2, "angle_deg": 1, "surface_mm": 1, "walls_mm": 1}
_SLACK_MM = 1e-6


def on_bed(rig: RigSettings, folder: Path) -> RigSettings:
    """`rig` with the pad's place, side and height, and the workspace above it, where it leaves them open.

    The workspace is the pad seen from above, as far as the nozzle gets; down to `max_depth_mm`, but never below the top
    of the holder's walls.

    Args:
        folder: with the `fabrication.json` of a pad with a holder, see "frame" in it.

    Raises:
        RigFault: "refused" where something is open, and the folder or the tip's place does not tell it.
        InputError: the file is damaged.
    """
    if None not in (rig.pad_mm, rig.contact_mm, rig.box_mm):
        return rig
    if rig.tcp_mm is None:
        message = "[rig] tcp_mm is unknown, allowed are x, y and z of the probe's tip from the nozzle"
        raise RigFault("refused", message, "measure them with the probe in place")
    frame = _frame(folder)
    (x, y), surface = rig.pad_mm or frame["centre_mm"], frame["surface_mm"]
    contact = surface if rig.contact_mm is None else rig.contact_mm
    (right, top), (width, depth, height) = _halves(frame), frame["bed_mm"]
    dx, dy, dz = rig.tcp_mm
    box = (
        *(max(x - right, dx), min(x + right, width + dx)),
        *(max(y - top, dy), min(y + top, depth + dy)),
        *(max(contact - rig.max_depth_mm, frame["walls_mm"]) - _SLACK_MM, height + dz),
    )
    mirrored = frame["mirrored"] if rig.mirrored is None else rig.mirrored
    place = {"pad_mm": (x, y), "mirrored": mirrored, "contact_mm": contact, "box_mm": rig.box_mm or box}
    return rig.model_copy(update=place | {"pad_angle_deg": rig.pad_angle_deg + frame["angle_deg"]})


def _frame(folder: Path) -> Mapping[str, Any]:
    """The frame in the folder's fabrication.json, checked: numbers, rows of them as tuples, and whether it is mirrored.

    Holders of before that was said took the pad with its tracks down.
    """
    path = folder / FILE
    if not path.is_file():
        message = f"[rig] pad_mm, contact_mm or box_mm is unknown, and there is no {path}"
        raise RigFault("refused", message, "measure them, or make the pad's holder: [mould] holder = true")
    frame = read_json(path, FORMAT).get("frame")
    if not isinstance(frame, Mapping):
        message = f"[rig] pad_mm, contact_mm or box_mm is unknown, and {path} is of a pad without a holder"
        raise RigFault("refused", message, "measure them, or make the pad's holder: [mould] holder = true")
    counts = _LENGTHS | {"pad_mm": 2 if isinstance(frame.get("pad_mm"), list) else 1}
    read = {name: _numbers(frame.get(name), count) for name, count in counts.items()}
    if wrong := [name for name, value in read.items() if value is None]:
        raise InputError(f"{path}: frame has no {wrong[0]}, expected {counts[wrong[0]]} finite numbers")
    if type(mirrored := frame.get("mirrored", False)) is not bool:
        raise InputError(f"{path}: mirrored of frame is {short_repr(mirrored)}, expected true or false")
    return read | {"mirrored": mirrored}


def _halves(frame: Mapping[str, Any]) -> tuple[float, float]:
    """Half of what the pad spans along the axes of the bed, on which it lies turned by quarters."""
    side = frame["pad_mm"]
    width, height = side if isinstance(side, tuple) else (side, side)
    return (height / 2, width / 2) if round(frame["angle_deg"] / 90) % 2 else (width / 2, height / 2)


def _numbers(value: object, count: int) -> Any:
    """The value as a number or as a tuple of so many; None where it is something else."""
    values: list[Any] = value if isinstance(value, list) else [value]
    if len(values) != count or not all(type(one) in (int, float) and abs(one) <= 1e4 for one in values):
        return None
    return tuple(map(float, values)) if count > 1 else float(values[0])
