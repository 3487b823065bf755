"""`padforge sense live`: presses are localized in real time, displayed, and sent to other programs."""

import json
from collections.abc import Iterable
from contextlib import ExitStack, closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.common.command_line import FiniteRange, echo, json_option, load_spec, spec_option
from padforge.common.server import HOST
from padforge.sense.cli.options import FOLDER, redrawn_lines
from padforge.sense.cli.rig import check_rig, rig_option

if TYPE_CHECKING:
    from padforge.sense.live.outputs import JsonLines
    from padforge.sense.live.pipeline import Estimate, Event
    from padforge.sense.live.viewers import FoxgloveOutput, RerunOutput
    from padforge.sense.rig.streams import ReadingStream

PORT = 8321
BAR = 12  # maximum length of a fibre's bar on a terminal, to either side, characters


@click.command()
@rig_option
@click.option("--replay", metavar="RECORDING", type=click.Path(path_type=Path), help="Replay a recording.")
@click.option("--speed", type=FiniteRange(min=0.01), default=1.0, show_default=True, help="Speed of --replay.")
@click.option("--model", type=FOLDER, default="out/pad", show_default=True, help="Folder that calibrate wrote.")
@click.option(
    "--port", type=click.IntRange(0, 65_535), default=PORT, show_default=True, help="Port of the page; 0: any."
)
@click.option("--tcp", type=click.IntRange(0, 65_535), help="Send lines of JSON on this port; 0: any.")
@click.option("--foxglove", type=click.IntRange(0, 65_535), help="Serve Foxglove on this port; 0: any.")
@click.option(
    "--rerun",
    metavar="[TARGET]",
    is_flag=False,
    flag_value="rerun+http://127.0.0.1:9876/proxy",
    help="Send to the viewer Rerun: the one here, one by its address rerun+http://..., or into a file .rrd.",
)
@click.option(
    "--host",
    default=HOST,
    show_default=True,
    help="Address of page and --tcp; others than this machine's need --token.",
)
@click.option("--token", default="", envvar="PADFORGE_TOKEN", help="Secret that clients have to send.")
@spec_option
@json_option
def live(
    rig: str, replay: Path | None, speed: float, model: Path, port: int, spec: Path | None, as_json: bool, **output: Any
) -> int:
    """Show touches as they happen, in the terminal and a page. The page is for the browsers of this machine.

    \b
    padforge sense live --model out/pad

    \b
    --rig simulated      the simulated pad that the model was trained on, pressed at random
    --rig ur5            the board of [rig]; no arm is used or moved
    --replay RECORDING   a recording

    \b
    padforge sense live --tcp 9000                                for programs here: docs/live-protocol.md
    padforge sense live --foxglove 8765 --rerun                   for viewers of robotics
    padforge sense live --tcp 9000 --host 0.0.0.0 --token WORD    for other machines

    Anyone in the network who knows the token can watch, and nothing is encrypted.

    Every reading from the touch to the end of the release gives a position with radii that hold at that moment. Where
    the output is no terminal, a line says when a press begins, its radius has shrunk by a quarter, the finger has moved
    by more than that, and the press is over; with --json there is a line for every reading.

    A faulty fibre is masked from then on, if the folder of the model has a health model. A line says when the presses
    are those of another pad: then no fibre is masked, and it ends with exit 1. Ctrl-C ends it.
    Fibres are numbered from 1; in JSON "fibres" and "failed" hold indices, from 0.
    """
    from padforge.sense.formats.import_export import open_recording
    from padforge.sense.live.outputs import LivePage, MessageBuilder
    from padforge.sense.live.pad_sensor import load_health, open_board
    from padforge.sense.live.pipeline import Live
    from padforge.sense.localizer.model import LocalizerModel
    from padforge.sense.rig.streams import is_pad_mirrored, stream_board, stream_recording
    from padforge.sense.settings import RigSettings

    check_rig(rig)
    localizer = LocalizerModel.load(model)
    with ExitStack() as stack:
        if replay is None:
            options = load_spec(spec).section(RigSettings)
            mirrored = is_pad_mirrored(model, options)
            board = stack.enter_context(closing(open_board(rig, model, options, localizer.fibres)))
            stream = stream_board(board, localizer.rate_hz)
        else:
            recording = open_recording(replay)
            stream, mirrored = stream_recording(recording, speed), recording.mirrored
        if (health := load_health(model)) is None:
            echo(f"{model}: health was not learnt, so no faulty fibre will be detected", err=True)
        pipeline = Live(localizer, rate_hz=stream.rate_hz, fibres=stream.fibres, health=health)
        page = stack.enter_context(LivePage(port, host=output["host"], token=output["token"]))
        if replay is None and rig == "simulated":
            echo("touches are simulated, at random positions; --rig shows those of a real pad", err=True)
        touches = replay or ("simulated touches" if rig == "simulated" else f"{rig} rig")
        scaler, title = localizer.scaler, f"{touches}, {model}"
        half_mm = scaler.half_size_mm.tolist() if scaler.half_size_mm.any() else [scaler.scale_mm] * 2
        area = {"centre_mm": scaler.origin_mm.tolist(), "half_mm": half_mm}
        outputs, addresses = _open_outputs(stack, stream, area, **output)
        for line in (f"page: {page.url} (Ctrl-C ends)", *addresses):
            echo(line, err=True)
        builder = MessageBuilder(pipeline, mirrored)
        draw, printer = None if as_json else stack.enter_context(redrawn_lines()), EventPrinter(as_json)
        pad = {"title": title, **area, "mirrored": mirrored}

        @stack.push
        def show_end(kind: object, error: BaseException | None, trace: object) -> None:
            page.show(pad | pipeline.view() | {"ended": str(error or "") or "ended"})

        for times_s, readings in stream.blocks:
            events = pipeline.update(times_s, readings)
            if len(times_s):
                view = pad | pipeline.view() | {"ended": ""}
                page.show(view)
                if draw is None:
                    printer.print(events)
                else:
                    draw(view_lines(view))
                for message in builder.build(times_s, readings, events) if outputs else ():
                    for each in outputs:
                        each.send(message)
    return int(pipeline.is_other_pad)


