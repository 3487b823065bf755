"""Shared parts of the command lines: common options, progress on stderr, results on stdout, exit codes."""

import atexit
import functools
import json
import logging
import math
import os
import signal
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from itertools import zip_longest
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from padforge.common.validation import Fault, InputError, missing_extra, printable

if TYPE_CHECKING:
    from rich.progress import Progress

    from padforge.common.settings import Spec

    from .progress import OnProgress

spec_option = click.option(
    "--spec",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Settings file (default: pad.toml in the current folder, if there is one).",
)
scheduler_option = click.option(
    "--scheduler", metavar="ADDRESS", help="Dask scheduler to run on. Trust it: it can execute code on this machine."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on stdout.")
seed_option = click.option(
    "--seed", type=click.IntRange(0, 2**32 - 1), help="Seed of every random choice (default: that of the settings, 0)."
)
force_option = click.option(
    "--force", is_flag=True, help="Replace files even if others in the folder were made from them."
)


def out_option(
    default: str = "", what: str = "Folder for the results", file: bool = False, place: str = "in the folder of the pad"
) -> Callable[..., Any]:
    """Make the option `--out` for a folder or a file; its help names the `default`, or the `place` that is chosen."""
    return click.option(
        "--out",
        type=click.Path(file_okay=file, dir_okay=not file, path_type=Path),
        default=default or None,
        help=f"{what} (default: {default or place}).",
    )


class FiniteRange(click.FloatRange):
    """A range of finite numbers; click's own accepts NaN and infinity."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"got {value!r}, expected a finite number", param, ctx)
        return number


def setting_option(name: str, section: str, kind: Any, text: str) -> Callable[..., Any]:
    """Return an option that overrides the setting of its name and is checked when the command line is parsed.

    `section` is the model of the setting, as `module:class`, which is imported when the option is used.
    """

    def check(context: click.Context, param: click.Parameter, value: Any) -> Any:
        if value is not None:
            try:
                resolve_name(section)(**{str(param.name): value})
            except InputError as error:
                raise click.BadParameter(str(error).partition(": ")[2]) from error
        return value

    return click.option(name, type=kind, callback=check, help=text)


class SectionedGroup(click.Group):
    """A group whose help lists its commands under headings, in the order in which they were added."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self._headings: dict[str, str] = {}
        super().__init__(*arguments, **options)

    def add_command(self, cmd: click.Command, name: str | None = None, heading: str = "Commands") -> None:
        super().add_command(cmd, name)
        self._headings[name or cmd.name or ""] = heading

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, self._headings))
        limit = formatter.width - 6 - width  # click's indent, gap and margin
        for heading in dict.fromkeys(self._headings.values()):
            commands = [(name, self.commands[name]) for name in self._headings if self._headings[name] == heading]
            rows = [(name.ljust(width), command.get_short_help_str(limit)) for name, command in commands]
            with formatter.section(heading):
                formatter.write_dl(rows)


def pad_folder(source: Path | None = None) -> Path:
    """Return the default folder for results: that of `source`, a folder or .json; out/NAME for another file NAME.*."""
    if source is None:
        return Path("out/pad")
    if source.is_dir() or source.suffix.lower() == ".json":
        return source.parent if source.name not in ("", "..") else source.resolve().parent
    return Path("out") / source.stem


def profile_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the option `--profile` to a command."""

    @click.option("--profile", is_flag=True, help="Print to stderr where time went and what was skipped.")
    @functools.wraps(command)
    def with_profile(*arguments: Any, profile: bool, **options: Any) -> Any:
        if not profile:
            return command(*arguments, **options)
        from .profiling import profiled

        with profiled() as result:
            try:
                return command(*arguments, **options)
            finally:
                click.echo("\n".join(result.lines()), err=True)

    return with_profile


class SettingsFile(NamedTuple):
    """What `load_spec` checks in a settings file; the object of click's root context."""

    sections: Collection[str]  # names of the allowed sections
    check: "Callable[[Spec], None]"  # raises InputError if sections contradict each other


def load_spec(path: Path | None) -> "Spec":
    """Load and check the settings at `path`; by default pad.toml of the current folder, or the default settings."""
    from padforge.common.settings import Spec

    default, context = Path("pad.toml"), click.get_current_context(silent=True)
    file: SettingsFile | None = context.find_root().obj if context else None
    spec = Spec.load(path or (default if default.exists() else None), file.sections if file else None)
    if file:
        file.check(spec)
    return spec


