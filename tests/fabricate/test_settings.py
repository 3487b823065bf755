import math

import numpy as np
import pytest

from design.common.errors import InputError
from design.common.settings import Spec, commented_toml
from design.settings import Layout
from fabricate.materials import FibreSettings, SiliconeSettings
from fabricate.settings import DEFAULTS, DispenserSettings, FabricationSettings, MouldSettings, PrinterSettings
from tests.fabricate.planted import with_settings


def test_defaults_come_back_from_their_own_file(tmp_path):
    path = tmp_path / "pad.toml"
    models = (MouldSettings, PrinterSettings, DispenserSettings, SiliconeSettings, FibreSettings)
    path.write_text(commented_toml({model.section(): model for model in models}), encoding="utf-8")
    assert FabricationSettings.from_spec(Spec.load(path)) == DEFAULTS


@pytest.mark.parametrize(
    ("tables", "parts"),
    [
        ({"mould": {"ridge_width": 1.0}}, ("[mould] ridge_width", "no such key", "ridge_width_mm")),
        ({"mould": {"wall_mm": 0.1}}, ("[mould] wall_mm", "0.1", "greater than or equal to 0.8")),
        ({"mould": {"floor_mm": "2"}}, ("[mould] floor_mm", "'2'", "number")),
        ({"printer": {"bed_mm": [100.0, 100.0]}}, ("[printer] bed_mm", "at least 3")),
        ({"dispenser": {"box_mm": [0.0, 9.0, 5.0, 5.0, 0.0, 9.0]}}, ("[dispenser] box_mm", "5.0", "from low to high")),
        ({"dispenser": {"arm_pose": [0.0, 1.0]}}, ("[dispenser] arm_pose", "1.0")),
        ({"dispenser": {"arm_pose": "known"}}, ("[dispenser] arm_pose", "'known'")),
        ({"dispenser": {"arm_pose": [400.0, -250.0, 100.0, 0.0, 0.0, 1.5]}}, ("[dispenser] arm_pose", "400.0", "10")),
        ({"printer": {"layer_mm": 0.0}}, ("[printer] layer_mm", "0.0", "greater than or equal to 0.01")),
    ],
)
def test_a_bad_key_is_one_clear_line(tables, parts):
    spec = Spec(tables, "pad.toml")
    with pytest.raises(InputError) as error:
        FabricationSettings.from_spec(spec)
    assert all(part in str(error.value) for part in parts), error.value
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("ridge_width_mm", 12.0),
        ("floor_mm", 0.0),
        ("wall_mm", 0.0),
        ("silicone_mm", 0.0),
        ("wall_draft_deg", -1.0),
        ("ridge_draft_deg", -1.0),
        ("ridge_draft_deg", math.nan),
        ("silicone_mm", math.nan),
        ("silicone_mm", math.inf),
        ("exit_width_mm", 11.0),
        ("exit_width_mm", 0.3),
        ("levels", "three"),
        ("spout", True),
    ],
)
def test_hostile_values_are_one_clear_line(key, value):
    with pytest.raises(InputError, match=rf"\[mould\] {key}: (got )?") as refusal:
        FabricationSettings.from_spec(Spec({"mould": {key: value}})).require_consistent(Layout.of(4))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("pitch_mm", [0.1, 3.0])
def test_a_pitch_too_small_for_the_ridges_or_the_exits(pitch_mm):
    with pytest.raises(InputError, match="allowed is less than the pitch"):
        DEFAULTS.require_consistent(Layout.of(4, pitch_mm))


def test_terraces_are_whole_layers_with_steps_no_printer_places():
    for draft, layers in ((0.5, 34), (3.0, 5), (20.0, 1)):
        settings = FabricationSettings(mould=MouldSettings(ridge_draft_deg=draft))
        assert settings.terrace_mm == pytest.approx(layers * 0.1)
    assert FabricationSettings().terrace_mm == math.inf


