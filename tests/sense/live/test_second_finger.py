"""A second finger that lands while the first one rests is localized from the change; fingers lift one by one."""

from itertools import pairwise
from typing import Any, NamedTuple
from unittest.mock import Mock, patch

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense import RigSettings, calibrate, simulate
from padforge.sense.arrays import Array
from padforge.sense.live import pipeline
from padforge.sense.live.pipeline import Estimate, Live
from padforge.sense.localizer.model import UNIFORM, LocalizerModel
from padforge.sense.localizer.press_course import PressCourse
from padforge.sense.recording.press_plan import make_plan
from padforge.sense.simulation.built_pad import PressParts
from padforge.sense.simulation.example import PLAN
from padforge.sense.simulation.pad_model import Divider, Gains, Strain, scaled, strain_of
from padforge.sense.simulation.simulated_recording import model_plan
from tests.helpers.once import Once
from tests.sense.conftest import QUICK, few_moments

RIG = RigSettings(presses=400, seed=1).for_contact(Contact())
APART_MM, TRIALS, WARM_UP = 15.0, 10, 4  # between two fingers; trials, and single presses before them
REST, LAND, LIFT, LAST = 30, 13, 33, 46  # readings: rest, landing of the second finger after the first one, the lifts


class Touch(NamedTuple):
    """A finger on the pad, from one reading to another."""

    position_mm: Array
    down: int
    up: int
    share: float = 1.0  # of the depth


def simulate_fingers(pad: Morphology, touches: list[Touch], seed: int) -> Array:
    """Readings (R, C), V, of the pad that `simulate` presses with `RIG`; the strains under all fingers add up."""
    built, rng = np.random.default_rng(RIG.seed), np.random.default_rng(seed)
    make_plan(pad, RIG, built)  # `simulate` samples the presses before the pad
    divider = Divider(len(pad.knots), RIG.rate_hz, RIG, built)
    model, n_readings = model_plan(pad, Contact(), RIG), max(touch.up for touch in touches) + 2 * REST
    positions_mm = np.array([touch.position_mm for touch in touches])
    responses = model.responses(positions_mm, np.full(len(touches), RIG.press_depths_mm[0]))
    responses = scaled(responses, Gains(3.0, len(pad.knots), RIG, rng)(len(touches)))
    strain, rows = Strain(*np.zeros((3, n_readings, len(pad.knots)))), np.arange(n_readings)
    for row, touch in enumerate(touches):
        depth = touch.share * np.clip(np.minimum(rows - touch.down, touch.up - rows), 0, 1)[:, None]
        onset = depth * np.exp(-np.maximum(rows - touch.down, 0) / 2)[:, None]
        response, steps = PressParts(*(part[row] for part in responses)), np.diff(depth, axis=0, prepend=0)
        for total, part in zip(strain, strain_of(response, np.zeros(1), depth, onset, steps), strict=True):
            total += part
    return divider(strain)


def follow(model: LocalizerModel, trials: list[list[Touch]], seed: int = 5) -> list[list[Estimate]]:
    """The estimates in each trial, whose touches begin at reading 0, after some single presses."""
    pad, positions_mm = Morphology.load(PLAN), random_positions(seed)
    warm_up = [[Touch(position_mm, 0, 20)] for position_mm in positions_mm[:WARM_UP]]
    touches, starts = list[Touch](), list[int]()
    for trial in [*warm_up, *trials]:
        starts.append(REST + max((touch.up for touch in touches), default=0))
        touches += [touch._replace(down=starts[-1] + touch.down, up=starts[-1] + touch.up) for touch in trial]
    readings = simulate_fingers(pad, touches, seed)
    health: Any = model  # a stand-in, of the same pad
    monitor = Mock(model=Mock(dead=()), failed=(), n_presses=0, update=Mock(return_value=[]))
    with patch.object(pipeline, "FaultMonitor", return_value=monitor):
        live = Live(model, rate_hz=RIG.rate_hz, health=health)
    times_s, events, swings, moved_v = np.arange(len(readings)) / RIG.rate_hz, [], [], []
    for begin, touch in pairwise([Touch(np.zeros(2), 0, 0), *sorted(touches, key=lambda touch: touch.up)]):
        events += live.update(times_s[begin.up : touch.up], readings[begin.up : touch.up])
        over = {event.press for event in events if isinstance(event, Estimate) and event.final}
        assert all(estimate.final == (estimate.press in over) for estimate in live.presses)
        rest = max(start for start in starts if start < touch.up)
        swings.append([fibre["swing"] for fibre in live.view()["fibres"]])
        moved_v.append(readings[touch.up - 1] - readings[rest - 5 : rest].mean(axis=0))
    last = max(touch.up for touch in touches)
    events += live.update(times_s[last:], readings[last:])
    assert not live.pressed
    # however many fingers are on it, the view shows each fibre's change from its rest, on one scale
    scale = np.median(np.divide(swings, moved_v), axis=0)
    np.testing.assert_allclose(swings, scale * moved_v, atol=0.1)
    estimates = [event for event in events if isinstance(event, Estimate)]
    # the monitor of the fibres counts the presses that it is not shown
    assert monitor.update.call_count + monitor.n_presses == 1 + max(estimate.press for estimate in estimates)
    firsts = [start - REST / 2 for start in starts[WARM_UP:]]
    numbers = np.searchsorted(firsts, [estimate.time_s * RIG.rate_hz for estimate in estimates]) - 1
    return [[estimates[row] for row in np.flatnonzero(numbers == trial)] for trial in range(len(trials))]


