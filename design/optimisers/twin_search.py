"""The search for the next pad of a printed one, which never hands back what locates less well than plain pads do.

What is minimised is a measure. Where a contact was measured, networks trained under it are the judge: they compare what
was found for it with the usual pad, which needs no measurement, and with straight fibres.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from padforge.design.common.profiling import stage
from padforge.design.evaluation.contacts_believed import errors_by_contact
from padforge.design.pad.knots import Array
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

from .problem import posed
from .search import SearchListener, SearchResult, SearchRun, score_result, search

TOLERANCE = 1.03
"""Error with any number of fibres failed, of the better of the usual pad and straight ones, that is no worse: trained
networks are not surer of it."""
SUBSETS = 8
"""Sets of failed fibres of a size by which pads are judged."""
SHARES = {"usual": 0.35, "twin": 0.4, "from usual": 0.2}
"""Of a time budget, what each search takes."""


def search_for_twin(
    pad: PadSettings,
    contact: Contact,
    settings: SearchSettings,
    rules: RulesSettings,
    usual: SearchSettings,
    *,
    origin: Morphology | None = None,
    run: SearchRun | None = None,
) -> SearchResult:
    """Find the fibres of a pad for a contact and a scatter that were measured.

    It searches afresh, and from the usual pad; of what is found, the usual pad and straight fibres it returns the pad
    that trained networks locate best by.

    Args:
        pad: what the pad is.
        contact: as measured.
        settings: of the search, with the scatter as measured.
        rules: to be kept.
        usual: settings of the search for the usual pad, which is for the usual contact.
        origin: the morphology to start from; random if None.
        run: whom it tells, what it keeps and how long it may take.

    Returns:
        Its `found_by` is "twin", "from usual", "usual" or "straight fibres". A search that is stopped ends with the
        best so far of what was begun.
    """
    run = run or SearchRun()
    plain = search(pad, None, usual, rules, run=_part(run, "usual"))
    if plain.stopped == "interrupted":
        return plain
    afresh = search(pad, contact, settings, rules, origin=origin, run=_part(run, "twin"))
    one = settings.model_copy(update={"starts": 1, "knots": max(settings.knots, usual.knots)})
    further = search(pad, contact, one, rules, origin=plain.morphology, run=_part(run, "from usual"))
    pads = {
        "usual": plain.morphology,
        "straight fibres": Morphology.straight(pad.layout),
        "twin": afresh.morphology,
        "from usual": further.morphology,
    }
    if rules.enforce:  # one that cannot be built is no use, unless none can
        problem = posed(pad, contact, settings, rules, None)
        pads = {name: each for name, each in pads.items() if not problem.broken(each)} or {"twin": afresh.morphology}
    with stage("judge"):
        found = errors_by_contact(pads, {"": contact}, pad, settings.response_scatter, settings.seed, SUBSETS)
    name = choose({each.pad: np.array([level.mean for level in each.errors]) for each in found})
    parts = {"usual": plain, "twin": afresh, "from usual": further}
    history = [entry | {"run": f"{part}, {entry['run']}"} for part, each in parts.items() for entry in each.history]
    return replace(
        score_result(pads[name], name, pad, contact, settings, rules),
        history=history,
        seconds=sum(each.seconds for each in parts.values()),
        stopped=next((each.stopped for each in parts.values() if each.stopped), ""),
    )


def choose(errors: Mapping[str, Array], plain: Sequence[str] = ("usual", "straight fibres")) -> str:
    """Return the pad that errs least over all numbers of failed fibres, of those that are worse than plain at none.

    Args:
        errors: by pad, with 0, 1, ... fibres failed.
        plain: those to which the others are compared, as far as they are there.
    """
    best = np.min([errors[name] for name in plain if name in errors] or list(errors.values()), axis=0)
    ratios = {name: each / best for name, each in errors.items()}
    least = min(float(ratio.max()) for ratio in ratios.values())
    fair = [name for name, ratio in ratios.items() if ratio.max() <= max(least, TOLERANCE)]
    return min(fair, key=lambda name: float(np.log(ratios[name]).mean()))


def state_folders(keep_in: Path) -> dict[str, Path]:
    """Return where each of the searches keeps its states: beside each other, as none may lie in another's."""
    return {name: keep_in.with_name(f"{keep_in.name}-{name}".replace(" ", "-")) for name in SHARES}


def _part(run: SearchRun, name: str) -> SearchRun:
    """How one of the searches runs."""
    keep_in = None if run.keep_in is None else state_folders(run.keep_in)[name]
    budget = None if run.time_budget is None else SHARES[name] * run.time_budget
    return replace(run, keep_in=keep_in, time_budget=budget, report=_named(run.report, name))


def _named(report: SearchListener, name: str) -> Callable[[str, int, int, float], None]:
    return lambda start, done, total, objective: report(f"{name}, {start}", done, total, objective)
