"""Write one HTML page on all results in the folder of a pad."""

from functools import cache
from pathlib import Path

from padforge.design.common.validation import Fault, InputError
from padforge.design.common.validation import check_path as as_path


def write_report(folder: Path) -> Path:
    """Write `report.html` on the results of all stages in a folder; a stage without results has no section.

    Args:
        folder: folder of the pad.

    Returns:
        Path of the page.

    Raises:
        InputError: there are no results, or a file is damaged.
        Fault: some results are of another pad or recording; the first section of the page lists them.
    """
    from padforge.design.common.files import recover, reraise_as_input_error, write_text
    from padforge.design.common.page import PageSection, page
    from padforge.design.report import (
        contact_sections,
        design_sections,
        provenance_row,
        provenance_section,
        stage_sections,
    )
    from padforge.fabricate.report.sections import fabrication_sections
    from padforge.sense.report import sections as sense
    from padforge.sense.report.identification_results import identification_sections

    folder = as_path("folder", folder)
    recover(folder)
    stages = (
        ("design", folder / "design.json", design_sections),
        ("fabrication", folder / "fabrication.json", fabrication_sections),
        ("recording", folder / "recording" / "start.json", sense.recording_sections),
        ("identification", folder / "identification.json", identification_sections),
        ("calibration", folder / "calibration.json", sense.calibration_sections),
        ("fibre-loss", folder / "fibre_loss.json", sense.fibre_loss_sections),
        ("contacts", folder / "contacts.json", contact_sections),
    )
    sections, provenance, mismatches = stage_sections(folder, stages, cache(lambda: sense.recording_digest(folder)))
    studies: list[str] = []
    for path, document in sense.find_studies(folder):
        with reraise_as_input_error(path):
            studies += sense.study_pieces(path, document)
            provenance.append(provenance_row(folder, f"study {path.stem}", document))
    if not provenance:
        raise InputError(f"{folder}: no design.json, fabrication.json, calibration.json or study to report on")
    if studies:
        sections.append(PageSection("Studies", studies))
    lead = "Fibres, mould and calibration of one soft strain-sensor pad."
    title = f"Pad report: {folder.resolve().name}"
    write_text(folder / "report.html", page(title, lead, [*sections, provenance_section(provenance)]))
    if mismatches:
        raise Fault(f"{folder / 'report.html'}: {'; '.join(mismatches)}")
    return folder / "report.html"
