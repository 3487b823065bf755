"""What every stage's command line shares: the settings file, progress on stderr, results on stdout."""

import atexit
import functools
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.design.common.validation import Fault, InputError, missing_extra

if TYPE_CHECKING:
    from rich.progress import Progress

    from .settings import Spec

spec_option = click.option(
    "--spec",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Settings file (default: pad.toml in the current folder, if there is one).",
)
scheduler_option = click.option(
    "--scheduler", metavar="ADDRESS", help="Work on a Dask cluster, trusted wholly: what it sends runs here."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on stdout.")
seed_option = click.option(
    "--seed", type=click.IntRange(0, 2**32 - 1), help="Seed of every random choice (default: that of the settings, 0)."
)

force_option = click.option("--force", is_flag=True, help="Replace files that others in the folder were made from.")


def out_option(default: str = "", what: str = "Folder for the results", file: bool = False) -> Callable[..., Any]:
    """`--out`, the folder (or file) results go to: unless `default` names one, a command takes that of `pad_folder`."""
    return click.option(
        "--out",
        type=click.Path(file_okay=file, dir_okay=not file, path_type=Path),
        default=default or None,
        help=f"{what} (default: {default or 'in the folder of the pad'}).",
    )


def pad_folder(source: Path | None = None) -> Path:
    """The one rule for where results go that no `--out` says: to the folder of the pad they belong to.

    Args:
        source: what a command is given. A morphology.json or a recording's folder lies in the folder of its pad; a file
            from elsewhere, NAME.mat, makes one of its own, out/NAME; without any it is out/pad.
    """
    if source is None:
        return Path("out/pad")
    if source.is_dir() or source.suffix.lower() == ".json":
        return source.parent if source.name not in ("", "..") else source.resolve().parent
    return Path("out") / source.stem


def profile_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """`--profile`: at the command's end, say on stderr where time went and what was skipped."""

    @click.option("--profile", is_flag=True, help="Say on stderr where time went and what was skipped.")
    @functools.wraps(command)
    def noted(*arguments: Any, profile: bool, **options: Any) -> Any:
        if not profile:
            return command(*arguments, **options)
        from .profiling import profiled

        with profiled() as found:
            try:
                return command(*arguments, **options)
            finally:
                click.echo("\n".join(found.lines()), err=True)

    return noted


def load_spec(path: Path | None) -> "Spec":
    """The settings file named, else `pad.toml` here if there is one, else the defaults.

    Sections are those that the front door has put into its context, or any.
    """
    from .settings import Spec

    here, context = Path("pad.toml"), click.get_current_context(silent=True)
    return Spec.load(path or (here if here.exists() else None), context.find_root().obj if context else None)


@contextmanager
def progress() -> Iterator["Progress"]:
    """A progress display on stderr; silent where stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    err = Console(stderr=True)
    name, note = TextColumn("{task.description:<12}"), TextColumn("{task.fields[note]}")
    with Progress(name, BarColumn(), note, TimeElapsedColumn(), console=err, disable=not err.is_terminal) as bar:
        yield bar


def show_result(document: dict[str, Any], lines: list[str], as_json: bool) -> None:
    """Print the machine-readable result or its summary for people, both on stdout."""
    click.echo(json.dumps(document, indent=1) if as_json else "\n".join(lines))


INTERRUPTED = 130


def run_to_end(command: click.Command, name: str, extras: Mapping[str, str]) -> int:
    """Run a command line on the arguments of this process; its exit code, with one line on stderr where it failed.

    The process is to end with that code, and does so at once where tasks are left at work by then.

    Args:
        extras: what has to be installed for its commands, by the first word of each; for others it is all of these.
    """
    _prepare()
    code = _run(command, name, extras)
    atexit.register(_leave_tasks, code)
    return code


def _leave_tasks(code: int) -> None:
    """End this process if tasks are at work: they can neither be told to stop nor be waited for.

    Where the interpreter ends under them, those in torch crash it.
    """
    computing = sys.modules.get(f"{__package__}.parallel")
    if computing is not None and computing.DaemonThreads.at_work:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)


def _run(command: click.Command, name: str, extras: Mapping[str, str]) -> int:
    try:
        _require_words(sys.argv[1:])
        return command.main(standalone_mode=False, prog_name=name) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        return 2
    except (click.exceptions.Abort, KeyboardInterrupt) as error:
        told = str(error if isinstance(error, KeyboardInterrupt) else error.__cause__ or "")
        return _fail(name, f"interrupted; {told or 'what was finished is kept'}", INTERRUPTED)
    except click.ClickException as error:
        return _fail(name, error.format_message(), 2)
    except InputError as error:
        return _fail(name, str(error), 2)
    except Fault as fault:
        return _fail(name, str(fault), fault.exit_code)
    except OSError as error:
        return _fail(name, f"{error.filename}: {error.strerror}" if error.filename else str(error), 2)
    except ModuleNotFoundError as error:
        message = missing_extra(error, extras.get("".join(sys.argv[1:2]), ",".join(dict.fromkeys(extras.values()))))
        if message is None:
            raise
        return _fail(name, message, 2)
    except MemoryError as error:
        return _fail(name, f"this takes more memory than there is ({error or 'no more is given'})", 2)


def _prepare() -> None:
    """Let names that are no text be printed, and an end from outside clear up as Ctrl-C does."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    for ending in {"SIGTERM", "SIGHUP"} & set(dir(signal)):
        number = getattr(signal, ending)
        if signal.getsignal(number) is signal.SIG_DFL:  # else it is ignored, as under nohup
            signal.signal(number, signal.default_int_handler)


def _require_words(words: list[str]) -> None:
    """Refuse what no shell can hand over, but a caller from Python can: such names would trip whatever opens them."""
    for word in words:
        try:
            odd = b"\0" in os.fsencode(word)
        except UnicodeEncodeError:
            odd = True
        if odd:
            raise InputError(f"{word!r}: holds characters that no argument can have")


def _fail(name: str, message: str, code: int) -> int:
    with suppress(OSError):  # of a disk that is full: the exit code says the same
        print(f"{name}: {_plain(' '.join(message.split()))}", file=sys.stderr)
    return code


def _plain(text: str) -> str:
    """A text whose control characters are written out: what a file has them for is to order terminals about."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)
