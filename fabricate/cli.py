"""`padforge fabricate`: build the mould of a morphology, or check one."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from padforge.common.command_line import (
    json_option,
    load_spec,
    out_option,
    pad_folder,
    profile_option,
    show_result,
    spec_option,
)
from padforge.common.validation import InputError

if TYPE_CHECKING:
    from padforge.common.settings import Spec
    from padforge.design.morphology import Morphology

_MARKS = {"pass": "ok  ", "warn": "warn", "fail": "FAIL"}


class BuildByDefault(click.Group):
    """A group of commands of which `build` is the default."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Insert `build` before arguments that start with neither a command nor a help option."""
        if args and args[0] not in self.commands and args[0] not in ctx.help_option_names:
            args = ["build", *args]
        return super().parse_args(ctx, args)


@click.group(cls=BuildByDefault, subcommand_metavar="[build] MORPHOLOGY | check MESH_OR_MORPHOLOGY  [OPTIONS]")
def fabricate() -> None:
    """Make the printable mould of a morphology, or check one.

    \b
    padforge fabricate MORPHOLOGY                     writes the mould
    padforge fabricate check MESH_OR_MORPHOLOGY       exit 1 when a check fails

    A MORPHOLOGY is a morphology.json or a published .mat; a mesh is a .stl or .3mf.
    """


class _FormatsOption(click.Option):
    """An option whose help lists the formats; they are imported only when the help is shown."""

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        from padforge.fabricate.export import FORMATS

        self.help = f"Formats of the files to write, of {', '.join(FORMATS)}."
        return super().get_help_record(ctx)


def _parse_formats(context: click.Context, param: click.Parameter, value: str) -> tuple[str, ...]:
    from padforge.fabricate.export import FORMATS

    formats = tuple(name.strip() for name in value.split(",") if name.strip())
    if unknown := [name for name in formats if name not in FORMATS]:
        raise click.BadParameter(f"got {unknown[0]!r}, allowed are {', '.join(FORMATS)}")
    return formats


formats_option = click.option(
    "--formats", cls=_FormatsOption, default="stl,step,svg,png", show_default=True, callback=_parse_formats
)


@fabricate.command()
@click.argument("morphology", type=click.Path(path_type=Path))
@formats_option
@spec_option
@out_option(what="Folder for the files")
@json_option
@profile_option
def build(morphology: Path, formats: tuple[str, ...], spec: Path | None, out: Path | None, as_json: bool) -> None:
    """Write the mould of MORPHOLOGY; `build` may be left out.

    \b
    padforge fabricate build out/pad/morphology.json --formats stl,3mf,dxf
    padforge fabricate 5.mat --out out/published   a pad of the published study
    padforge fabricate build out/pad/morphology.json --formats gcode   the toolpath of a machine that places the fibres

    The mould is written whatever the checks find, and their findings are printed; `check` exits 1 when one fails.
    """
    from padforge.common.files import locked_folder
    from padforge.design.morphology import Morphology
    from padforge.fabricate.export import build as build_files

    from .settings import FabricationSettings

    settings = FabricationSettings.from_spec(load_spec(spec))
    pad = Morphology.load(morphology)
    folder = out or pad_folder(morphology)
    with locked_folder(folder):
        inputs = [path for path in (morphology, spec) if path]
        result = build_files(pad, folder, formats, settings, inputs)
    document = result.to_dict()
    show_result(document, mould_lines(document, folder), as_json)


def mould_lines(document: dict[str, Any], out: Path) -> list[str]:
    """Summarise a fabrication document in a few lines: the mould, and the findings that did not pass."""
    size = " x ".join(f"{round(side, 2):g}" for side in document["size_mm"])
    remarks = [finding for finding in document["findings"] if finding["status"] != "pass"]
    passed = len(document["findings"]) - len(remarks)
    return [
        f"mould: {size} mm, {document['silicone_volume_ml']:.1f} ml of silicone -> {out / document['files'][0]}"
        if document["files"]
        else f"mould: {size} mm -> {out / 'fabrication.json'}",
        f"  {passed} checks passed" + ("" if remarks else ", no warnings"),
        *(f"  {_line(finding)}" for finding in remarks),
    ]


@fabricate.command()
@click.argument("mesh_or_morphology", type=click.Path(path_type=Path))
@spec_option
@click.option(
    "--picture",
    type=click.Path(dir_okay=False, path_type=Path),
    help="PNG to draw, with the positions of the findings marked.",
)
@json_option
@click.pass_context
def check(ctx: click.Context, mesh_or_morphology: Path, spec: Path | None, picture: Path | None, as_json: bool) -> None:
    """Check a mesh, or the mould of a morphology. Exit 1 when a check fails.

    \b
    padforge fabricate check out/pad/mould.stl
    padforge fabricate check out/pad/morphology.json --picture findings.png
    """
    from padforge.common.files import atomic_file
    from padforge.fabricate.checks.plan_checks import check_file
    from padforge.fabricate.outputs.pictures import draw_findings

    from .settings import FabricationSettings

    if picture is not None and picture.suffix.lower() != ".png":
        raise InputError(f"--picture is {picture}, allowed is a name that ends in .png")
    vertices, triangles, findings = check_file(mesh_or_morphology, FabricationSettings.from_spec(load_spec(spec)))
    if picture is not None:
        with atomic_file(picture) as temporary:
            draw_findings(vertices, triangles, findings, temporary)
    passed = all(finding.status != "fail" for finding in findings)
    documents = [finding.to_dict() for finding in findings]
    show_result({"passed": passed, "findings": documents}, list(map(_line, documents)), as_json)
    ctx.exit(0 if passed else 1)


def _line(finding: dict[str, Any]) -> str:
    """Format a finding with the first three of its positions."""
    positions = [f"({x:z.1f}, {y:z.1f})" for x, y in finding["positions_mm"]]
    others = len(positions) - 3
    more = f" and {others} more place{'s' * (others > 1)}" if others > 0 else ""
    where = f" at {' '.join(positions[:3])}{more}" if positions else ""
    return f"{_MARKS[finding['status']]} {finding['name']}: {finding['message']}{where}"


def mould_costs(pad: "Morphology", spec: "Spec", folder: Path) -> dict[str, float]:
    """Build the mould of a pad, write fabrication.json and .stl to `folder`, and return its costs.

    If the contact is a layer they include the strain of fibres under a press, and the force of the press if the modulus
    of the silicone is known.
    """
    from padforge.design.contact import contact_press, fibre_strains
    from padforge.design.layer import reduced_modulus_kpa
    from padforge.design.settings import read_contact
    from padforge.fabricate.export import build as build_files

    from .settings import FabricationSettings

    settings = FabricationSettings.from_spec(spec)
    result = build_files(pad, folder, ("stl",), settings)
    failed = sum(finding.status == "fail" for finding in result.findings)
    costs = {"mould_ml": result.mould_volume_ml, "silicone_ml": result.silicone_volume_ml, "failed": failed}
    contact, modulus_kpa = read_contact(spec), settings.silicone.material.modulus_kpa
    if contact.model == "layer":
        costs["strain_percent"] = 100 * max(stretch for _, stretch in fibre_strains(contact))
        if modulus_kpa:
            costs["force_n"] = contact_press(contact).force_n(reduced_modulus_kpa(modulus_kpa))
    return costs
