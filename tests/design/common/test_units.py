"""Quantities with units in settings: what they come to, and what is refused."""

import math
from typing import Any

import pytest

from padforge.design.common.settings import Spec
from padforge.design.common.units import to_unit
from padforge.design.common.validation import InputError
from padforge.design.settings import SILICONE_MM, read_contact
from padforge.settings import section_models

MODELS = section_models()


@pytest.mark.parametrize(
    ("section", "key", "value", "expected"),
    [
        ("pad", "pitch_mm", "5 mm", 5.0),
        ("pad", "pitch_mm", "0.2 in", 5.08),  # rounded once: 0.2 * 25.4 is 5.079999
        ("pad", "pitch_mm", ["0.5cm", 8], (5.0, 8.0)),
        ("pad", "sensed_mm", "fibres", "fibres"),
        ("pad", "bent_radius_mm", "0.1 m", 100.0),
        ("pad", "bent_radius_mm", "flat", None),
        ("pad", "keep_out_mm", [[["0 cm", 0], ["1 cm", 0], [0, "1 cm"]]], (((0, 0), (10, 0), (0, 10)),)),
        ("printer", "layer_mm", "100 um", 0.1),
        ("printer", "layer_mm", "100 µm", 0.1),
        ("printer", "layer_mm", "100 \u03bcm", 0.1),  # the Greek letter
        ("rig", "pad_angle_deg", "1 rad", math.degrees(1)),
        ("mould", "wall_draft_deg", "2°", 2.0),
        ("dispenser", "travel_mm_s", "600 mm/min", 10.0),
        ("dispenser", "acceleration_mm_s2", "0.1 m/s^2", 100.0),
        ("silicone", "cure_h", "240 min", 4.0),
        ("silicone", "pot_life_min", "0.5 h", 30.0),
        ("rig", "rate_hz", "1e-1 kHz", 100.0),
        ("rig", "noise_mv", "0.001 V", 1.0),
        ("rig", "touch_s", "20 ms", 0.02),
        ("rig", "max_force_n", "500 mN", 0.5),
        ("rig", "tool_rad", [0, "180 deg", 0], (0.0, math.pi, 0.0)),
    ],
)
def test_quantities_are_converted_to_the_unit_of_the_key(section: str, key: str, value: Any, expected: Any) -> None:
    assert getattr(Spec({section: {key: value}}).section(MODELS[section]), key) == expected


@pytest.mark.parametrize(
    ("section", "key", "value", "allowed"),
    [
        ("pad", "pitch_mm", "5 kg", "mm, cm, m, um, in"),
        ("pad", "pitch_mm", [8, "5 mm/s"], "mm, cm, m, um, in"),
        ("pad", "pitch_mm", "5", "mm, cm, m, um, in"),
        ("pad", "pitch_mm", "5 MM", "mm, cm, m, um, in"),
        ("pad", "pitch_mm", "1e400 mm", "mm, cm, m, um, in"),
        ("rig", "max_force_n", "20 kg", "N, mN"),
        ("pad", "grid", "5 mm", "integer"),
        ("contact", "radius", "5 mm", "number"),  # in grid units
        ("fibre", "ohm_per_mm", "5 mm", "number"),
    ],
)
def test_wrong_units_are_refused_with_key_value_and_units(section: str, key: str, value: Any, allowed: str) -> None:
    with pytest.raises(InputError) as refused:
        Spec({section: {key: value}}, "pad.toml").section(MODELS[section])
    assert str(refused.value).startswith(f"pad.toml: [{section}] {key}: got {value!r}, ")
    assert allowed in str(refused.value)


def test_contact_of_a_mould_stated_in_units() -> None:
    """The pad is as thick as the mould makes it, in whatever unit the mould states that."""
    contact = read_contact(Spec({"mould": {"silicone_mm": "0.8 cm"}, "fibre": {"diameter_mm": "200 um"}}))
    assert (contact.thickness_mm, contact.fibre_depths_mm) == (8.0, pytest.approx((1.1, 0.3)))
    assert read_contact(Spec({"mould": {"silicone_mm": "8 kg"}})).thickness_mm == SILICONE_MM  # [mould] refuses it


def test_lists_that_contain_themselves_are_left_to_the_model() -> None:
    endless: list[Any] = ["1 cm"]
    endless.append(endless)
    converted = to_unit("pitch_mm", endless)
    assert isinstance(converted, list)
    assert converted[0] == 10.0
