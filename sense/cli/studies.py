"""`padforge study ...`: the paper's figures and tables for any pads, and beyond."""

import math
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.common import command_line as common
from padforge.common.validation import InputError
from padforge.sense.cli.options import fibre_indices, fibres_option, max_failures_option

if TYPE_CHECKING:
    from padforge.common.settings import Spec
    from padforge.design.morphology import Morphology
    from padforge.design.settings import Contact
    from padforge.sense.studies.press_model import PressModel
    from padforge.sense.studies.study import Study


DEFAULT_PADS = ("square", "random-5", "optimised")


@click.group()
def study() -> None:
    """Reproduce the paper's figures and tables for your own pads.

    \b
    padforge study robustness                          three pads: square grid,
                                                       random and optimised
    padforge study robustness square out/pad/morphology.json
    padforge study scaling --jobs 2 --out out/study

    A PAD is a morphology.json, a published .mat, `square`, `random-N` (N knots a fibre), `optimised` or `optimised-N`
    (result of a short search) or `genetic-N` (of the published search), as large as [pad] says; `square@8` has a grid
    of 8.
    Each study writes NAME.json, NAME.csv, NAME.png and NAME.md.
    """


def _command(name: str, argument: str = "PAD") -> Callable[..., Any]:
    """Return a decorator that makes a command, with the options of all studies, of a function that returns a study."""

    def decorate(make: "Callable[..., Study]") -> click.Command:
        @wraps(make)
        def command(
            names: tuple[str, ...],
            seed: int | None,
            jobs: int | None,
            scheduler: str | None,
            out: Path,
            as_json: bool,
            **options: Any,
        ) -> None:
            from padforge.common.files import check_writable
            from padforge.common.parallel import cluster
            from padforge.sense.studies.study import run, study_lines

            check_writable(out)
            try:
                with common.progress_bar(name) as show:
                    show(0, 0, "pads")
                    study = make(names, seed=seed or 0, **options)
                    with cluster(scheduler) as executor:
                        document = run(study, out, jobs=jobs, executor=executor, on_progress=show)
            except KeyboardInterrupt as error:
                raise KeyboardInterrupt("nothing is written") from error
            common.show_result(document, [*study_lines(document), "", f"{name} -> {out / name}.png"], as_json)

        options = (
            click.argument("names", metavar=f"[{argument}]...", nargs=-1),
            common.seed_option,
            click.option("--jobs", type=click.IntRange(1, 256), help="Parallel tasks (default: one a core)."),
            common.scheduler_option,
            common.out_option("out/study"),
            common.json_option,
        )
        for option in reversed(options):
            command = option(command)
        return study.command(name)(command)

    return decorate


def _pads(
    names: tuple[str, ...], seed: int, settings: "Spec", default: tuple[str, ...] = DEFAULT_PADS
) -> "dict[str, Morphology]":
    from padforge.design.settings import PadSettings
    from padforge.sense.studies.study import load_pads

    return load_pads(names or default, seed, settings.section(PadSettings).layout)


def _press_model(settings: "Spec") -> "PressModel":
    """Return the stated contact with the scatter of the settings, or those of the paper if no contact is stated."""
    from padforge.design.settings import SearchSettings
    from padforge.sense.studies.press_model import PressModel

    contact = _stated_contact(settings)
    return PressModel(contact, settings.section(SearchSettings).response_scatter) if contact else PressModel()


def _stated_contact(settings: "Spec") -> "Contact | None":
    """Return the stated contact, if any; print a line on stderr if it strains the silicone too much."""
    from padforge.design.contact import describe_large_strain
    from padforge.design.settings import Contact, read_contact

    if not settings.stated(Contact):
        return None
    contact = read_contact(settings)
    if notice := describe_large_strain(contact):
        common.echo(notice, err=True)
    return contact


def _check_square(context: click.Context, param: click.Parameter, value: int) -> int:
    if math.isqrt(value) ** 2 != value:
        raise click.BadParameter(f"got {value}, allowed is a square number from 4")
    return value


