"""What the front door lists by name: sections of settings, extras to install, benches. Each is imported when needed."""

from pkgutil import resolve_name
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from padforge.design.common.settings import Settings

SECTIONS = {
    "pad": "padforge.design.settings:PadSettings",
    "contact": "padforge.design.settings:Contact",
    "search": "padforge.design.settings:SearchSettings",
    "rules": "padforge.design.settings:RulesSettings",
    "mould": "padforge.fabricate.settings:MouldSettings",
    "printer": "padforge.fabricate.settings:PrinterSettings",
    "silicone": "padforge.fabricate.materials:SiliconeSettings",
    "fibre": "padforge.fabricate.materials:FibreSettings",
    "dispenser": "padforge.fabricate.settings:DispenserSettings",
    "rig": "padforge.sense.settings:RigSettings",
    "localizer": "padforge.sense.settings:LocalizerSettings",
}
"""The sections of a `pad.toml`, and where the settings of each are."""

PRESETS = {"published": "padforge.design.settings:PUBLISHED"}
"""Settings other than the defaults, by section, that `padforge init` can write."""

EXTRAS = {"design": "design", "fabricate": "cad", "sense": "train", "study": "train"}
"""What of `pyproject.toml` each stage needs to be installed; what chains stages needs all of it."""

BENCHES = {
    "contact": "padforge.design.pad.benchmark:BENCH",
    "objective": "padforge.design.criteria.benchmark:BENCH",
    "search": "padforge.design.optimisers.benchmark:BENCH",
    "networks": "padforge.design.evaluation.benchmark:BENCH",
    "filter": "padforge.sense.recordings.processing.benchmark:BENCH",
    "localizer": "padforge.sense.localizer.calibration.benchmark:BENCH",
    "twin": "padforge.sense.twin.benchmark:BENCH",
    "mould": "padforge.fabricate.mould.benchmark:BENCH",
}
"""Where each bench is, imported when it is asked for."""


def sections() -> "dict[str, type[Settings]]":
    """The models of all sections, by name."""
    return {name: resolve_name(where) for name, where in SECTIONS.items()}
