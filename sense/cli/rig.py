"""`padforge sense record` and `doctor`: the edge where rigs come in."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from design.common import command_line as common
from design.common.errors import InputError

from .options import FILE, FOLDER, recording_line, reported

if TYPE_CHECKING:
    from design.pad.morphology import Morphology
    from design.settings import PadSettings

rig_option = click.option(
    "--rig", metavar="NAME", default="simulated", show_default=True, help="simulated, ur5, or an arm that is installed."
)
drivers_option = click.option(
    "--through-drivers", is_flag=True, help="The simulated rig in real time, through the drivers of the real one."
)


@click.command()
@rig_option
@click.option(
    "--morphology", type=FILE, help="morphology.json or published .mat (default: the twin's, or straight fibres)."
)
@click.option("--twin", type=FILE, help="twin.json of a measured pad, which the simulated pad answers like.")
@click.option("--presses", type=int, help="Presses to record.")
@click.option("--plan", help="As [rig] plan: uniform, grid, boustrophedon, adaptive, or a .csv of x_mm,y_mm,depth_mm.")
@click.option("--model", type=FOLDER, help="Localizer that an adaptive plan is steered by.")
@click.option("--dry-run", is_flag=True, help="Go through the whole plan above the pad, touching nothing.")
@click.option("--resume", is_flag=True, help="Go on with a recording that was left unfinished.")
@drivers_option
@common.seed_option
@common.spec_option
@common.out_option(what="Folder of the recording; must be new or empty")
@common.profile_option
def record(
    rig: str,
    morphology: Path | None,
    twin: Path | None,
    presses: int | None,
    plan: str | None,
    model: Path | None,
    dry_run: bool,
    resume: bool,
    through_drivers: bool,
    seed: int | None,
    spec: Path | None,
    out: Path | None,
) -> None:
    """Record presses on a pad, into the folder `recording` beside its morphology.

    \b
    padforge sense record --morphology out/pad/morphology.json --presses 1500

    \b
    --rig simulated                     a simulated pad, at once
    --rig simulated --through-drivers   the same in real time, through emulated devices
    --rig ur5                           a UR robot and the board, as [rig] says

    --twin twin.json, that identify wrote, makes the simulated pad the one that was measured: laid, wired, turned and
    noisy as that was. With --morphology as well it is that pad as planned, with the reach, gain and noise of the twin.

    A recording that broke off keeps every finished press; --resume makes the others.
    Software is not the emergency stop: keep the robot's own one within reach.
    """
    from design.pad.twin import Twin
    from design.settings import Contact, PadSettings
    from sense.recordings.recorder import START
    from sense.rig import operation
    from sense.rig.planning.setup import Setup
    from sense.settings import RigSettings

    settings, target = common.load_spec(spec), out or common.pad_folder(morphology or twin) / "recording"
    if twin and (rig != "simulated" or through_drivers):
        raise InputError("--twin is of the simulated pad, allowed with --rig simulated and without --through-drivers")
    like = Twin.load(twin) if twin else None
    pad = _pad(morphology, settings.section(PadSettings))
    inputs = [path for path in (morphology, twin, spec) if path is not None]
    overrides = {"presses": presses, "plan": plan, "seed": seed}
    if rig == "simulated" and not through_drivers:
        if resume or dry_run or plan or model:
            raise InputError("--resume, --dry-run, --plan and --model need --through-drivers or --rig ur5")
        shown = like if like and not morphology else pad
        recording = operation.record_simulated(settings, shown, target, overrides, inputs, like)
    else:
        options = settings.section(RigSettings, **overrides)
        inputs += [] if options.plan_file is None else [options.plan_file]
        command = f"padforge sense record --rig {rig}" + " --through-drivers" * through_drivers
        sensed_mm = settings.section(PadSettings, grid=pad.grid, pitch_mm=pad.pitch_mm).sensed_mm
        setup = Setup(pad, settings.section(Contact), options, target, command, inputs, sensed_mm)
        if resume and not (target / START).exists():
            click.echo(f"{target}: nothing to resume, a new recording begins", err=True)
        with reported("presses") as report:
            recording = operation.record(rig, setup, model, dry=dry_run, resume=resume, report=report)
    click.echo("dry run: every pose reached, nothing kept" if recording is None else recording_line(recording, target))


def _pad(morphology: Path | None, of_pad: "PadSettings") -> "Morphology":
    from design.pad.morphology import Morphology

    return Morphology.load(morphology) if morphology else Morphology.straight(of_pad.grid, of_pad.pitch_mm)


@click.command()
@rig_option
@drivers_option
@common.spec_option
@common.json_option
@click.pass_context
def doctor(ctx: click.Context, rig: str, through_drivers: bool, spec: Path | None, as_json: bool) -> None:
    """Look the rig over before a long run; nothing moves. Exit 1 where something fails.

    \b
    padforge sense doctor --rig ur5

    Ports, versions, rates, latency, and every channel's rest and noise; channels count from 1, as fibres do.
    """
    from dataclasses import asdict

    from design.settings import Contact, PadSettings
    from sense.rig.operation import look_over
    from sense.rig.planning.setup import Setup
    from sense.settings import RigSettings

    settings = common.load_spec(spec)
    pad, options = _pad(None, settings.section(PadSettings)), settings.section(RigSettings)
    found = look_over(rig, Setup(pad, settings.section(Contact), options, Path(), "padforge sense doctor"))
    passed = all(diagnosis.status != "fail" for diagnosis in found)
    lines = [f"{d.status:<4} {d.name}: {d.found}" for d in found]
    common.show_result({"passed": passed, "found": [asdict(d) for d in found]}, lines, as_json)
    ctx.exit(0 if passed else 1)
