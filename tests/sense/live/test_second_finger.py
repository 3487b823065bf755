"""A second finger that lands while the first one rests is localized from the change; fingers lift one by one."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest

from padforge.sense import Recording
from padforge.sense.arrays import Array
from padforge.sense.live import pipeline
from padforge.sense.live.pipeline import Estimate, Live
from padforge.sense.localizer.model import UNIFORM, LocalizerModel
from padforge.sense.localizer.press_course import PressCourse

N_PAIRS, APART_MM = 20, 15.0
WARM_UP, CYCLE, FADE = (
    4,
    110,
    30,
)  # presses from which a detector learns, readings of a trial, and of the end of a residue
LAND, LATER = 13, 26  # readings from the touch of the first finger to that of the second one, and to a lift


@dataclass(frozen=True)
class Touch:
    """A recorded press, made again at a reading of a trial, held until another one."""

    press: int
    down: int
    up: int
    strength: float = 1.0


def respond(recording: Recording, touch: Touch) -> Array:
    """Responses (CYCLE, C), V: the last reading of the hold is repeated, and what remains after the release fades."""
    down, up = recording.down_command[touch.press], recording.up_command[touch.press]
    change = recording.readings[down : up + 20] - recording.readings[down - 5 : down].mean(axis=0)
    held = np.minimum(np.arange(touch.up - touch.down), up - down - 1)
    after = change[up - down :]
    fading = after[-1] * np.linspace(1, 0, FADE)[:, None]
    response = np.concatenate([change[held], after, fading])
    return touch.strength * np.pad(response, ((touch.down, CYCLE - touch.down - len(response)), (0, 0)))


def follow(model: LocalizerModel, recording: Recording, trials: list[list[Touch]]) -> list[list[Estimate]]:
    """The estimates of each trial, in which the responses to all touches add up."""
    warm_up = [[Touch(press, 20, 40)] for press in range(WARM_UP)]
    readings = np.concatenate([sum(respond(recording, touch) for touch in trial) for trial in warm_up + trials])
    noise = 1e-3 * np.random.default_rng(1).standard_normal(readings.shape)
    times_s = np.arange(len(readings)) / recording.rate_hz
    live = Live(model, rate_hz=recording.rate_hz)
    events = live.feed(times_s, np.median(recording.readings, axis=0) + readings + noise)
    assert not live.pressed
    estimates = [event for event in events if isinstance(event, Estimate)]
    numbers = (np.array([event.time_s for event in estimates]) * recording.rate_hz / CYCLE).astype(int) - WARM_UP
    return [[estimates[row] for row in np.flatnonzero(numbers == trial)] for trial in range(len(trials))]


def pairs(recording: Recording) -> list[tuple[int, int]]:
    chosen = np.random.default_rng(0).integers(5, len(recording.presses_mm) - 1, size=(200, 2))
    apart = np.hypot(*(recording.presses_mm[chosen[:, 0]] - recording.presses_mm[chosen[:, 1]]).T) > APART_MM
    return [(int(first), int(second)) for first, second in chosen[apart][:N_PAIRS]]


def error_mm(recording: Recording, estimate: Estimate, press: int) -> float:
    return float(np.hypot(*(recording.presses_mm[press] - [estimate.x_mm, estimate.y_mm])))


@pytest.mark.parametrize("first_lifts", [True, False])
def test_a_second_finger_is_located_and_lifts_are_told_apart(
    localizer: LocalizerModel, recording: Recording, first_lifts: bool
) -> None:
    """One finger lifts two seconds after the second one has landed, the other one a second later."""
    ups = (20 + LATER, 33 + LATER) if first_lifts else (33 + LATER, 20 + LATER)
    chosen = pairs(recording)
    trials = [[Touch(first, 20, ups[0]), Touch(second, 20 + LAND, ups[1])] for first, second in chosen]
    noticed, in_order, errors_mm, is_within = 0, 0, [], []
    for (_, second), estimates in zip(chosen, follow(localizer, recording, trials), strict=True):
        ends = [estimate for estimate in estimates if estimate.final]
        if not any(estimate.finger == 2 for estimate in estimates):
            continue
        noticed += 1
        assert Counter(end.press for end in ends).most_common(1)[0][1] == 1
        in_order += [end.finger for end in ends] == ([1, 2] if first_lifts else [2, 1])
        (end,) = [end for end in ends if end.finger == 2]
        errors_mm.append(error_mm(recording, end, second))
        is_within.append(errors_mm[-1] <= end.r90_mm)
    print(noticed, in_order, np.mean(errors_mm), np.mean(is_within))
    assert noticed >= 0.7 * N_PAIRS
    assert in_order >= 0.8 * noticed
    assert np.mean(errors_mm) < 4
    assert np.mean(is_within) > 0.7


def test_single_and_deepening_presses_are_no_second_finger(localizer: LocalizerModel, recording: Recording) -> None:
    presses = range(5, 35)
    single = [[Touch(press, 20, 20 + LATER)] for press in presses]
    deepening = [[Touch(press, 20, 20 + LATER), Touch(press, 20 + LAND, 20 + LATER, 0.6)] for press in presses]
    for estimates in follow(localizer, recording, single + deepening):
        assert {estimate.finger for estimate in estimates} <= {1}


def test_a_lift_that_cannot_be_told_leaves_no_finger_located(
    localizer: LocalizerModel, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "MAX_ERROR_RATIO", 0.0)
    trials = [[Touch(a, 20, 20 + LATER), Touch(b, 20 + LAND, 33 + LATER)] for a, b in pairs(recording)[:8]]
    told = [estimates for estimates in follow(localizer, recording, trials) if {e.finger for e in estimates} == {1, 2}]
    assert told
    for estimates in told:
        for end in (estimate for estimate in estimates if estimate.final):
            assert end.unlike
            assert end.r90_mm == pytest.approx(UNIFORM[2] * localizer.scaler.scale_mm)


def test_the_expected_response_relaxes_beyond_the_windows() -> None:
    """Its changes fall by half from one of the last windows to the next, as before."""
    pressed = np.zeros((9, 1))
    pressed[:, 0] = [0, 4, 4, 4, 4, 4, 4, 2, 1]
    course = PressCourse(np.ones(1), np.ones(1), np.ones(1, bool), pressed, np.zeros((8, 1)))
    frames = np.array([1, 2, 9.5, 13.5, 17.5, 21.5, 25.5, 1000])
    np.testing.assert_allclose(course.response(frames)[:, 0], [0, 4, 4, 2, 1, 0.5, 0.25, 0], atol=1e-9)
