"""What a search is given."""

from dataclasses import dataclass
from typing import Any

from design.pad.morphology import Morphology
from design.settings import Contact, PadSettings, RulesSettings, SearchSettings


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

    def settings(self) -> dict[str, Any]:
        """Everything a result depends on, as JSON, by section."""
        return {
            "pad": self.pad.model_dump(mode="json"),
            "contact": self.contacts[0].model_dump(mode="json"),
            "search": self.search.model_dump(mode="json"),
            "rules": self.rules.model_dump(mode="json"),
            "origin": {"knots": None if self.origin is None else self.origin.knots.tolist()},
        }
