"""`padforge sense live`: the edge where readings come in as they are taken and places are shown at once."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from design.common.command_line import json_option, load_spec, spec_option

from .options import drawn_anew
from .rig import rig_option

if TYPE_CHECKING:
    from sense.health.health_model import HealthModel
    from sense.live.pipeline import Event
    from sense.localizer.localizer import Localizer
    from sense.rig.devices.protocols import Converter

    Show = Callable[[dict[str, Any], Sequence[Event]], None]
    """Takes what there is to show, see `Live.view`, and what has just come to light."""

PORT = 8321
BAR = 12
"""Characters of a fibre's bar on a terminal, to either side."""


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
@spec_option
@json_option
def live(
    rig: str, replay: Path | None, speed: float, models: tuple[Path, ...], port: int, spec: Path | None, as_json: bool
) -> None:
    """Show where a pad is pressed, as it is pressed: here, and on a page for the browsers of this machine.

    \b
    padforge sense live --model out/pad

    \b
    --rig simulated      the simulated pad that the model was learnt from, pressed at random
    --rig ur5            the board, as [rig] says; the arm is not used
    --replay RECORDING   what was recorded

    A fibre found bad is left out from then on, if health was learnt into the folder of the first model. Ctrl-C ends it.
    Fibres are numbered from 1; in JSON "fibres" and "lost" hold indices, from 0.
    """
    from sense.live.page_server import LivePage
    from sense.live.pipeline import Live
    from sense.live.sources import connected, replayed
    from sense.localizer.localizer import Localizer
    from sense.recordings.import_export import open_recording
    from sense.settings import RigSettings

    localizers = [Localizer.load(model) for model in models]
    with ExitStack() as stack:
        if replay is not None:
            recording = open_recording(replay)
            source, mirrored = replayed(recording, speed), recording.mirrored
        else:
            mirrored = bool(load_spec(spec).section(RigSettings).mirrored)
            converter = _converter(rig, models[0], localizers[0], spec)
            stack.callback(converter.close)
            source = connected(converter, localizers[0].rate_hz)
        pipeline = Live(localizers, _health(models[0]), source.fibres, source.rate_hz)
        page = stack.enter_context(LivePage(port))
        click.echo(f"page: {page.url} (Ctrl-C ends)", err=True)
        show = _json if as_json else stack.enter_context(_terminal())
        scaling = localizers[0].normalization
        half_mm = scaling.half_mm
        pad = {
            "title": f"{replay or f'{rig} rig'}, {models[0]}",
            "middle_mm": scaling.middle_mm.tolist(),
            "half_mm": [scaling.span_mm] * 2 if half_mm is None or not half_mm.any() else half_mm.tolist(),
            "mirrored": mirrored,
        }

        @stack.push
        def tell_the_end(kind: object, error: BaseException | None, trace: object) -> None:
            page.show(pad | pipeline.view() | {"ended": str(error or "") or "ended"})

        for times_s, readings in source.blocks:
            events = pipeline.feed(times_s, readings)
            if len(times_s):
                view = pad | pipeline.view() | {"ended": ""}
                page.show(view)
                show(view, events)


def _converter(rig: str, model: Path, localizer: "Localizer", spec: Path | None) -> "Converter":
    """The converter alone, not yet connected: whoever presses the pad, it is not the arm."""
    if rig == "simulated":
        from sense.live.sources import simulated

        return simulated(model)
    from sense.rig.devices.plugins import device
    from sense.settings import RigSettings

    options = load_spec(spec).section(RigSettings)
    return device("padforge.boards", options.board)(options, options.inputs(localizer.fibres))


def _health(model: Path) -> "HealthModel | None":
    """What was learnt of a healthy pad, if it was."""
    from sense.health.health_model import DETECTED, HealthModel
    from sense.health.model_folder import has_health

    if not has_health(model, DETECTED):
        click.echo(f"{model}: health was not learnt, so no fibre will be found bad", err=True)
        return None
    return HealthModel.load(model, DETECTED)


def _json(view: dict[str, Any], events: "Sequence[Event]") -> None:
    from sense.live.pipeline import Estimate

    for event in events:
        kind = {"event": type(event).__name__.lower()}
        click.echo(json.dumps(kind | (event.document if isinstance(event, Estimate) else asdict(event))))


def _plain(view: dict[str, Any], events: "Sequence[Event]") -> None:
    for event in events:
        click.echo(event.text)  # a line for each, as soon as it is known: click flushes


@contextmanager
def _terminal() -> "Iterator[Show]":
    """What shows on stdout: all there is, drawn anew and again; or a line an event, where it is no terminal."""
    with drawn_anew() as draw:
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
