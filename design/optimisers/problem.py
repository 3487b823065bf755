"""What a search is given."""

from dataclasses import dataclass
from typing import Any

from padforge.design.common.errors import MOST_VALUES, InputError, instance
from padforge.design.criteria.fibre_loss import loss_shares
from padforge.design.criteria.rules import Violation, check_rules
from padforge.design.criteria.score import free_presses
from padforge.design.pad.courses.keep_out import require_free_ends
from padforge.design.pad.morphology import Morphology
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings


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


def posed(
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
        require_free_ends(pad, rules)
        if pad.bent_radius_mm is not None and pad.bent_radius_mm < rules.min_bend_radius_mm:
            raise InputError(
                f"[pad] bent_radius_mm is {pad.bent_radius_mm:g}, allowed is at least {rules.min_bend_radius_mm:g}, "
                'to which fibres may be bent ([rules] min_bend_radius_mm), or "flat"'
            )
    if settings.method == "genetic":
        # Offspring are compared with all pads of the generation, and all their knots are held several times over.
        room = settings.population * max(settings.population, 2 * fibres * settings.knots)
        if room > MOST_VALUES // 4:
            raise InputError(
                f"population is {settings.population}: that takes {room} numbers for {fibres} fibres of "
                f"{settings.knots} knots, allowed are {MOST_VALUES // 4}"
            )
    if not any(loss_shares(settings.lost)[:fibres]):
        raise InputError(f"lost is {settings.lost}, allowed is what leaves some of the {fibres} fibres")
    if origin is not None:
        instance("origin", origin, Morphology)
        knots = origin.knots.shape[1] - 2
        if origin.layout.counts != pad.layout.counts or origin.layout.spacing != pad.layout.spacing:
            raise InputError(f"the morphology to start from has {origin.layout}, allowed is the pad's, {pad.layout}")
        if knots > settings.knots:
            raise InputError(
                f"knots is {settings.knots}, allowed is at least the {knots} of the morphology to start from"
            )
    return SearchProblem(pad, (contact, *settings.contacts), settings, rules, origin)
