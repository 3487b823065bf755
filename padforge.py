"""padforge: the front door. `import padforge` hands out all there is; the command line chains the stages.

`padforge.design`, `padforge.fabricate` and `padforge.sense` are the packages, and whatever these three hand out is here
as well: `padforge.search`, `padforge.build`, `padforge.calibrate`, with the settings they take.
"""

import shutil
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType
from typing import TYPE_CHECKING, Any

import click

import design
import fabricate
import sense
from design.benchmarking.cli import bench_command
from design.cli.main import compare_command
from design.cli.main import design as design_group
from design.common.command_line import (
    INTERRUPTED,
    load_spec,
    out_option,
    profile_option,
    run_to_end,
    seed_option,
    spec_option,
)
from design.common.errors import Fault, InputError
from fabricate.cli import fabricate as fabricate_group
from fabricate.cli import mould_costs
from sense.cli.main import sense as sense_group
from sense.studies.cli import study as study_group

if TYPE_CHECKING:
    from design import *  # noqa: F403  what an editor completes `padforge.` with
    from design.common.settings import Settings, Spec
    from fabricate import *  # noqa: F403
    from sense import *  # noqa: F403

PACKAGES = {"design": design, "fabricate": fabricate, "sense": sense}

SECTIONS = {
    "pad": "design.settings:PadSettings",
    "contact": "design.settings:Contact",
    "search": "design.settings:SearchSettings",
    "rules": "design.settings:RulesSettings",
    "mould": "fabricate.settings:MouldSettings",
    "printer": "fabricate.settings:PrinterSettings",
    "silicone": "fabricate.materials:SiliconeSettings",
    "fibre": "fabricate.materials:FibreSettings",
    "dispenser": "fabricate.settings:DispenserSettings",
    "rig": "sense.settings:RigSettings",
    "localizer": "sense.settings:LocalizerSettings",
}
"""The sections of a `pad.toml`, and where the settings of each are."""

PRESETS = {"published": "design.settings:PUBLISHED"}
"""Settings other than the defaults, by section, that `padforge init` can write."""

EXTRAS = {"design": "design", "fabricate": "cad", "sense": "train", "study": "train"}
"""What of `pyproject.toml` each stage needs to be installed; what chains stages needs all of it."""

BENCHES = {
    "contact": "design.pad.benchmark:BENCH",
    "objective": "design.criteria.benchmark:BENCH",
    "search": "design.optimisers.benchmark:BENCH",
    "networks": "design.evaluation.benchmark:BENCH",
    "filter": "sense.recordings.processing.benchmark:BENCH",
    "localizer": "sense.localizer.calibration.benchmark:BENCH",
    "twin": "sense.twin.benchmark:BENCH",
    "mould": "fabricate.mould.benchmark:BENCH",
}
"""Where each bench is, imported when it is asked for."""


