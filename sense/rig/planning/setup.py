"""What is to be recorded, and the run directory it goes to: a new one, or one to go on with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from design.common.errors import InputError
from design.common.files import provenance, read_json

if TYPE_CHECKING:
    from design.pad.morphology import Morphology
    from design.settings import Contact, Sensed
    from sense.recordings.recorder import Recorder
    from sense.settings import RigSettings

    from .press_plan import PressPlan


@dataclass(frozen=True)
class Setup:
    """What is to be recorded: the pad, what presses it, settings, the run directory, and where all that came from.

    Attributes:
        sensed_mm: which part of the pad is pressed (`PadSettings`), unless a file says where.
    """

    pad: "Morphology"
    contact: "Contact"
    rig: "RigSettings"
    out: Path
    command: str
    inputs: Sequence[Path] = ()
    sensed_mm: "Sensed" = "beyond"


def plan_of(setup: Setup, rig: "RigSettings", resume: bool) -> "PressPlan":
    """The plan of a resumed recording, or the one that `rig` asks for: of a kind, or from a file."""
    import numpy as np

    from sense.recordings.recorder import FORMAT, START

    from .press_plan import PressPlan, planned, read_plan

    if resume and (setup.out / START).exists():
        source = read_json(setup.out / START, FORMAT).get("source")
        source = source if isinstance(source, dict) else {}
        kept = source.get("plan")
        if not isinstance(kept, dict) or "presses" not in kept:
            raise InputError(f"{setup.out}: has no plan, so that it cannot be resumed")
        _require_same(setup, rig, source)
        return PressPlan.of(kept["presses"])
    if (file := rig.plan_file) is not None:
        return read_plan(file, rig.depth_mm)
    return planned(setup.pad, rig, np.random.default_rng(rig.seed), setup.sensed_mm)


_LASTING = ("channels", "rate_hz", "converter_rate_hz", "readings_per_press", "pad_mm", "pad_angle_deg", "contact_mm")
"""Settings that all of a recording has to share."""


def _require_same(setup: Setup, rig: "RigSettings", source: Mapping[str, Any]) -> None:
    """Refuse to go on with a recording under other settings, or of another pad."""
    was, now = source.get("rig"), rig.model_dump(mode="json")
    for key in _LASTING:
        before = was.get(key) if isinstance(was, dict) else None
        if before != now[key]:
            raise InputError(f"[rig] {key}: got {now[key]}, the recording in {setup.out} was begun with {before}")
    if source.get("morphology") != _morphology(setup):
        raise InputError(f"{setup.out}: was begun with another pad than the one given")


def _morphology(setup: Setup) -> dict[str, Any]:
    return {"pitch_mm": setup.pad.pitch_mm, "knots": setup.pad.knots.tolist()}


def recorder_of(setup: Setup, rig: "RigSettings", plan: "PressPlan", folder: Path, resume: bool) -> "Recorder":
    """The recorder of a new recording, or of the one in `folder` that is gone on with."""
    from sense.recordings.recorder import START, Recorder

    from .press_plan import COLUMNS

    if resume and (folder / START).exists():
        return Recorder.resume(folder)
    source = {
        "kind": "rig",
        "rig": rig.model_dump(mode="json"),
        "morphology": _morphology(setup),
        "plan": {"columns": list(COLUMNS), "presses": plan.document()},
    }
    return Recorder(folder, rig.channels, source, provenance(setup.command, rig.seed, setup.inputs))
