"""`padforge design edit`: fibres drawn by hand in a browser, and what is told of them at once."""

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
from padforge.design.common.command_line import force_option, load_spec, out_option, pad_folder, spec_option

PORT = 8322
_LOOK_S = 0.2
"""Between two looks for Ctrl-C where the system does not wake a thread that waits."""


@click.command()
@click.argument("pad", required=False, type=click.Path(path_type=Path))
@spec_option
@out_option(what="Morphology to write when it is saved", file=True)
@force_option
@click.option("--port", type=click.IntRange(0, 65_535), default=PORT, show_default=True, help="Of the page; 0: any.")
def edit(pad: Path | None, spec: Path | None, out: Path | None, force: bool, port: int) -> None:
    """Draw fibres in a browser of this machine, and see at once which rules they break and where presses are confused.

    \b
    padforge design edit out/pad/morphology.json     saves beside it, to out/pad/morphology-edited.json
    padforge design edit                             the straight pad of pad.toml, into out/pad/edited.json
    padforge design edit published.mat --out mine.json

    Knots are dragged, or chosen with Tab and moved with the arrow keys. Saving (Ctrl+S in the page) replaces no file
    that was there before but the one that --out names. Ctrl-C here ends it.
    """
    from padforge.design.common.errors import InputError
    from padforge.design.common.files import refuse_unwritable
    from padforge.design.common.page.local_page.local_page import LocalPage, page_text
    from padforge.design.pad.morphology import Morphology
    from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

    from .editor.answers import Answers
    from .editor.session import Session

    out = out or _free(pad)
    if out.suffix.lower() != ".json":
        raise InputError(f"--out is {out}, allowed is a name that ends in .json")
    refuse_unwritable(out.parent)
    settings = load_spec(spec)
    layout = settings.section(PadSettings).layout if pad is None else Morphology.load(pad).layout
    size = settings.section(PadSettings, **layout.settings)
    judged = Answers(size, settings.section(RulesSettings), settings.section(Contact), settings.section(SearchSettings))
    text = page_text("padforge.design.cli.editor", "editor.html", "editor.css", "drawing.js", "editor.js")
    with ExitStack() as stack:
        session = Session(judged, pad, out, lambda view: page.show(view), force)
        page = LocalPage(port, text, {"/edit": session.edit, "/save": session.save})
        stack.enter_context(page)
        click.echo(
            f"page: {page.url} (Ctrl-C ends), saves to {out}{' in place of what it has' * out.exists()}", err=True
        )
        stack.push(lambda *error: _end(session))
        session.begin()
        while True:
            time.sleep(_LOOK_S)


def _end(session: Any) -> None:
    session.end()
    if session.unsaved:
        click.echo("what was drawn since the last save is not kept", err=True)


def _free(pad: Path | None) -> Path:
    """The first name beside a pad that no file has."""
    folder, stem = pad_folder(pad), "edited" if pad is None else f"{pad.stem}-edited"
    from .editor.session import free_name

    return free_name(folder / f"{stem}.json")
