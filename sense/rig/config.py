"""Configuration of a recording on a rig: the pad's frame, what is recorded, and whether a recording may be resumed.

The pad's frame comes from `[rig]`, or on a printer's bed from the holder that was printed there. A recording stores its
settings, plan and devices in `start.json`. It may be resumed with other settings only if presses stay comparable.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from padforge.common.files import provenance, read_json
from padforge.common.settings import Settings, as_tuple, validate
from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.settings import Contact, PadSettings
from padforge.sense.arrays import Array
from padforge.sense.recording.press_plan import (
    COLUMNS,
    PressPlan,
    check_pressable,
    fit_pad_settings,
    make_plan,
    pad_source,
    pressable_test,
)
from padforge.sense.recording.run_directory import FORMAT, START, Recorder
from padforge.sense.rig.devices import Pose, RigFault
from padforge.sense.rig.safety import check_probe
from padforge.sense.settings import SIMULATED, Millimetres, RigSettings

FABRICATION_FILE = "fabrication.json"
FABRICATION_FORMAT = "padforge-fabrication/1"

KIND = "rig"  # kind of source of a recording that an arm pressed
_PLAN_KEYS = ("presses", "plan", "seed")
_CHANGEABLE = {
    *_PLAN_KEYS,  # the plan is stored
    *("host", "port", "baud", "printer_port", "printer_baud"),  # devices are compared by their serial numbers
    *("box_mm", "max_depth_mm", "max_force_n"),
    *SIMULATED,
}
"""Settings that may change when a recording is resumed; any other would make its presses incomparable."""
_IDENTITY_KEYS = {"arm": ("model", "serial", "tcp"), "board": ("name", "serial", "firmware")}
"""Keys of a device's identity that must not change when a recording is resumed."""


@dataclass(frozen=True)
class RobotFrame:
    """The pad's frame in the arm's base frame."""

    centre_mm: tuple[float, float]  # of the pad
    turn_rad: float  # angle from the base's y axis to the pad's
    contact_mm: float  # height of the pad's surface
    tool_rad: tuple[float, float, float]  # rotation vector of the tool
    mirrored: bool = False  # whether the pad lies with its tracks up, which inverts its x axis

    @classmethod
    def from_settings(cls, rig: RigSettings) -> "RobotFrame":
        """Return the frame of `[rig]`; raises RigFault("refused") if the pad's height or centre is unknown."""
        if rig.contact_mm is None:
            message = "[rig] contact_mm is unknown, allowed is the height of the pad's surface in the base frame"
            raise RigFault("refused", message, "touch the pad with the tool by hand and note its z")
        if rig.pad_mm is None:
            message = "[rig] pad_mm is unknown, allowed are x and y of the pad's centre in the base frame"
            raise RigFault("refused", message, "jog the tool to the middle of the pad and note its x and y")
        return cls(rig.pad_mm, math.radians(rig.pad_angle_deg), rig.contact_mm, rig.tool_rad, bool(rig.mirrored))

    def pose(self, position_mm: Array, depth_mm: float) -> Pose:
        """Return the tool's pose at a position (2,) on the plan, `depth_mm` below the surface (above it: negative)."""
        x, y = np.asarray(position_mm, dtype=np.float64) @ self._axes + self.centre_mm
        return (float(x), float(y), self.contact_mm - depth_mm, *self.tool_rad)

    def tip(self, poses: Array) -> tuple[Array, Array]:
        """Return positions (n, 2) on the plan and depths (n,) of poses (n, 3 or more), mm."""
        positions_mm = (poses[:, :2] - self.centre_mm) @ self._axes.T
        return positions_mm, self.contact_mm - poses[:, 2]

    @property
    def _axes(self) -> Array:
        """x and y axis of the plan in the base frame, the rows of a (2, 2) array."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return np.array([[-c, -s] if self.mirrored else [c, s], [-s, c]])


class HolderFrame(Settings):
    """Pose of a pad in its holder on a printer's bed, as `fabricate.mould.bed_frame` describes it; mm and degrees."""

    bed_mm: Annotated[tuple[Millimetres, Millimetres, Millimetres], BeforeValidator(as_tuple)]
    centre_mm: Annotated[tuple[Millimetres, Millimetres], BeforeValidator(as_tuple)]
    angle_deg: float = Field(ge=-360, le=360)
    mirrored: bool
    pad_mm: Annotated[Millimetres | tuple[Millimetres, Millimetres], BeforeValidator(as_tuple)]
    surface_mm: Millimetres
    walls_mm: Millimetres


def cast_thickness_mm(folder: Path) -> float | None:
    """Return the thickness, mm, of the pad cast in the mould of a folder; None if there is no mould."""
    path = folder / FABRICATION_FILE
    if not path.is_file():
        return None
    return read_json(path, FABRICATION_FORMAT)["sizes"]["pad_thickness_mm"]


