"""`padforge sense record` and `doctor`: the edge where rigs come in."""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.design.common import command_line as common
from padforge.design.common.validation import InputError
from padforge.sense.cli.options import FILE, FOLDER, progress_bar, recording_line, redrawn_lines, typed_keys

if TYPE_CHECKING:
    from padforge.design.morphology import Morphology
    from padforge.design.settings import PadSettings
    from padforge.design.twin import Twin
    from padforge.sense.recording.recording import Recording
    from padforge.sense.rig.config import RigConfig


rig_option = click.option(
    "--rig",
    metavar="NAME",
    default="simulated",
    show_default=True,
    help="simulated, ur5, printer, hand, or an arm that is installed.",
)
_warn = partial(click.echo, err=True)
drivers_option = click.option(
    "--virtual-hardware", is_flag=True, help="Emulated devices in real time, behind the drivers of the real ones."
)


@click.command()
@rig_option
@click.option(
    "--morphology",
    type=FILE,
    help="morphology.json or published .mat (default: the twin's, or straight fibres; of a real rig, beside --out).",
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
    virtual_hardware: bool,
    seed: int | None,
    spec: Path | None,
    out: Path | None,
) -> None:
    """Record presses on a pad, into the folder `recording` beside its morphology.

    \b
    padforge sense record --morphology out/pad/morphology.json --presses 1500

    \b
    --rig simulated                     a simulated pad, at once
    --virtual-hardware                   any of them in real time, through emulated devices
    --rig ur5, --rig printer            a UR robot or a 3D printer, and the board, as [rig] says
    --rig hand                          you and the board: a page and the terminal show where to press

    --twin twin.json, that identify wrote, makes the simulated pad the one that was measured: laid, wired, turned and
    noisy as that was. With --morphology as well it is that pad as planned, with the reach, gain and noise of the twin.

    A recording that broke off keeps every finished press; --resume makes the others.
    Software is not the emergency stop: keep the robot's own one within reach.
    """
    from padforge.design.settings import Contact, PadSettings
    from padforge.sense.rig import operation
    from padforge.sense.rig.config import RigConfig
    from padforge.sense.rig.devices import require_rig_system
    from padforge.sense.settings import RigSettings

    settings, folder = common.load_spec(spec), common.pad_folder(morphology or twin)
    target = out or folder / "recording"
    like = _twin(twin, at_once=rig == "simulated" and not virtual_hardware)
    if not (rig == "simulated" or virtual_hardware or morphology):
        morphology = _beside(target)
        folder = common.pad_folder(morphology)
    pad = _pad(morphology, settings.section(PadSettings))
    inputs = [path for path in (morphology, twin, spec) if path is not None]
    overrides = {"presses": presses, "plan": plan, "seed": seed}
    if rig == "simulated" and not virtual_hardware:
        if resume or dry_run or model:
            raise InputError("--resume, --dry-run and --model need --virtual-hardware or a real rig")
        shown = like if like and not morphology else pad
        if like and morphology and (left := like.ignored_effects()):
            click.echo(f"{twin}: {left}", err=True)
        recording = operation.record_simulated(settings, shown, target, overrides, inputs, like)
    else:
        require_rig_system()
        options = settings.section(RigSettings, **overrides)
        inputs += [] if options.plan_file is None else [options.plan_file]
        command = f"padforge sense record --rig {rig}" + " --virtual-hardware" * virtual_hardware
        size = settings.section(PadSettings, **pad.layout.settings)
        setup = RigConfig(pad, settings.section(Contact), options, target, command, inputs, size, folder)
        recording = _record_with(rig, setup, model, dry_run, resume, virtual_hardware)
    click.echo("dry run: every pose reached, nothing kept" if recording is None else recording_line(recording, target))


def _twin(path: Path | None, at_once: bool) -> "Twin | None":
    from padforge.design.twin import Twin

    if path and not at_once:
        raise InputError("--twin is of the simulated pad, allowed with --rig simulated and without --virtual-hardware")
    return Twin.load(path) if path else None


def _beside(recording: Path) -> Path:
    """The morphology.json in the folder that a recording goes to: a real pad is known, never guessed."""
    path = recording.parent / "morphology.json"
    if not path.is_file():
        raise InputError(f"--morphology is needed, of the pad under the arm: there is none at {path}")
    return path


