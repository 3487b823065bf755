"""`[rig]` and `[localizer]`: the defaults, and where their ranges end."""

import pytest

from sense.settings import LocalizerSettings, RigSettings
from tests.helpers.limits import require_ends


def test_the_defaults_are_those_of_the_published_bench() -> None:
    rig = RigSettings().model_dump()
    expected = {
        "presses": 1500,
        "plan": "uniform",
        "rate_hz": 13.3,
        "readings_per_press": 40,
        "depth_mm": 5.0,
        "seed": 0,
        "noise_mv": 1.6,
        "drift_mv": 40.0,
        "creep": 0.1,
        "hysteresis": 0.2,
        "converter_rate_hz": 1000.0,
        "channels": 8,
        "box_mm": "unknown",
        "contact_mm": "unknown",
        "pad_angle_deg": 0.0,
        "max_depth_mm": 6.0,
        "clearance_mm": 10.0,
        "travel_mm_s": 100.0,
        "press_mm_s": 40.0,
        "acceleration_mm_s2": 500.0,
        "max_force_n": 60.0,
    }
    assert {key: rig[key] for key in expected} == expected
    assert LocalizerSettings().model_dump() == {
        "method": "masked",
        "features": "full",
        "split": "random",
        "test_share": 0.15,
        "lost": 3,
        "members": 2,
        "hidden": 256,
        "layers": 5,
        "epochs": 600,
        "batch": 256,
        "rate": 0.004,
        "seed": 0,
    }


@pytest.mark.parametrize(
    ("model", "key", "kept", "refused"),
    [
        (RigSettings, "max_force_n", (0.1, 250.0), (0.0, 250.1)),
        (RigSettings, "max_depth_mm", (0.1, 50.0), (0.0, 50.1)),
        (RigSettings, "press_mm_s", (0.1, 250.0), (0.0, 250.1)),
        (RigSettings, "travel_mm_s", (0.1, 500.0), (0.0, 500.1)),
        (RigSettings, "clearance_mm", (1.0, 500.0), (0.9, 500.1)),
        (RigSettings, "channels", (1, 8), (0, 9)),
        (LocalizerSettings, "test_share", (0.01, 0.99), (0.0, 1.0)),
        (LocalizerSettings, "lost", (0, 8), (-1, 9)),
        (LocalizerSettings, "rate", (1e-6, 1.0), (0.0, 1.1)),
    ],
)
def test_values_at_the_ends_of_what_is_allowed(model: type, key: str, kept: tuple, refused: tuple) -> None:
    require_ends(model, key, kept, refused)
