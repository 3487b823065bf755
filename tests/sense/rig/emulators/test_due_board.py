"""The board as it is emulated: what it refuses."""

import pytest

from sense.rig.boards.due.framing import BoardSettings, Status
from sense.rig.emulators.due_board import MAX_PERIOD_NS, MIN_NS_PER_CONVERSION, judge_settings


@pytest.mark.parametrize(
    ("settings", "status"),
    [
        (BoardSettings(8 * MIN_NS_PER_CONVERSION, 0xFF, 1), Status.OK),
        (BoardSettings(8 * MIN_NS_PER_CONVERSION - 1, 0xFF, 1), Status.TOO_FAST),
        (BoardSettings(12 * 16 * MIN_NS_PER_CONVERSION, 0xFFF, 16), Status.OK),
        (BoardSettings(12 * 16 * MIN_NS_PER_CONVERSION - 1, 0xFFF, 16), Status.TOO_FAST),
        (BoardSettings(MAX_PERIOD_NS, 1, 1), Status.OK),
        (BoardSettings(MAX_PERIOD_NS + 1, 1, 1), Status.BAD_SETTINGS),
    ],
)
def test_a_period_is_at_least_that_of_its_conversions(settings: BoardSettings, status: Status) -> None:
    assert judge_settings(settings) == status
