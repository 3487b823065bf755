"""What the front door lists by name: sections of settings, extras to install, benches. Each is imported when needed."""

from pkgutil import resolve_name
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from design.common.settings import Settings

SECTIONS = {
    "pad": "design.settings:PadSettings",
    "contact": "design.settings:Contact",
    "search": "design.settings:SearchSettings",
    "rules": "design.settings:RulesSettings",
    "mould": "fabricate.settings:MouldSettings",
    "printer": "fabricate.settings:PrinterSettings",
    "silicone": "fabricate.materials:SiliconeSettings",
    "fibre": "fabricate.materials:FibreSettings",
    "dispenser": "fabricate.settings:DispenserSettings",
    "rig": "sense.settings:RigSettings",
    "localizer": "sense.settings:LocalizerSettings",
}
"""The sections of a `pad.toml`, and where the settings of each are."""

PRESETS = {"published": "design.settings:PUBLISHED"}
"""Settings other than the defaults, by section, that `padforge init` can write."""

EXTRAS = {"design": "design", "fabricate": "cad", "sense": "train", "study": "train"}
"""What of `pyproject.toml` each stage needs to be installed; what chains stages needs all of it."""

BENCHES = {
    "contact": "design.pad.benchmark:BENCH",
    "objective": "design.criteria.benchmark:BENCH",
    "search": "design.optimisers.benchmark:BENCH",
    "networks": "design.evaluation.benchmark:BENCH",
    "filter": "sense.recordings.processing.benchmark:BENCH",
    "localizer": "sense.localizer.calibration.benchmark:BENCH",
    "twin": "sense.twin.benchmark:BENCH",
    "mould": "fabricate.mould.benchmark:BENCH",
}
"""Where each bench is, imported when it is asked for."""


def sections() -> "dict[str, type[Settings]]":
    """The models of all sections, by name."""
    return {name: resolve_name(where) for name, where in SECTIONS.items()}
