"""Write the sections of a report on the design of a pad and on the provenance of all results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from padforge.design.common.files import find_unchanged, read_json, reraise_as_input_error
from padforge.design.common.page import PageSection, collapsible, columns, figures, heading, paragraph, table
from padforge.design.settings import PadSettings, RulesSettings, sensed_rectangle

PAD = "morphology.json"
Stage = tuple[str, Path, Callable[[Path, Mapping[str, Any]], list[PageSection]]]
"""Name of a stage, its document, and the function that writes the sections on it."""


def design_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Write the section on the fibres: plan, expected errors, design rules, terms of the objective.

    Args:
        folder: folder of the pad.
        document: its `design.json`.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is damaged.
        InputError: the plan is not a picture.
    """
    terms, violations = document["terms"], document["violations"]
    settings = document["provenance"]["settings"]
    enforced, search = settings["rules"]["enforce"], settings["search"]
    layout = PadSettings(**settings["pad"]).layout
    low, high = sensed_rectangle(layout)
    size = " x ".join(f"{round((b - a) * layout.unit_mm, 6):g}" for a, b in zip(low, high, strict=True)) + " mm"
    errors = [
        [name[-1], *(f"{float(errors_mm[name]):#.3g}" for errors_mm in (terms, document["straight"]))]
        for name in sorted(terms)
        if name.startswith("expected_error")
    ]
    check = f"{len(violations)} broken" if violations else "all hold" if enforced else "not enforced"
    plan = f"Plan of the pad, {size}: horizontal and vertical fibres, their crossings, and the contact at the centre."
    error_text = (
        "Expected error of a localizer in mm, averaged over all sets of failed fibres of a size. It is computed before"
        " anything is built, by a formula that agrees with the errors of trained networks within about 5 %. Responses"
        f" to a press vary by {float(search['scatter']):.0%} of their value from press to press, plus"
        f" {float(search['noise']):.1%} of full scale."
    )
    body = [
        columns(
            [figures([(folder / "design.svg", plan)])],
            [
                heading("Errors by failed fibres"),
                paragraph(error_text),
                table(["failed fibres", "expected error (mm)", "straight fibres (mm)"], errors),
            ],
        ),
        heading("Design rules"),
        paragraph(f"Checked on the exact curves: {check}."),
        table(["rule", "limit", "result", "setting"], list(_rule_rows(settings["rules"], violations))),
    ]
    if violations:
        rows = [_violation_row(violation) for violation in violations]
        body.append(table(["broken rule", "fibres", "position (mm)", "measured", "limit"], rows))
    rows = [[name, value, document["descriptions"].get(name, "")] for name, value in terms.items()]
    body.append(collapsible("All terms of the objective", [table(["term", "value", "meaning"], rows)]))
    key_figures = [
        (f"{layout.horizontals} + {layout.verticals}", f"fibres on {size}"),
        (check, "design rules"),
        (f"{errors[0][1]} mm", "expected error of the design"),
    ]
    return [PageSection("Fibres", body, key_figures)]


def _rule_rows(rules: Mapping[str, Any], violations: Sequence[Mapping[str, Any]]) -> Iterator[list[object]]:
    broken = {violation["rule"] for violation in violations}
    for name, limit in rules.items():
        if name != "enforce":
            result = "fail" if name in broken else "pass" if rules["enforce"] else "not enforced"
            field = RulesSettings.model_fields.get(name)
            yield [field.description if field else name, limit, result, name]


def _violation_row(violation: Mapping[str, Any]) -> list[object]:
    fibres, position_mm = ", ".join(map(str, violation["fibres"])), violation["place_mm"]
    position = "-" if position_mm is None else "({:.1f}, {:.1f})".format(*position_mm)
    return [violation["rule"], fibres or "pad", position, violation["measured"], violation["limit"]]


def stage_sections(
    folder: Path, stages: Sequence[Stage], recording: Callable[[], str | None] = lambda: None
) -> tuple[list[PageSection], list[list[object]], list[str]]:
    """Write the sections on all stages that have a document in a folder.

    Args:
        folder: folder of the pad.
        stages: stages in the order of the report.
        recording: returns the digest of the recording in the folder, None if there is none; called only if needed.

    Returns:
        Sections, rows of their provenance, and results that are of another pad or recording; these are listed in a
        section of their own, the first.

    Raises:
        InputError: a document is damaged.
    """
    sections: list[PageSection] = []
    rows: list[list[object]] = []
    mismatches: list[str] = []
    for name, path, write_sections in stages:
        if path.exists():
            document = read_json(path, f"padforge-{name}/{2 if name == 'design' else 1}")
            with reraise_as_input_error(path):
                mismatches += _find_mismatches(folder, name, document, recording)
                sections += write_sections(folder, document)
                rows.append(provenance_row(folder, name, document))
    if mismatches:
        advice = "This folder has files of two pads. Run these stages again, or use a folder for each pad."
        sections.insert(0, PageSection("Files of different pads", list(map(paragraph, [advice, *mismatches]))))
    return sections, rows, mismatches


