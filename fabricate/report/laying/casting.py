"""The silicone of a pad: how much of it to mix, and how to cast it."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from padforge.fabricate.mould.plan import Plan

from .tables import table

SURPLUS_PERCENT = 10
"""What sticks to the cup and the stick."""


def silicone(plan: Plan, mould_mm3: float) -> dict[str, Any]:
    """What fills the mould to the top of its walls: the box around it without the mould itself."""
    printed, material = plan.enlarged, plan.settings.silicone.material
    volume_ml = (printed.tray.area * (plan.settings.mould.floor_mm + printed.silicone_mm) - mould_mm3) / 1000
    mass_g = volume_ml * material.density_g_per_ml * (1 + SURPLUS_PERCENT / 100)
    part_a_g, part_b_g = (round(mass_g * part / sum(material.parts), 2) for part in material.parts)
    return {
        **asdict(material),
        "parts": list(material.parts),
        "thickness_mm": plan.thickness_mm,
        "volume_ml": round(volume_ml, 4),
        "surplus_percent": SURPLUS_PERCENT,
        "mass_g": round(part_a_g + part_b_g, 2),
        "part_a_g": part_a_g,
        "part_b_g": part_b_g,
    }


def mixing(silicone: Mapping[str, Any]) -> Iterator[str]:
    """What to weigh, from what `silicone` says."""
    parts = [round(silicone[key], 1) for key in ("part_a_g", "part_b_g")]
    masses = [f"{mass:.1f} g" for mass in (*parts, sum(parts))]
    yield from table((silicone["name"], "part A", "part B", "together"), [("mass", *masses)])
    yield ""
    yield (
        f"The mould holds {silicone['volume_ml']:.1f} ml, the pad is {silicone['thickness_mm']:.3g} mm thick."
        f" The masses include {silicone['surplus_percent']:g} % for what stays in the cup."
    )
    if silicone["shrinkage"]:
        yield (
            f"The silicone shrinks by {100 * silicone['shrinkage']:.3g} % as it cures, and the mould is larger by that."
            " Lengths and places below are those of the pad."
        )


def casting(document: Mapping[str, Any]) -> Iterator[str]:
    """How to cast, in steps, from a whole fabrication document."""
    mould, silicone = document["settings"]["mould"], document["silicone"]
    pour = "Pour it slowly into one corner of the level mould, up to the top of the walls."
    if mould["spout"]:
        pour = "Lay the lid on the level mould and pour through its spout until silicone rises in the vents."
    elif mould["lid"]:
        pour += " Lay the lid on: air and surplus leave by its vents."
    pot_life = _duration(silicone["pot_life_min"])
    yield f"1. Stir part A and part B together. The pot life is {pot_life}: be done with pouring by then."
    yield "2. Degas the mix in a vacuum until its bubbles have burst."
    yield f"3. {pour}"
    yield f"4. Leave it for {_duration(60 * silicone['cure_h'])} at room temperature."
    around = " and around every pillar" if document["settings"]["pad"]["keep_out_mm"] else ""
    yield f"5. Free the casting all along the walls{around}, then pull it out from a corner."


def _duration(minutes: float) -> str:
    """Minutes up to an hour and a half, else hours."""
    return f"{minutes:g} minutes" if minutes <= 90 else f"{minutes / 60:.3g} hours"
