"""The fibres as resistors: what each should have from end to end, and the fixed one in its divider."""

from collections.abc import Iterator, Mapping
from typing import Any

from padforge.fabricate.materials import divider_ohm
from padforge.fabricate.mould.plan import Plan

from .tables import table


def resistances(plan: Plan, length_mm: float) -> dict[str, float | None]:
    """Of a fibre from end to end, leads included, and of the fixed resistor of its divider; None where unknown."""
    ohm_per_mm = plan.settings.fibre.material.ohm_per_mm
    if ohm_per_mm is None:
        return {"resistance_ohm": None, "divider_ohm": None}
    ohm = ohm_per_mm * length_mm
    return {"resistance_ohm": round(ohm, 2), "divider_ohm": divider_ohm(ohm)}


def wiring(document: Mapping[str, Any]) -> Iterator[str]:
    """What every fibre should have, and the resistor to wire it to, from a whole fabrication document."""
    fibres, ohm_per_mm = document["fibres"], document["fibre"]["ohm_per_mm"]
    if "exits" in document:
        numbers = ", ".join(map(str, document["exits"]))
        yield f"Along the near side, from left to right as the pad lies for laying, these fibres end: {numbers}."
        yield ""
    if ohm_per_mm is None:
        yield (
            f"The resistance of the fibre, {document['fibre']['name']}, is unknown: measure 100 mm of it and set"
            " `[fibre] ohm_per_mm`. What each fibre then has, and the fixed resistor that goes with it, stand here."
        )
        return
    yield (
        f"At {ohm_per_mm:.3g} Ohm per mm the fibres should have these resistances from end to end, leads included. A"
        " divider shows a change by the most if its fixed resistor is as large as the fibre at rest: here the nearest"
        " of the E24 series. 1 % more in the fibre then is 1/400 of the supply, 8 mV of 3.3 V."
    )
    yield ""
    rows = [(f["number"], f["fibre"], *(_ohms(f[key]) for key in ("resistance_ohm", "divider_ohm"))) for f in fibres]
    yield from table(("number", "fibre", "resistance", "fixed resistor"), rows)


def _ohms(ohm: float) -> str:
    """A resistance to three digits, as it is said at the bench."""
    factor, unit = next(pair for pair in ((1e6, "MOhm"), (1e3, "kOhm"), (1.0, "Ohm")) if ohm >= pair[0] or pair[0] == 1)
    return f"{float(f'{ohm / factor:.3g}'):g} {unit}"
