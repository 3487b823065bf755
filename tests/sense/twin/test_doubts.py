"""What is said of pads that are not the one recorded, and not said of those that are."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense import RigSettings
from padforge.sense.arrays import Array
from padforge.sense.twin.as_built import OFFSET, AsBuiltPad, PadPlan, channel_indices
from padforge.sense.twin.doubts import find_doubts
from padforge.sense.twin.identification import Identification
from padforge.sense.twin.wiring import Wiring, images
from tests.helpers.golden import Golden
from tests.sense.conftest import few_candidates, identify_simulated

from .conftest import few_compared


def test_doubts_are_told_whole(identification: Identification, golden: Golden) -> None:
    """Of a pad that lies as planned nothing; nor of straight fibres that images plan where they are."""
    pad, plan = identification.fit.pad, Morphology.straight(2)
    straight = replace(pad, plan=PadPlan.from_morphology(plan))
    lain = Wiring(straight.transform, 0.5, pad.fibres, 0.9)
    turned, offsets = images(lain, plan.layout), [channel_indices(channel)[OFFSET] for channel in range(4)]

    def moved(places: Any, by: float, pad: AsBuiltPad = pad, **others: object) -> Identification:
        values = pad.values.copy()
        values[places] += by
        return replace(identification, fit=replace(identification.fit, pad=replace(pad, values=values)), **others)

    def explaining(explained: Array) -> Identification:
        return replace(identification, explained=explained)

    cases = {
        "as planned": identification,
        "one channel is explained badly": explaining(identification.explained - 0.7 * (np.arange(4) == 2)),
        "all channels are": explaining(identification.explained - 0.2),
        "a smooth function explains a little more": explaining(identification.explained_smooth - 0.02),
        "a fibre 6.75 mm along x and y from its plan": moved(offsets[1], 0.6),
        "a quarter turn": moved(0, np.pi / 2),
        "askew": moved(0, np.radians(-101)),
        "shrunk": moved(3, -0.3),
        "straight fibres, images that fit": moved(0, 0.0, straight, alternatives=turned),
        "straight fibres, two of them swapped": moved(
            0, 0.0, straight, alternatives=[replace(lain, fibres=(0, 1, 3, 2))]
        ),
        "straight fibres 1.7 mm beside their plan": moved(np.concatenate(offsets), 0.15, straight, alternatives=turned),
        "winding fibres, images that fit": replace(identification, alternatives=turned),
    }
    lines = ["\n    ".join([f"{name}:", *find_doubts(result)]) for name, result in cases.items()]
    golden("sense/identification/doubts.txt", "\n".join(lines), rtol=2e-2)


@pytest.mark.slow
@few_candidates()
@few_compared()
def test_another_pad_is_doubted_and_the_recorded_one_is_not() -> None:
    rig = RigSettings(presses=160, seed=1)
    built = Morphology.random(2, knots=3, seed=1)
    right, wrong = (identify_simulated(built, told, rig) for told in (built, Morphology.random(2, knots=4, seed=11)))
    assert find_doubts(right) == []
    assert right.fit.pad.fibres == (0, 1, 2, 3)
    assert any("is it the recording of this pad?" in doubt for doubt in find_doubts(wrong))