def _find_mismatches(
    folder: Path, stage: str, document: Mapping[str, Any], recording: Callable[[], str | None]
) -> Iterator[str]:
    """Yield whether a result is of another pad than the morphology.json in the folder, or of another recording."""
    origin = document["provenance"]
    inputs, name = origin.get("inputs", {}), f"{stage} ({origin.get('command')})"
    pad = document.get("morphology_sha256") if stage == "design" else inputs.get(PAD)
    if isinstance(pad, str) and (folder / PAD).is_file() and not find_unchanged(folder, {PAD: pad}):
        yield f"{name} is of another pad than the {PAD} here"
    if isinstance(inputs.get("recording"), str) and recording() not in (None, inputs["recording"]):
        yield f"{name} is of another recording than the one here"


def provenance_row(folder: Path, stage: str, document: Mapping[str, Any]) -> list[object]:
    """Return the row of `provenance_section` on a document.

    Args:
        folder: folder of the report; inputs in it are compared with those that were used.
        stage: name of the stage.
        document: its document.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the document is damaged.
    """
    origin = document["provenance"]
    versions = ", ".join(f"{package} {version}" for package, version in origin.get("versions", {}).items())
    inputs = "; ".join(_describe_inputs(folder, origin.get("inputs", {})))
    return [stage, origin.get("command"), origin.get("seed"), versions or "-", inputs or "-"]


def _describe_inputs(folder: Path, inputs: Mapping[str, Any]) -> Iterator[str]:
    for name, digest in inputs.items():
        if not isinstance(digest, str):  # the provenance of an input that was computed
            yield f"{name}: {digest['command']}" if digest else name
        elif Path(name).name == name and (folder / name).is_file():  # never opens a file in another folder
            match = "the one here" if find_unchanged(folder, {name: digest}) else "not the one here"
            yield f"{name} {digest} ({match})"
        else:
            yield f"{name} {digest}"


def provenance_section(rows: Sequence[Sequence[object]]) -> PageSection:
    """Write the section on the provenance of all results, from the rows that `provenance_row` returns."""
    header = ["stage", "command", "seed", "versions", "inputs (sha256)"]
    return PageSection(
        "Provenance", [collapsible("Commands, seeds, versions and inputs of all stages", [table(header, rows)])]
    )


def contact_line(document: Mapping[str, Any]) -> str:
    """Summarise a `contacts.json`: errors with all fibres under the assumed contact, and their range under others."""
    parts = []
    for pad in ("designed", "straight"):
        assumed, *others = [row["errors_mm"][0] for row in document["rows"] if row["pad"] == pad]
        parts.append(f"{assumed:.2f} mm under the assumed contact, {min(others):.2f} to {max(others):.2f} mm otherwise")
    return f"contact: mean error of a small network {parts[0]}; of straight fibres {parts[1]}"


def contact_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """Return how the simulated errors in a `contacts.json` depend on the contact model.

    Args:
        folder: of the document.
        document: as padforge writes it.

    Raises:
        KeyError, TypeError, ValueError: the document is not as padforge writes it.
    """
    rows, scatter = document["rows"], document["scatter"]
    levels = range(max(len(row["errors_mm"]) for row in rows))
    lead = (
        "The contact is assumed until a printed pad is identified. Here the pad, and straight fibres of the same pad,"
        " are simulated under other contacts as well: mean error in mm of a small network, trained afresh under each"
        f" on one reading of each fibre with a scatter of {float(scatter['share']):.0%} of the response and"
        f" {float(scatter['floor']):.1%} of full scale. Where rows differ, simulated errors depend on the contact as"
        " much as on the pad; where straight fibres are better, optimising has not paid off."
    )
    head = ["contact", "fibres", *(f"{n_failed} failed" for n_failed in levels)]
    body = [[row["contact"], row["pad"], *(f"{error:.2f}" for error in row["errors_mm"])] for row in rows]
    return [PageSection("Contact model", [paragraph(lead), table(head, body)])]
