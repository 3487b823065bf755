"""A search as it is asked for: settings in; morphology.json, design.json and the plan out."""

from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from padforge.design.common.checkpoints import Checkpoints
from padforge.design.common.command_line import progress
from padforge.design.common.files import (
    atomic_files,
    check_replaceable,
    provenance,
    read_json,
    reraise_as_input_error,
    sha256,
    write_json,
)
from padforge.design.common.plotting import save_figure
from padforge.design.common.profiling import stage
from padforge.design.common.validation import InputError
from padforge.design.contact_comparison import design_contact
from padforge.design.morphology import Morphology
from padforge.design.objectives.rules import Violation, check_rules
from padforge.design.objectives.score import describe_terms
from padforge.design.optimize.search import SearchOptions, SearchResult, search
from padforge.design.optimize.twin_search import search_for_twin, settings_for_twin, state_folders
from padforge.design.plan_drawing import draw_plan
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from padforge.design.common.settings import Spec
    from padforge.design.optimize.search import OnProgress

SURE = 0.05
"""Share by which expected errors must differ to say which pad a trained network will locate better by."""


@dataclass(frozen=True)
class _Request:
    """A search as it is asked for: its settings, the pad it starts from, and where its result will have come from."""

    pad: PadSettings
    contact: Contact
    settings: SearchSettings
    rules: RulesSettings
    begin: Morphology | None
    made_by: dict[str, Any]


def run_search(
    spec: "Spec",
    out: Path,
    overrides: dict[str, Any],
    origin: str | None = None,
    run: SearchOptions | None = None,
    twin: Path | None = None,
    written: Callable[[SearchResult], None] = lambda result: None,
    remade: Collection[str] = (),
    force: bool = False,
) -> tuple[dict[str, Any], SearchResult]:
    """Search with the settings of `spec`, write all results to `out`, and return `design.json` with the result.

    Args:
        overrides: of the settings of the search, by name; those that are not None count.
        origin: "random", "straight" or the file of a morphology to start from, which also says how many knots a fibre
            has unless `overrides` does; None for random ones.
        run: how long it may take and on what it runs; its states are kept in `out`, and a bar tells its progress.
        twin: a `twin.json`, for whose reach, scatter and sensed rectangle to search (`search_for_twin`).
        written: called when the results are on the disk, before the states of a search that came to its end go.
        remade: names of what else in `out` is made anew with the pad.
        force: whether a pad is replaced that others in `out` were made from.

    Raises:
        InputError: settings that cannot be, or others were made from the pad in `out`; what is found is kept to go on.
    """
    asked, remade = _request(spec, overrides, origin, twin), {"design.json", *remade}
    pad, path = asked.pad, out / "morphology.json"
    check_replaceable(path, asked.made_by, remade, force)
    with progress() as bar:
        run = replace(run or SearchOptions(), on_progress=progress_callback(bar), keep_in=out / "search")
        wanted = pad, asked.contact, asked.settings, asked.rules
        if twin is None:
            result = search(*wanted, origin=asked.begin, run=run)
        else:
            default = spec.section(SearchSettings, **overrides)
            result = search_for_twin(*wanted, default, origin=asked.begin, run=run)
    document = {
        "format": "padforge-design/2",
        "terms": result.terms,
        "descriptions": describe_terms(result.terms),
        "candidate": result.candidate,
        "straight": result.straight,
        "violations": [asdict(violation) for violation in result.violations],
        "history": result.history,
        "seconds": round(result.seconds, 3),
        "stopped": result.stopped,
        "provenance": asked.made_by,
    }
    with stage("figures"), atomic_files(out) as together:
        Morphology.from_layout(result.morphology.knots, pad.layout, asked.made_by).save(together / path.name)
        check_replaceable(path, together / path.name, remade, force)  # a search of the same settings may end elsewhere
        document["morphology_sha256"] = sha256(together / path.name)
        figure = draw_plan(result.morphology, asked.contact, result.violations, pad.keep_out_mm)
        save_figure(figure, together / "design.svg")
        save_figure(figure, together / "design.png")
        write_json(together / "design.json", document)
    written(result)
    if not result.stopped:
        keep_in = out / "search"
        for folder in (keep_in, *(state_folders(keep_in).values() if twin else ())):
            Checkpoints(folder, {}).clear()
    return document, result


def check_search(
    spec: "Spec", out: Path, overrides: dict[str, Any], remade: Collection[str] = (), force: bool = False
) -> None:
    """Refuse ahead what `run_search` would refuse, by the same arguments.

    Raises:
        InputError: as there.
    """
    made_by = _request(spec, overrides).made_by
    check_replaceable(out / "morphology.json", made_by, {"design.json", *remade}, force)


