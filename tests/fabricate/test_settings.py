import pytest

from design.errors import InputError
from design.settings import Spec, commented_toml
from fabricate.settings import DEFAULTS, MODELS, Mould, Printer, Settings


def test_defaults_come_back_from_their_own_file(tmp_path):
    path = tmp_path / "pad.toml"
    path.write_text(commented_toml(MODELS), encoding="utf-8")
    assert Settings.from_spec(Spec.load(path)) == DEFAULTS


@pytest.mark.parametrize(
    ("tables", "parts"),
    [
        ({"mould": {"ridge_width": 1.0}}, ("[mould] ridge_width", "no such key", "ridge_width_mm")),
        ({"mould": {"wall_mm": 0.1}}, ("[mould] wall_mm", "0.1", "greater than or equal to 0.8")),
        ({"mould": {"floor_mm": "2"}}, ("[mould] floor_mm", "'2'", "number")),
        ({"printer": {"bed_mm": [100.0, 100.0]}}, ("[printer] bed_mm", "at least 3")),
        ({"printer": {"layer_mm": 0.0}}, ("[printer] layer_mm", "0.0", "greater than 0")),
    ],
)
def test_a_bad_key_is_one_clear_line(tables, parts):
    spec = Spec(tables, "pad.toml")
    with pytest.raises(InputError) as error:
        Settings.from_spec(spec)
    assert all(part in str(error.value) for part in parts), error.value
    assert "\n" not in str(error.value)


def test_the_deep_family_has_the_tall_ridges():
    horizontal = Settings.from_spec(Spec({}))
    vertical = Settings.from_spec(Spec({"pad": {"deep_family": "vertical"}}))
    assert horizontal.ridge_heights_mm == (1.2, 0.4)
    assert vertical.ridge_heights_mm == (0.4, 1.2)


def test_default_ridges_are_whole_layers_of_common_printers():
    for layer_mm in (0.1, 0.2):
        for height in (Mould().deep_ridge_height_mm, Mould().shallow_ridge_height_mm, Mould().floor_mm):
            assert height / layer_mm == pytest.approx(round(height / layer_mm))
    assert Printer().layer_mm == 0.1
