import math

import pytest

from design.common.errors import InputError
from design.common.settings import Spec, commented_toml
from fabricate.settings import DEFAULTS, FabricationSettings, MouldSettings, PrinterSettings


def test_defaults_come_back_from_their_own_file(tmp_path):
    path = tmp_path / "pad.toml"
    path.write_text(commented_toml({"mould": MouldSettings, "printer": PrinterSettings}), encoding="utf-8")
    assert FabricationSettings.from_spec(Spec.load(path)) == DEFAULTS


@pytest.mark.parametrize(
    ("tables", "parts"),
    [
        ({"mould": {"ridge_width": 1.0}}, ("[mould] ridge_width", "no such key", "ridge_width_mm")),
        ({"mould": {"wall_mm": 0.1}}, ("[mould] wall_mm", "0.1", "greater than or equal to 0.8")),
        ({"mould": {"floor_mm": "2"}}, ("[mould] floor_mm", "'2'", "number")),
        ({"printer": {"bed_mm": [100.0, 100.0]}}, ("[printer] bed_mm", "at least 3")),
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
        FabricationSettings.from_spec(Spec({"mould": {key: value}})).require_consistent(11.25)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("pitch_mm", [0.1, 3.0])
def test_a_pitch_too_small_for_the_ridges_or_the_exits(pitch_mm):
    with pytest.raises(InputError, match="allowed is less than the pitch"):
        DEFAULTS.require_consistent(pitch_mm)


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
