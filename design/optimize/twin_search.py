"""The search for the next pad of a printed one, which never hands back what locates less well than plain pads do.

What is minimised is a measure. Where a contact was measured, networks trained under it are the judge: they compare what
was found for it with the usual pad, which needs no measurement, and with straight fibres.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from padforge.design.common.profiling import stage
from padforge.design.common.validation import InputError
from padforge.design.contact_comparison import errors_by_contact
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.expected_error import straight_full_scale
from padforge.design.optimize.problem import build_problem
from padforge.design.optimize.search import OnProgress, SearchOptions, SearchResult, score_result, search
from padforge.design.settings import Contact, Layout, PadSettings, RulesSettings, SearchSettings
from padforge.design.twin import Twin

if TYPE_CHECKING:
    from padforge.design.common.settings import Spec

KEYS = ("grid", "horizontals", "verticals", "pitch_mm")
"""Of `[pad]`, that say where fibres end."""


def settings_for_twin(spec: "Spec", path: Path, pad: Morphology | None = None) -> "Spec":
    """The settings of `spec`, with the reach, the noise and the sensed rectangle of the `twin.json` at `path`.

    Its fibres and pitch are the pad's as well, where `spec` states none, or those of `pad`, if one is given. Reach and
    rectangle stay as they are in mm on a pad of another pitch; of the rectangle what lies beyond a pad is left out.

    Raises:
        InputError: no valid twin; `spec` states another contact, or other fibres than the twin's.
    """
    twin = Twin.load(path)
    if spec.stated(Contact) and spec.section(Contact) != Contact():
        raise InputError(f"{spec.source}: [contact] is given beside {path}, which has one of its own; leave one out")
    own = twin.morphology.layout
    stated = {**own.settings, **{key: spec.stated(PadSettings)[key] for key in KEYS if key in spec.stated(PadSettings)}}
    if pad is not None:
        stated = {**pad.layout.settings}
    size = spec.section(PadSettings, **stated, sensed_mm="beyond").layout
    if pad is None and size.counts != own.counts:
        raise InputError(f"{spec.source}: [pad] asks for {size}, but {path} is of a pad of {own}")
    return spec.replaced(
        {
            "pad": stated | {"sensed_mm": [min(pair) for pair in zip(twin.sensed_mm, size.size_mm, strict=True)]},
            "contact": twin.contact().model_dump(),
            "search": {**spec.stated(SearchSettings), **_scatter(twin, size)},
        }
    )


def _scatter(twin: Twin, layout: Layout) -> dict[str, float]:
    """How the responses of a held press scatter, in `[search]`'s shares of a full scale: that of straight fibres."""
    gains_v, noises_v = np.array([(abs(each.gain_v), each.noise_v) for each in twin.channels if each.gain_v]).T
    scale = straight_full_scale(layout, twin.contact(), "beyond")
    noise = twin.scatter.floor * np.median(noises_v) / (np.median(gains_v) * scale)
    return {
        "noise": float(np.clip(noise, 1e-3, 10)),
        "scatter": twin.scatter.share,
        "scatter_common": twin.scatter.common,
    }


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
    run: SearchOptions | None = None,
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
        Its `candidate` is "twin", "from usual", "usual" or "straight fibres". A search that is stopped ends with the
        best so far of what was begun.
    """
    run = run or SearchOptions()
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
        problem = build_problem(pad, contact, settings, rules, None)
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


def _part(run: SearchOptions, name: str) -> SearchOptions:
    """How one of the searches runs."""
    keep_in = None if run.keep_in is None else state_folders(run.keep_in)[name]
    budget = None if run.time_budget is None else SHARES[name] * run.time_budget
    return replace(run, keep_in=keep_in, time_budget=budget, report=_named(run.report, name))


def _named(report: OnProgress, name: str) -> Callable[[str, int, int, float], None]:
    return lambda start, done, total, objective: report(f"{name}, {start}", done, total, objective)
