"""Run a search on the settings of a `pad.toml`, and write morphology.json, design.json and the plan of the pad."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from padforge.common import files
from padforge.common.parallel import Checkpoints
from padforge.common.plotting import save_figure
from padforge.common.profiling import stage
from padforge.common.settings import Spec
from padforge.common.validation import InputError
from padforge.design.contact_comparison import design_contact
from padforge.design.morphology import Morphology
from padforge.design.objectives.rules import Violation
from padforge.design.objectives.score import describe_terms
from padforge.design.optimize.search import (
    SearchOptions,
    SearchResult,
    search,
    search_for_twin,
    settings_for_twin,
    state_folders,
)
from padforge.design.paths.curves import crossings, lengths
from padforge.design.report import FORMAT, draw_plan
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

SIGNIFICANT = 0.05  # relative difference of expected errors from which trained networks agree which pad is better


def run_design(
    spec: Spec,
    out: Path,
    overrides: Mapping[str, Any],
    start_from: str | None = None,
    options: SearchOptions | None = None,
    twin: Path | None = None,
    on_written: Callable[[SearchResult], None] = lambda result: None,
    regenerated: Collection[str] = (),
    force: bool = False,
) -> tuple[dict[str, Any], SearchResult]:
    """Search for the best pad and write its files.

    Args:
        spec: settings of the pad, the contact, the search and the rules.
        out: folder of the pad; the states of the search are checkpointed in it.
        overrides: settings of the search that win over those of `spec` unless None.
        start_from: "random", "straight" or the file of a morphology, which also sets the number of knots unless
            `overrides` does; random if None.
        options: how the search is run.
        twin: a `twin.json`, for whose contact, scatter and sensed rectangle the pad is designed (`search_for_twin`).
        on_written: called when the files are written, before the checkpoints of a finished search are deleted.
        regenerated: names of other files in `out` that the caller makes anew with the pad.
        force: whether to replace a pad from which other files in `out` were made.

    Returns:
        The content of `design.json`, and the result.

    Raises:
        InputError: invalid settings, or the pad in `out` is in use; the checkpoints stay.
    """
    settings, start, origin = _read_request(spec, overrides, start_from, twin)
    path, checkpoints, regenerated = out / "morphology.json", out / "search", {"design.json", *regenerated}
    files.check_replaceable(path, origin, regenerated, force)
    options = replace(options or SearchOptions(), keep_in=checkpoints)
    if twin is None:
        result = search(*settings, origin=start, run=options)
    else:
        nominal = spec.section(SearchSettings, **overrides)
        result = search_for_twin(*settings, nominal, origin=start, run=options)
    # with its provenance, so that its mould is compared with what it was designed for
    designed = Morphology.from_layout(result.morphology.knots, settings[0].layout, origin)
    result = replace(result, morphology=designed)
    document = {
        "format": FORMAT,
        "terms": result.terms,
        "descriptions": describe_terms(result.terms),
        "candidate": result.candidate,
        "straight": result.straight,
        "violations": [asdict(violation) for violation in result.violations],
        "history": result.history,
        "seconds": round(result.seconds, 3),
        "stopped": result.stopped,
        "provenance": origin,
    }
    with stage("figures"), files.atomic_files(out) as folder:
        pad, contact = settings[:2]
        designed.save(folder / path.name)
        # checked again: an interrupted search with the same settings may end with another pad
        files.check_replaceable(path, folder / path.name, regenerated, force)
        document["morphology_sha256"] = files.sha256(folder / path.name)
        figure = draw_plan(designed, contact, result.violations, pad.keep_out_corners_mm)
        for name in ("figures/design.svg", "figures/design.png"):
            save_figure(figure, folder / name)
        files.write_json(folder / "design.json", document)
    on_written(result)
    if not result.stopped:
        for states in (checkpoints, *(state_folders(checkpoints).values() if twin else ())):
            Checkpoints(states, {}).clear()
    return document, result


def check_design(
    spec: Spec, out: Path, overrides: Mapping[str, Any], regenerated: Collection[str] = (), force: bool = False
) -> None:
    """Check the arguments of `run_design` without searching."""
    origin = _read_request(spec, overrides)[-1]
    files.check_replaceable(out / "morphology.json", origin, {"design.json", *regenerated}, force)


def _read_request(
    spec: Spec, overrides: Mapping[str, Any], start_from: str | None = None, twin: Path | None = None
) -> tuple[tuple[PadSettings, Contact, SearchSettings, RulesSettings], Morphology | None, dict[str, Any]]:
    """Return the settings of a search, the pad it starts from, and the provenance of its result."""
    inputs: list[Path] = []
    if twin is not None:
        spec, inputs = settings_for_twin(spec, twin), [twin]
    pad, rules, start = spec.section(PadSettings), spec.section(RulesSettings), None
    if start_from == "straight":
        start = Morphology.straight(pad.layout)
    elif start_from not in (None, "random"):
        if Path(start_from).suffix.lower() not in (".json", ".mat"):
            raise InputError(f"--start-from is {start_from}, allowed are random, straight and a .json or .mat")
        start = Morphology.load(start_from)
        inputs.append(Path(start_from))
        overrides = {**overrides, "knots": overrides.get("knots") or (start.knots.shape[1] - 2 or None)}
    settings = spec.section(SearchSettings, **overrides)
    sections = pad, design_contact(spec, settings), settings, rules
    packages = ["pymoo"] * (settings.method == "genetic")  # if it is missing, this is refused here
    origin = files.provenance("padforge design", settings.seed, inputs, packages)
    origin["settings"] = {section.section(): section.model_dump(mode="json") for section in sections}
    return sections, start, origin


def load_result(out: Path) -> SearchResult:
    """Load the result of a search from the folder of a pad; InputError if a file is damaged."""
    document = files.read_json(out / "design.json", FORMAT)
    with files.reraise_as_input_error(out / "design.json"):
        return SearchResult(
            Morphology.load(out / "morphology.json"),
            document["terms"],
            [Violation(**violation) for violation in document["violations"]],
            document["candidate"],
            document["straight"],
            document["provenance"]["settings"]["rules"]["enforce"],
            document["history"],
            document["seconds"],
            document["stopped"],
        )


def summary_lines(result: SearchResult, out: Path) -> list[str]:
    """Summarise a search in a few lines of text: expected errors beside those of straight fibres, and broken rules."""
    violations = [f"  broken: {violation}" for violation in result.violations[:10]]
    remaining = len(result.violations) - len(violations)
    stopped = f" ({result.stopped}: the best so far)" if result.stopped else ""
    return [
        f"design: {len(result.morphology.knots)} fibres in {result.seconds:.1f} s{stopped}"
        f" -> {out / 'morphology.json'}",
        *_error_lines(result),
        _amount_line(result.morphology),
        *(violations or ["  all rules hold" if result.enforced else "  rules are not enforced"]),
        *([f"  ... and {remaining} more"] if remaining > 0 else []),
    ]


def _amount_line(pad: Morphology) -> str:
    """State the length of fibre between the pad's edges, and the crossings, beside those of straight fibres."""
    designed, straight = (
        f"{lengths(fibres).sum() * pad.unit_mm / 1000:.2f} m, {len(crossings(fibres))} crossings"
        for fibres in (pad, Morphology.straight(pad.layout))
    )
    return f"  fibre           {designed}; straight fibres {straight}"


def _error_lines(result: SearchResult) -> list[str]:
    designed = [value for term, value in result.terms.items() if term.startswith("expected_error")]
    straight = [value for term, value in result.straight.items() if term.startswith("expected_error")]
    lines = [
        f"  expected error  {_format_errors(designed)} mm with {_format_errors(range(len(designed)))} failed fibres",
        f"  straight fibres {_format_errors(straight)} mm",
    ]
    similar = [n for n, (a, b) in enumerate(zip(designed, straight, strict=True)) if a > (1 - SIGNIFICANT) * b]
    if result.candidate == "straight fibres":
        lines.append("  the search found no better pad than straight fibres; try more steps or time")
    elif similar:
        lines.append(f"  not significantly better than straight fibres with {_format_errors(similar)} failed fibres")
    return lines


def _format_errors(errors: Collection[float]) -> str:
    """Join errors by slashes, to the hundredth, or counts: "0.21 / 0.24"."""
    return " / ".join(f"{error:.2f}" if isinstance(error, float) else str(error) for error in errors)
