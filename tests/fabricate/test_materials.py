import math

import numpy as np
import pytest
import trimesh

from design.common.errors import InputError
from design.common.settings import Spec
from design.pad.morphology import Morphology
from fabricate.export import build
from fabricate.materials import FIBRES, SILICONES, Fibre, FibreSettings, Silicone, SiliconeSettings, divider_ohm
from tests.fabricate.planted import with_settings


@pytest.mark.parametrize(
    ("written", "preset"),
    [
        ("EcoFlex 00-30", "EcoFlex 00-30"),
        ("ecoflex 0030", "EcoFlex 00-30"),
        ("DRAGON SKIN 10 Slow", "Dragon Skin 10 slow"),
        ("dragonskin20", "Dragon Skin 20"),
        ("Published", "published"),
    ],
)
def test_a_preset_is_found_however_its_name_is_written(written, preset):
    settings = SiliconeSettings(name=written)
    assert settings.name == preset
    assert settings.material == SILICONES[preset]


@pytest.mark.parametrize(
    ("section", "model", "presets", "needed"),
    [
        ("silicone", SiliconeSettings, SILICONES, "cure_h, density_g_per_ml, parts, pot_life_min, shrinkage"),
        ("fibre", FibreSettings, FIBRES, "diameter_mm"),
    ],
)
def test_an_unknown_preset_gets_the_list(section, model, presets, needed):
    with pytest.raises(InputError) as error:
        Spec({section: {"name": "Ecoflex 00-31"}}, "pad.toml").section(model)
    assert str(error.value) == (
        f"pad.toml: [{section}] name: got 'Ecoflex 00-31', allowed are {', '.join(presets)};"
        f" or a material of your own with {needed} set"
    )


def test_what_is_set_stands_in_place_of_the_preset():
    grade = SiliconeSettings(name="Dragon Skin 30", shrinkage=0.004).material
    assert (grade.shrinkage, grade.cure_h, grade.density_g_per_ml) == (0.004, 16, 1.08)
    assert FibreSettings(ohm_per_mm=120.0).material == Fibre("carbon-black TPE", 0.3, 120.0, None, 0.8)


def test_materials_of_ones_own():
    spec = Spec(
        {
            "silicone": {
                **{"name": "Sylgard 184", "density_g_per_ml": 1.03, "parts": [10, 1]},
                **{"pot_life_min": 90, "cure_h": 48, "shrinkage": "preset"},
            },
            "fibre": {"name": "silvered yarn", "diameter_mm": 0.2},
        }
    )
    with pytest.raises(InputError, match="of your own with shrinkage set"):
        spec.section(SiliconeSettings)
    whole = spec.section(SiliconeSettings, shrinkage=0.01)
    assert whole.material == Silicone("Sylgard 184", 1.03, (10, 1), 90, 48, 0.01)
    assert spec.section(FibreSettings).material == Fibre("silvered yarn", 0.2)


@pytest.mark.parametrize(
    ("model", "key", "value"),
    [
        (SiliconeSettings, "density_g_per_ml", 0.0),
        (SiliconeSettings, "parts", [1.0, 0.0]),
        (SiliconeSettings, "parts", [1.0]),
        (SiliconeSettings, "shrinkage", 0.3),
        (SiliconeSettings, "shrinkage", -0.01),
        (SiliconeSettings, "cure_h", math.nan),
        (FibreSettings, "diameter_mm", 11.0),
        (FibreSettings, "ohm_per_mm", "unknown"),
        (FibreSettings, "least_bend_mm", -1.0),
        (FibreSettings, "name", ""),
        (FibreSettings, "name", "two\nlines"),
        (SiliconeSettings, "name", "a | b"),
    ],
)
def test_hostile_values_are_one_clear_line(model, key, value):
    with pytest.raises(InputError, match=rf"^pad.toml: \[{model.section()}\] {key}(\.\d)?: got ") as refusal:
        Spec({model.section(): {key: value}}, "pad.toml").section(model)
    assert "\n" not in str(refusal.value)


