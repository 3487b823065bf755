"""What is to be recorded, and the run directory it goes to: a new one, or one to go on with."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from padforge.design.common.files import provenance, read_json
from padforge.design.common.validation import InputError

if TYPE_CHECKING:
    from padforge.design.morphology import Morphology
    from padforge.design.settings import Contact, PadSettings
    from padforge.sense.recordings.press_plan import PressPlan
    from padforge.sense.recordings.recorder import Recorder
    from padforge.sense.settings import RigSettings


@dataclass(frozen=True)
class Setup:
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


def plan_of(setup: Setup, rig: "RigSettings", resume: bool) -> "PressPlan":
    """The plan of a resumed recording, or the one that `rig` asks for: of a kind, or from a file."""
    import numpy as np

    from padforge.sense.recordings.press_plan import PressPlan, all_free, free_of, planned, size_of
    from padforge.sense.recordings.recorder import START

    if resume and (setup.out / START).exists():
        plan = PressPlan.of(begun_source(setup, rig, KIND)["plan"]["presses"])
        return all_free(plan, setup.out, free_of(setup.pad, size_of(setup.pad, setup.size)))
    return planned(setup.pad, rig, np.random.default_rng(rig.seed), setup.size)


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


def begun_source(setup: Setup, rig: "RigSettings", kind: str) -> dict[str, Any]:
    """The source of the recording in `setup.out`, which is to be gone on with.

    Raises:
        InputError: it is of another kind, has no plan, or was begun with other settings or another pad.
    """
    from padforge.sense.recordings.recorder import FORMAT, START

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


def kept_plan(setup: Setup) -> str:
    """What to tell where other presses are asked for than the recording was begun with, whose plan is kept; else ""."""
    from padforge.sense.recordings.recorder import FORMAT, START

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
    setup: Setup, rig: "RigSettings", kind: str, plan: Mapping[str, Any], devices: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """What a new recording says of where it came from.

    Args:
        plan: its presses, and the names of their columns. devices: what "arm" and "board" said of themselves.
    """
    said = {name: _plain(about) for name, about in devices.items()}
    return {"kind": kind, "devices": said, **_told(setup, rig), "plan": dict(plan)}


def _told(setup: Setup, rig: "RigSettings") -> dict[str, Any]:
    """Settings, with the inputs of the board as they are wired and the side of the pad as it counts, and the pad."""
    from padforge.sense.recordings.press_plan import told_pad

    wired = rig.model_copy(update={"channels": rig.inputs(len(setup.pad.knots)), "mirrored": bool(rig.mirrored)})
    return {"rig": wired.model_dump(mode="json"), "morphology": told_pad(setup.pad)}


def _plain(about: Mapping[str, Any]) -> dict[str, Any]:
    """What a device said, as it is read from JSON again."""
    return json.loads(json.dumps(dict(about)))


def recorder_of(
    setup: Setup,
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
    from padforge.sense.recordings.press_plan import COLUMNS
    from padforge.sense.recordings.recorder import FORMAT, START, Recorder

    if resume and (folder / START).exists():
        require_same_devices(folder, read_json(folder / START, FORMAT).get("source", {}), devices)
        return Recorder.resume(folder)
    source = source_of(setup, rig, KIND, {"columns": list(COLUMNS), "presses": plan.document()}, devices)
    return Recorder(folder, len(setup.pad.knots), source, provenance(setup.command, rig.seed, setup.inputs))