def _open_outputs(
    stack: ExitStack,
    stream: "ReadingStream",
    area: dict[str, Any],
    tcp: int | None,
    foxglove: int | None,
    rerun: str | None,
    host: str,
    token: str,
) -> "tuple[list[JsonLines | FoxgloveOutput | RerunOutput], list[str]]":
    """Return the requested outputs, which `stack` closes, and lines with the addresses of servers."""
    from padforge.sense.live.outputs import JsonLines
    from padforge.sense.live.viewers import FoxgloveOutput, RerunOutput

    outputs: list[JsonLines | FoxgloveOutput | RerunOutput] = []
    addresses: list[str] = []
    if tcp is not None:
        lines = stack.enter_context(JsonLines(host, tcp, token))
        addresses.append(f"lines: {lines.address[0]}:{lines.address[1]}")
        outputs.append(lines)
    if foxglove is not None:
        viewer = stack.enter_context(FoxgloveOutput(foxglove, **area))
        addresses.append(f"foxglove: {viewer.url}")
        outputs.append(viewer)
    if rerun is not None:
        outputs.append(stack.enter_context(RerunOutput(rerun, stream.fibres, **area)))
    return outputs, addresses


class EventPrinter:
    """Prints events: all as JSON, or as text without the estimates that add little to the last one of their press."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._latest: dict[int, Estimate] = {}  # of the presses that are not over

    def print(self, events: "Iterable[Event]") -> None:
        """Print events, one a line."""
        from padforge.sense.live.pipeline import Estimate

        for event in events:
            is_estimate = isinstance(event, Estimate)
            # `echo` flushes, so that each line appears at once.
            if self._as_json:
                values = event.to_dict() if is_estimate else asdict(event) | {"text": event.text}
                click.echo(json.dumps({"event": type(event).__name__.lower()} | values))
            elif not is_estimate or self._is_news(event):
                echo(event.text)

    def _is_news(self, estimate: "Estimate") -> bool:
        """Return whether to print an estimate, and remember it if so."""
        latest = self._latest.get(estimate.press)
        if estimate.final:
            self._latest.pop(estimate.press, None)
            return True
        if latest is None or estimate.is_sharper_than(latest) or estimate.has_moved_from(latest):
            self._latest[estimate.press] = estimate
        return self._latest[estimate.press] is estimate


def view_lines(view: dict[str, Any]) -> list[str]:
    """Return the view of a pad (`Live.view`) as text."""
    presses = [press for press in view["presses"] if not press["final"]] or view["presses"][-1:]
    return [
        "pressed" if view["pressed"] else "waiting for a press",
        *([press["text"] for press in presses] or ["no press yet"]),
        *(f"fibre {c:<3} {_bar(fibre['swing'] or 0.0)} {fibre['state']}" for c, fibre in enumerate(view["fibres"], 1)),
        *view["faults"],
    ]


def _bar(swing: float) -> str:
    full = min(round(abs(swing) * BAR), BAR) * "█"
    left, right = (full, "") if swing < 0 else ("", full)
    return f"{left:>{BAR}}|{right:<{BAR}}"
