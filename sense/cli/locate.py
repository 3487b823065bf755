"""`padforge sense locate`, `health` and `deploy`: what a recording says of presses and fibres, here and elsewhere."""

import re
from pathlib import Path
from typing import Any

import click

from padforge.design.common.command_line import (
    json_option,
    load_spec,
    out_option,
    pad_folder,
    profile_option,
    show_result,
    spec_option,
)
from padforge.design.common.validation import InputError

from padforge.sense.cli.options import FibreNumbers, fibre_indices, model_option, read_recording, recording_argument, reported


@click.command()
@model_option
@recording_argument
@click.option("--mask", type=FibreNumbers(), default=(), help="Fibres to leave out, by number, the first is 1.")
@out_option(what="CSV file for the places, places.csv", file=True)
@profile_option
def locate(model: Path, recording: Path, mask: tuple[int, ...], out: Path | None) -> None:
    """Find the place of every press of RECORDING, and how sure it is; no true place is needed.

    \b
    padforge sense locate --model out/pad out/later/recording --mask 1,4 --out places.csv

    \b
    The columns of the CSV: press (counted from 0), x_mm, y_mm, sd_x_mm, sd_y_mm (standard
    deviations), r50_mm, r90_mm (radii that hold the true place in 50 % and 90 % of cases);
    of a model that has learnt them also depth_mm, depth_r90_mm, force_n, force_r90_n.
    """
    from padforge.sense.health.model_folder import examined, has_health
    from padforge.sense.localizer import locating
    from padforge.sense.localizer.localizer import Localizer

    file = out or pad_folder(recording) / "places.csv"
    localizer = Localizer.load(model)
    lost = fibre_indices(mask, localizer.fibres)
    opened = read_recording(recording)
    findings = examined(model, opened)[1] if has_health(model) else []
    for finding in findings:
        click.echo(f"{finding.text}; left out from there on", err=True)
    found = locating.locate(localizer, opened, lost, findings)
    locating.write_places(found, file)
    click.echo(f"{len(found.r50_mm)} places -> {file}")


@click.command()
@model_option
@recording_argument
@json_option
@click.pass_context
def health(context: click.Context, model: Path, recording: Path, as_json: bool) -> None:
    """Say which fibres of RECORDING are lost, damaged or drifting, from the readings alone.

    \b
    padforge sense health --model out/pad out/later/recording

    Exit 1 if one is. Fibres are numbered from 1; in JSON "dead" and "fibres" hold indices, from 0.
    """
    from dataclasses import asdict

    from padforge.sense.health.model_folder import examined
    from padforge.sense.health.monitor import fault_lines

    opened = read_recording(recording)
    known, findings = examined(model, opened)
    document = {
        "format": "padforge-findings/1",
        "presses": len(opened.begun),
        "dead": list(known.dead),
        "findings": [asdict(finding) | {"text": finding.text} for finding in findings],
    }
    show_result(document, fault_lines(findings, opened.fibres, known.dead), as_json)
    context.exit(int(bool(findings)))


class Bytes(click.ParamType):
    """A number of bytes, as `65536`, `64k` or `1M`."""

    name = "BYTES"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        found = re.fullmatch(r"(\d{1,9})([kM]?)", value)
        if found is None:
            self.fail(f"got {value!r}, expected bytes, as 65536, 64k or 1M", param, ctx)
        return int(found[1]) * {"": 1, "k": 2**10, "M": 2**20}[found[2]]


@click.command()
@model_option
@click.argument("files", nargs=-1, required=True, metavar="[RECORDING] OUT", type=click.Path(path_type=Path))
@click.option("--flash", type=Bytes(), default="256k", show_default=True, help="For code and tables of a .h.")
@click.option("--ram", type=Bytes(), default="64k", show_default=True, help="For the state of a .h.")
@click.option("--quantize", type=click.Choice(["int8"]), help="Weights of a .h as int8, not float32.")
@spec_option
@profile_option
def deploy(model: Path, files: tuple[Path, ...], flash: int, ram: int, quantize: str | None, spec: Path | None) -> None:
    """Write the localizer for other machines: OUT is an .onnx, or a .h for microcontrollers.

    \b
    padforge sense deploy --model out/pad localizer.onnx
    padforge sense deploy --model out/pad out/pad/recording localizer.h --flash 256k --ram 64k

    An .onnx takes readings and when they were of a press, and gives places and radii. It is tried by onnxruntime
    beside the localizer, on the presses of RECORDING or on some made up, and not written if they differ.

    A .h is one C99 file that takes reading after reading. It holds a network of its own, as large as --flash and
    --ram allow, which learns from RECORDING what is known by the end of a press. Presses that the model has not
    learnt from tell how far off it is, beside the model and, where that looks at the release, one that does not,
    trained for this. [localizer] says for how long they learn.
    """
    from padforge.design.common.files import check_writable, sha256
    from padforge.sense.localizer.localizer import Localizer

    path, recording = files[-1], files[0] if len(files) == 2 else None
    if len(files) > 2:
        raise InputError(f"{files[1]}: one argument too many, expected [RECORDING] OUT")
    if path.suffix not in (".onnx", ".h"):
        raise InputError(f"{path}: cannot be written, expected a name that ends in .onnx or .h")
    if not path.parent.is_dir():
        raise InputError(f"{path}: cannot be written, there is no folder {path.parent}")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: cannot be written, it is there and no file")
    check_writable(path.parent)
    localizer, digest = Localizer.load(model), sha256(model / "localizer.json")
    if path.suffix == ".onnx":
        from padforge.sense.live.deployment.onnx_file import export_onnx, onnx_line

        opened = None if recording is None else read_recording(recording)
        click.echo(f"{onnx_line(export_onnx(localizer, digest, path, opened))} -> {path}")
        return
    from padforge.sense.live.deployment.budget import Budget
    from padforge.sense.live.deployment.c_header import export_header, header_lines
    from padforge.sense.settings import LocalizerSettings

    if recording is None:
        raise InputError(f"{path}: a .h learns from a recording, which is not given: expected RECORDING {path}")
    budget, options = Budget(flash, ram, quantize == "int8"), load_spec(spec).section(LocalizerSettings)
    opened = read_recording(recording)
    with reported("training") as report:
        header = export_header(localizer, digest, path, opened, budget, options, report)
    click.echo("\n".join([*header_lines(header, budget), f"localizer -> {path}"]))
