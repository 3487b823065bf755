import math
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import pytest

from padforge.common.settings import Spec
from padforge.design.morphology import Morphology
from padforge.fabricate import FabricationSettings, MouldSettings, Plan, materials
from padforge.fabricate.mould import conductive_plan, lid_body, mould_body
from tests.fabricate.planted import with_settings
from tests.helpers.golden import json_text
from tests.helpers.refusals import refusal_table

OWN = {"name": "Sylgard 184", "density_g_per_ml": 1.03, "parts": [10, 1], "pot_life_min": 90, "cure_h": 48}
KEYS: list[tuple[str, dict[str, Any]]] = [
    ("mould", {"ridge_width": 1.0}),
    ("mould", {"wall_mm": 0.1}),
    ("dispenser", {"box_mm": [0.0, 9.0, 5.0, 5.0, 0.0, 9.0]}),
    ("silicone", {"name": "a | b"}),
    ("silicone", {"name": "Ecoflex 00-31"}),
    ("silicone", OWN | {"shrinkage": "preset"}),
    ("fibre", {"name": "yarn"}),
]
CONTRADICTIONS: list[tuple[float, dict[str, object]]] = [
    (11.25, {"ridge_width_mm": 12.0}),
    (11.25, {"spout": True}),
    (11.25, {"exit_width_mm": 0.3}),
    (3.3, {}),  # the walls on both sides of a slot lean outwards, by 6 mm tan(2 degrees) each
    (11.25, {"shallow_ridge_height_mm": 1.2}),
    (11.25, {"silicone_mm": 1.0}),
    (11.25, {"tolerance_mm": 0.1}),
]
BODIES: list[tuple[Callable[..., object], tuple, dict[str, object]]] = [
    (lid_body, (1, 3.5), {"lid": True, "spout": True}),
    (mould_body, (2,), {"pins": True, "exit_mm": 0.0, "wall_mm": 1.0}),
    (conductive_plan, (2, 5.0), {}),
]


def test_refusals_of_settings(golden):
    rows: dict[str, Callable[[], object]] = {}
    for section, keys in KEYS:
        rows[f"[{section}] {keys}"] = partial(FabricationSettings.from_spec, Spec({section: keys}, "pad.toml"))
    for pitch_mm, mould in CONTRADICTIONS:
        pad, settings = Morphology.straight(4, pitch_mm), with_settings(mould)
        rows[f"[mould] {mould}, pitch {pitch_mm} mm"] = partial(Plan, pad, settings)
    for make, size, mould in BODIES:
        pad, settings = Morphology.straight(*size), with_settings(mould)
        rows[f"{make.__name__} of {size}, {mould}"] = lambda make=make, at=(pad, settings): make(Plan(*at))
    golden("fabricate/refusals_of_settings.txt", refusal_table(rows))


def test_terraces_are_whole_layers():
    for draft, layers in ((0.5, 34), (3.0, 5), (20.0, 1)):
        settings = FabricationSettings(mould=MouldSettings(ridge_draft_deg=draft))
        assert settings.terrace_mm == pytest.approx(layers * 0.1)
    assert FabricationSettings().terrace_mm == math.inf


def test_materials_are_those_of_their_preset_or_of_their_keys():
    """Names of presets ignore case, spaces and hyphens."""
    for written, preset in (("ecoflex 0030", "Ecoflex 00-30"), ("Published", "published")):
        settings = materials.SiliconeSettings(name=written)
        assert (settings.name, settings.material) == (preset, materials.SILICONES[preset])
    grade = materials.SiliconeSettings(name="Dragon Skin 30", shrinkage=0.004).material
    assert (grade.shrinkage, grade.cure_h, grade.density_g_per_ml) == (0.004, 16, 1.08)
    fibre = materials.FibreSettings(ohm_per_mm=120.0).material
    assert fibre == materials.Fibre("carbon-black TPE", 0.3, 120.0, None, 0.8)
    spec = Spec({"silicone": OWN, "fibre": {"name": "silvered yarn", "diameter_mm": 0.2}})
    silicone = spec.section(materials.SiliconeSettings, shrinkage=0.01).material
    assert silicone == materials.Silicone("Sylgard 184", 1.03, (10, 1), 90, 48, 0.01)
    assert spec.section(materials.FibreSettings).material == materials.Fibre("silvered yarn", 0.2)


@pytest.mark.parametrize("fibre_ohm", [0.3, 34.48, 99.0, 9.6e4])
def test_divider_ohm_is_the_most_sensitive_of_the_series(fibre_ohm):
    series = "1 1.1 1.2 1.3 1.5 1.6 1.8 2 2.2 2.4 2.7 3 3.3 3.6 3.9 4.3 4.7 5.1 5.6 6.2 6.8 7.5 8.2 9.1"
    sold = [float(f"{value}e{decade}") for value in series.split() for decade in range(-2, 8)]

    def swing(ohm: float) -> float:
        """By how much of the supply the reading changes with a share of the fibre's resistance."""
        return ohm * fibre_ohm / (ohm + fibre_ohm) ** 2

    found = materials.divider_ohm(fibre_ohm)
    assert found == pytest.approx(max(sold, key=swing))
    assert swing(found) > 0.99 / 4


def test_materials(golden):
    """Moduli are those of the bulletins, in psi, to a kilopascal."""
    psi = [8, 8, 10, 12, 22, 22, 22, 49, 86]
    grades = [silicone for name, silicone in materials.SILICONES.items() if name != materials.PUBLISHED]
    for grade, modulus in zip(grades, psi, strict=True):
        assert grade.modulus_kpa == pytest.approx(6.894757 * modulus, abs=0.6)
    tables = {"silicones": materials.SILICONES, "fibres": materials.FIBRES}
    golden("fabricate/materials.json", json_text({n: {k: asdict(v) for k, v in t.items()} for n, t in tables.items()}))