def random_positions(seed: int, count: int = 100) -> Array:
    return np.random.default_rng(seed).uniform(-20, 20, (count, 2))


def pairs(ups: tuple[int, int], count: int = TRIALS) -> list[list[Touch]]:
    first, second = random_positions(1), random_positions(2)
    apart = np.flatnonzero(np.hypot(*(first - second).T) > APART_MM)[:count]
    return [[Touch(first[row], 0, ups[0]), Touch(second[row], LAND, ups[1])] for row in apart]


def error_mm(estimate: Estimate, touch: Touch) -> float:
    return float(np.hypot(*(touch.position_mm - [estimate.x_mm, estimate.y_mm])))


@pytest.fixture(scope="module")
def example(once: Once) -> LocalizerModel:
    options = QUICK.model_copy(update={"members": 1, "max_failures": 1, "epochs": 10})
    recording = simulate(Morphology.load(PLAN), RIG)
    with few_moments():
        return once("second-finger", lambda _: calibrate(recording, options, by_moment=False)[0])


@pytest.mark.parametrize("ups", [(LIFT, LAST), (LAST, LIFT), (LIFT, LIFT)])
def test_a_second_finger_is_localized_and_lifts_are_told_apart(example: LocalizerModel, ups: tuple[int, int]) -> None:
    trials, told, errors_mm, is_within = pairs(ups), 0, list[float](), list[bool]()
    for trial, estimates in zip(trials, follow(example, trials), strict=True):
        ends = {estimate.finger: estimate for estimate in estimates if estimate.final}
        order = [estimate.finger for estimate in estimates if estimate.final]
        if len(ends) == len(order) == 2:
            told += ups[0] == ups[1] or order == sorted((1, 2), key=lambda finger: ups[finger - 1])
            errors_mm += [error_mm(ends[finger], touch) for finger, touch in enumerate(trial, 1)]
            is_within += [error_mm(ends[finger], touch) <= ends[finger].r90_mm for finger, touch in enumerate(trial, 1)]
            assert ends[2].press == ends[1].press + 1
    assert told >= 0.8 * TRIALS
    assert np.mean(errors_mm) < 4
    assert np.mean(is_within) > 0.6


def test_single_and_deepening_presses_are_no_second_finger(example: LocalizerModel) -> None:
    single = [[Touch(position_mm, 0, LIFT)] for position_mm in random_positions(3, TRIALS)]
    deepening = [
        [Touch(position_mm, 0, LIFT, 0.6), Touch(position_mm, LAND, LIFT, 0.4)]
        for position_mm in random_positions(4, TRIALS)
    ]
    for estimates in follow(example, single + deepening):
        assert {estimate.finger for estimate in estimates} == {1}


@patch.object(pipeline, "MAX_ERROR_RATIO", 0.0)
def test_a_lift_that_cannot_be_told_leaves_no_finger_localized(example: LocalizerModel) -> None:
    for estimates in follow(example, pairs((LIFT, LAST), 3)):
        ends = [estimate for estimate in estimates if estimate.final]
        assert [end.finger for end in ends] == [2, 1]
        for end in ends:
            assert end.unlike
            assert end.r90_mm == pytest.approx(UNIFORM[2] * example.scaler.scale_mm)


def test_the_expected_response_relaxes_beyond_the_windows() -> None:
    """Its changes fall by half from one of the last windows to the next, and go on to."""
    pressed = np.array([[0, 4, 4, 4, 4, 4, 4, 2, 1]], float).T
    course = PressCourse(np.ones(1), np.ones(1), np.ones(1, bool), pressed, np.zeros((8, 1)))
    frames = np.array([1, 2, 9.5, 13.5, 17.5, 21.5, 25.5, 1000])
    np.testing.assert_allclose(course.response(frames)[:, 0], [0, 4, 4, 2, 1, 0.5, 0.25, 0], atol=1e-9)
