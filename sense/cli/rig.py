"""The commands `padforge sense record` and `doctor`."""

from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.common import command_line as common
from padforge.common.validation import InputError
from padforge.sense.cli.options import FILE, FOLDER, recording_line, redrawn_lines, typed_keys

if TYPE_CHECKING:
    from padforge.design.morphology import Morphology
    from padforge.design.settings import PadSettings
    from padforge.sense.recording.recording import Recording
    from padforge.sense.rig.config import RigConfig


_RIG_SETTINGS = "padforge.sense.settings:RigSettings"
_RIGS = "simulated, ur5, printer, hand, or an installed arm."
rig_option = click.option("--rig", metavar="NAME", default="simulated", show_default=True, help=_RIGS)
_warn = partial(common.echo, err=True)


def check_rig(name: str, simulated: bool = True) -> None:
    """Raise InputError unless `--rig` is the name of a rig; "simulated" is allowed if `simulated`."""
    from importlib.metadata import entry_points

    names = [*(["simulated"] if simulated else []), "hand", *sorted(entry_points(group="padforge.arms").names)]
    if name not in names:
        raise InputError(f"--rig is {name!r}, allowed are {', '.join(dict.fromkeys(names))}")


@click.command()
@rig_option
@click.option(
    "--morphology",
    type=FILE,
    help="morphology.json or published .mat (default: the twin's, or straight fibres; with a real rig, beside --out).",
)
@click.option("--twin", type=FILE, help="twin.json of a measured pad; the simulated pad responds like it.")
@common.setting_option("--presses", _RIG_SETTINGS, int, "Presses to record.")
@common.setting_option(
    "--plan", _RIG_SETTINGS, str, "Positions: uniform, grid, serpentine, adaptive, or a .csv of x_mm,y_mm,depth_mm."
)
@click.option("--model", type=FOLDER, help="Localizer of an adaptive plan, which presses where it is least certain.")
@click.option("--dry-run", is_flag=True, help="Move through the whole plan above the pad without touching it.")
@click.option("--resume", is_flag=True, help="Continue an unfinished recording.")
@click.option("--mcap", is_flag=True, help="At the end, export to OUT.mcap as well, for ROS 2 and Foxglove.")
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
    mcap: bool,
    seed: int | None,
    spec: Path | None,
    out: Path | None,
) -> None:
    """Record presses on a pad. They go into the folder `recording` beside its morphology.

    \b
    padforge sense record --morphology out/pad/morphology.json --presses 1500

    \b
    --rig simulated             a simulated pad, at once: to rehearse
    --rig ur5, --rig printer    a UR robot or a 3D printer, and the board, as set in [rig]
    --rig hand                  you and the board: a page and the terminal show where to press

    --twin twin.json, which identify writes, makes the simulated pad respond like the measured one: paths of the fibres,
    wiring, pose, gain and noise. With --morphology as well, the fibres are those of that plan, and only the sensitivity
    profile, gain and noise are the twin's.

    An interrupted recording keeps every finished press; --resume records the others.
    --mcap exports it once it is complete, beside the folder (pip install '.[formats]').
    Software is not the emergency stop: keep the robot's own one within reach.
    """
    from padforge.design.contact import describe_large_strain
    from padforge.design.settings import PadSettings, read_contact
    from padforge.design.twin import Twin
    from padforge.sense.recording.press_plan import deepest_contact, planned_depths_mm
    from padforge.sense.rig import operation
    from padforge.sense.rig.config import RigConfig
    from padforge.sense.rig.devices import check_platform
    from padforge.sense.settings import read_rig

    check_rig(rig)
    settings, folder = common.load_spec(spec), common.pad_folder(morphology or twin)
    target = out or folder / "recording"
    simulated = rig == "simulated"
    if twin and not simulated:
        raise InputError("--twin is of the simulated pad, allowed with --rig simulated")
    twin_model = Twin.load(twin) if twin else None
    if not (simulated or morphology):
        morphology = target.parent / "morphology.json"  # a real pad has no default
        if not morphology.is_file():
            raise InputError(f"--morphology is needed, of the pad under the arm: there is none at {morphology}")
        folder = common.pad_folder(morphology)
    pad = _load_pad(morphology, settings.section(PadSettings))
    bag = _bag_path(target, dry_run, resume) if mcap else None
    inputs = [path for path in (morphology, twin, spec) if path is not None]
    overrides = {"presses": presses, "plan": plan, "seed": seed}
    options, contact = read_rig(settings, **overrides), read_contact(settings)
    operation.check_press_depths(pad, options, contact, folder)
    if simulated:
        if resume or dry_run or model:
            raise InputError("--resume, --dry-run and --model need a real rig")
        if plan == "adaptive":
            raise InputError("--plan is adaptive, which needs a real rig")
        deepest = deepest_contact(contact, planned_depths_mm(options))
        if twin_model is None and (notice := describe_large_strain(deepest)):
            _warn(notice)
        pressed = twin_model if twin_model and not morphology else pad
        if twin_model and morphology and (ignored := twin_model.ignored_effects()):
            _warn(f"{twin}: {ignored}")
        recording = operation.record_simulated(settings, pressed, target, overrides, inputs, twin_model)
    else:
        check_platform()
        inputs += [] if options.plan_file is None else [options.plan_file]
        command = f"padforge sense record --rig {rig}"
        pad_settings = settings.section(PadSettings, **pad.layout.settings)
        config = RigConfig(pad, contact, options, target, command, inputs, pad_settings, folder)
        recording = _record_with(rig, config, model, dry_run, resume)
    common.echo("dry run: every pose reached, nothing kept" if recording is None else recording_line(recording, target))
    if bag is not None and recording is not None:
        from padforge.sense.formats.import_export import arm_states, export_file

        export_file(recording, bag, states=arm_states(target))
        common.echo(f"{target} -> {bag}")