@_command("robustness")
@max_failures_option
@click.option(
    "--signals",
    "rule",
    type=click.Choice(["published", "exact"]),
    default="published",
    show_default=True,
    help="Fibres sampled as in the paper, or exact.",
)
@click.option(
    "--presses",
    type=click.IntRange(4),
    default=1024,
    show_default=True,
    callback=_check_square,
    help="Training presses, a square number.",
)
@fibres_option("--failed", "Also map errors without these fibres, numbered from 1, such as 6,7,8.")
@common.spec_option
def robustness(
    names: tuple[str, ...], *, seed: int, spec: Path | None, failed: tuple[int, ...], **options: Any
) -> "Study":
    """Errors by number of failed fibres (figures 3 to 5). Means are over all sets of them. Error maps without the worst
    set of each size, and without the fibres of --failed, are drawn, and their change from the map with all fibres.

    \b
    padforge study robustness square random-5 --max-failures 2

    \b
    Figures 3 and 4, errors by method, number of knots and failed fibres:
    padforge study robustness square random-5 optimised-1 optimised-3 optimised-5 genetic-1 genetic-3 genetic-5

    For recordings of a built pad (figures 13 and 14) see `padforge sense fibre-loss`.
    """
    from padforge.sense.studies.robustness import robustness_study

    settings = common.load_spec(spec)
    contact = _stated_contact(settings)
    pads = _pads(names, seed, settings)
    options["failed"] = fibre_indices(failed, min(pad.layout.fibres for pad in pads.values()))
    return robustness_study(pads, seed=seed, contact=contact, **options)


@_command("scaling")
@click.option("--grids", metavar="N,N,...", help="Sizes of the surfaces (default: 1, 2, 4, ... 32 tiles a side).")
@common.spec_option
def scaling(names: tuple[str, ...], *, seed: int, grids: str | None, spec: Path | None) -> "Study":
    """Larger surfaces, tiled with the pads (figures 7 and 8).

    The contact is the paper's, or what [contact] states; under a layer responses scatter by [search].

    \b
    padforge study scaling optimised --grids 4,16,64
    """
    from padforge.sense.studies.scaling import MAX_GRID, scaling_study

    try:
        sizes = tuple(sorted({int(part) for part in grids.split(",")})) if grids is not None else ()
    except ValueError:
        sizes = (0,)
    if sizes and not 2 <= sizes[0] <= sizes[-1] <= MAX_GRID:
        raise InputError(f"--grids is {grids!r}, expected numbers from 2 to {MAX_GRID} with commas between them")
    settings = common.load_spec(spec)
    pads = _pads(names, seed, settings, ("square", "optimised"))
    return scaling_study(pads, grids=sizes, press_model=_press_model(settings), seed=seed)


@_command("multicontact")
@common.spec_option
def multicontact(names: tuple[str, ...], *, seed: int, spec: Path | None) -> "Study":
    """Number and positions of contacts at once (figure 9). The order of two contacts does not count.

    The contact is the paper's, or what [contact] states; under a layer responses scatter by [search].

    \b
    padforge study multicontact square
    """
    from padforge.sense.studies.multicontact import multicontact_study

    settings = common.load_spec(spec)
    return multicontact_study(_pads(names, seed, settings), press_model=_press_model(settings), seed=seed)


@_command("drift", "PAD_OR_RECORDING")
def drift(names: tuple[str, ...], *, seed: int) -> "Study":
    """Filters and drift compensation (figure 12, table III). The methods run on simulated pads and on recordings.

    \b
    padforge study drift out/pad/recording
    """
    from padforge.sense.formats.import_export import is_recording
    from padforge.sense.studies.drift import drift_study
    from padforge.sense.studies.study import load_pads, load_recordings

    names = names or DEFAULT_PADS
    recordings = [name for name in names if is_recording(Path(name))]
    pads = [name for name in names if name not in recordings]
    return drift_study(load_pads(pads, seed), load_recordings(recordings), seed=seed)


def _add_study(name: str, module: str, text: str, example: str) -> None:
    """Add the command of a study without further options; its help shows it with the pads `example`."""

    def make(names: tuple[str, ...], *, seed: int, spec: Path | None = None) -> "Study":
        from padforge.design.settings import read_contact

        make_study = getattr(import_module(f"padforge.sense.studies.{module}"), f"{name}_study")
        settings = common.load_spec(spec)
        return make_study(_pads(names, seed, settings), seed=seed, contact=read_contact(settings))

    make.__doc__ = f"{text}\n\n\b\npadforge study {name} {example}"
    _command(name)(common.spec_option(make))


_sensitivity = """Tools and depths other than in training (figure 6).

Radius and depth are 0.5, 1 and 1.5 times those that [contact] states. If [contact] is a shape, as in the preset
`published`, the objects are the polygons of the paper, of radius K in grid units and with D sides."""
_force = "Depth and force of a press, from the signals. A tool presses the layer of [contact]."
_shape = "Which object was pressed, from the signals. Objects are a dome, a ball, a finger and a flat end."
_strokes = "Follow a finger that slides over simulated pads. The localizers are trained on single presses of them."
_add_study("strokes", "strokes", _strokes, "optimised")
_add_study("sensitivity", "sensitivity", _sensitivity, "square")
_add_study("force", "indentation", _force, "square random-5")
_add_study("shape", "indentation", _shape, "random-5")
