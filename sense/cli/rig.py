"""`padforge sense record` and `doctor`: the edge where rigs come in."""

import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from design.common.command_line import (
    json_option,
    load_spec,
    profile_option,
    progress,
    seed_option,
    show_result,
    spec_option,
)
from sense.rig.planning.setup import Order, plan_of, recorder_of

if TYPE_CHECKING:
    from design.common.settings import Spec
    from design.pad.morphology import Morphology
    from sense.recordings.recording import Recording
    from sense.rig.devices import Arm, Converter
    from sense.rig.planning.press_plan import PressPlan
    from sense.settings import RigSettings

_FILE = click.Path(path_type=Path, dir_okay=False)
_FOLDER = click.Path(path_type=Path, file_okay=False)

rig_option = click.option("--rig", type=click.Choice(["simulated", "ur5"]), default="simulated", show_default=True)
drivers_option = click.option(
    "--through-drivers", is_flag=True, help="The simulated rig in real time, through the drivers of the real one."
)


@click.command()
@rig_option
@click.option(
    "--morphology", type=_FILE, help="morphology.json or published .mat (default: the straight grid of [pad])."
)
@click.option("--presses", type=int, help="Presses to record.")
@click.option("--plan", type=_FILE, help="CSV of x_mm, y_mm and depth_mm to press, in place of [rig] plan.")
@click.option("--model", type=_FOLDER, help="Localizer that an adaptive plan is steered by.")
@click.option("--dry-run", is_flag=True, help="Go through the whole plan above the pad, touching nothing.")
@click.option("--resume", is_flag=True, help="Go on with a recording that was left unfinished.")
@drivers_option
@seed_option
@spec_option
@click.option("--out", type=_FOLDER, default="out/pad/recording", show_default=True, help="Folder of the recording.")
@profile_option
def record(
    rig: str,
    morphology: Path | None,
    presses: int | None,
    plan: Path | None,
    model: Path | None,
    dry_run: bool,
    resume: bool,
    through_drivers: bool,
    seed: int | None,
    spec: Path | None,
    out: Path,
) -> None:
    """Record presses on a pad.

    \b
    padforge sense record --morphology out/pad/morphology.json --presses 1500

    \b
    --rig simulated                     a simulated pad, at once
    --rig simulated --through-drivers   the same in real time, through emulated devices
    --rig ur5                           a UR robot and the board, as [rig] says

    A recording that broke off keeps every finished press; --resume makes the others.
    Software is not the emergency stop: keep the robot's own one within reach.
    """
    from design.common.errors import InputError
    from design.settings import PadSettings
    from sense.recordings.recorder import START
    from sense.settings import RigSettings

    settings = load_spec(spec)
    of_pad = settings.section(PadSettings)
    inputs = [path for path in (morphology, plan, spec) if path is not None]
    overrides = {"presses": presses, "seed": seed}
    pad = _pad(morphology, of_pad.grid, of_pad.pitch_mm)
    if rig == "simulated" and not through_drivers:
        if resume or dry_run or plan or model:
            raise InputError("--resume, --dry-run, --plan and --model need --through-drivers or --rig ur5")
        click.echo(recording_line(run_recording(settings, pad, out, overrides, inputs), out))
        return
    options = settings.section(RigSettings, **overrides)
    command = f"padforge sense record --rig {rig}" + " --through-drivers" * through_drivers
    order = Order(pad, options, settings, out, command, inputs)
    for ending in {"SIGTERM", "SIGHUP"} & set(
        dir(signal)
    ):  # an end that stops the arm and keeps the data, as Ctrl-C is
        signal.signal(getattr(signal, ending), signal.default_int_handler)
    if resume and not (out / START).exists():
        click.echo(f"{out}: nothing to resume, a new recording begins", err=True)
    with _devices(rig, order) as (arm, converter, chosen):
        recording = _run(order, chosen, arm, converter, plan, model, dry=dry_run, resume=resume)
    click.echo("dry run: every pose reached, nothing kept" if recording is None else recording_line(recording, out))


def _pad(morphology: Path | None, grid: int, pitch_mm: float) -> "Morphology":
    from design.pad.morphology import Morphology

    return Morphology.load(morphology) if morphology else Morphology.straight(grid, pitch_mm)


def run_recording(
    spec: "Spec", pad: "Morphology", out: Path, overrides: Mapping[str, Any], inputs: Sequence[Path] = ()
) -> "Recording":
    """Record presses on the simulated rig with the settings of `spec` into the run directory `out`."""
    from design.common.files import provenance
    from design.common.profiling import stage
    from design.settings import Contact
    from sense.recordings.recorder import refuse_existing
    from sense.recordings.simulation import simulate
    from sense.settings import RigSettings

    refuse_existing(out)
    options = spec.section(RigSettings, **overrides)
    with stage("simulate"):
        recording = simulate(pad, options, spec.section(Contact))
    recording.save(out, provenance("padforge sense record --rig simulated", options.seed, inputs))
    return recording