def __getattr__(name: str) -> Any:
    for package in PACKAGES.values():
        if name in package.__all__:
            return getattr(package, name)
    raise AttributeError(f"module 'padforge' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *(name for package in PACKAGES.values() for name in package.__all__)})


class _Packages(MetaPathFinder, Loader):
    """Finds `padforge.design.pad` where it lies, in `design.pad`: one module by two names, not two modules."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """What makes an alias, for the names of the packages and all below."""
        top, _, name = fullname.partition(".")
        return ModuleSpec(fullname, self) if top == "padforge" and name.partition(".")[0] in PACKAGES else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module itself; its own specification is kept for `exec_module`."""
        module = import_module(spec.name.removeprefix("padforge."))
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Nothing but what importing by another name has changed: it ran when it was imported."""
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


__path__: list[str] = []
"""None of its own: all that is in this package is found by `_Packages`."""
sys.meta_path.insert(0, _Packages())


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="padforge")
@click.pass_context
def cli(context: click.Context) -> None:
    """From an idea to a calibrated soft strain-sensor pad.

    \b
    padforge run                                     all of it, on built-in defaults, into out/pad
    padforge design --out out/pad                    optimise the fibres
    padforge fabricate out/pad/morphology.json       make the mould
    padforge sense calibrate out/pad/recording       learn places from presses
    padforge study robustness                        the paper's figures, for pads of your own
    """
    context.obj = list(SECTIONS)


for group in (design_group, fabricate_group, sense_group, study_group, bench_command(BENCHES)):
    cli.add_command(group)
design_group.add_command(compare_command(mould_costs))


@cli.command("init")
@click.argument("path", type=click.Path(dir_okay=False, path_type=Path), default="pad.toml")
@click.option("--preset", type=click.Choice(list(PRESETS)), help="published: contact, noise and area of the paper.")
def _init(path: Path, preset: str | None) -> None:
    """Write a settings file, pad.toml, with every default and a comment a key.

    \b
    padforge init
    padforge init soft.toml --preset published
    """
    from design.common.files import write_text
    from design.common.settings import commented_toml

    if path.exists():
        raise InputError(f"{path}: exists already; choose another name or move it away")
    write_text(path, commented_toml(_sections(), resolve_name(PRESETS[preset]) if preset else None))
    click.echo(f"settings -> {path}")


@cli.command("run")
@spec_option
@seed_option
@out_option("out/pad")
@profile_option
@click.pass_context
def _run(context: click.Context, spec: Path | None, seed: int | None, out: Path) -> None:
    """Do the whole job: optimise, mould, record presses on the simulated rig, calibrate, report.

    \b
    padforge run
    padforge run --spec pad.toml --seed 1 --out out/soft

    Exit 1 if the pad breaks a design rule or its mould fails a check; everything is written all the same.
    """
    from design.common.files import claimed
    from design.common.profiling import stage

    settings = load_spec(spec)
    _check_ahead(settings, out)
    with claimed(out):
        if (code := _run_stages(settings, seed, out)) != INTERRUPTED:
            with stage("report"):
                click.echo(f"report: {write_report(out)}")
    context.exit(code)


@cli.command("report")
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path), default="out/pad")
def _report(folder: Path) -> None:
    """Write report.html for the pad in FOLDER: whatever its stages have left there, on one page.

    \b
    padforge report out/pad
    """
    click.echo(f"report: {write_report(folder)}")


def _sections() -> "dict[str, type[Settings]]":
    return {name: resolve_name(where) for name, where in SECTIONS.items()}


def _check_ahead(spec: "Spec", out: Path) -> None:
    """Refuse what would fail only after minutes of work: any section, sections that do not fit, a real recording."""
    import numpy as np

    from design.settings import PadSettings
    from fabricate import FabricationSettings
    from sense.localizer.calibration.calibration import split_presses
    from sense.recordings.recorder import refuse_replacing
    from sense.settings import LocalizerSettings, RigSettings

    for model in _sections().values():
        spec.section(model)
    FabricationSettings.from_spec(spec).require_consistent(spec.section(PadSettings).layout)
    learning = spec.section(LocalizerSettings)
    split_presses(spec.section(RigSettings).presses, learning.split, learning.test_share, np.random.default_rng(0))
    refuse_replacing(out / "recording")


def _run_stages(spec: "Spec", seed: int | None, out: Path) -> int:
    """All stages into `out`, each with its summary on stdout; the exit code: 0, 1 if a rule or check fails, or 130."""
    from design.report.contact_section import compare_contacts, contact_line
    from design.report.files import run_search, search_lines
    from fabricate import FabricationSettings, build
    from fabricate.cli import mould_lines
    from sense.cli.calibration import run_calibration
    from sense.recordings.recorder import refuse_replacing
    from sense.report.calibration_results import calibration_lines
    from sense.rig.operation import record_simulated

    seeds = {"seed": seed}
    _, found = run_search(spec, out, seeds)
    click.echo("\n".join(search_lines(found, out)))
    if found.stopped:
        return INTERRUPTED
    written = [out / "morphology.json"]
    fabrication = FabricationSettings.from_spec(spec)
    mould = build(found.morphology, out, settings=fabrication, inputs=written, warn=partial(click.echo, err=True))
    click.echo("\n".join(mould_lines(mould, out)))
    recorded = out / "recording"
    refuse_replacing(recorded)
    if recorded.exists():
        shutil.rmtree(recorded)
    recording = record_simulated(spec, found.morphology, recorded, seeds, written)
    click.echo(f"sense: {len(recording.presses_mm)} presses on the simulated rig -> {recorded}")
    calibration = run_calibration(spec, recording, out, seeds)
    click.echo("\n".join(f"  {line}" for line in calibration_lines(calibration)))
    click.echo(contact_line(compare_contacts(spec, found.morphology, out, seed)))
    return int(bool(found.violations) or any(finding["status"] == "fail" for finding in mould["findings"]))


def write_report(folder: Path) -> Path:
    """Write `report.html` from the files in `folder`; stages that have left none are left out.

    Raises:
        InputError: no stage has left anything, or a file is damaged.
        Fault: there are files of another pad among them, which the page tells first.
    """
    from design.common.files import as_written, write_text
    from design.common.page.elements import PageSection, page
    from design.report.contact_section import contact_sections
    from design.report.sections import design_sections, provenance_row, provenance_section, stage_pages
    from fabricate.report.sections import fabrication_sections
    from sense.report import sections as sensed
    from sense.report.identification_results import identification_sections

    stages = (
        ("design", folder / "design.json", design_sections),
        ("fabrication", folder / "fabrication.json", fabrication_sections),
        ("recording", folder / "recording" / "start.json", sensed.recording_sections),
        ("identification", folder / "identification.json", identification_sections),
        ("calibration", folder / "calibration.json", sensed.calibration_sections),
        ("fibre-loss", folder / "fibre_loss.json", sensed.fibre_loss_sections),
        ("contacts", folder / "contacts.json", contact_sections),
    )
    sections, origins, strange = stage_pages(folder, stages)
    studies: list[str] = []
    for path, document in sensed.find_studies(folder):
        with as_written(path):
            studies += sensed.study_pieces(path, document)
            origins.append(provenance_row(folder, f"study {path.stem}", document))
    if not origins:
        raise InputError(f"{folder}: no design.json, fabrication.json, calibration.json or study to report on")
    if studies:
        sections.append(PageSection("Studies", studies))
    lead = "Fibres, mould and calibration of one soft strain-sensor pad."
    title = f"Pad report: {folder.resolve().name}"
    write_text(folder / "report.html", page(title, lead, [*sections, provenance_section(origins)]))
    if strange:
        raise Fault(f"{folder / 'report.html'}: {'; '.join(strange)}")
    return folder / "report.html"


def main() -> None:
    """Run the command line."""
    sys.exit(run_to_end(cli, "padforge", EXTRAS))


if __name__ == "__main__":
    main()
