"""`[rig]` and `[localizer]`: where their ranges end."""

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense.settings import LocalizerSettings, RigSettings
from tests.helpers.limits import require_ends


@pytest.mark.parametrize(
    ("model", "key", "kept", "refused"),
    [
        (RigSettings, "max_force_n", (0.1, 250.0, "unwatched"), (0.0, 250.1, "unknown")),
        (RigSettings, "depth_mm", (0.1, 50.0, "contact"), (0.0, 50.1, "deep")),
        (RigSettings, "depths_mm", ([0.1, 50.0],), ([5.0, 0.0], [50.1])),
        (RigSettings, "max_depth_mm", (0.1, 50.0), (0.0, 50.1)),
        (RigSettings, "press_mm_s", (0.1, 250.0), (0.0, 250.1)),
        (RigSettings, "travel_mm_s", (0.1, 500.0), (0.0, 500.1)),
        (RigSettings, "acceleration_mm_s2", (0.1, 3000.0), (0.0, 3000.1)),
        (RigSettings, "clearance_mm", (1.0, 500.0), (0.9, 500.1)),
        (RigSettings, "box_mm", ([-1e4, 1e4] * 3, "unknown"), ([0, 1] * 2, [0, float("nan")] * 3)),
        (RigSettings, "contact_mm", (-1e4, 1e4, "unknown"), (1.1e4, float("inf"), "unwatched")),
        (RigSettings, "tool_rad", ([0, 6.3, 0],), ([0, 6.4, 0], [0, 3.14])),
        (RigSettings, "plan", ("serpentine", "mine.CSV"), ("boustrophedon", "mine.txt")),
        (RigSettings, "baud", (9600, 20_000_000), (9599, 20_000_001)),
        (RigSettings, "channels", ([0, 511], []), (8, [-1], [512], ["A0"])),
        (LocalizerSettings, "test_share", (0.01, 0.99), (0.0, 1.0)),
        (LocalizerSettings, "max_failures", (0, 8), (-1, 9)),
        (LocalizerSettings, "learning_rate", (1e-6, 1.0), (0.0, 1.1)),
    ],
)
def test_values_at_the_ends_of_what_is_allowed(model: type, key: str, kept: tuple, refused: tuple) -> None:
    require_ends(model, key, kept, refused)


def test_a_force_that_nobody_watches_is_said_in_words_and_numbers_may_be_of_numpy() -> None:
    assert RigSettings.model_validate({"max_force_n": "unwatched"}).max_force_n is None
    assert RigSettings(max_force_n=None).model_dump()["max_force_n"] == "unwatched"
    box_mm = np.array([[-30, 30], [-30, 30], [5, 60]]).ravel()  # numbers of NumPy are numbers
    rig = RigSettings(presses=np.int64(50), noise_mv=np.float32(0.5), channels=np.arange(3), box_mm=box_mm)  # type: ignore[arg-type]
    assert rig == RigSettings(presses=50, noise_mv=0.5, channels=(0, 1, 2), box_mm=(-30, 30, -30, 30, 5, 60))


def test_inputs_are_in_order_or_as_they_are_named() -> None:
    assert RigSettings().inputs(16) == tuple(range(16))
    assert RigSettings(channels=(3, 0, 11, 2)).inputs(4) == (3, 0, 11, 2)
    for channels, said in (
        ((3, 0, 2), "got 3 inputs, the pad has 4 fibres: name one for each"),
        ((3, 0, 2, 1, 4), "got 5 inputs, the pad has 4 fibres"),
        ((3, 0, 2, 3), "got input 3 for more than one fibre"),
    ):
        with pytest.raises(InputError, match=rf"^\[rig\] channels: {said}"):
            RigSettings(channels=channels).inputs(4)