@contextmanager
def progress() -> Iterator["Progress"]:
    """Show progress bars on stderr if it is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    err = Console(stderr=True)
    name, note = TextColumn("{task.description:<12}"), TextColumn("{task.fields[note]}")
    with Progress(name, BarColumn(), note, TimeElapsedColumn(), console=err, disable=not err.is_terminal) as bar:
        yield bar


@contextmanager
def progress_bar(name: str) -> Iterator["OnProgress"]:
    with progress() as bar:
        task = bar.add_task(name, total=None, note="")

        def show(done: int, total: int, what: str) -> None:
            count = f"{done} of {total}  " if total else ""
            bar.update(task, completed=done, total=total or None, note=count + what)

        yield show


def echo(line: str, err: bool = False) -> None:
    """Print a line, on stderr if `err`; characters that are not printable are escaped."""
    click.echo(printable(line), err=err)


def show_result(document: dict[str, Any], lines: list[str], as_json: bool) -> None:
    """Print the machine-readable result or its summary for people, both on stdout."""
    click.echo(json.dumps(document, indent=1) if as_json else "\n".join(map(printable, lines)))


def text_table(rows: Sequence[Sequence[str]], text_columns: Collection[int] = (0,)) -> list[str]:
    """Format cells in aligned columns, a line per row, numbers right-aligned; missing cells of short rows are "-"."""
    columns = []
    for number, column in enumerate(zip_longest(*rows, fillvalue="-")):
        width = max(map(len, column))
        columns.append([cell.ljust(width) if number in text_columns else cell.rjust(width) for cell in column])
    return ["  ".join(row) for row in zip(*columns, strict=True)]


class _StderrHandler(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        # click.echo would bypass the sys.stderr of a progress bar and write into the bar.
        print(printable(self.format(record)), file=sys.stderr)


_HANDLER = _StderrHandler()
INTERRUPTED = 130  # exit code after Ctrl-C, as of shells


def run_to_end(command: click.Command, name: str, extras: Mapping[str, str]) -> int:
    """Run a command line with the arguments of this process, and return the exit code; errors are one line on stderr.

    `extras` are the extras of padforge that each subcommand needs, by its name; other subcommands need all of these.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # file names may not be valid text
    for signal_name in {"SIGTERM", "SIGHUP"} & set(dir(signal)):
        number = getattr(signal, signal_name)
        if signal.getsignal(number) is signal.SIG_DFL:  # otherwise it is ignored, as under nohup
            signal.signal(number, signal.default_int_handler)  # clean up as after Ctrl-C
    logger = logging.getLogger("padforge")
    logger.setLevel(logging.INFO)
    logger.addHandler(_HANDLER)  # has no effect if it was added before
    code = _run(command, name, extras)
    atexit.register(_end_with_tasks, code)
    return code


def _end_with_tasks(code: int) -> None:
    """End this process at once if tasks are running: they cannot be stopped, and torch would crash in the clean-up."""
    parallel = sys.modules.get(f"{__package__}.parallel")
    if parallel is not None and parallel.active_threads:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)


def _run(command: click.Command, name: str, extras: Mapping[str, str]) -> int:
    try:
        return command.main(standalone_mode=False, prog_name=name) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        return 2
    except (click.exceptions.Abort, KeyboardInterrupt) as error:
        message = str(error if isinstance(error, KeyboardInterrupt) else error.__cause__ or "")
        return _fail(name, f"interrupted; {message or 'what was finished is kept'}", INTERRUPTED)
    except click.MissingParameter as error:
        text = getattr(error.param, "help", None)
        return _fail(name, error.format_message() + (f" {text}" if text else ""))
    except click.ClickException as error:
        return _fail(name, error.format_message())
    except (InputError, Fault) as error:
        return _fail(name, str(error), error.exit_code)
    except OSError as error:
        return _fail(name, f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except ModuleNotFoundError as error:
        every = ",".join(dict.fromkeys(",".join(extras.values()).split(",")))
        message = missing_extra(error, extras.get("".join(sys.argv[1:2]), every))
        if message is None:
            raise
        return _fail(name, message)
    except MemoryError as error:
        return _fail(name, f"out of memory ({error})" if str(error) else "out of memory")


def _fail(name: str, message: str, code: int = 2) -> int:
    with suppress(OSError):  # if stderr is a file on a full disk, the exit code must suffice
        print(f"{name}: {printable(' '.join(message.split()))}", file=sys.stderr)
    return code
