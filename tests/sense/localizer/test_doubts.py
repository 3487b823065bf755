"""Presses that cannot lie where the recording says, and recordings that a localizer does not fit."""

from dataclasses import replace

import numpy as np

from padforge.sense import Recording
from padforge.sense.localizer.doubts import find_doubts
from padforge.sense.localizer.model import LocalizerModel


def test_far_presses_are_named_and_another_recording_is_doubted(
    localizer: LocalizerModel, recording: Recording
) -> None:
    localization = localizer.predict(recording)
    assert find_doubts(recording, localization, 0.9, 45) == []
    presses_mm = recording.presses_mm.copy()
    corner = int(np.argmin(presses_mm.sum(axis=1)))
    presses_mm[corner] *= -1  # a sign was lost
    presses_mm[3] = np.nan
    (line,) = find_doubts(replace(recording, presses_mm=presses_mm), localization, 0.9, 45)
    assert line.startswith(f"more than 4 r90 from where the fibres say: press {corner} at (")
    other = replace(recording, presses_mm=np.roll(recording.presses_mm, 1, axis=0))
    expected = ["2% of 300 presses lie within r90: is it the recording of this pad?"]
    assert find_doubts(other, localizer.predict(other), 0.02, 300) == expected
    assert find_doubts(recording, localization, 0.02, 10) == []  # of so few it may be chance
