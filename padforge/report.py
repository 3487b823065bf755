"""Write one HTML page on all results in the folder of a pad."""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from padforge.common.files import find_unchanged, read_json, reraise_as_input_error, write_text
from padforge.common.validation import Fault, InputError, check_path

PAD = "morphology.json"


def write_report(folder: Path) -> Path:
    """Write `report.html` with a section on each stage that has results in the folder of a pad.

    Raises:
        InputError: there are no results, or a file is damaged.
        Fault: some results are of another pad or recording; the first section of the page lists them.
    """
    from padforge.common.page import PageSection, collapsible, page, paragraph, table
    from padforge.design import contact_comparison
    from padforge.design import report as design
    from padforge.fabricate import export
    from padforge.fabricate.outputs.report import fabrication_sections
    from padforge.sense.localizer import evaluation
    from padforge.sense.recording import run_directory
    from padforge.sense.report import identification
    from padforge.sense.report import sections as sense
    from padforge.sense.studies import fibre_loss

    def write_design(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
        materials = _materials(folder, export.FORMAT)
        return [*design.design_sections(folder, document), *design.press_sections(document, *materials)]

    folder = check_path("folder", folder)
    recording = cache(lambda: sense.recording_digest(folder))
    sections: list[PageSection] = []
    provenance: list[list[object]] = []
    mismatches: list[str] = []
    for format_, file, write_sections in (
        (design.FORMAT, "design.json", write_design),
        (export.FORMAT, "fabrication.json", fabrication_sections),
        (run_directory.FORMAT, "recording/start.json", sense.recording_sections),
        (identification.FORMAT, "identification.json", identification.identification_sections),
        (evaluation.FORMAT, "calibration.json", sense.calibration_sections),
        (fibre_loss.FORMAT, "fibre_loss.json", sense.fibre_loss_sections),
        (contact_comparison.FORMAT, "contacts.json", design.contact_sections),
    ):
        if (path := folder / file).exists():
            document, name = read_json(path, format_), format_.removeprefix("padforge-").partition("/")[0]
            with reraise_as_input_error(path):
                mismatches += _find_mismatches(folder, name, document, recording)
                sections += write_sections(folder, document)
                provenance.append(_provenance_row(folder, name, document))
    if mismatches:
        advice = "This folder has files of two pads. Run these stages again, or use a folder for each pad."
        sections.insert(0, PageSection("Files of different pads", list(map(paragraph, [advice, *mismatches]))))
    studies: list[str] = []
    for path, document in sense.find_studies(folder):
        with reraise_as_input_error(path):
            studies += sense.study_pieces(path, document)
            provenance.append(_provenance_row(folder, f"study {path.stem}", document))
    if not provenance:
        raise InputError(f"{folder}: no design.json, fabrication.json, calibration.json or study to report on")
    if studies:
        sections.append(PageSection("Studies", studies))
    rows = table(["stage", "command", "seed", "versions", "inputs (sha256)"], provenance)
    summary = "Commands, seeds, versions and inputs of all stages"
    sections.append(PageSection("Provenance", [collapsible(summary, [rows])]))
    lead = "Fibres, mould and calibration of one soft strain-sensor pad."
    write_text(folder / "report.html", page(f"Pad report: {folder.resolve().name}", lead, sections))
    if mismatches:
        raise Fault(f"{folder / 'report.html'}: {'; '.join(mismatches)}")
    return folder / "report.html"


def _materials(folder: Path, format_: str) -> tuple[float | None, tuple[str, float] | None]:
    """Return the arguments of `press_sections` on the materials of the mould in a folder, None if unknown."""
    path = folder / "fabrication.json"
    if not path.exists():
        return None, None
    with reraise_as_input_error(path):
        document = read_json(path, format_)
        max_strain, silicone = document["fibre"]["max_strain"], document["silicone"]
        stiffness = (silicone["name"], float(silicone["modulus_kpa"])) if silicone["modulus_kpa"] else None
        return None if max_strain is None else float(max_strain), stiffness


def _find_mismatches(
    folder: Path, stage: str, document: Mapping[str, Any], recording: Callable[[], str | None]
) -> Iterator[str]:
    """Yield a message if a result is of another pad than the folder's morphology.json, or of another recording."""
    origin = document["provenance"]
    inputs, name = origin.get("inputs", {}), f"{stage} ({origin.get('command')})"
    pad = document.get("morphology_sha256") if stage == "design" else inputs.get(PAD)
    if isinstance(pad, str) and (folder / PAD).is_file() and not find_unchanged(folder, {PAD: pad}):
        yield f"{name} is of another pad than the {PAD} here"
    if isinstance(inputs.get("recording"), str) and recording() not in (None, inputs["recording"]):
        yield f"{name} is of another recording than the one here"


def _provenance_row(folder: Path, stage: str, document: Mapping[str, Any]) -> list[object]:
    """Return stage, command, seed, versions and inputs; inputs are compared with the files of their names here."""
    origin = document["provenance"]
    versions = ", ".join(f"{package} {version}" for package, version in origin.get("versions", {}).items())
    inputs = "; ".join(_describe_inputs(folder, origin.get("inputs", {})))
    return [stage, origin.get("command"), origin.get("seed"), versions or "-", inputs or "-"]


def _describe_inputs(folder: Path, inputs: Mapping[str, Any]) -> Iterator[str]:
    for name, digest in inputs.items():
        if not isinstance(digest, str):  # the provenance of an input that was computed
            yield f"{name}: {digest['command']}" if digest else name
        elif Path(name).name == name and (folder / name).is_file():  # a name that contains a path is never opened
            match = "the one here" if find_unchanged(folder, {name: digest}) else "not the one here"
            yield f"{name} {digest} ({match})"
        else:
            yield f"{name} {digest}"
