"""What a report has to say of the design of a pad, and of where all its results came from."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from design.common.files import sha256
from design.common.page.elements import PageSection, beside, figures, folded, heading, paragraph, table
from design.settings import RulesSettings

_TERMS = {
    "information": "mutual information of places and signals, bits",
    "idle_share": "share of presses in which a fibre is idle",
    "sharpness": "mean second difference of the signals along a serpentine",
    "published_entropy": "joint entropy of the signals, as published",
    "published_sharpness": "sharpness, as published",
    "published_disorder": "disorder, as published",
    "published_objective": "objective, as published",
}


def design_sections(folder: Path, document: Mapping[str, Any]) -> list[PageSection]:
    """The fibres of a `design.json` in `folder`: plan, rules with their verdicts, terms of the objective.

    Raises:
        KeyError, IndexError, TypeError, ValueError, AttributeError: the document is not as padforge writes it.
        InputError: the plan is no picture.
    """
    terms, broken = document["terms"], document["violations"]
    settings = document["provenance"]["settings"]
    pad, enforced = settings["pad"], settings["rules"]["enforce"]
    grid, pitch_mm = int(pad["grid"]), float(pad["pitch_mm"])
    spread = {int(name[-1]): float(value) for name, value in terms.items() if name.startswith("ambiguity")}
    holds = f"{len(broken)} broken" if broken else "all hold" if enforced else "not asked for"
    size = f"{grid * pitch_mm:g} x {grid * pitch_mm:g} mm"
    plan = (
        f"The plan of the pad, {size}: horizontal and vertical fibres, their crossings, and the contact in the middle."
    )
    fibres = PageSection(
        "Fibres",
        [
            beside(
                [figures([(folder / "design.svg", plan)])],
                [
                    heading("Ambiguity by lost fibres"),
                    paragraph(
                        "How far, on average, the place that a noisy reading suggests lies from the one that was"
                        " pressed, over all losses of so many fibres. The noise has a standard deviation of"
                        f" {100 * float(settings['search']['noise']):.2g}% of a signal's full scale."
                    ),
                    table(
                        ["fibres lost", "grid units", "mm", "mm, straight fibres"],
                        [
                            [lost, f"{value:#.3g}", f"{value * pitch_mm:#.3g}", _straight(document, lost, pitch_mm)]
                            for lost, value in spread.items()
                        ],
                    ),
                ],
            ),
            heading("Design rules"),
            paragraph(f"Checked on the exact curves: {holds}."),
            table(["rule", "limit", "verdict", "setting"], list(_rules(settings["rules"], broken))),
            *([table(["broken rule", "fibres", "place (mm)", "measured", "limit"], _places(broken))] if broken else []),
            folded("All terms of the objective", [table(["term", "value", "what it is"], list(_terms(terms)))]),
        ],
        [
            (f"{grid} + {grid}", f"fibres on {size}"),
            (holds, "design rules"),
            (f"{spread[0] * pitch_mm:#.3g} mm", "ambiguity of the design"),
        ],
    )
    return [fibres]


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
        "Provenance", [folded("Commands, seeds, versions and inputs of every stage", [table(head, rows)])]
    )


def _straight(document: Mapping[str, Any], lost: int, pitch_mm: float) -> str:
    """The ambiguity of straight fibres in mm; nothing where a search before this version left none."""
    value = document.get("straight", {}).get(f"ambiguity_lost_{lost}")
    return "-" if value is None else f"{float(value) * pitch_mm:#.3g}"


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


def _terms(terms: Mapping[str, float]) -> Iterator[list[object]]:
    for name, value in terms.items():
        if name.startswith("ambiguity_lost_"):
            yield [name, value, f"ambiguity with {name[-1]} fibres lost, grid units"]
        elif name.startswith("penalty_"):
            yield [name, value, f"how far {name.removeprefix('penalty_')} is broken, as the search has it"]
        else:
            yield [name, value, _TERMS.get(name, "")]


def _inputs(folder: Path, inputs: Mapping[str, Any]) -> Iterator[str]:
    for name, digest in inputs.items():
        here = folder / name
        if not isinstance(digest, str):
            yield f"{name}: {digest['command']}" if digest else name
        elif here.is_file():
            yield f"{name} {digest} ({'the one here' if sha256(here) == digest else 'not the one here'})"
        else:
            yield f"{name} {digest}"