def test_the_default_silicone_is_that_of_the_published_pads_whose_moulds_were_as_large():
    assert SiliconeSettings().material == Silicone("EcoFlex 00-20", 1.07, (1, 1), 30, 4, 0)
    assert FibreSettings().material.diameter_mm == 0.3
    assert {grade.shrinkage for name, grade in SILICONES.items() if name != "published"} == {0.001}


@pytest.mark.parametrize("fibre_ohm", [0.3, 1.0, 9.7, 99.0, 105.0, 7.3e3, 9.6e4, 1e5, 3.14159e6])
def test_no_resistor_of_the_series_shows_a_change_better(fibre_ohm):
    series = "1 1.1 1.2 1.3 1.5 1.6 1.8 2 2.2 2.4 2.7 3 3.3 3.6 3.9 4.3 4.7 5.1 5.6 6.2 6.8 7.5 8.2 9.1"
    sold = [float(f"{value}e{decade}") for value in series.split() for decade in range(-2, 8)]

    def swing(ohm: float) -> float:
        return ohm / (ohm + fibre_ohm) - ohm / (ohm + 1.0001 * fibre_ohm)

    found = divider_ohm(fibre_ohm)
    assert found in sold
    assert swing(found) >= max(map(swing, sold)) * (1 - 1e-4)
    assert swing(found) > 0.99 * 1e-4 / 4


def test_a_shrinking_silicone_gets_a_larger_mould_and_the_same_pad(tmp_path):
    pad, mould = Morphology.straight(2, 12.0), {"holder": True, "number_mm": 0.0, "exit_mm": 0.0}
    kept = build(pad, tmp_path / "kept", ["stl"], with_settings(mould))
    grown = build(pad, tmp_path / "grown", ["stl"], with_settings(mould, silicone={"shrinkage": 0.04}))
    floors = []
    for folder in ("kept", "grown"):
        mesh = trimesh.load_mesh(tmp_path / folder / "mould.stl")
        assert isinstance(mesh, trimesh.Trimesh)
        floors.append(mesh.vertices[np.isclose(mesh.vertices[:, 2], 2.0)][:, :2].max())
    assert floors == pytest.approx([18.0, 18.0 / 0.96], abs=1e-5)
    sizes = grown["sizes"]
    assert sizes["cavity_mm"] * 0.96 == pytest.approx(sizes["pad_mm"]) == pytest.approx(kept["sizes"]["pad_mm"])
    assert sizes["cavity_depth_mm"] == 6.2  # 6.25 mm in whole layers
    assert sizes["pad_thickness_mm"] == pytest.approx(6.2 * 0.96)
    assert grown["frame"]["surface_mm"] == pytest.approx(2 + 6.2 * 0.96)
    assert grown["frame"]["pad_mm"] == kept["frame"]["pad_mm"]
    assert (tmp_path / "kept" / "holder.stl").read_bytes() == (tmp_path / "grown" / "holder.stl").read_bytes()
    for key in ("in_pad_mm", "cut_mm"):
        assert [fibre[key] for fibre in grown["fibres"]] == [fibre[key] for fibre in kept["fibres"]]
    assert [row[2:4] for row in grown["crossings"]["table"]] == [row[2:4] for row in kept["crossings"]["table"]]
    assert [fibre["ridge_mm"] * 0.96 for fibre in grown["fibres"]] == pytest.approx(
        [fibre["depth_mm"] for fibre in grown["fibres"]]
    )
    assert {finding["status"] for finding in grown["findings"]} == {"pass"}


def test_what_does_not_shrink_has_the_mould_of_before(tmp_path):
    pad = Morphology.random(1, 2, seed=7)
    build(pad, tmp_path / "published", ["stl"])
    build(pad, tmp_path / "named", ["stl"], with_settings(silicone={"name": "Dragon Skin 30", "shrinkage": 0.0}))
    moulds = [(tmp_path / folder / "mould.stl").read_bytes() for folder in ("published", "named")]
    assert moulds[0] == moulds[1]
