"""What a report has to say of the design of a pad, and of where all its results came from."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from padforge.design.common.files import find_unchanged, read_json, reraise_as_input_error
from padforge.design.common.page import PageSection, collapsible, columns, figures, heading, paragraph, table
from padforge.design.settings import PadSettings, RulesSettings, sensed_rectangle


def design_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """The fibres of a `design.json` in `folder`: plan, rules with their verdicts, terms of the objective.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: the plan is no picture.
    """
    terms, broken = document["terms"], document["violations"]
    descriptions = document.get("descriptions", {})
    described = [[name, value, descriptions.get(name, "")] for name, value in terms.items()]
    settings = document["provenance"]["settings"]
    pad, enforced = settings["pad"], settings["rules"]["enforce"]
    layout = PadSettings(**pad).layout
    unit_mm, (low, high) = layout.unit_mm, sensed_rectangle(layout)
    levels = sorted(int(name[-1]) for name in terms if name.startswith("expected_error"))
    both = terms, document.get("straight", {})
    holds = f"{len(broken)} broken" if broken else "all hold" if enforced else "not asked for"
    size = " x ".join(f"{round((b - a) * unit_mm, 6):g}" for a, b in zip(low, high, strict=True)) + " mm"
    plan = (
        f"The plan of the pad, {size}: horizontal and vertical fibres, their crossings, and the contact in the middle."
    )
    fibres = PageSection(
        "Fibres",
        [
            columns(
                [figures([(folder / "design.svg", plan)])],
                [
                    heading("Errors by lost fibres"),
                    paragraph(
                        "What a localizer is expected to err, in mm, on average over all sets of so many failed"
                        " fibres, and as much for straight fibres: before anything is built, by a formula that goes"
                        " with the errors of trained networks within some 5 %. Responses are taken to scatter by"
                        f" {float(settings['search']['scatter']):.0%} of themselves from press to press, and by"
                        f" {float(settings['search']['noise']):.1%} of full scale."
                    ),
                    table(
                        ["fibres failed", "expected error (mm)", "straight (mm)"],
                        [[failed, *(_mm(each, f"expected_error_mm_{failed}") for each in both)] for failed in levels],
                    ),
                ],
            ),
            heading("Design rules"),
            paragraph(f"Checked on the exact curves: {holds}."),
            table(["rule", "limit", "verdict", "setting"], list(_rules(settings["rules"], broken))),
            *([table(["broken rule", "fibres", "place (mm)", "measured", "limit"], _places(broken))] if broken else []),
            collapsible("All terms of the objective", [table(["term", "value", "what it is"], described)]),
        ],
        [
            (f"{layout.horizontals} + {layout.verticals}", f"fibres on {size}"),
            (holds, "design rules"),
            (f"{_mm(terms, 'expected_error_mm_0')} mm", "expected error of the design"),
        ],
    )
    return [fibres]


PAD = "morphology.json"
Stage = tuple[str, Path, Callable[[Path, Mapping[str, Any]], list[PageSection]]]
"""Its name, the document that it has left, and what a report has to say of that."""


def stage_pages(
    folder: Path, stages: Sequence[Stage], recording: Callable[[], str | None] = lambda: None
) -> tuple[list[PageSection], list[list[object]], list[str]]:
    """What the documents in `folder` give to a report, as far as they are there.

    Args:
        recording: gives the digest of the recording there, None where there is none; asked for if a stage is of one.

    Returns:
        Parts of the page, rows of their provenance, and what does not belong together, which the first part tells too.

    Raises:
        InputError: a document is damaged.
    """
    sections: list[PageSection] = []
    origins: list[list[object]] = []
    strange: list[str] = []
    for name, path, made_of in stages:
        if path.exists():
            document = read_json(path, f"padforge-{name}/{2 if name == 'design' else 1}")
            with reraise_as_input_error(path):
                strange += _misfits(folder, name, document, recording)
                sections += made_of(folder, document)
                origins.append(provenance_row(folder, name, document))
    return [*([_misfits_section(strange)] if strange else []), *sections], origins, strange


def _misfits(
    folder: Path, stage: str, document: Mapping[str, Any], recording: Callable[[], str | None]
) -> Iterator[str]:
    """What of a stage's result in `folder` is of another pad than the morphology.json there, or another recording.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
    """
    made_by = document["provenance"]
    inputs, told = made_by.get("inputs", {}), f"{stage} ({made_by.get('command')})"
    made_of = inputs.get(PAD) if stage != "design" else document.get("morphology_sha256")
    if isinstance(made_of, str) and (folder / PAD).is_file() and not find_unchanged(folder, {PAD: made_of}):
        yield f"{told} is of another pad than the {PAD} here"
    learnt_from = inputs.get("recording")
    if isinstance(learnt_from, str) and recording() not in (None, learnt_from):
        yield f"{told} is of another recording than the one here"


def _misfits_section(found: Sequence[str]) -> PageSection:
    """What does not belong together, as `_misfits` tells it."""
    advice = paragraph("Files of two pads lie in this folder. Do these stages again, or put the pads into two folders.")
    return PageSection("Does not belong together", [advice, *(paragraph(each) for each in found)])


def provenance_row(folder: Path, stage: str, document: Mapping[str, Any]) -> list[object]:
    """Where the result of a stage came from: a row for `provenance_section`.

    Args:
        folder: of the report; inputs that lie in it are compared with those that were used.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the provenance is not as padforge writes it.
    """
    made_by = document["provenance"]
    versions = ", ".join(f"{package} {version}" for package, version in made_by.get("versions", {}).items())
    inputs = "; ".join(_inputs(folder, made_by.get("inputs", {})))
    return [stage, made_by.get("command"), made_by.get("seed"), versions or "-", inputs or "-"]


def provenance_section(rows: Sequence[Sequence[object]]) -> PageSection:
    """Where all results came from, as rows of `origin` say."""
    head = ["stage", "command", "seed", "versions", "inputs (sha256)"]
    return PageSection(
        "Provenance", [collapsible("Commands, seeds, versions and inputs of every stage", [table(head, rows)])]
    )


def _mm(terms: Mapping[str, Any], name: str) -> str:
    """A term in mm; nothing where a search before this version left none."""
    value = terms.get(name)
    return "-" if value is None else f"{float(value):#.3g}"


def _rules(rules: Mapping[str, Any], broken: Sequence[Mapping[str, Any]]) -> Iterator[list[object]]:
    for name, limit in rules.items():
        if name == "enforce":
            continue
        fails = any(violation["rule"] == name for violation in broken)
        verdict = "fail" if fails else "pass" if rules["enforce"] else "not asked for"
        known = RulesSettings.model_fields.get(name)
        yield [known.description if known else name, limit, verdict, name]


def _places(broken: Sequence[Mapping[str, Any]]) -> list[list[object]]:
    return [
        [
            violation["rule"],
            ", ".join(map(str, violation["fibres"])) or "pad",
            "-" if violation["place_mm"] is None else "({:.1f}, {:.1f})".format(*violation["place_mm"]),
            violation["measured"],
            violation["limit"],
        ]
        for violation in broken
    ]


def _inputs(folder: Path, inputs: Mapping[str, Any]) -> Iterator[str]:
    for name, digest in inputs.items():
        if not isinstance(digest, str):
            yield f"{name}: {digest['command']}" if digest else name
        elif Path(name).name == name and (folder / name).is_file():  # no name leads to files of others
            here = "the one here" if find_unchanged(folder, {name: digest}) else "not the one here"
            yield f"{name} {digest} ({here})"
        else:
            yield f"{name} {digest}"


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
