"""A finger that presses as well as people do."""

from itertools import pairwise

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense.settings import RigSettings
from tests.emulators.finger import LIGHT, MISHAPS, REACTION_S, SHORT_S, SLIDE_MM, Finger, FingerStroke

RATE_HZ = 50.0


def make_presses(mishaps: float, presses: int) -> Finger:
    """Ask a finger for presses at (5, -5) mm, two seconds each."""
    rig = RigSettings(noise_mv=0.0, drift_mv=0.0)
    finger = Finger(Morphology.straight(2), Contact(), rig, RATE_HZ, mishaps=mishaps)
    block = np.arange(1, 51) / RATE_HZ
    for press in range(presses):
        for second, phase in enumerate(("press", "hold", "lift", "wait", "wait")):
            finger.look({"phase": phase, "target": (5.0, -5.0)})
            assert finger.volts(5.0 * press + second + block).shape == (50, 4)
    return finger


def test_finger_presses_where_asked_lifts_and_errs() -> None:
    finger = make_presses(0.0, 30)
    assert [stroke.kind for stroke in finger.strokes] == ["press"] * 30
    places = np.array([stroke.position_mm for stroke in finger.strokes])
    assert places.mean(axis=0) == pytest.approx([5, -5], abs=1.0)
    assert places.std(axis=0) == pytest.approx([1.5, 1.5], rel=0.4)
    late = np.array([(stroke.down_s % 5, stroke.up_s % 5 - 2) for stroke in finger.strokes])
    assert (late > [REACTION_S[0], 0]).all()
    assert (late < np.array([REACTION_S[1], REACTION_S[1] / 2]) + 0.04).all()
    assert min(stroke.depth_mm for stroke in finger.strokes) >= 3.5
    assert finger.commands() == []
    finger.look({"phase": "lift", "target": (5.0, -5.0)})  # it touches nothing when asked to lift
    finger.volts(150.0 + np.arange(1, 201) / RATE_HZ)
    assert finger.commands() == ["free"]
    strokes = make_presses(1.0, 40).strokes
    assert {stroke.kind for stroke in strokes} == {*MISHAPS, "echo"}
    for before, stroke in pairwise(strokes):
        assert (stroke.kind == "echo") == (before.kind == "double")
    of_kind = {stroke.kind: stroke for stroke in strokes}
    assert of_kind["short"].up_s - of_kind["short"].down_s == pytest.approx(SHORT_S)
    assert of_kind["light"].depth_mm < 1.2 * LIGHT * RigSettings().press_depths_mm[0]
    slid, still = (of_kind[kind].contact(of_kind[kind].down_s + 1)[0] for kind in ("slide", "double"))
    assert slid - of_kind["slide"].position_mm == pytest.approx([-SLIDE_MM, 0])  # to the other half of the pad
    np.testing.assert_array_equal(still, of_kind["double"].position_mm)
    stroke = FingerStroke("press", np.zeros(2), 4.0, down_s=1.0, up_s=2.0)  # it sinks in and leaves
    assert [stroke.contact(at_s)[1] for at_s in (0.5, 1.5, 2.2)] == [0, 4, 0]
