"""A rig at work: its devices are opened, looked over, and made to record; or a recording is simulated at once."""

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from design.common.errors import InputError
from design.common.files import provenance
from design.common.profiling import stage
from design.common.settings import Spec
from design.pad.morphology import Morphology
from design.pad.twin import Twin
from design.settings import Contact, PadSettings
from sense.localizer.localizer import Localizer
from sense.recordings.recorder import refuse_existing
from sense.recordings.recording import Recording
from sense.recordings.simulation.published_protocol import simulate
from sense.settings import RigSettings

from .devices.protocols import Arm, Converter
from .diagnostics import Diagnosis, examine_arm, examine_converter
from .planning.adaptive_plan import Steering
from .planning.press_plan import PressPlan
from .planning.setup import Setup, plan_of, recorder_of
from .session.press_loop import Report, Session, require_safe_plan

SUPPLY_V = 3.3
"""Of the board's converter."""


def record_simulated(
    spec: Spec,
    pad: Morphology | Twin,
    out: Path,
    overrides: Mapping[str, Any],
    inputs: Sequence[Path] = (),
    like: Twin | None = None,
) -> Recording:
    """Record presses on the simulated rig, at once, with the settings of `spec`, into the run directory `out`.

    Args:
        pad, like: see `simulate`.

    Raises:
        InputError: settings that cannot be, a twin that reads no fibre, or a recording in the way.
    """
    refuse_existing(out)
    options = spec.section(RigSettings, **overrides)
    plan = pad.morphology if isinstance(pad, Twin) else pad
    sensed_mm = spec.section(PadSettings, grid=plan.grid, pitch_mm=plan.pitch_mm).sensed_mm
    with stage("simulate"):
        recording = simulate(pad, options, spec.section(Contact), sensed_mm, like)
    recording.save(out, provenance("padforge sense record --rig simulated", options.seed, inputs))
    return recording


@contextmanager
def opened_rig(kind: str, setup: Setup) -> Iterator[tuple[Arm, Converter, RigSettings]]:
    """Arm and converter of a rig, "simulated" or the name of an arm, not yet connected, and the settings for them."""
    if kind == "simulated":
        from .emulators.whole_rig import emulated, emulated_rig

        chosen = emulated_rig(setup.rig, setup.pad)
        with emulated(setup.pad, setup.contact, chosen) as (arm, converter, _, _):
            yield arm, converter, chosen
        return
    from .arms.ur5.driver import UR5
    from .boards.due.driver import Arduino
    from .boards.due.serial_link import port_of

    arm, converter = UR5(setup.rig.host), Arduino(port_of(setup.rig), setup.rig.converter_rate_hz, setup.rig.channels)
    try:
        yield arm, converter, setup.rig
    finally:
        converter.close()
        arm.close()


def record(
    kind: str,
    setup: Setup,
    model: Path | None = None,
    *,
    dry: bool = False,
    resume: bool = False,
    report: Report = lambda done, of: None,
) -> Recording | None:
    """Record with the drivers of a rig, see `opened_rig`; what is done is on the disk whatever happens.

    Args:
        model: folder of the localizer that an adaptive plan is steered by.
        dry: go through the plan without touching the pad; nothing is kept. resume: go on with what is in `setup.out`.
        report: told of presses done, and in all.

    Returns:
        The recording, None of a dry run.

    Raises:
        InputError: settings, a plan or a run directory that cannot be.
        RigFault: the rig failed, or the plan is not safe.
    """
    with opened_rig(kind, setup) as (arm, converter, rig):
        plan = plan_of(setup, rig, resume)
        steer = _steering(setup, rig, model)
        require_safe_plan(plan, rig)
        if not (resume or dry):
            refuse_existing(setup.out)
        converter.connect()  # a board in use is refused before the arm's program is ended
        arm.connect()
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "dry" if dry else setup.out
            with recorder_of(setup, rig, plan, folder, resume) as recorder:
                report(len(recorder.done), len(plan))
                Session(arm, converter, recorder, rig, dry=dry).run(plan, report, steer)
            return None if dry else Recording.open(folder)


def _steering(setup: Setup, rig: RigSettings, model: Path | None) -> Callable[[PressPlan, int], PressPlan]:
    if rig.plan != "adaptive":
        return lambda plan, press: plan
    if model is None:
        raise InputError("[rig] plan is adaptive, which needs --model, a folder that calibrate wrote")
    return Steering(Localizer.load(model), setup.out, np.random.default_rng(rig.seed))


def look_over(kind: str, setup: Setup) -> list[Diagnosis]:
    """What to know of a rig, see `opened_rig`, before a long run; nothing moves."""
    from .boards.due.serial_link import find_ports

    ports = [f"{port.device} ({port.kind})" for port in find_ports()]
    found = [Diagnosis("ports", "ok", ", ".join(ports) or "no board seen on USB")]
    with opened_rig(kind, setup) as (arm, converter, _):
        found += examine_converter(converter, SUPPLY_V, time.monotonic, time.sleep)
        found += examine_arm(arm, time.monotonic, time.sleep)
    return found
