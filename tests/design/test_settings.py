"""`pad.toml`: defaults, comments, refusals."""

import tomllib

import pytest

from design import Contact, InputError, Spec
from design.settings import MODELS, Pad, Rules, Search, commented_toml


def test_the_written_defaults_read_back_as_the_defaults():
    text = commented_toml(MODELS)
    spec = Spec(tomllib.loads(text))
    for model in MODELS.values():
        assert spec.section(model) == model()
    for name, model in MODELS.items():
        assert f"[{name}]" in text
        for key, field in model.model_fields.items():
            assert any(line.startswith(f"{key} = ") and str(field.description) in line for line in text.splitlines())


@pytest.mark.parametrize(
    ("tables", "model", "message"),
    [
        ({"pads": {}}, Pad, r"unknown section \[pads\], allowed are pad, contact"),
        ({"pad": {"gird": 4}}, Pad, r"\[pad\] gird: no such key, allowed are grid"),
        ({"pad": {"grid": 0}}, Pad, r"\[pad\] grid: got 0, .*greater than or equal to 1"),
        ({"pad": {"pitch_mm": float("nan")}}, Pad, r"\[pad\] pitch_mm: got nan, .*finite"),
        ({"pad": {"grid": "4"}}, Pad, r"\[pad\] grid: got '4', .*integer"),
        ({"contact": {"sides": 2}}, Contact, r"\[contact\] sides: got 2"),
        ({"contact": {"weight": "cubic"}}, Contact, r"\[contact\] weight: got 'cubic', .*inverse_square"),
        ({"search": {"method": "luck"}}, Search, r"\[search\] method: got 'luck', .*descent"),
        ({"rules": 3}, Rules, r"rules is 3, expected a section \[rules\]"),
    ],
)
def test_refusals_name_the_key_the_value_and_what_is_allowed(tables, model, message):
    with pytest.raises(InputError, match=message) as refusal:
        Spec(tables).section(model)
    assert "\n" not in str(refusal.value)


def test_a_circle_is_written_and_read_as_a_word():
    assert Spec({"contact": {"sides": "circle"}}).section(Contact).sides is None
    assert Contact(sides=None).model_dump()["sides"] == "circle"


def test_overrides_win_over_the_file():
    spec = Spec({"search": {"knots": 7, "seed": 3}})
    found = spec.section(Search, knots=2, seed=None)
    assert (found.knots, found.seed) == (2, 3)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[pad", b"= 3"])
def test_files_that_are_no_toml_are_refused(tmp_path, content):
    path = tmp_path / "pad.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"pad\.toml: not a TOML file"):
        Spec.load(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        Spec.load(tmp_path / "none.toml")
