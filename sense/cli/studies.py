"""`padforge study ...`: the paper's figures and tables for any pads, carried further."""

import os
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.design.common import command_line as common
from padforge.design.common.validation import InputError

if TYPE_CHECKING:
    from padforge.design.morphology import Morphology
    from padforge.sense.studies.study import Study


DEFAULT_PADS = ("square", "random-5", "optimised")


@click.group()
def study() -> None:
    """Reproduce the paper's figures and tables for pads of your own, and go beyond them.

    \b
    padforge study robustness                              square grid, a random pad and an optimised one
    padforge study robustness square out/pad/morphology.json
    padforge study scaling --jobs 2 --out out/study

    A PAD is a morphology.json, a published .mat, `square`, `random-N` (N knots a fibre), `optimised` or `optimised-N`
    (found by a short search) or `genetic-N` (found by the published one); `square@8` has a grid of 8.
    Each study writes NAME.json, NAME.csv, NAME.png and NAME.md. Broken off, it goes on with --resume.
    """


def _command(name: str, of: str = "PAD") -> Callable[..., Any]:
    """A study's command, of pads or what else `of` says: options that all have, and what is done with the study that
    the decorated function makes of the names given and the seed."""

    def decorate(make: "Callable[..., Study]") -> click.Command:
        @wraps(make)
        def command(
            names: tuple[str, ...],
            seed: int | None,
            jobs: int | None,
            scheduler: str | None,
            resume: bool,
            out: Path,
            as_json: bool,
            **options: Any,
        ) -> None:
            from padforge.design.common.files import check_writable
            from padforge.design.common.parallel import cluster
            from padforge.sense.studies.study import run, study_lines

            check_writable(out)
            with common.progress() as bar:
                task = bar.add_task(name, total=None, note="pads")
                made = make(names, seed=seed or 0, **options)

                def report(done: int, total: int, last: str) -> None:
                    bar.update(task, completed=done, total=total, note=f"{done} of {total}  {last}")

                try:
                    with cluster(scheduler) as executor:
                        document = run(made, out, jobs=jobs, executor=executor, resume=resume, progress=report)
                except KeyboardInterrupt:
                    bar.stop()
                    print("padforge: interrupted; --resume goes on from what was finished", file=sys.stderr, flush=True)
                    # At once: threads in the middle of their arithmetic cannot be told to stop, nor be waited for.
                    os._exit(common.INTERRUPTED)
            common.show_result(document, [*study_lines(document), "", f"{name} -> {out / name}.png"], as_json)

        options = (
            click.argument("names", metavar=f"[{of}]...", nargs=-1),
            common.seed_option,
            click.option("--jobs", type=click.IntRange(1, 256), help="Tasks at once (default: one a core)."),
            common.scheduler_option,
            click.option("--resume", is_flag=True, help="Go on where a study into the same folder was broken off."),
            common.out_option("out/study"),
            common.json_option,
        )
        for option in reversed(options):
            command = option(command)
        return study.command(name)(command)

    return decorate


def _pads(names: tuple[str, ...], seed: int, default: tuple[str, ...] = DEFAULT_PADS) -> "dict[str, Morphology]":
    from padforge.sense.studies.study import load_pads

    return load_pads(names or default, seed)


@_command("robustness")
@click.option(
    "--max-failures", type=click.IntRange(0, 8), default=3, show_default=True, help="Up to so many fibres lost at once."
)
@click.option(
    "--signals",
    "rule",
    type=click.Choice(["published", "exact"]),
    default="published",
    show_default=True,
    help="Fibres sampled as in the paper, or exact.",
)
@click.option("--presses", type=click.IntRange(4), default=1024, show_default=True, help="To train on, a square.")
@common.spec_option
def robustness(names: tuple[str, ...], *, seed: int, spec: Path | None, **options: Any) -> "Study":
    """Errors by number of lost fibres, over all sets of them, and maps before and after (figures 3, 4 and 5).

    \b
    padforge study robustness square random-5 --max-failures 2

    \b
    Figures 3 and 4, errors by method, number of knots and lost fibres:
    padforge study robustness square random-5 optimised-1 optimised-3 optimised-5 genetic-1 genetic-3 genetic-5

    For recordings of a built pad (figures 13 and 14) see `padforge sense fibre-loss`.
    """
    from padforge.design.settings import Contact
    from padforge.sense.studies.robustness import robustness_study

    settings = common.load_spec(spec)
    contact = settings.section(Contact) if settings.stated(Contact) else None
    return robustness_study(_pads(names, seed), seed=seed, contact=contact, **options)


@_command("sensitivity")
def sensitivity(names: tuple[str, ...], *, seed: int) -> "Study":
    """Objects of other sizes and shapes, and other ones in use than in training (figure 6).

    \b
    padforge study sensitivity square
    """
    from padforge.sense.studies.sensitivity import sensitivity_study

    return sensitivity_study(_pads(names, seed), seed=seed)


@_command("scaling")
@click.option("--grids", default="4,8,16,32,64,128", show_default=True, help="Sizes of the surfaces.")
def scaling(names: tuple[str, ...], *, seed: int, grids: str) -> "Study":
    """Larger surfaces, the pads repeated over them as tiles (figures 7 and 8).

    \b
    padforge study scaling optimised --grids 4,16,64
    """
    from padforge.sense.studies.scaling import scaling_study

    return scaling_study(_pads(names, seed, ("square", "optimised")), grids=_numbers(grids), seed=seed)


def _numbers(text: str) -> tuple[int, ...]:
    try:
        numbers = tuple(sorted({int(part) for part in text.split(",")}))
    except ValueError:
        numbers = ()
    if not numbers or not 2 <= numbers[0] <= numbers[-1] <= 256:
        raise InputError(f"grids is {text!r}, expected numbers from 2 to 256 with commas between them")
    return numbers


@_command("force")
def force(names: tuple[str, ...], *, seed: int) -> "Study":
    """Depth and force of a press from the signals that locate it, with a model of indentation.

    \b
    padforge study force square random-5
    """
    from padforge.sense.studies.indentation import force_study

    return force_study(_pads(names, seed), seed=seed)


@_command("shape")
def shape(names: tuple[str, ...], *, seed: int) -> "Study":
    """Which object was pressed, from the signals that locate it.

    \b
    padforge study shape random-5
    """
    from padforge.sense.studies.indentation import shape_study

    return shape_study(_pads(names, seed), seed=seed)


@_command("drift", of="PAD_OR_RECORDING")
def drift(names: tuple[str, ...], *, seed: int) -> "Study":
    """Denoising and drift compensation, on pads as simulated and on recordings; idle shares (figure 12, table III).

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


@_command("multicontact")
def multicontact(names: tuple[str, ...], *, seed: int) -> "Study":
    """Two contacts at once, whichever is named first, and how many there are (figure 9).

    \b
    padforge study multicontact square
    """
    from padforge.sense.studies.multicontact import multicontact_study

    return multicontact_study(_pads(names, seed), seed=seed)
