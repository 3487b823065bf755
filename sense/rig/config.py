"""Where the pad lies before the arm: from places on the pad to poses of the tool and back.

Where the pad lies on a printer's bed: in the holder, which was printed there and left, so that nobody teaches it.

What is to be recorded, and the run directory it goes to: a new one, or one to go on with.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.design.common.files import provenance, read_json
from padforge.design.common.validation import InputError, short_repr
from padforge.sense.arrays import Array
from padforge.sense.rig.devices import Pose, RigFault
from padforge.sense.settings import RigSettings

if TYPE_CHECKING:
    from padforge.design.morphology import Morphology
    from padforge.design.settings import Contact, PadSettings
    from padforge.sense.recording.press_plan import PressPlan
    from padforge.sense.recording.run_directory import Recorder


@dataclass(frozen=True)
class RobotFrame:
    """The pad's frame in the arm's base frame.

    Attributes:
        centre_mm: of the pad, x and y. turn_rad: from the base's y axis to the pad's.
        contact_mm: height of the pad's surface. tool_rad: rotation vector of the tool.
        mirrored: whether the pad lies with its tracks up: its y axis as on the plan, its x axis the other way.
    """

    centre_mm: tuple[float, float]
    turn_rad: float
    contact_mm: float
    tool_rad: tuple[float, float, float]
    mirrored: bool = False

    @classmethod
    def of(cls, rig: RigSettings) -> "RobotFrame":
        """The frame that `[rig]` says; raises RigFault where the contact height or the pad's place is unknown."""
        if rig.contact_mm is None:
            raise RigFault(
                "refused",
                "[rig] contact_mm is unknown, allowed is the height of the pad's surface in the base frame",
                "touch the pad with the tool by hand and note its z",
            )
        if rig.pad_mm is None:
            raise RigFault(
                "refused",
                "[rig] pad_mm is unknown, allowed are x and y of the pad's centre in the base frame",
                "jog the tool to the middle of the pad and note its x and y",
            )
        return cls(rig.pad_mm, math.radians(rig.pad_angle_deg), rig.contact_mm, rig.tool_rad, bool(rig.mirrored))

    def pose(self, place_mm: Array, depth_mm: float) -> Pose:
        """The tool's pose at a place (2,) on the pad's plan, `depth_mm` below its surface (above: less than 0)."""
        x, y = np.asarray(place_mm, dtype=np.float64) @ self._axes + self.centre_mm
        return (float(x), float(y), self.contact_mm - depth_mm, *self.tool_rad)

    def tip(self, poses: Array) -> tuple[Array, Array]:
        """Places (n, 2) on the pad's plan and depths (n,) of poses (n, 3 or more), mm."""
        places = (poses[:, :2] - self.centre_mm) @ self._axes.T
        return places, self.contact_mm - poses[:, 2]

    @property
    def _axes(self) -> Array:
        """(2, 2) the axes of the plan, x and y, in the base frame, a row each."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return np.array([[-c, -s] if self.mirrored else [c, s], [-s, c]])


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


@dataclass(frozen=True)
class RigConfig:
    """What is to be recorded: the pad, what presses it, settings, the run directory, and where all that came from.

    Attributes:
        size: which part of the pad is pressed, unless a file says where, and which is not; the default if None.
        folder: of the pad, with what fabricate has written.
    """

    pad: "Morphology"
    contact: "Contact"
    rig: "RigSettings"
    out: Path
    command: str
    inputs: Sequence[Path] = ()
    size: "PadSettings | None" = None
    folder: Path = Path()


def plan_of(setup: RigConfig, rig: "RigSettings", resume: bool) -> "PressPlan":
    """The plan of a resumed recording, or the one that `rig` asks for: of a kind, or from a file."""
    import numpy as np

    from padforge.sense.recording.press_plan import (
        PressPlan,
        check_pressable,
        fit_pad_settings,
        make_plan,
        pressable_test,
    )
    from padforge.sense.recording.run_directory import START

    if resume and (setup.out / START).exists():
        plan = PressPlan.from_rows(begun_source(setup, rig, KIND)["plan"]["presses"])
        return check_pressable(plan, setup.out, pressable_test(setup.pad, fit_pad_settings(setup.pad, setup.size)))
    return make_plan(setup.pad, rig, np.random.default_rng(rig.seed), setup.size)


KIND = "rig"
"""Of the source of a recording that an arm pressed."""
_PLANNED = ("presses", "plan", "seed")
_FREE = {
    *_PLANNED,  # the plan is kept
    *("host", "port", "baud", "printer_port", "printer_baud"),  # serial numbers are compared
    *("box_mm", "max_depth_mm", "max_force_n"),
    *("noise_mv", "drift_mv", "creep", "hysteresis", "hysteresis_s"),
}
"""Settings that may change within a recording; any other changes what a press is."""
_ONCE = {"mirrored": False}
"""What held before there was a setting, for recordings of that time."""
_IDENTITY = {"arm": ("model", "serial", "tcp"), "board": ("name", "serial", "firmware")}
"""What devices say of themselves that all of a recording has to share."""


def begun_source(setup: RigConfig, rig: "RigSettings", kind: str) -> dict[str, Any]:
    """The source of the recording in `setup.out`, which is to be gone on with.

    Raises:
        InputError: it is of another kind, has no plan, or was begun with other settings or another pad.
    """
    from padforge.sense.recording.run_directory import FORMAT, START

    source = read_json(setup.out / START, FORMAT).get("source")
    source = source if isinstance(source, dict) else {}
    if not isinstance(plan := source.get("plan"), dict) or "presses" not in plan:
        raise InputError(f"{setup.out}: has no plan, so that it cannot be resumed")
    if source.get("kind") != kind:
        raise InputError(f"{setup.out}: holds a recording of kind {source.get('kind')!r}, not {kind!r}")
    was, now = source.get("rig"), _told(setup, rig)
    if source.get("morphology") != now["morphology"]:
        raise InputError(f"{setup.out}: was begun with another pad than the one given")
    for key in sorted(now["rig"].keys() - _FREE):
        before = was.get(key, _ONCE.get(key)) if isinstance(was, dict) else None
        if before != (got := now["rig"][key]):
            raise InputError(f"[rig] {key}: got {got}, the recording in {setup.out} was begun with {before}")
    return source


def kept_plan(setup: RigConfig) -> str:
    """What to tell where other presses are asked for than the recording was begun with, whose plan is kept; else ""."""
    from padforge.sense.recording.run_directory import FORMAT, START

    if not (setup.out / START).exists():
        return ""
    source, now = read_json(setup.out / START, FORMAT)["source"], setup.rig.model_dump(mode="json")
    other = [f"{key} = {source['rig'].get(key)}" for key in _PLANNED if source["rig"].get(key) != now[key]]
    return f"{setup.out}: goes on by the plan it was begun with, [rig] {', '.join(other)}" if other else ""


def require_same_devices(out: Path, source: Mapping[str, Any], devices: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise InputError where a recording would be gone on with with another arm, tool or board; see `source_of`."""
    kept = source.get("devices")
    for device, about in devices.items():
        was = kept.get(device) if isinstance(kept, dict) else None
        for key in _IDENTITY[device]:
            before = was.get(key) if isinstance(was, dict) else None
            if before != (now := _plain(about).get(key)):
                raise InputError(f"{device}: {key} is {now}, the recording in {out} was begun with {before}")


