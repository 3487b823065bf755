"""Diagnoses of a rig before a long run, beside what its devices gave; nothing moves."""

import re

import numpy as np

from padforge.sense.rig.devices import BoardSamples
from padforge.sense.rig.doctor import examine_arm, examine_board
from tests.sense.rig.fakes import FIBRES, RIG, FakeArm, FakeBoard, Time


def numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", text)]


def test_examine_board_tells_what_the_board_read() -> None:
    """Channel 1 is skewed, so that its median is not its mean."""
    time = Time()
    board = FakeBoard(FakeArm(time))
    read, given = board.read, list[BoardSamples]()

    def noted() -> BoardSamples:
        board.lose = 3 if len(given) == 20 else 0
        samples = read()
        samples.volts[:, 0] += 0.01 * np.exp(np.random.default_rng(len(given)).standard_normal(len(samples.times_s)))
        given.append(samples)
        return samples

    board.read = noted
    with time.of_all():
        rows = {row.name: row.message for row in examine_board(board)}
        now_s = time()
    times_s, volts, missing = (np.concatenate([getattr(each, name) for each in given]) for name in vars(given[0]))
    assert set(rows) == {"board", "rate", "samples", "latency", *(f"channel {k}" for k in range(1, FIBRES + 1))}
    assert numbers(rows["rate"])[0] == np.round((len(times_s) - 1) / np.ptp(times_s), 1)
    assert missing.sum() == 3
    assert numbers(rows["samples"]) == [3, 3 + len(times_s)]
    assert numbers(rows["latency"]) == [round(1e3 * (now_s - times_s[-1]), 1)]
    for k, column in enumerate(volts.T):
        expected = k, round(float(np.median(column)), 3), round(1e3 * float(np.std(column)), 2)
        assert numbers(rows[f"channel {k + 1}"]) == [*expected]


def test_examine_arm_tells_the_usual_rate_the_longest_gap_and_the_age() -> None:
    """Of states 10 ms apart but for one gap of half a second, the last of which is 40 ms old."""
    time = Time()
    arm = FakeArm(time, pose=(1.25, -400.06, 99.0, 0.0, np.pi, 0.0), force_n=0.35)
    times_s = np.cumsum([0.0, *[0.01] * 60, 0.5, *[0.01] * 60])
    arm.drain = lambda: np.column_stack([times_s, np.zeros((len(times_s), 9))])
    state = arm.state

    def old():
        found = state()
        time.now += 0.04
        return found

    arm.state = old
    with time.of_all():
        rows = {row.name: row.message for row in examine_arm(arm, RIG)}
    assert rows["states"] == "100 Hz, longest gap 500 ms"
    assert rows["age"] == "40.0 ms"
    assert numbers(rows["tool"]) == [1.2, -400.1, 99.0]
    assert arm.moves == []
