"""Scores of a pad: the table of terms that `score`, the searches, design.json and the report have in common.

To add a term, write a function of a `ScoredPad` and add a row to TERMS; it then appears in `score`, in design.json and
in the report (published terms only in `score` and in designs for a shape). For a search to minimise it as well, follow
`sharpness`: a weight in `SearchSettings`, 0 by default, a term of `SearchProblem.comparison`, and value and gradient,
as of `sharpness_loss`, in `GradientSearch`.

To add a rule, see `padforge.design.objectives.rules`.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from padforge.common.settings import or_default
from padforge.common.validation import check_type
from padforge.design.contact import fibre_axes, serpentine_presses, signals
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.ambiguity import AMBIGUITY_NOISE, ambiguities
from padforge.design.objectives.bayes_error import expected_errors
from padforge.design.objectives.criterion import SEARCH_SIDE
from padforge.design.objectives.penalties import PER_SPAN, check_comparisons, penalties
from padforge.design.published import objective as formula
from padforge.design.settings import PUBLISHED_CONTACT, Contact, PadSettings, RulesSettings, Scatter, SearchSettings
from padforge.design.signal_gradients import FibreCurves


@dataclass(frozen=True)
class ScoredPad:
    """A pad and the settings on which its terms depend."""

    pad: Morphology
    contact: Contact
    search: SearchSettings
    rules: RulesSettings
    pad_settings: PadSettings
    noise: float = AMBIGUITY_NOISE  # of the signals in the ambiguity, relative to full scale

    def terms(self, names: Collection[str] = ()) -> dict[str, float]:
        """Compute the terms of the rows of TERMS with these names, or of all rows, by name."""
        values: dict[str, float] = {}
        for term in TERMS:
            if not names or term.name in names:
                value = term.compute(self)
                by_suffix = value if isinstance(value, Mapping) else {"": value}
                values |= {f"{term.name}_{suffix}".rstrip("_"): number for suffix, number in by_suffix.items()}
        return values

    @cached_property
    def expected_errors(self) -> list[float]:
        """Expected errors with 0, 1, ... fibres failed, grid units."""
        return expected_errors(self.pad, self.contact, self.search, self.pad_settings)

    @cached_property
    def serpentine_signals(self) -> Array:
        """Signals of presses along a serpentine; shape (Q, F)."""
        return signals(self.pad, serpentine_presses(self.pad_settings.sensed, 32, 5 / 49), self.contact)

    @property
    def published_contact(self) -> Contact:
        """The contact of the published terms, which must be a shape."""
        return self.contact if self.contact.model == "shape" else PUBLISHED_CONTACT

    @cached_property
    def published(self) -> formula.PublishedTerms:
        """The published objective and its terms."""
        return formula.published_terms(self.pad, self.published_contact)[0]


@dataclass(frozen=True)
class Term:
    """A row of the table of terms."""

    name: str  # of the value, or the common prefix of several
    description: str  # text for people; `{}` stands for the suffix of the name
    compute: Callable[[ScoredPad], float | Mapping[object, float]]  # returns the value, or several by their suffix
    is_published: bool = False  # whether it belongs to the published method, whose contact is a shape


def sharpness(signals: Array) -> float:
    """Return Z of signals (F, Q), grid units, as published except for the quantisation, which has no gradient."""
    return float(np.abs(np.diff(signals, n=2, axis=1)).mean())


def sharpness_loss(curves: FibreCurves, contact: Contact, pad_settings: PadSettings) -> tuple[float, Array]:
    """Return the sharpness in a search, and its gradient (3, F, n) by the curves."""
    signals, differentiate = curves.signals(serpentine_presses(pad_settings.sensed, SEARCH_SIDE), contact)
    signs = np.sign(np.diff(signals, n=2, axis=1))
    # the transpose of a second difference is the second difference of the padded array
    grad_signals = np.diff(np.pad(signs, ((0, 0), (2, 2))), n=2, axis=1)
    return sharpness(signals), differentiate(grad_signals / signs.size)


def _in_mm(scored: ScoredPad, values: list[float]) -> dict[object, float]:
    return {n_failed: scored.pad.unit_mm * value for n_failed, value in enumerate(values)}


def _ambiguities(scored: ScoredPad) -> list[float]:
    return ambiguities(scored.pad, scored.contact, scored.search.max_failures, scored.noise, scored.pad_settings)


def _penalties(scored: ScoredPad) -> dict[object, float]:
    along, across = (axis[0] for axis in fibre_axes(scored.pad)[:2])
    return {**penalties(along, across, scored.pad_settings, scored.rules).values}


TERMS = (
    Term("expected_error_mm", "expected error with {} failed, mm", lambda s: _in_mm(s, s.expected_errors)),
    Term("ambiguity_mm", "ambiguity with {} failed, mm", lambda s: _in_mm(s, _ambiguities(s))),
    Term(
        "information",
        "mutual information of positions and signals, bits",
        lambda s: formula.information(s.pad, s.contact),
    ),
    Term("idle_share", "share of presses in which a fibre is idle", lambda s: formula.idle_share(s.serpentine_signals)),
    Term(
        "sharpness",
        "mean second difference of the signals along a serpentine, grid units",
        lambda s: sharpness(s.serpentine_signals.T),
    ),
    Term("penalty", "penalty of {} in the gradient search", _penalties),
    Term(
        "published_entropy",
        "joint entropy of the signals of each family, summed, bits",
        lambda s: s.published.entropy,
        is_published=True,
    ),
    Term("published_sharpness", "sharpness Z as published", lambda s: s.published.sharpness, is_published=True),
    Term("published_disorder", "disorder C as published", lambda s: s.published.disorder, is_published=True),
    Term("published_objective", "objective as published", lambda s: s.published.objective, is_published=True),
    Term(
        "published_joint_entropy",
        "joint entropy of the signals of all fibres, bits; its 49 presses limit it to log2 49 = 5.61, which straight "
        "fibres and all published pads reach",
        lambda s: s.published.joint_entropy,
        is_published=True,
    ),
)


def terms_of(contact: Contact) -> list[str]:
    """Return the names of the rows of TERMS for pads designed for a contact; published ones need a shape."""
    return [term.name for term in TERMS if contact.model == "shape" or not term.is_published]


def describe_terms(names: Iterable[str]) -> dict[str, str]:
    """Return the descriptions of the values of `ScoredPad.terms` by their names."""
    descriptions = {term.name: term.description for term in TERMS}
    # a value belongs to the row with the longest name that is a prefix of its name
    rows = {name: max((row for row in descriptions if name.startswith(row)), key=len, default="") for name in names}
    return {name: descriptions[row].format(name[len(row) + 1 :]) for name, row in rows.items() if row}


def score(
    pad: Morphology,
    contact: Contact | None = None,
    max_failures: int | tuple[float, ...] = 3,
    noise: float = AMBIGUITY_NOISE,
    rules: RulesSettings | None = None,
    pad_settings: PadSettings | None = None,
    scatter: Scatter | None = None,
) -> dict[str, float]:
    """Compute every term of a pad; TERMS describes them.

    The presses of the information and of the published terms lie between the outermost fibres, as published; all others
    cover the pressed rectangle. If `contact` is no shape, the published terms are those of the published contact.

    Args:
        pad: the fibres.
        contact: contact model of the presses; the default layer if None.
        max_failures: maximum number of failed fibres, or weights of 0, 1, ... failed fibres.
        noise: noise of the signals in the ambiguity, relative to full scale.
        rules: limits of the penalties; the default ones if None.
        pad_settings: settings of the pad, with the rectangle that is pressed.
        scatter: scatter of the responses in the expected error; that of a default search if None.

    Returns:
        Values by name. Expected errors and ambiguities are in mm; their names end in the number of failed fibres.

    Raises:
        InputError: arguments out of range, or a pad of too many fibres or knots.
    """
    contact, rules = or_default("contact", contact, Contact), or_default("rules", rules, RulesSettings)
    layout = check_type("pad", pad, Morphology).layout
    pad_settings = or_default("pad_settings", pad_settings, PadSettings).for_layout(layout)
    noise, keys = SearchSettings(noise=noise).noise, {"max_failures": max_failures}
    if scatter is not None:
        check_type("scatter", scatter, Scatter)
        keys |= {"noise": scatter.floor, "scatter": scatter.share, "scatter_common": scatter.common}
    search = SearchSettings(**keys)
    check_comparisons(len(pad.knots), PER_SPAN * (pad.knots.shape[1] - 1) + 1)
    return ScoredPad(pad, contact, search, rules, pad_settings, noise).terms()
