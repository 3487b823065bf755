"""What members expect of themselves is held against presses that they have not learnt from."""

from dataclasses import replace

import numpy as np
import pytest

from sense import Localizer, Recording
from sense.localizer.calibration.calibration import _proven
from sense.localizer.network import learnt


def test_members_expect_the_errors_that_they_make_of_presses_never_learnt_from(
    recording: Recording, localizer: Localizer
) -> None:
    """A member that has far too high an opinion of itself is put right by them, and counts for what it is worth."""
    bias = localizer.corrector["last.b"].copy()
    bias[:, :, 2:] -= np.log(50)
    proud = replace(localizer, corrector={**localizer.corrector, "last.b": bias})
    presses, test = proud.inputs(recording), np.array(proud.test)
    put_right = _proven(proud, presses[test], recording.presses_mm[test], 2)
    shift = put_right.corrector["last.b"] - bias
    assert not shift[:, :, :2].any()
    assert shift[0, 0, 2] == shift[0, 0, 3] == pytest.approx(np.log(50), abs=0.7)

    alone = (proud.observer, proud.corrector), (put_right.observer, put_right.corrector)
    before, after = (learnt(proud.weights, presses.inputs, presses.alive, "masked", *each)[-1, :, 2:] for each in alone)
    np.testing.assert_allclose(after - before, np.full_like(before, shift[0, 0, 2]), atol=1e-4)