def source_of(
    setup: RigConfig, rig: "RigSettings", kind: str, plan: Mapping[str, Any], devices: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """What a new recording says of where it came from.

    Args:
        plan: its presses, and the names of their columns. devices: what "arm" and "board" said of themselves.
    """
    said = {name: _plain(about) for name, about in devices.items()}
    return {"kind": kind, "devices": said, **_told(setup, rig), "plan": dict(plan)}


def _told(setup: RigConfig, rig: "RigSettings") -> dict[str, Any]:
    """Settings, with the inputs of the board as they are wired and the side of the pad as it counts, and the pad."""
    from padforge.sense.recording.press_plan import pad_source

    wired = rig.model_copy(update={"channels": rig.inputs(len(setup.pad.knots)), "mirrored": bool(rig.mirrored)})
    return {"rig": wired.model_dump(mode="json"), "morphology": pad_source(setup.pad)}


def _plain(about: Mapping[str, Any]) -> dict[str, Any]:
    """What a device said, as it is read from JSON again."""
    return json.loads(json.dumps(dict(about)))


def recorder_of(
    setup: RigConfig,
    rig: "RigSettings",
    plan: "PressPlan",
    folder: Path,
    resume: bool,
    devices: Mapping[str, Mapping[str, Any]],
) -> "Recorder":
    """The recorder of a new recording, or of the one in `folder` that is gone on with.

    Args:
        devices: what "arm" and "board" said of themselves on connecting.

    Raises:
        InputError: the recording cannot be gone on with, or was begun with other devices.
    """
    from padforge.sense.recording.press_plan import COLUMNS
    from padforge.sense.recording.run_directory import FORMAT, START, Recorder

    if resume and (folder / START).exists():
        require_same_devices(folder, read_json(folder / START, FORMAT).get("source", {}), devices)
        return Recorder.resume(folder)
    source = source_of(setup, rig, KIND, {"columns": list(COLUMNS), "presses": plan.to_rows()}, devices)
    return Recorder(folder, len(setup.pad.knots), source, provenance(setup.command, rig.seed, setup.inputs))
