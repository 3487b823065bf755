"""One page of all that the stages have left in the folder of a pad."""

from functools import cache
from pathlib import Path

from padforge.design.common.validation import Fault, InputError
from padforge.design.common.validation import check_path as as_path


def write_report(folder: Path) -> Path:
    """Write `report.html` from the files in `folder`; stages that have left none are left out.

    Raises:
        InputError: no stage has left anything, or a file is damaged.
        Fault: there are files of another pad or recording among them, which the page tells first.
    """
    from padforge.design.common.files import recover, reraise_as_input_error, write_text
    from padforge.design.common.page import PageSection, page
    from padforge.design.report import (
        contact_sections,
        design_sections,
        provenance_row,
        provenance_section,
        stage_pages,
    )
    from padforge.fabricate.report.sections import fabrication_sections
    from padforge.sense.report import sections as sensed
    from padforge.sense.report.identification_results import identification_sections

    folder = as_path("folder", folder)
    recover(folder)
    stages = (
        ("design", folder / "design.json", design_sections),
        ("fabrication", folder / "fabrication.json", fabrication_sections),
        ("recording", folder / "recording" / "start.json", sensed.recording_sections),
        ("identification", folder / "identification.json", identification_sections),
        ("calibration", folder / "calibration.json", sensed.calibration_sections),
        ("fibre-loss", folder / "fibre_loss.json", sensed.fibre_loss_sections),
        ("contacts", folder / "contacts.json", contact_sections),
    )
    sections, origins, strange = stage_pages(folder, stages, cache(lambda: sensed.recording_digest(folder)))
    studies: list[str] = []
    for path, document in sensed.find_studies(folder):
        with reraise_as_input_error(path):
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