def _request(spec: "Spec", overrides: dict[str, Any], origin: str | None = None, twin: Path | None = None) -> _Request:
    """Read what a search is asked for by the arguments of `run_search`."""
    spec, inputs = (spec, []) if twin is None else (settings_for_twin(spec, twin), [twin])
    pad, rules = spec.section(PadSettings), spec.section(RulesSettings)
    begin, origin = None, origin or "random"
    if origin == "straight":
        begin = Morphology.straight(pad.layout)
    elif origin != "random":
        begin, inputs = Morphology.load(origin), [*inputs, Path(origin)]
        overrides = overrides | {"knots": overrides.get("knots") or (begin.knots.shape[1] - 2 or None)}
    settings = spec.section(SearchSettings, **overrides)
    contact = design_contact(spec, settings)
    made_by = provenance("padforge design", settings.seed, inputs, packages=("torch", "pymoo"))  # as they are read
    used = {"pad": pad, "contact": contact, "search": settings, "rules": rules}
    made_by["settings"] = {name: section.model_dump(mode="json") for name, section in used.items()}
    return _Request(pad, contact, settings, rules, begin, made_by)


def load_result(out: Path) -> SearchResult | None:
    """What a search into `out` has found, or None where the morphology there is another one.

    Raises:
        InputError: a file is damaged.
    """
    path = out / "design.json"
    if not (path.exists() and (out / "morphology.json").exists()):
        return None
    document = read_json(path, "padforge-design/2")
    with reraise_as_input_error(path):
        if document["morphology_sha256"] != sha256(out / "morphology.json"):
            return None
        terms, straight = (
            {name: float(value) for name, value in document[key].items()} for key in ("terms", "straight")
        )
        violations = [Violation(**each) for each in document["violations"]]
        list(map(str, violations))  # which tells of values that are none
        return SearchResult(
            Morphology.load(out / "morphology.json"),
            terms,
            violations,
            str(document["candidate"]),
            straight,
            bool(document["provenance"]["settings"]["rules"]["enforce"]),
            document["history"],
            float(document["seconds"]),
            document["stopped"],
        )


def write_plan(spec: "Spec", pad: Morphology, path: Path) -> None:
    """Draw a pad with the contact and rules of `spec` to `path`.

    Raises:
        InputError: a path that ends neither in .svg nor in .png, or cannot be written.
    """
    if path.suffix.lower() not in (".svg", ".png"):
        raise InputError(f"--out is {path}, allowed are .svg and .png")
    size = spec.section(PadSettings, **pad.layout.settings)
    broken = check_rules(pad, spec.section(RulesSettings), size)
    save_figure(draw_plan(pad, spec.section(Contact), broken, size.keep_out_mm), path)


def search_lines(result: SearchResult, out: Path) -> list[str]:
    """What a person wants to know of a search, in a few lines."""
    broken = [f"  broken  {violation}" for violation in result.violations[:10]]
    more = len(result.violations) - len(broken)
    return [
        f"design: {len(result.morphology.knots)} fibres in {result.seconds:.1f} s -> {out / 'morphology.json'}"
        + (f" ({result.stopped}: the best so far)" if result.stopped else ""),
        *_located(result),
        *(broken or ["  all rules hold" if result.enforced else "  rules are not enforced"]),
        *([f"  ... and {more} more"] if more > 0 else []),
    ]


def _located(result: SearchResult) -> list[str]:
    """How well the pad and straight fibres are expected to locate, in mm, and where the pad is no better."""
    errors, straight = (
        [value for term, value in terms.items() if term.startswith("expected_error")]
        for terms in (result.terms, result.straight)
    )
    designed, plain = (" / ".join(f"{value:.2f}" for value in values) for values in (errors, straight))
    failed = " / ".join(map(str, range(len(errors))))
    lines = [
        f"  expected error {designed} mm with {failed} fibres failed, before anything is built",
        f"                 {plain} mm with straight fibres",
    ]
    if result.candidate == "straight fibres":
        return [*lines, "  these are straight fibres: nothing better was found; more steps or time may find it"]
    alike = [str(k) for k, pair in enumerate(zip(errors, straight, strict=True)) if pair[0] > (1 - SURE) * pair[1]]
    if alike:
        lines.append(f"  no better than straight fibres, as far as such figures tell, with {', '.join(alike)} failed")
    return lines


def progress_callback(bar: "Progress") -> "OnProgress":
    tasks: dict[str, TaskID] = {}
    best: list[float] = []

    def report(run: str, done: int, total: int, objective: float) -> None:
        if run not in tasks:
            tasks[run] = bar.add_task(run, total=total, note="")
        best[:] = [min([objective, *best])]
        bar.update(tasks[run], completed=done, note=f"objective {objective:.4f}, best {best[0]:.4f}")

    return report