def _bag_path(target: Path, dry_run: bool, resume: bool) -> Path:
    """Return the path of the bag of a recording; raise InputError if it cannot be written."""
    from padforge.sense.formats.ros_recording import load_typestore

    if dry_run:
        raise InputError("--mcap exports what is recorded, and --dry-run keeps nothing")
    named = target if target.name.strip(".") else target.resolve()  # "." and ".." have no name
    path = named.with_name(f"{named.name}.mcap")
    load_typestore(f"{path}: MCAP")
    if path.exists() and not resume:
        raise InputError(f"{path}: exists, recordings are never written over; choose another --out")
    return path


def _load_pad(morphology: Path | None, pad_settings: "PadSettings") -> "Morphology":
    from padforge.design.morphology import Morphology

    return Morphology.load(morphology) if morphology else Morphology.straight(pad_settings.layout)


def _record_with(rig: str, config: "RigConfig", model: Path | None, dry_run: bool, resume: bool) -> "Recording | None":
    """Record with an arm, or by hand."""
    from padforge.sense.recording.run_directory import START
    from padforge.sense.rig import operation

    if resume and not (config.out / START).exists():
        _warn(f"{config.out}: nothing to resume, a new recording begins")
        resume = False
    if rig == "hand":
        if dry_run or model:
            raise InputError("--dry-run and --model need an arm, allowed with --rig hand are --plan and --resume")
        return _record_by_hand(config, resume)
    with common.progress_bar("presses") as show:
        return operation.record(rig, config, model=model, dry=dry_run, resume=resume, on_progress=show)


def _record_by_hand(config: "RigConfig", resume: bool) -> "Recording":
    """Record by hand, with the view and the commands on a page, and in a terminal if there is one."""
    from padforge.sense.live.outputs import LivePage
    from padforge.sense.rig.by_hand import COMMANDS, pad_view, record_by_hand, view_lines
    from padforge.sense.rig.operation import make_board

    commands = {row["key"]: row["command"] for row in COMMANDS}
    pad = pad_view(config.pad, str(config.out), bool(config.rig.mirrored))
    latest: dict[str, Any] = {}
    with ExitStack() as stack:
        board = stack.enter_context(closing(make_board(config.rig, config.rig.inputs(len(config.pad.knots)))))
        page = stack.enter_context(LivePage(0, "hand.html", commands.values()))
        _warn(f"page: {page.url} (q ends)")
        draw, typed = stack.enter_context(redrawn_lines()), stack.enter_context(typed_keys())

        @stack.push
        def show_end(kind: object, error: BaseException | None, trace: object) -> None:
            if latest:  # the session has begun
                page.show(latest | {"ended": str(error or "") or "ended"})

        def show(view: dict[str, Any]) -> None:
            if draw is None and view["message"] != latest.get("message", ""):
                common.echo(view["message"])
            if draw is not None and view["phase"] == "lift" and latest.get("phase") != "lift":
                click.echo("\a", nl=False)  # a sound, since the person looks at the pad
            latest.update(pad | view)
            page.show(dict(latest))
            if draw is not None:
                draw(view_lines(latest))

        def poll_commands() -> list[str]:
            return [*page.read_commands(), *(commands[key] for key in typed() if key in commands)]

        return record_by_hand(config, board, show, poll_commands, resume)


@click.command()
@click.option(
    "--rig",
    metavar="NAME",
    default="hand",
    show_default=True,
    help="hand (the board), ur5, printer, or an installed arm.",
)
@click.option("--morphology", type=FILE, help="Pad whose fibres are examined (default: all inputs that are named).")
@common.spec_option
@common.json_option
def doctor(rig: str, morphology: Path | None, spec: Path | None, as_json: bool) -> int:
    """Examine the rig before a long run; nothing moves. Exit 1 if something fails.

    \b
    padforge sense doctor --rig ur5

    Ports, versions, rates, latency, and the level at rest and the noise of every channel. Channels count from 1, as
    fibres do, inputs as they are printed on the board. Without --morphology, the inputs that [rig] channels names, or
    all, are examined.
    """
    from dataclasses import asdict

    from padforge.design.settings import PadSettings, read_contact
    from padforge.sense.rig.config import RigConfig
    from padforge.sense.rig.devices import check_platform
    from padforge.sense.rig.operation import diagnose
    from padforge.sense.settings import read_rig

    check_rig(rig, simulated=False)
    check_platform()
    settings = common.load_spec(spec)
    pad, options = _load_pad(morphology, settings.section(PadSettings)), read_rig(settings)
    inputs = options.inputs(len(pad.knots)) if morphology else options.channels
    contact, folder = read_contact(settings), common.pad_folder(morphology)
    config = RigConfig(pad, contact, options, Path(), "padforge sense doctor", folder=folder)
    diagnoses = diagnose(rig, config, inputs)
    passed = all(diagnosis.status != "fail" for diagnosis in diagnoses)
    lines = [f"{diagnosis.status:<4} {diagnosis.name}: {diagnosis.message}" for diagnosis in diagnoses]
    rows = [asdict(diagnosis) for diagnosis in diagnoses]
    common.show_result({"passed": passed, "diagnoses": rows}, lines, as_json)
    return int(not passed)
