"""What a search is given."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from padforge.design.common.validation import MAX_VALUES, InputError, check_type
from padforge.design.morphology import Morphology
from padforge.design.objectives.fibre_loss import loss_shares
from padforge.design.objectives.rules import Violation, check_rules
from padforge.design.objectives.score import free_presses
from padforge.design.paths.keep_outs import check_fibre_ends
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

RESERVE = 0.15  # share of a time budget kept for repairing
MENDING_S = 3.0  # of repair after Ctrl-C
LATEST_S = 10.0  # after a deadline, for slices at work: one takes a second or so, but an executor may hang


class Stop:
    """Whether to go on: until Ctrl-C or a deadline of `time.perf_counter`."""

    def __init__(self, begin: float, time_budget: float | None) -> None:
        self.deadline = None if time_budget is None else begin + (1 - RESERVE) * time_budget
        self.end = None if time_budget is None else begin + time_budget
        self.reason = ""
        self._again = False

    def interrupt(self) -> None:
        self._again = self.reason == "interrupted"
        self.reason = "interrupted"

    def given_up(self, elsewhere: bool) -> bool:
        """Whether slices at work are not waited for any longer: after a second Ctrl-C, or long after the deadline.

        Args:
            elsewhere: whether they are on an executor, which may hang; here, they do end.
        """
        late = elsewhere and bool(self) and self.deadline is not None and time.perf_counter() > self.deadline + LATEST_S
        return self._again or late

    def mend_until(self) -> float:
        """When to end the repair of the best so far."""
        return self.end if self.reason == "out of time" and self.end else time.perf_counter() + MENDING_S

    def __bool__(self) -> bool:
        if not self.reason and self.deadline is not None and time.perf_counter() > self.deadline:
            self.reason = "out of time"
        return bool(self.reason)


@contextmanager
def stopped_by_interrupt(stop: Stop) -> Iterator[None]:
    """Let Ctrl-C set `stop` instead of tearing down threads; outside the main thread, where none arrives, nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: stop.interrupt())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@dataclass(frozen=True)
class SearchProblem:
    """A pad that serves all of `contacts` within `rules`, to be found as `search` says, from an origin or afresh."""

    pad: PadSettings
    contacts: tuple[Contact, ...]
    search: SearchSettings
    rules: RulesSettings
    origin: Morphology | None = None

    @property
    def starts(self) -> range:
        """Numbers of the starts; the genetic search is one."""
        return range(self.search.starts if self.search.method != "genetic" else 1)

    @property
    def steps(self) -> int:
        """Steps of a start, or generations, as far as they are known beforehand."""
        return self.search.generations if self.search.method == "genetic" else self.search.steps

    def broken(self, pad: Morphology) -> list[Violation]:
        """The rules that a pad breaks, as far as they are asked for."""
        return check_rules(pad, self.rules, self.pad) if self.rules.enforce else []

    def settings(self) -> dict[str, Any]:
        """Everything a result depends on, as JSON, by section."""
        return {
            "pad": self.pad.model_dump(mode="json"),
            "contact": self.contacts[0].model_dump(mode="json"),
            "search": self.search.model_dump(mode="json"),
            "rules": self.rules.model_dump(mode="json"),
            "origin": {"knots": None if self.origin is None else self.origin.knots.tolist()},
        }


def build_problem(
    pad: PadSettings, contact: Contact, settings: SearchSettings, rules: RulesSettings, origin: Morphology | None
) -> SearchProblem:
    """The problem that settings pose.

    Raises:
        InputError: settings that do not fit each other, the origin or this machine.
    """
    if settings.device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise InputError("device is 'cuda', but no such device is found; allowed here is 'cpu'")
    fibres = pad.layout.fibres
    free_presses(pad)
    if rules.enforce:
        check_fibre_ends(pad, rules)
        if pad.bent_radius_mm is not None and pad.bent_radius_mm < rules.min_bend_radius_mm:
            raise InputError(
                f"[pad] bent_radius_mm is {pad.bent_radius_mm:g}, allowed is at least {rules.min_bend_radius_mm:g}, "
                'to which fibres may be bent ([rules] min_bend_radius_mm), or "flat"'
            )
    if settings.method == "genetic":
        # Offspring are compared with all pads of the generation, and all their knots are held several times over.
        room = settings.population * max(settings.population, 2 * fibres * settings.knots)
        if room > MAX_VALUES // 4:
            raise InputError(
                f"population is {settings.population}: that takes {room} numbers for {fibres} fibres of "
                f"{settings.knots} knots, allowed are {MAX_VALUES // 4}"
            )
    if not any(loss_shares(settings.max_failures)[:fibres]):
        raise InputError(f"max_failures is {settings.max_failures}, allowed is what leaves some of the {fibres} fibres")
    if origin is not None:
        check_type("origin", origin, Morphology)
        knots = origin.knots.shape[1] - 2
        if origin.layout.counts != pad.layout.counts or origin.layout.spacing != pad.layout.spacing:
            raise InputError(f"the morphology to start from has {origin.layout}, allowed is the pad's, {pad.layout}")
        if knots > settings.knots:
            raise InputError(
                f"knots is {settings.knots}, allowed is at least the {knots} of the morphology to start from"
            )
    return SearchProblem(pad, (contact, *settings.contacts), settings, rules, origin)
