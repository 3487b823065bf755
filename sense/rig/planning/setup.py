"""What is to be recorded, and the run directory it goes to: a new one, or one to go on with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from design.common.errors import InputError
from design.common.files import provenance, read_json

if TYPE_CHECKING:
    from design.common.settings import Spec
    from design.pad.morphology import Morphology
    from sense.recordings.recorder import Recorder
    from sense.settings import RigSettings

    from .press_plan import PressPlan


@dataclass(frozen=True)
class Order:
    """What is to be recorded: the pad, settings and plan, and where they came from."""

    pad: "Morphology"
    rig: "RigSettings"
    spec: "Spec"
    out: Path
    command: str
    inputs: Sequence[Path]


def plan_of(order: Order, rig: "RigSettings", plan_file: Path | None, resume: bool) -> "PressPlan":
    """The plan of a resumed recording, of a file, or of the settings."""
    import numpy as np

    from sense.recordings.recorder import FORMAT, START

    from .press_plan import PressPlan, planned, read_plan

    if resume and (order.out / START).exists():
        source = read_json(order.out / START, FORMAT).get("source")
        source = source if isinstance(source, dict) else {}
        kept = source.get("plan")
        if not isinstance(kept, dict) or "presses" not in kept:
            raise InputError(f"{order.out}: has no plan, so that it cannot be resumed")
        _require_same(order, rig, source)
        return PressPlan.of(kept["presses"])
    if plan_file is not None:
        return read_plan(plan_file, rig.depth_mm)
    return planned(order.pad, rig, np.random.default_rng(rig.seed))


_LASTING = ("channels", "rate_hz", "converter_rate_hz", "readings_per_press", "pad_mm", "pad_angle_deg", "contact_mm")
"""Settings that all of a recording has to share."""


def _require_same(order: Order, rig: "RigSettings", source: Mapping[str, Any]) -> None:
    """Refuse to go on with a recording under other settings, or of another pad."""
    was, now = source.get("rig"), rig.model_dump(mode="json")
    for key in _LASTING:
        before = was.get(key) if isinstance(was, dict) else None
        if before != now[key]:
            raise InputError(f"[rig] {key}: got {now[key]}, the recording in {order.out} was begun with {before}")
    if source.get("morphology") != _morphology(order):
        raise InputError(f"{order.out}: was begun with another pad than the one given")


def _morphology(order: Order) -> dict[str, Any]:
    return {"pitch_mm": order.pad.pitch_mm, "knots": order.pad.knots.tolist()}


def recorder_of(order: Order, rig: "RigSettings", plan: "PressPlan", folder: Path, resume: bool) -> "Recorder":
    """The recorder of a new recording, or of the one in `folder` that is gone on with."""
    from sense.recordings.recorder import START, Recorder

    from .press_plan import plan_lines as describe_plan

    if resume and (folder / START).exists():
        return Recorder.resume(folder)
    source = {
        "kind": "rig",
        "rig": rig.model_dump(mode="json"),
        "morphology": _morphology(order),
        "plan": describe_plan(plan),
    }
    return Recorder(folder, rig.channels, source, provenance(order.command, rig.seed, order.inputs))
