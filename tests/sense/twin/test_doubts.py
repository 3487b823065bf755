"""What is said of pads that are not the one recorded, and not said of those that are."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense import RigSettings
from padforge.sense.twin.as_built import OFFSET, PadPlan, channel_indices
from padforge.sense.twin.doubts import find_doubts
from padforge.sense.twin.identification import Identification
from padforge.sense.twin.wiring import Wiring, images
from tests.sense.conftest import few_candidates, identify_simulated

from .conftest import few_compared


@pytest.fixture
def result(identification: Identification) -> Identification:
    """A pad that lies as planned, without its contact and its parts."""
    return identification


def test_a_channel_that_a_smooth_function_of_the_position_explains_better_is_doubted(result: Identification) -> None:
    """And nothing of a pad that lies as planned; but a fibre far beside its plan."""
    assert result.fit.pad.fibres == (0, 1, 2, 3)
    assert find_doubts(result) == []
    explained = result.explained.copy()
    explained[2] = 0.2
    *_, doubt = find_doubts(replace(result, explained=explained))
    assert doubt.startswith(f"channel 3 does not fit: fibre {result.fit.pad.fibres[2] + 1} explains 0.20 of held-out")
    whole, count, *channels = find_doubts(replace(result, explained=result.explained - 0.2))
    assert whole.startswith("the fibres explain 0.")
    assert count == "4 of 4 channels do not fit: is it the recording of this pad?"
    assert len(channels) == 4
    assert find_doubts(replace(result, explained=result.explained_smooth - 0.02)) == []
    values = result.fit.pad.values.copy()
    values[channel_indices(1)[OFFSET]] += 0.6  # 6.75 mm along x and y: across a fibre, whichever way it runs
    beside = replace(result, fit=replace(result.fit, pad=replace(result.fit.pad, values=values)))
    (doubt,) = find_doubts(beside)
    assert doubt.startswith("channel 2 does not fit: fibre 2 lies")
    assert doubt.endswith("mm beside its plan, allowed is 3.0")


@pytest.mark.parametrize(
    ("turn_deg", "scale", "said"), [(90, 1, ""), (-101, 1, "11 degrees"), (2, 0.7, "scale of 0.70")]
)
def test_a_pad_that_lay_askew_or_at_another_scale_is_doubted(result, turn_deg: float, scale: float, said: str) -> None:
    values = result.fit.pad.values.copy()
    values[0], values[3] = np.radians(turn_deg), scale
    fit = replace(result.fit, pad=replace(result.fit.pad, values=values))
    doubts = find_doubts(replace(result, fit=fit))
    assert [said in doubt for doubt in doubts if "would have lain" in doubt] == [True] * bool(said)


def test_a_second_wiring_is_told_of_unless_it_plans_each_fibre_where_it_was(result: Identification) -> None:
    swapped = Wiring(result.fit.pad.transform, 0.5, (1, 0, 2, 3), 0.9)
    count, *channels = find_doubts(replace(result, alternatives=[swapped]))
    assert count.startswith("1 other pose or wiring explains")
    assert channels == ["channel 1 may read fibre 2 in place of 1", "channel 2 may read fibre 1 in place of 2"]
    straight = Morphology.straight(2)
    pad = replace(result.fit.pad, plan=PadPlan.from_morphology(straight), fibres=(0, 1, 2, 3))
    lain = Wiring(pad.transform, 0.5, pad.fibres, 0.9)
    images_of_it, swapped = images(lain, straight.layout), replace(lain, fibres=(0, 1, 3, 2))
    of_straight_fibres = replace(result, fit=replace(result.fit, pad=pad), alternatives=images_of_it)
    assert len(images_of_it) == 7
    assert not any("pose" in doubt for doubt in find_doubts(of_straight_fibres))
    count, *_ = (doubt for doubt in find_doubts(replace(of_straight_fibres, alternatives=[swapped])) if "pose" in doubt)
    assert count.startswith("1 other")
    # fibres that lie 1.7 mm beside a straight plan are those of another pad
    values = pad.values.copy()
    for channel in range(4):
        values[channel_indices(channel)[OFFSET]] += 0.15
    fit = replace(of_straight_fibres.fit, pad=replace(pad, values=values))
    count, *_ = find_doubts(replace(of_straight_fibres, fit=fit))
    assert count.startswith("7 other")
    # the courses of PLAN are no images of each other
    count, *_ = find_doubts(replace(result, alternatives=images_of_it))
    assert count.startswith("7 other")


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