def test_default_ridges_are_whole_layers_of_common_printers():
    for layer_mm in (0.1, 0.2):
        for height in (
            MouldSettings().deep_ridge_height_mm,
            MouldSettings().shallow_ridge_height_mm,
            MouldSettings().floor_mm,
        ):
            assert height / layer_mm == pytest.approx(round(height / layer_mm))
    assert PrinterSettings().layer_mm == 0.1


@pytest.mark.parametrize("shrinkage", [1e-3, 0.013, 0.2])
def test_a_mould_is_larger_by_what_the_silicone_shrinks(shrinkage):
    asked = with_settings({"border_mm": 1.5}, silicone={"shrinkage": shrinkage})
    mould = asked.enlarged().mould
    for key in ("border_mm", "ridge_width_mm", "exit_mm", "exit_width_mm", "number_mm"):
        assert getattr(mould, key) * (1 - shrinkage) == pytest.approx(getattr(asked.mould, key), rel=1e-12)
    for key in ("floor_mm", "wall_mm", "wall_draft_deg", "tolerance_mm", "min_silicone_mm", "lead_mm"):
        assert getattr(mould, key) == getattr(asked.mould, key)
    assert asked.enlarged().shrunk == 1


@pytest.mark.parametrize("layer_mm", [0.1, 0.2])
@pytest.mark.parametrize("shrinkage", [1e-3, 0.02, 0.13])
def test_heights_of_whole_layers_stay_so_and_come_out_within_half_a_layer(layer_mm, shrinkage):
    asked = with_settings(printer={"layer_mm": layer_mm}, silicone={"shrinkage": shrinkage})
    for key in ("silicone_mm", "deep_ridge_height_mm", "shallow_ridge_height_mm"):
        height = getattr(asked.enlarged().mould, key)
        assert height / layer_mm == pytest.approx(round(height / layer_mm))
        assert height * (1 - shrinkage) == pytest.approx(getattr(asked.mould, key), abs=layer_mm / 2)


def test_heights_between_layers_are_larger_like_all_else():
    asked = with_settings({"silicone_mm": 5.55, "shallow_ridge_height_mm": 0.45}, silicone={"shrinkage": 0.1})
    for key in ("silicone_mm", "deep_ridge_height_mm", "shallow_ridge_height_mm"):
        assert getattr(asked.enlarged().mould, key) * 0.9 == pytest.approx(getattr(asked.mould, key))


def test_the_defaults_are_those_the_pads_were_made_with():
    assert MouldSettings().model_dump() == {
        "floor_mm": 2.0,
        "wall_mm": 2.0,
        "wall_draft_deg": 2.0,
        "silicone_mm": 6.0,
        "border_mm": 0.0,
        "ridge_width_mm": 0.4,
        "ridge_draft_deg": 0.0,
        "deep_ridge_height_mm": 1.2,
        "shallow_ridge_height_mm": 0.4,
        "levels": "as_needed",
        "min_silicone_mm": 0.4,
        "exit_mm": 2.0,
        "exit_width_mm": 3.0,
        "number_mm": 2.5,
        "pins": False,
        "lid": False,
        "spout": False,
        "holder": False,
        "conductive": False,
        "lead_mm": 30.0,
        "tolerance_mm": 0.01,
    }
    assert PrinterSettings().model_dump() == {
        "nozzle_mm": 0.4,
        "layer_mm": 0.1,
        "bed_mm": [220.0, 220.0, 250.0],
        "resin": False,
    }


@pytest.mark.parametrize("other", [None, 3, "pad.toml", {"mould": {}}])
def test_settings_are_read_from_a_spec_and_nothing_else(other):
    with pytest.raises(InputError, match=r"spec is .*, expected a Spec"):
        FabricationSettings.from_spec(other)


def test_numbers_of_numpy_are_numbers():
    assert Spec({}).section(MouldSettings, wall_mm=np.int64(3)) == MouldSettings(wall_mm=3)
    assert Spec({}).section(PrinterSettings, bed_mm=np.array([200, 210, 220])) == PrinterSettings(
        bed_mm=[200, 210, 220]
    )
