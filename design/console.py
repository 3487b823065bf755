"""What every stage's command line shares: the settings file, progress on stderr, results on stdout."""

import functools
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.progress import Progress

    from .settings import Spec

spec_option = click.option(
    "--spec",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Settings file (default: pad.toml in the current folder, if there is one).",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on stdout.")
seed_option = click.option("--seed", type=click.IntRange(0, 2**32 - 1), help="Seed of every random choice.")


def out_option(default: str) -> Callable[..., Any]:
    """`--out DIR`, the folder results go to."""
    return click.option(
        "--out",
        type=click.Path(file_okay=False, path_type=Path),
        default=default,
        show_default=True,
        help="Folder for the results.",
    )


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
    """The settings file named, else `pad.toml` here if there is one, else the defaults."""
    from .settings import Spec

    here = Path("pad.toml")
    return Spec.load(path or (here if here.exists() else None))


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
