"""One face for both searches: settings in, the best morphology with its scores and its history out."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from .contact import boustrophedon, signals
from .information import idle_share, information
from .losses import lost_subsets
from .morphology import Morphology
from .objective import published_terms
from .rules import Violation, check
from .settings import Contact, Pad, Rules, Search

Report = Callable[[str, int, int, float], None]
"""Hears of a search: what runs ("start 2"), steps done, steps in all, and its objective at that step."""

Note = Callable[[str, int, int, float], bool]
"""The same, and answers whether to go on."""

NOTED_STEPS = 10
SCORING_SIDE, SCORED_LOSSES = 20, 64


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    Attributes:
        morphology: the best pad: fewest broken rules first, then least score.
        terms: every term of `score` for it.
        violations: the rules it breaks; empty where rules are not enforced.
        history: one entry per reported step: {"run", "step", "objective"}.
        seconds: wall time.
        interrupted: whether Ctrl-C ended the search early; the best so far is kept.
    """

    morphology: Morphology
    terms: dict[str, float]
    violations: list[Violation]
    history: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    interrupted: bool = False


def score(pad: Morphology, contact: Contact, lost: int = 2) -> dict[str, float]:
    """Every term of a pad, by name.

    `ambiguity_lost_k` is the expected localisation error in grid units (formula of `descent`) over losses of k
    fibres, on a regular grid of presses; `information` is that of the pad in bits (formula there), `idle_share` the
    share of presses in which a fibre is idle; the rest are the published terms.
    """
    import torch

    from .descent import NOISE, ambiguity

    line = np.linspace(1, pad.grid, SCORING_SIDE) if pad.grid > 1 else np.linspace(0.5, 1.5, SCORING_SIDE)
    presses = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    found = torch.tensor(signals(pad, presses, contact).T, dtype=torch.float32)
    places = torch.tensor(presses, dtype=torch.float32)
    fibres = 2 * pad.grid
    terms = {}
    for k in range(min(lost, fibres - 1) + 1):
        losses = lost_subsets(fibres, k, SCORED_LOSSES)
        kept = torch.ones(len(losses), fibres)
        for row, loss in enumerate(losses):
            kept[row, list(loss)] = 0
        terms[f"ambiguity_lost_{k}"] = ambiguity(found, places, kept, NOISE[1]).item()
    serpentine = boustrophedon(pad.grid, 32, 5 / 49)
    terms |= {"information": information(pad, contact), "idle_share": idle_share(signals(pad, serpentine, contact))}
    published = asdict(published_terms(pad, contact)[0])
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
    stop = threading.Event()

    def note(run: str, step: int, total: int, objective: float) -> bool:
        if step % NOTED_STEPS == 0 or step == total or settings.method == "genetic":
            history.append({"run": run, "step": step, "objective": objective})
            report(run, step, total, objective)
        return not stop.is_set()

    with _stopped_by_interrupt(stop):
        find = _descend_all if settings.method == "descent" else _breed
        candidates = find(pad, contact, settings, rules, note)
        findings = [check(candidate, rules) if rules.enforce else [] for candidate in candidates]
        scores = [score(candidate, contact, settings.lost) for candidate in candidates]
    ranks = [(len(broken), _mean_ambiguity(terms)) for broken, terms in zip(findings, scores, strict=True)]
    best = min(range(len(candidates)), key=ranks.__getitem__)
    history.sort(key=lambda entry: (entry["run"], entry["step"]))
    seconds = time.perf_counter() - begin
    return SearchResult(candidates[best], scores[best], findings[best], history, seconds, stop.is_set())


@contextmanager
def _stopped_by_interrupt(stop: threading.Event) -> Iterator[None]:
    """Let Ctrl-C set `stop` instead of tearing down threads; outside the main thread, where none arrives, nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: stop.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _mean_ambiguity(terms: dict[str, float]) -> float:
    return float(np.mean([value for name, value in terms.items() if name.startswith("ambiguity")]))


def _descend_all(pad: Pad, contact: Contact, settings: Search, rules: Rules, note: Note) -> list[Morphology]:
    """Every start of the gradient search, one thread a core: torch lets go of the interpreter while it works.

    Once a start is told to stop, those that wait are left out.
    """
    import torch

    from .descent import Step, descend

    stopped = threading.Event()

    def run(start: int) -> Morphology | None:
        def heard(step: Step) -> bool:
            if not note(f"start {start + 1}", step.number, settings.steps, step.ambiguity):
                stopped.set()
            return not stopped.is_set()

        return None if stopped.is_set() else descend(start, pad, contact, settings, rules, heard)

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            starts = [pool.submit(run, start) for start in range(settings.starts)]
            while wait(starts, timeout=0.1).not_done:  # a wait without end would not let a signal through
                pass
            return [found for start in starts if (found := start.result()) is not None]
    finally:
        torch.set_num_threads(threads)


def _breed(pad: Pad, contact: Contact, settings: Search, rules: Rules, note: Note) -> list[Morphology]:
    from .genetic import breed

    total = settings.generations
    return [breed(pad, contact, settings, lambda generation, best: note("genetic", generation, total, best))]
