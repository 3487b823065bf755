"""`padforge sense live`: the edge where readings come in as they are taken and places are shown at once."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.design.common.command_line import json_option, load_spec, spec_option
from padforge.design.common.server import HOST
from padforge.sense.cli.options import redrawn_lines
from padforge.sense.cli.rig import rig_option

if TYPE_CHECKING:
    from padforge.sense.health.health_model import HealthModel
    from padforge.sense.live.outputs import Outlet
    from padforge.sense.live.pipeline import Event
    from padforge.sense.localizer.model import LocalizerModel
    from padforge.sense.rig.devices import Board
    from padforge.sense.rig.streams import Source

    Show = Callable[[dict[str, Any], Sequence[Event]], None]
    """Takes what there is to show, see `Live.view`, and what has just come to light."""

PORT = 8321
BAR = 12
"""Characters of a fibre's bar on a terminal, to either side."""


def _ways_out(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options that say to which other programs it is told as well, and from where they may listen."""
    options = (
        click.option("--tcp", type=click.IntRange(0, 65_535), help="Tell it in lines of JSON on this port; 0: any."),
        click.option("--osc", metavar="HOST:PORT", help="Tell it in Open Sound Control to this address."),
        click.option("--lsl", metavar="NAME", help="Tell it as streams of the Lab Streaming Layer, by this name."),
        click.option("--host", default=HOST, show_default=True, help="Of page and --tcp; for others with a --token."),
        click.option("--token", default="", envvar="PADFORGE_TOKEN", help="What must be known to listen."),
    )
    for option in reversed(options):
        command = option(command)
    return command


@click.command()
@rig_option
@click.option("--replay", metavar="RECORDING", type=click.Path(path_type=Path), help="Show a recording, not a rig.")
@click.option("--speed", type=click.FloatRange(min=0.01), default=1.0, show_default=True, help="Of the replay.")
@click.option(
    "--model",
    "models",
    type=click.Path(path_type=Path, file_okay=False),
    multiple=True,
    default=("out/pad",),
    show_default=True,
    help="Folder that calibrate wrote; may be given again for one that answers earlier, or better.",
)
@click.option("--port", type=click.IntRange(0, 65_535), default=PORT, show_default=True, help="Of the page; 0: any.")
@_ways_out
@spec_option
@json_option
def live(
    rig: str,
    replay: Path | None,
    speed: float,
    models: tuple[Path, ...],
    port: int,
    spec: Path | None,
    as_json: bool,
    **out: Any,
) -> None:
    """Show where a pad is pressed, as it is pressed: here, and on a page for the browsers of this machine.

    \b
    padforge sense live --model out/pad

    \b
    --rig simulated      the simulated pad that the model was learnt from, pressed at random
    --rig ur5            the board, as [rig] says; the arm is not used
    --replay RECORDING   what was recorded

    \b
    padforge sense live --tcp 9000                                for programs here: docs/live-protocol.md
    padforge sense live --osc 127.0.0.1:9001 --lsl pad            for music, for labs
    padforge sense live --tcp 9000 --host 0.0.0.0 --token WORD    for other machines

    Whoever knows the token sees page and lines from anywhere in the network, and nothing is encrypted.

    A fibre found bad is left out from then on, if health was learnt into the folder of the first model. Ctrl-C ends it.
    Fibres are numbered from 1; in JSON "fibres" and "failed" hold indices, from 0.
    """
    from padforge.sense.live.outputs import LivePage, Messages, tell_all
    from padforge.sense.live.pipeline import Live
    from padforge.sense.localizer.model import LocalizerModel

    localizers = [LocalizerModel.load(model) for model in models]
    with ExitStack() as stack:
        rigged = (stack, rig, models[0], localizers[0], spec)
        source, mirrored = _connected(*rigged) if replay is None else _replayed(replay, speed)
        pipeline = Live(localizers, _health(models[0]), source.fibres, source.rate_hz)
        page = stack.enter_context(LivePage(port, host=out["host"], token=out["token"]))
        click.echo(f"page: {page.url} (Ctrl-C ends)", err=True)
        outlets, messages = _outlets(stack, source, **out), Messages(pipeline, mirrored)
        show = _json if as_json else stack.enter_context(_terminal())
        pad = _pad(f"{replay or f'{rig} rig'}, {models[0]}", localizers[0], mirrored)

        @stack.push
        def tell_the_end(kind: object, error: BaseException | None, trace: object) -> None:
            page.show(pad | pipeline.view() | {"ended": str(error or "") or "ended"})

        for times_s, readings in source.blocks:
            events = pipeline.feed(times_s, readings)
            if len(times_s):
                view = pad | pipeline.view() | {"ended": ""}
                page.show(view)
                show(view, events)
                if outlets:
                    tell_all(outlets, messages.of(times_s, readings, events))


def _connected(
    stack: ExitStack, rig: str, model: Path, localizer: "LocalizerModel", spec: Path | None
) -> "tuple[Source, bool]":
    """The readings of a converter, until `stack` is left, and whether the pad lies with its tracks up."""
    from padforge.sense.rig.streams import connected, lies_mirrored
    from padforge.sense.settings import RigSettings

    mirrored = lies_mirrored(model, load_spec(spec).section(RigSettings))
    converter = _converter(rig, model, localizer, spec)
    stack.callback(converter.close)
    return connected(converter, localizer.rate_hz), mirrored


def _replayed(replay: Path, speed: float) -> "tuple[Source, bool]":
    """The readings of a recording, and whether the pad lay with its tracks up."""
    from padforge.sense.formats.import_export import open_recording
    from padforge.sense.rig.streams import replayed

    recording = open_recording(replay)
    return replayed(recording, speed), recording.mirrored


def _pad(title: str, localizer: "LocalizerModel", mirrored: bool) -> dict[str, Any]:
    """What stays the same of the view."""
    scaling = localizer.scaler
    half_mm = scaling.half_mm
    return {
        "title": title,
        "origin_mm": scaling.origin_mm.tolist(),
        "half_mm": [scaling.span_mm] * 2 if half_mm is None or not half_mm.any() else half_mm.tolist(),
        "mirrored": mirrored,
    }


def _outlets(
    stack: ExitStack, source: "Source", tcp: int | None, osc: str | None, lsl: str | None, host: str, token: str
) -> "list[Outlet]":
    """The ways out that were asked for, open until `stack` is left."""
    from padforge.sense.live.outputs import Lines, Lsl, Osc

    outlets: list[Outlet] = []
    if tcp is not None:
        lines = stack.enter_context(Lines(host, tcp, token))
        click.echo(f"lines: {lines.address[0]}:{lines.address[1]}", err=True)
        outlets.append(lines)
    if osc is not None:
        outlets.append(stack.enter_context(Osc(osc)))
    if lsl is not None:
        outlets.append(Lsl(lsl, source.fibres, source.rate_hz))
    return outlets


def _converter(rig: str, model: Path, localizer: "LocalizerModel", spec: Path | None) -> "Board":
    """The converter alone, not yet connected: whoever presses the pad, it is not the arm."""
    if rig == "simulated":
        from padforge.sense.rig.streams import simulated

        return simulated(model)
    from padforge.sense.rig.devices import device
    from padforge.sense.settings import RigSettings

    options = load_spec(spec).section(RigSettings)
    return device("padforge.boards", options.board)(options, options.inputs(localizer.fibres))


def _health(model: Path) -> "HealthModel | None":
    """What was learnt of a healthy pad, if it was."""
    from padforge.sense.health.fault_detector import has_health
    from padforge.sense.health.health_model import DETECTED, HealthModel

    if not has_health(model, DETECTED):
        click.echo(f"{model}: health was not learnt, so no fibre will be found bad", err=True)
        return None
    return HealthModel.load(model, DETECTED)


def _json(view: dict[str, Any], events: "Sequence[Event]") -> None:
    from padforge.sense.live.pipeline import Estimate

    for event in events:
        kind = {"event": type(event).__name__.lower()}
        click.echo(json.dumps(kind | (event.document if isinstance(event, Estimate) else asdict(event))))


def _plain(view: dict[str, Any], events: "Sequence[Event]") -> None:
    for event in events:
        click.echo(event.text)  # a line for each, as soon as it is known: click flushes


@contextmanager
def _terminal() -> "Iterator[Show]":
    """What shows on stdout: all there is, drawn anew and again; or a line an event, where it is no terminal."""
    with redrawn_lines() as draw:
        yield _plain if draw is None else lambda view, events: draw(view_lines(view))


def view_lines(view: dict[str, Any]) -> list[str]:
    """What there is to show (`Live.view`) as text."""
    latest = view["presses"][-1] if view["presses"] else None
    return [
        "pressed" if view["pressed"] else "waiting for a press",
        latest["text"] if latest else "no press yet",
        *(f"fibre {c:<3} {_bar(fibre['swing'] or 0.0)} {fibre['state']}" for c, fibre in enumerate(view["fibres"], 1)),
        *view["findings"],
    ]


def _bar(swing: float) -> str:
    full = min(round(abs(swing) * BAR), BAR) * "█"
    left, right = (full, "") if swing < 0 else ("", full)
    return f"{left:>{BAR}}|{right:<{BAR}}"