@contextmanager
def _devices(rig: str, order: Order) -> Iterator[tuple["Arm", "Converter", "RigSettings"]]:
    """Arm and converter, not yet connected, and the settings for them."""
    if rig == "simulated":
        from design.settings import Contact
        from sense.rig.emulators.whole_rig import emulated, emulated_rig

        chosen = emulated_rig(order.rig, order.pad)
        with emulated(order.pad, order.spec.section(Contact), chosen) as (arm, converter, _, _):
            yield arm, converter, chosen
        return
    from sense.rig.arduino.driver import Arduino
    from sense.rig.ur5.driver import UR5

    arm, converter = UR5(order.rig.host), Arduino(port_of(order.rig), order.rig.converter_rate_hz, order.rig.channels)
    try:
        yield arm, converter, order.rig
    finally:
        converter.close()
        arm.close()


def port_of(rig: "RigSettings") -> str:
    """The board's port, looked for where it is not set."""
    from sense.rig.arduino.serial_link import find_ports
    from sense.rig.devices import RigFault

    if rig.port != "auto":
        return rig.port
    if not (ports := find_ports()):
        raise RigFault("refused", '[rig] port is "auto" and no board is found', "plug it in, or name its port")
    return ports[0].device


def _run(
    order: Order,
    rig: "RigSettings",
    arm: "Arm",
    converter: "Converter",
    plan_file: Path | None,
    model: Path | None,
    *,
    dry: bool,
    resume: bool,
) -> "Recording | None":
    """Record, or go through the plan without touching the pad."""
    import tempfile

    from sense.recordings.recorder import refuse_existing
    from sense.recordings.recording import Recording
    from sense.rig.session.press_loop import Session, require_safe_plan

    plan = plan_of(order, rig, plan_file, resume)
    steer = _steering(order, rig, model)
    require_safe_plan(plan, rig)
    if not (resume or dry):
        refuse_existing(order.out)
    converter.connect()  # a board in use is refused before the arm's program is ended
    arm.connect()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "dry" if dry else order.out
        with recorder_of(order, rig, plan, folder, resume) as recorder, progress() as bar:
            task = bar.add_task("presses", total=len(plan), completed=len(recorder.done), note="")
            session = Session(arm, converter, recorder, rig, dry=dry)
            session.run(plan, lambda done, of: bar.update(task, completed=done), steer)
        return None if dry else Recording.open(folder)


def _steering(order: Order, rig: "RigSettings", model: Path | None) -> Callable[["PressPlan", int], "PressPlan"]:
    if rig.plan != "adaptive":
        return lambda plan, press: plan
    import numpy as np

    from design.common.errors import InputError
    from sense.localizer.localizer import Localizer
    from sense.rig.planning.adaptive_plan import Steering

    if model is None:
        raise InputError("[rig] plan is adaptive, which needs --model, a folder that calibrate wrote")
    return Steering(Localizer.load(model), order.out, np.random.default_rng(rig.seed))


@click.command()
@rig_option
@drivers_option
@spec_option
@json_option
@click.pass_context
def doctor(ctx: click.Context, rig: str, through_drivers: bool, spec: Path | None, as_json: bool) -> None:
    """Look the rig over before a long run; nothing moves. Exit 1 where something fails.

    \b
    padforge sense doctor --rig ur5

    Ports, versions, rates, latency, and every channel's rest and noise.
    """
    import time

    from design.settings import PadSettings
    from sense.rig.arduino.serial_link import find_ports
    from sense.rig.diagnostics import Diagnosis, examine_arm, examine_converter
    from sense.settings import RigSettings

    settings = load_spec(spec)
    of_pad, options = settings.section(PadSettings), settings.section(RigSettings)
    order = Order(_pad(None, of_pad.grid, of_pad.pitch_mm), options, settings, Path(), "padforge sense doctor", ())
    ports = [f"{port.device} ({port.kind})" for port in find_ports()]
    found = [Diagnosis("ports", "ok", ", ".join(ports) or "no board seen on USB")]
    with _devices(rig, order) as (arm, converter, _):
        found += examine_converter(converter, 3.3, time.monotonic, time.sleep)
        found += examine_arm(arm, time.monotonic, time.sleep)
    passed = all(diagnosis.status != "fail" for diagnosis in found)
    lines = [f"{d.status:<4} {d.name}: {d.found}" for d in found]
    show_result({"passed": passed, "found": [d.document() for d in found]}, lines, as_json)
    ctx.exit(0 if passed else 1)


def recording_line(recording: "Recording", out: Path) -> str:
    """A recording in one line, with what is missing of it."""
    import numpy as np

    unknown = int((~recording.known).sum())
    missing = int(np.isnan(recording.readings).sum())
    return (
        f"{len(recording.presses_mm)} presses{f' ({unknown} of unknown place)' * (unknown > 0)}, "
        f"{len(recording.readings)} readings of {recording.fibres} fibres"
        f"{f', {missing} values missing,' * (missing > 0)} at {recording.rate_hz:.1f} Hz -> {out}"
    )
