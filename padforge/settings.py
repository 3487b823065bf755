"""All sections of a `pad.toml`, and the check that they do not contradict each other."""

from pkgutil import resolve_name
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from padforge.common.settings import Settings, Spec

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
"""Sections of a `pad.toml`, and the model of each."""


def section_models() -> "dict[str, type[Settings]]":
    """Import the models of all sections, by name."""
    return {name: resolve_name(path) for name, path in SECTIONS.items()}


def check_settings(spec: "Spec") -> None:
    """Check all sections and whether they contradict each other, including sections that a command does not need.

    Fibres and pitch of the pad are compared only if they are stated, since most commands take them from a morphology.

    Raises:
        InputError: a key is unknown, a value out of range, or two sections contradict each other.
    """
    from padforge.design.settings import PadSettings
    from padforge.fabricate import FabricationSettings
    from padforge.sense.settings import read_rig

    for model in section_models().values():
        if model.section() != "contact":  # which `FabricationSettings` reads, completed by the lengths of the cast pad
            spec.section(model)
    fabrication, rig = FabricationSettings.from_spec(spec), read_rig(spec)
    if spec.stated(PadSettings).keys() & {"grid", "horizontals", "verticals", "pitch_mm", "size_mm"}:
        layout = spec.section(PadSettings).layout
        fabrication.require_consistent(layout)
        rig.inputs(layout.fibres)