def _record_with(
    rig: str, setup: "RigConfig", model: Path | None, dry_run: bool, resume: bool, virtual_hardware: bool
) -> "Recording | None":
    """Record with an arm, or by hand."""
    from padforge.sense.recording.run_directory import START
    from padforge.sense.rig import operation

    if resume and not (setup.out / START).exists():
        _warn(f"{setup.out}: nothing to resume, a new recording begins")
    if rig == "hand":
        if dry_run or model:
            raise InputError("--dry-run and --model need an arm, allowed with --rig hand are --plan and --resume")
        return _record_by_hand(setup, resume, virtual_hardware)
    with progress_bar("presses") as report:
        how = {"dry": dry_run, "resume": resume, "virtual_hardware": virtual_hardware, "report": report, "say": _warn}
        return operation.record(rig, setup, model, **how)


def _record_by_hand(setup: "RigConfig", resume: bool, emulated: bool) -> "Recording":
    """Show a person where to press, on a page and in the terminal, and take what is said on both."""
    from padforge.sense.live.outputs import LivePage
    from padforge.sense.rig.by_hand import WORDS, pad_view, record_by_hand, view_lines
    from padforge.sense.rig.operation import opened_board
    from padforge.sense.virtual.virtual_hand import pressed_by_finger

    words = {each["key"]: each["word"] for each in WORDS}
    with ExitStack() as stack:
        if emulated:
            converter, finger = stack.enter_context(pressed_by_finger(setup.pad, setup.contact, setup.rig))
            look, answer = finger.look, finger.said
        else:
            converter = stack.enter_context(opened_board(setup, setup.rig.inputs(len(setup.pad.knots))))
            look, answer = (lambda view: None), list
        page = stack.enter_context(LivePage(0, "hand.html", words.values()))
        _warn(f"page: {page.url} (q ends)")
        draw, typed = stack.enter_context(redrawn_lines()), stack.enter_context(typed_keys())
        latest = pad = pad_view(setup.pad, str(setup.out), bool(setup.rig.mirrored))

        @stack.push
        def tell_the_end(kind: object, error: BaseException | None, trace: object) -> None:
            if latest is not pad:
                page.show(latest | {"ended": str(error or "") or "ended"})

        def show(view: dict[str, Any]) -> None:
            nonlocal latest
            if draw is None and view["told"] != latest.get("told", ""):
                click.echo(view["told"])
            if draw is not None and view["phase"] == "lift" != latest.get("phase"):
                click.echo("\a", nl=False)  # eyes are on the pad
            latest = pad | view
            page.show(latest)
            look(latest)
            if draw is not None:
                draw(view_lines(latest))

        def said() -> list[str]:
            return [*page.said(), *(words[key] for key in typed() if key in words), *answer()]

        return record_by_hand(setup, converter, show, said, resume)


def _pad(morphology: Path | None, of_pad: "PadSettings") -> "Morphology":
    from padforge.design.morphology import Morphology

    return Morphology.load(morphology) if morphology else Morphology.straight(of_pad.layout)


@click.command()
@rig_option
@click.option("--morphology", type=FILE, help="Pad whose fibres are looked at (default: all inputs that are named).")
@drivers_option
@common.spec_option
@common.json_option
@click.pass_context
def doctor(
    ctx: click.Context, rig: str, morphology: Path | None, virtual_hardware: bool, spec: Path | None, as_json: bool
) -> None:
    """Look the rig over before a long run; nothing moves. Exit 1 where something fails.

    \b
    padforge sense doctor --rig ur5

    Ports, versions, rates, latency, and every channel's rest and noise; channels count from 1, as fibres do, inputs as
    they are printed on the board. Without --morphology the inputs that [rig] channels names, or all, are looked at.
    """
    from dataclasses import asdict

    from padforge.design.settings import Contact, PadSettings
    from padforge.sense.rig.config import RigConfig
    from padforge.sense.rig.devices import require_rig_system
    from padforge.sense.rig.operation import look_over
    from padforge.sense.settings import RigSettings

    require_rig_system()
    settings = common.load_spec(spec)
    pad, options = _pad(morphology, settings.section(PadSettings)), settings.section(RigSettings)
    known = morphology is not None or rig == "simulated" or virtual_hardware
    inputs = options.inputs(len(pad.knots)) if known else options.channels
    setup = RigConfig(
        pad, settings.section(Contact), options, Path(), "padforge sense doctor", folder=common.pad_folder(morphology)
    )
    found = look_over(rig, setup, inputs, virtual_hardware)
    passed = all(diagnosis.status != "fail" for diagnosis in found)
    lines = [f"{d.status:<4} {d.name}: {d.found}" for d in found]
    common.show_result({"passed": passed, "found": [asdict(d) for d in found]}, lines, as_json)
    ctx.exit(0 if passed else 1)
