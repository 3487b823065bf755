"""Reasons to doubt an evaluation: another pad, and presses whose stated positions are improbable."""

from collections.abc import Iterator

import numpy as np

from padforge.sense.localizer.model import Localization
from padforge.sense.recording import doubts
from padforge.sense.recording.recording import Recording

MAX_RADII = 4.0
"""Maximum distance of the predicted from the stated position, in radii of 90 %: on the published recording it is up to
2.5, and 5 or more if the sign of a coordinate is lost."""
MIN_WITHIN_R90 = 0.5  # minimum share of presses within their radii; on a pad that drifted for hours it is larger
MIN_PRESSES = 20  # minimum number of presses for that share
OTHER_PAD = (
    "these presses are unlike those of the calibration: another pad, or one cast again; radii do not hold; recalibrate"
)


def find_doubts(
    recording: Recording, localization: Localization, within_r90: float, n_presses: int, is_other_pad: bool = False
) -> list[str]:
    """Return reasons to doubt an evaluation, one a line.

    Args:
        recording: that was evaluated.
        localization: of all its presses.
        within_r90: share of the test presses within their radii of 90 %.
        n_presses: number of the test presses.
        is_other_pad: whether the responses are those of another pad.
    """
    if is_other_pad:
        return [*doubts.find_doubts(recording), OTHER_PAD]
    if within_r90 < MIN_WITHIN_R90 and n_presses >= MIN_PRESSES:
        misfit = f"{within_r90:.0%} of {n_presses} presses lie within r90: is it the recording of this pad?"
        return [*doubts.find_doubts(recording), misfit]
    return [*doubts.find_doubts(recording), *_misplaced_presses(recording, localization)]


def _misplaced_presses(recording: Recording, localization: Localization) -> Iterator[str]:
    distance = np.hypot(*(localization.positions_mm - recording.presses_mm).T)
    is_misplaced = distance > MAX_RADII * localization.r90_mm  # false where the position is unknown
    if is_misplaced.any():
        named = doubts.name_presses(recording, is_misplaced)
        yield f"more than {MAX_RADII:g} r90 from where the fibres say: {named}"