def locate_on_bed(rig: RigSettings, folder: Path) -> RigSettings:
    """Return settings completed with the pose of the pad on a printer's bed, and the workspace above it.

    The pose is that of the holder in `folder`, turned by `pad_angle_deg`. In x and y the workspace is the pad, as far
    as the nozzle reaches; in z it ends `max_depth_mm` below the pad's surface, or at the top of the holder's walls if
    that is higher. Values of `[rig]` take precedence; missing values raise RigFault("refused").
    """
    check_probe(rig)
    path = folder / FABRICATION_FILE
    stored = read_json(path, FABRICATION_FORMAT).get("frame") if path.is_file() else None
    if stored is None:
        if None not in (rig.pad_mm, rig.contact_mm, rig.box_mm):
            return rig
        reason = f"{path} is of a pad without a holder" if path.is_file() else f"there is no {path}"
        message = f"[rig] pad_mm, contact_mm or box_mm is unknown, and {reason}"
        raise RigFault("refused", message, "measure them, or make the pad's holder: [mould] holder = true")
    frame = validate(HolderFrame, stored, f"{path}: frame")
    x, y = rig.pad_mm or frame.centre_mm
    contact = frame.surface_mm if rig.contact_mm is None else rig.contact_mm
    half_x, half_y = (side / 2 for side in np.broadcast_to(frame.pad_mm, 2).tolist())
    angle_deg = rig.pad_angle_deg + frame.angle_deg
    if round(angle_deg / 90) % 2:  # quarter turn of the pad on the bed
        half_x, half_y = half_y, half_x
    width, depth, height = frame.bed_mm
    dx, dy, dz = rig.tcp_mm or (0.0, 0.0, 0.0)
    box = (
        *(max(x - half_x, dx), min(x + half_x, width + dx)),
        *(max(y - half_y, dy), min(y + half_y, depth + dy)),
        *(max(contact - rig.max_depth_mm, frame.walls_mm) - 1e-6, height + dz),  # less rounding of the deepest press
    )
    located = {
        "pad_mm": (x, y),
        "mirrored": frame.mirrored if rig.mirrored is None else rig.mirrored,
        "contact_mm": contact,
        "box_mm": rig.box_mm or box,
        "pad_angle_deg": angle_deg,
    }
    return rig.model_copy(update=located)


@dataclass(frozen=True)
class RigConfig:
    """Configuration of a recording."""

    pad: Morphology
    contact: Contact
    rig: RigSettings
    out: Path  # run directory
    command: str  # for the provenance
    inputs: Sequence[Path] = ()  # files for the provenance
    pad_settings: PadSettings | None = None  # sensed area and keep-outs; None for the whole pad
    folder: Path = Path()  # folder of the pad, with the files of `fabricate`


def load_or_make_plan(config: RigConfig, resume: bool) -> PressPlan:
    """Return the stored plan of a resumed recording, otherwise a new one by `[rig]`."""
    if resume:
        plan = PressPlan.from_rows(read_source(config, KIND)["plan"]["presses"])
        free = pressable_test(config.pad, fit_pad_settings(config.pad, config.pad_settings))
        return check_pressable(plan, config.out, free)
    return make_plan(config.pad, config.rig, np.random.default_rng(config.rig.seed), config.pad_settings)


def read_source(config: RigConfig, kind: str) -> dict[str, Any]:
    """Return the source of the recording to resume; InputError if it has no plan, or its presses would differ."""
    source = read_json(config.out / START, FORMAT)["source"]
    if "plan" not in source:
        raise InputError(f"{config.out}: has no plan, so that it cannot be resumed")
    if source["kind"] != kind:
        raise InputError(f"{config.out}: holds a recording of kind {source['kind']!r}, not {kind!r}")
    current = _settings_and_pad(config)
    if source["morphology"] != current["morphology"]:
        raise InputError(f"{config.out}: was begun with another pad than the one given")
    for key in sorted(current["rig"].keys() - _CHANGEABLE):
        if (stored := source["rig"].get(key)) != (value := current["rig"][key]):
            raise InputError(f"[rig] {key}: got {value}, the recording in {config.out} was begun with {stored}")
    return source


def plan_notice(config: RigConfig) -> str:
    """Return a notice that a resumed recording keeps its plan although `[rig]` sets another; "" if it does not."""
    stored, current = read_json(config.out / START, FORMAT)["source"]["rig"], config.rig.model_dump(mode="json")
    changed = [f"{key} = {stored.get(key)}" for key in _PLAN_KEYS if stored.get(key) != current[key]]
    return f"{config.out}: keeps the plan that it was begun with, [rig] {', '.join(changed)}" if changed else ""


def open_recorder(
    config: RigConfig,
    presses: Sequence[Sequence[float]],
    folder: Path,
    resume: bool,
    identities: Mapping[str, Mapping[str, Any]],
    kind: str = KIND,
) -> Recorder:
    """Return the recorder of a new recording in `folder`, or of the one there if `resume`.

    `presses` are x and y, or x, y and depth, of each press of the plan, mm, and `identities` the results of `connect`,
    by "arm" and "board". Raises InputError for a recording that was begun with another arm, tool or board.
    """
    devices = json.loads(json.dumps({name: dict(identity) for name, identity in identities.items()}))  # as when read
    if resume:
        stored = read_json(folder / START, FORMAT)["source"]["devices"]
        for device, identity in devices.items():
            for key in _IDENTITY_KEYS[device]:
                if (before := stored[device].get(key)) != (now := identity.get(key)):
                    raise InputError(f"{device}: {key} is {now}, the recording in {folder} was begun with {before}")
        return Recorder.resume(folder)
    plan = {"columns": list(COLUMNS[: len(presses[0])]), "presses": presses}
    source = {"kind": kind, "devices": devices, **_settings_and_pad(config), "plan": plan}
    made_by = provenance(config.command, config.rig.seed, config.inputs)
    return Recorder(folder, len(config.pad.knots), source, made_by)


def _settings_and_pad(config: RigConfig) -> dict[str, Any]:
    """Return `[rig]`, with the wired inputs and the pad's side filled in, and the pad, as JSON."""
    rig = config.rig
    wired = rig.model_copy(update={"channels": rig.inputs(len(config.pad.knots)), "mirrored": bool(rig.mirrored)})
    return {"rig": wired.model_dump(mode="json"), "morphology": pad_source(config.pad)}
