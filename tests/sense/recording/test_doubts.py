"""Units that cannot be right, and presses far outside of the others."""

import re
from dataclasses import replace

import numpy as np
import pytest

from padforge.sense import Recording
from padforge.sense.recording.doubts import area_mm, find_doubts


def test_plausible_recordings_are_not_doubted(recording: Recording) -> None:
    assert find_doubts(recording) == []
    unknown = np.where(np.arange(300)[:, None] < 299, np.nan, recording.presses_mm)
    assert area_mm(replace(recording, presses_mm=unknown)) is None
    assert find_doubts(replace(recording, presses_mm=unknown)) == []


@pytest.mark.parametrize(
    ("name", "factor", "doubt"),
    [
        ("presses_mm", 1e-3, r"positions span 0\.0\d+ x 0\.0\d+ mm; are they in m \(x=NAME:m,y=NAME:m\)\?"),
        ("presses_mm", 1e3, r"positions span 2\.\d+e\+04 x 2\.\d+e\+04 mm; are they in another unit"),
        ("times_s", 1e3, r"there are 0\.013 readings a second; is time in ms \(time=NAME:ms\)\?"),
        ("times_s", 1e-3, r"there are 1\.3\d+e\+04 readings a second; is time in s "),
        (
            "readings",
            300,
            r"fibres rest at \d+(\.\d)? V; are they counts \(fibres=NAME:0\.00323 for 10 bits of 3\.3 V\)",
        ),
    ],
)
def test_units_are_doubted(recording: Recording, name: str, factor: float, doubt: str) -> None:
    (line,) = find_doubts(replace(recording, **{name: factor * getattr(recording, name)}))
    assert re.match(doubt, line), line


def test_far_presses_are_named(recording: Recording) -> None:
    presses_mm = recording.presses_mm.copy()
    presses_mm[7] = 250, 3.25
    (line,) = find_doubts(replace(recording, presses_mm=presses_mm))
    assert line.startswith("far outside of where most presses lie, x = ")
    assert line.endswith(" mm: press 7 at (250, 3.25) mm")
    presses_mm[10:17, 1] = -300
    (line,) = find_doubts(replace(recording, presses_mm=presses_mm))
    assert line.endswith("-300) mm, 3 more")
