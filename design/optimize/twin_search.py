"""The search for the next pad of a printed one, which never returns a pad that locates less well than plain ones do.

Where a contact was measured, networks trained under it decide: they compare what was searched for it with the default
pad, which needs no measurement, and with straight fibres.
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

LAYOUT_KEYS = ("grid", "horizontals", "verticals", "pitch_mm")
"""Keys of `[pad]` that say where fibres end."""
TOLERANCE = 1.03
"""Ratio of errors, to the better of the default pad and straight fibres, that counts as equal: that of trained networks
is no more certain."""
SUBSETS = 8
"""Sets of failed fibres of a size by which pads are compared."""
BUDGET_SHARES = {"default": 0.35, "twin": 0.4, "from default": 0.2}
"""Of a time budget, by search."""


def settings_for_twin(spec: "Spec", path: Path, pad: Morphology | None = None) -> "Spec":
    """Return the settings of `spec` with the sensitivity profile, the noise and the sensed rectangle of a twin.

    Profile and rectangle stay as they are in mm on a pad of another pitch; the rectangle is cut to the pad.

    Args:
        spec: settings; where it states no fibres or pitch, those of the twin count.
        path: of the `twin.json`.
        pad: whose fibres and pitch count instead.

    Raises:
        InputError: no valid twin; `spec` states another contact, or other fibres than the twin's.
    """
    twin = Twin.load(path)
    if spec.stated(Contact) and spec.section(Contact) != Contact():
        raise InputError(f"{spec.source}: [contact] is given beside {path}, which has one of its own; leave one out")
    layout, stated = twin.morphology.layout, spec.stated(PadSettings)
    keys = {**layout.settings, **{key: stated[key] for key in LAYOUT_KEYS if key in stated}}
    if pad is not None:
        keys = {**pad.layout.settings}
    size = spec.section(PadSettings, **keys, sensed_mm="beyond").layout
    if pad is None and size.counts != layout.counts:
        raise InputError(f"{spec.source}: [pad] asks for {size}, but {path} is of a pad of {layout}")
    return spec.replaced(
        {
            "pad": keys | {"sensed_mm": [min(pair) for pair in zip(twin.sensed_mm, size.size_mm, strict=True)]},
            "contact": twin.contact().model_dump(),
            "search": {**spec.stated(SearchSettings), **_scatter_settings(twin, size)},
        }
    )


def _scatter_settings(twin: Twin, layout: Layout) -> dict[str, float]:
    """Return how the responses of a held press scatter, in `[search]`'s shares of the full scale of straight fibres."""
    gains_v, noises_v = np.array(
        [(abs(channel.gain_v), channel.noise_v) for channel in twin.channels if channel.gain_v]
    ).T
    scale = straight_full_scale(layout, twin.contact(), "beyond")
    noise = twin.scatter.floor * np.median(noises_v) / (np.median(gains_v) * scale)
    return {
        "noise": float(np.clip(noise, 1e-3, 10)),
        "scatter": twin.scatter.share,
        "scatter_common": twin.scatter.common,
    }


def search_for_twin(
    pad: PadSettings,
    contact: Contact,
    settings: SearchSettings,
    rules: RulesSettings,
    default_settings: SearchSettings,
    *,
    origin: Morphology | None = None,
    run: SearchOptions | None = None,
) -> SearchResult:
    """Find the fibres of a pad for a measured contact and scatter.

    It searches from random starts, and from the default pad. Of these, the default pad and straight fibres it returns
    the pad with the least error of trained networks.

    Args:
        pad: settings of the pad.
        contact: as measured.
        settings: of the search, with the scatter as measured.
        rules: the limits.
        default_settings: settings of the search for the default pad, which is for the default contact.
        origin: the morphology to start from; random if None.
        run: callbacks, checkpoints, time budget and executor.

    Returns:
        Its `candidate` is "twin", "from default", "default" or "straight fibres". A search that is stopped ends with
        the best so far.
    """
    run = run or SearchOptions()
    plain = search(pad, None, default_settings, rules, run=_options(run, "default"))
    if plain.stopped == "interrupted":
        return plain
    afresh = search(pad, contact, settings, rules, origin=origin, run=_options(run, "twin"))
    from_plain = settings.model_copy(update={"starts": 1, "knots": max(settings.knots, default_settings.knots)})
    further = search(pad, contact, from_plain, rules, origin=plain.morphology, run=_options(run, "from default"))
    problem = build_problem(pad, contact, settings, rules)
    pads = {
        "default": plain.morphology,
        "straight fibres": Morphology.straight(pad.layout),
        "twin": afresh.morphology,
        "from default": further.morphology,
    }
    # a pad that cannot be built is no use, unless none can
    pads = {key: morphology for key, morphology in pads.items() if not problem.violations(morphology)} or {
        "twin": afresh.morphology
    }
    with stage("judge"):
        rows = errors_by_contact(pads, {"": contact}, pad, settings.response_scatter, settings.seed, SUBSETS)
    name = choose({row.pad: np.array(row.errors_mm) for row in rows})
    parts = {"default": plain, "twin": afresh, "from default": further}
    history = [entry | {"run": f"{part}, {entry['run']}"} for part, result in parts.items() for entry in result.history]
    return replace(
        score_result(pads[name], name, problem),
        history=history,
        seconds=sum(result.seconds for result in parts.values()),
        stopped=next((result.stopped for result in parts.values() if result.stopped), ""),
    )


def choose(errors: Mapping[str, Array], plain: Sequence[str] = ("default", "straight fibres")) -> str:
    """Return the pad of least mean error, among those that are worse than the plain ones with no number of failures.

    Args:
        errors: with 0, 1, ... fibres failed, by pad.
        plain: pads that the others are compared to; missing ones are ignored.
    """
    best = np.min([errors[name] for name in plain if name in errors] or list(errors.values()), axis=0)
    ratios = {name: error / best for name, error in errors.items()}
    least = min(float(ratio.max()) for ratio in ratios.values())
    fair = [name for name, ratio in ratios.items() if ratio.max() <= max(least, TOLERANCE)]
    return min(fair, key=lambda name: float(np.log(ratios[name]).mean()))


def state_folders(keep_in: Path) -> dict[str, Path]:
    """Return the folder of states of each search: beside each other, as none may lie in another's."""
    return {name: keep_in.with_name(f"{keep_in.name}-{name}".replace(" ", "-")) for name in BUDGET_SHARES}


def _options(run: SearchOptions, name: str) -> SearchOptions:
    """Return the options of one of the searches."""
    keep_in = None if run.keep_in is None else state_folders(run.keep_in)[name]
    budget = None if run.time_budget is None else BUDGET_SHARES[name] * run.time_budget
    return replace(run, keep_in=keep_in, time_budget=budget, on_progress=_prefixed(run.on_progress, name))


def _prefixed(on_progress: OnProgress, name: str) -> Callable[[str, int, int, float], None]:
    return lambda start, done, total, objective: on_progress(f"{name}, {start}", done, total, objective)
