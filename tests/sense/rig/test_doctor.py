"""The diagnosis of an arm whose states are not evenly spaced; the rest is kept as the command `doctor` prints it."""

import numpy as np

from padforge.sense.rig.doctor import examine_arm
from tests.sense.rig.fakes import RIG, FakeArm, Time


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
    assert rows["tool"] == "at 1.2, -400.1, 99.0 mm"
    assert arm.moves == []
