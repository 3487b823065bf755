"""The problem that a search solves."""

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from padforge.common.parallel import map_threads
from padforge.common.validation import MAX_VALUES, InputError, check_type
from padforge.design.contact_set import served_contacts
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.ambiguity import free_presses
from padforge.design.objectives.criterion import criterion_errors
from padforge.design.objectives.fibre_loss import failure_shares
from padforge.design.objectives.rules import Violation, check_rules
from padforge.design.objectives.score import ScoredPad, sharpness
from padforge.design.paths.keep_outs import check_fibre_ends
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

STEPS = {"layer": 1200, "profile": 1200, "shape": 3000}
"""Steps of a start by the model of the contact. Under a shape, whose signals begin and end abruptly, 2000 steps instead
of 1000 reduce errors by 8 %, and 3000 steps by 12 %.
"""


@dataclass(frozen=True)
class SearchProblem:
    """The problem of finding a pad that serves all contacts within the rules."""

    pad: PadSettings
    contacts: tuple[Contact, ...]  # the main one first
    search: SearchSettings
    rules: RulesSettings
    origin: Morphology | None = None  # morphology to start from; None for random starts

    @property
    def starts(self) -> range:
        """Numbers of the starts; the genetic search has one."""
        return range(self.search.starts if self.search.method != "genetic" else 1)

    @property
    def steps(self) -> int:
        """Steps of a start before repair, or generations."""
        if self.search.method == "genetic":
            return self.search.generations
        return self.search.steps or max(STEPS[contact.model] for contact in self.contacts)

    def violations(self, pad: Morphology) -> list[Violation]:
        """Return the rules that a pad breaks; none if rules are not enforced."""
        return check_rules(pad, self.rules, self.pad) if self.rules.enforce else []

    @cached_property
    def straight_errors(self) -> Array:
        """Criterion of straight fibres by contact and number of failed fibres; shape (C, K), grid units."""
        return self._criterion(Morphology.straight(self.pad.layout))

    def comparison(self, pad: Morphology) -> float:
        """Return the value by which finished pads are compared, the less the better, always on the same presses.

        It is the geometric mean of the errors relative to straight fibres, over all contacts and numbers of failed
        fibres, plus the weighted sharpness under the main contact. A start of the search descends a power mean instead,
        which the worst case dominates; in their worst case finished pads hardly differ from straight fibres.
        """
        log_ratios = np.log(self._criterion(pad) / self.straight_errors)
        shares = failure_shares(self.search.max_failures)[: log_ratios.shape[1]]
        error = math.exp(np.average(log_ratios.mean(axis=0), weights=shares))
        weight = self.search.sharpness
        return error + (weight * sharpness(self.scored(pad).serpentine_signals.T) if weight else 0.0)

    def scored(self, pad: Morphology) -> ScoredPad:
        """Return the scores of a pad under the main contact."""
        return ScoredPad(pad, self.contacts[0], self.search, self.rules, self.pad)

    def _criterion(self, pad: Morphology) -> Array:
        by_contact = partial(criterion_errors, pad, search=self.search, pad_settings=self.pad)
        return np.array(list(map_threads(by_contact, self.contacts)))

    def settings(self) -> dict[str, Any]:
        """Return everything that a result depends on, by section, for JSON."""
        sections = {"pad": self.pad, "contact": self.contacts[0], "search": self.search, "rules": self.rules}
        origin = {"knots": None if self.origin is None else self.origin.knots.tolist()}
        return {name: section.model_dump(mode="json") for name, section in sections.items()} | {"origin": origin}


def build_problem(
    pad: PadSettings, contact: Contact, settings: SearchSettings, rules: RulesSettings, origin: Morphology | None = None
) -> SearchProblem:
    """Build the search problem; `contact_set` adds the contacts to serve besides the main one.

    Raises:
        InputError: settings that do not fit each other or the origin.
    """
    fibres = pad.layout.fibres
    free_presses(pad)  # raises if there are none
    if rules.enforce:
        check_fibre_ends(pad, rules)
        if pad.bent_radius_mm is not None and pad.bent_radius_mm < rules.min_mean_bend_radius_mm:
            raise InputError(
                f"[pad] bent_radius_mm is {pad.bent_radius_mm:g}, allowed is at least "
                f"{rules.min_mean_bend_radius_mm:g}, to which fibres may be bent "
                '([rules] min_mean_bend_radius_mm), or "flat"'
            )
    if settings.method == "genetic":
        # memory: offspring are compared with all pads of a generation, and there are several copies of all knots
        values = settings.population * max(settings.population, 2 * fibres * settings.knots)
        if values > MAX_VALUES // 4:
            raise InputError(
                f"population is {settings.population}: that takes {values} numbers for {fibres} fibres of "
                f"{settings.knots} knots, allowed are {MAX_VALUES // 4}"
            )
    if not any(failure_shares(settings.max_failures)[:fibres]):
        raise InputError(f"max_failures is {settings.max_failures}, allowed are weights of less than {fibres} failed")
    if origin is not None:
        knots = check_type("origin", origin, Morphology).knots.shape[1] - 2
        if origin.layout.counts != pad.layout.counts or origin.layout.spacing != pad.layout.spacing:
            raise InputError(f"the morphology to start from has {origin.layout}, allowed is the pad's, {pad.layout}")
        if knots > settings.knots:
            raise InputError(
                f"knots is {settings.knots}, allowed is at least the {knots} of the morphology to start from"
            )
    return SearchProblem(pad, tuple(served_contacts(contact, settings).values()), settings, rules, origin)
