"""One face for both searches: settings in, the best morphology with its scores and its history out."""

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from itertools import combinations
from typing import Any

import numpy as np

from .contact import boustrophedon, signals
from .information import idle_share, information
from .morphology import Morphology
from .objective import published_terms
from .rules import Violation, check
from .settings import Contact, Pad, Rules, Search

Report = Callable[[str, int, int, float], None]
"""Hears of a search: what runs ("start 2"), steps done, steps in all, and its objective at that step."""

SCORING_SIDE = 20


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    Attributes:
        morphology: the best pad: fewest broken rules first, then least score.
        terms: every term of `score` for it.
        violations: the rules it breaks; empty where rules are not enforced.
        history: one entry per reported step: {"run", "step", "objective"}.
        seconds: wall time.
    """

    morphology: Morphology
    terms: dict[str, float]
    violations: list[Violation]
    history: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0


def score(pad: Morphology, contact: Contact, lost: int = 2) -> dict[str, float]:
    """Every term of a pad, by name.

    `ambiguity_lost_k` is the expected localisation error in grid units (formula of `descent`) over all losses of k
    fibres, on a regular grid of presses; `information` is that of the pad in bits (formula there), `idle_share` the
    share of presses in which a fibre is idle; the rest are the published terms.
    """
    import torch

    from .descent import NOISE, ambiguity

    line = np.linspace(1, pad.grid, SCORING_SIDE) if pad.grid > 1 else np.linspace(0.5, 1.5, SCORING_SIDE)
    presses = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    found = torch.tensor(signals(pad, presses, contact).T, dtype=torch.float32)
    fibres = 2 * pad.grid
    terms = {}
    for k in range(min(lost, fibres - 1) + 1):
        losses = list(combinations(range(fibres), k))
        total = 0.0
        for loss in losses:
            kept = torch.ones(1, fibres)
            kept[0, list(loss)] = 0
            total += ambiguity(found, torch.tensor(presses, dtype=torch.float32), kept, NOISE[1]).item()
        terms[f"ambiguity_lost_{k}"] = total / len(losses)
    serpentine = boustrophedon(pad.grid, 32, 5 / 49)
    terms |= {"information": information(pad, contact), "idle_share": idle_share(signals(pad, serpentine, contact))}
    published = asdict(published_terms(pad.knots[None], contact)[0])
    return terms | {f"published_{name}": value for name, value in published.items()}


def search(
    pad: Pad | None = None,
    contact: Contact | None = None,
    settings: Search | None = None,
    rules: Rules | None = None,
    report: Report = lambda run, done, total, objective: None,
) -> SearchResult:
    """Find the fibres of a pad by the method `settings` names; None stands for the defaults of `pad.toml`.

    The same settings give the same morphology, however many threads run the starts.
    """
    pad, contact = pad or Pad(), contact or Contact()
    settings, rules = settings or Search(), rules or Rules()
    begin = time.perf_counter()
    history: list[dict[str, Any]] = []

    def note(run: str, step: int, total: int, objective: float) -> None:
        history.append({"run": run, "step": step, "objective": objective})
        report(run, step, total, objective)

    find = _descend_all if settings.method == "descent" else _breed
    candidates = find(pad, contact, settings, rules, note)
    findings = [check(candidate, rules) if rules.enforce else [] for candidate in candidates]
    scores = [score(candidate, contact, settings.lost) for candidate in candidates]
    ranks = [(len(broken), _mean_ambiguity(terms)) for broken, terms in zip(findings, scores, strict=True)]
    best = min(range(len(candidates)), key=ranks.__getitem__)
    history.sort(key=lambda entry: (entry["run"], entry["step"]))
    return SearchResult(candidates[best], scores[best], findings[best], history, time.perf_counter() - begin)


def _mean_ambiguity(terms: dict[str, float]) -> float:
    return float(np.mean([value for name, value in terms.items() if name.startswith("ambiguity")]))


def _descend_all(pad: Pad, contact: Contact, settings: Search, rules: Rules, note: Report) -> list[Morphology]:
    """Every start of the gradient search, one thread a core: torch lets go of the interpreter while it works."""
    import torch

    from .descent import Step, descend

    def run(start: int) -> Morphology:
        def heard(step: Step) -> None:
            if step.number % 10 == 0 or step.number == settings.steps:
                note(f"start {start + 1}", step.number, settings.steps, step.ambiguity)

        return descend(start, pad, contact, settings, rules, heard)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return list(pool.map(run, range(settings.starts)))
    finally:
        torch.set_num_threads(threads)


def _breed(pad: Pad, contact: Contact, settings: Search, rules: Rules, note: Report) -> list[Morphology]:
    from .genetic import breed

    total = settings.generations
    return [breed(pad, contact, settings, lambda generation, best: note("genetic", generation, total, best))]
