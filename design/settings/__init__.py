"""The sections of `pad.toml` that design owns: the pad, the contact, the search and the rules."""

from collections.abc import Mapping

from padforge.design.common.settings import Settings

from .contact import MEASURED_REACH, PUBLISHED_CONTACT, Contact
from .layout import DEFAULT_PITCH_MM, MOST_FIBRES, Counts, Layout, Pitch
from .pad import PadSettings, Polygon, Rectangle, Sensed, between_fibres, sensed_rectangle
from .rules import TRACK_WIDTH_MM, RulesSettings
from .search import Lost, Scatter, SearchSettings

PUBLISHED_PAD, PUBLISHED_SEARCH = PadSettings(sensed_mm="fibres"), SearchSettings(noise=0.005, scatter=0.0)
PUBLISHED: Mapping[str, Settings] = {
    "pad": PUBLISHED_PAD,
    "contact": PUBLISHED_CONTACT,
    "search": PUBLISHED_SEARCH,
    "rules": RulesSettings(max_common_track_mm=None),
}
"""The world of the paper, by section, as far as it is another than the default."""

__all__ = [
    "DEFAULT_PITCH_MM",
    "MEASURED_REACH",
    "MOST_FIBRES",
    "PUBLISHED",
    "PUBLISHED_CONTACT",
    "PUBLISHED_PAD",
    "PUBLISHED_SEARCH",
    "TRACK_WIDTH_MM",
    "Contact",
    "Counts",
    "Layout",
    "Lost",
    "PadSettings",
    "Pitch",
    "Polygon",
    "Rectangle",
    "RulesSettings",
    "Scatter",
    "SearchSettings",
    "Sensed",
    "between_fibres",
    "sensed_rectangle",
]
