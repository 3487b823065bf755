"""Presses of simulated pads are split into the parts that they were made of."""

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.sense import Recording, RigSettings, simulate
from padforge.sense.simulation.built_pad import build_pad
from padforge.sense.simulation.pad_model import SUPPLY_V, Cycle, resistance_changes
from padforge.sense.twin.press_parts import SeparatedPresses, part_kernels, separate_parts

PAD = Morphology.random(2, knots=3, seed=5)
RIG = RigSettings(presses=500, seed=1, scatter=0.0, floor_mv=0.0, gain_wander=0.0, drift_mv=0.0, hysteresis_s=12.0)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate(PAD, RIG)


@pytest.fixture(scope="module")
def split(recording: Recording) -> SeparatedPresses:
    return separate_parts(recording, np.arange(500) % 7 != 0, hysteresis_s=20.0)


def test_parts_memory_and_touch_are_those_that_were_simulated(recording: Recording, split: SeparatedPresses) -> None:
    depths_mm = np.full(500, RIG.press_depths_mm)
    changes = resistance_changes(build_pad(PAD, RIG), recording.presses_mm, depths_mm, Contact(), RIG)
    rest_v = np.median(recording.readings[:10], axis=0)
    slope_v = rest_v * (1 - rest_v / SUPPLY_V)  # by which a divider falls for a small change of resistance
    for part, change, share in zip(split.parts, changes, (0.97, 0.65, 0.7, 0.92), strict=True):
        expected = -slope_v * change
        # onset and creep are told the least: presses are touched at other times than one knows
        found = [np.corrcoef(part.volts[:, c], expected[:, c])[0, 1] for c in range(recording.fibres)]
        assert np.mean(found) > share
    slope = np.polyfit((-slope_v * changes.held).ravel(), split.parts.held.volts.ravel(), 1)[0]
    assert slope == pytest.approx(1, abs=0.12)
    assert split.rig["memory"] == pytest.approx(RIG.memory, abs=0.2)
    assert split.rig["memory_mm"] == pytest.approx(RIG.memory_mm, rel=0.35)
    assert split.rig["hysteresis_s"] == pytest.approx(RIG.hysteresis_s, rel=0.5)
    assert split.rig["touch_s"] == pytest.approx(RIG.touch_s, abs=0.015)
    # without what presses take away, neighbouring ones differ by half as much as they do with it
    x, y = recording.presses_mm.T
    order = np.argsort(np.round(x) * 1e3 + y)
    with_it = np.array(
        [
            recording.readings[d + 8 : d + 20].mean(0) - recording.readings[d - 8 : d].mean(0)
            for d in recording.down_command
        ]
    )
    near = np.hypot(*np.diff(recording.presses_mm[order], axis=0).T) < 1.5
    before, after = (np.diff(volts[order], axis=0)[near].std() for volts in (with_it, split.pressed.volts))
    assert after < 0.8 * before


def test_kernels_of_a_press() -> None:
    """It is held by its last windows, creeps meanwhile, and leaves what remains inverted; what it takes adds to it."""
    (held, onset, creep, after), replaced = part_kernels(Cycle(40, 13.3), RigSettings(hysteresis_s=1e4))
    assert held[6:9] == pytest.approx(1, abs=0.05)
    assert held[13:] == pytest.approx(0, abs=1e-9)
    assert onset[1] > held[1]
    assert np.all(np.diff(creep[2:9]) < 0)
    assert after[:9] == pytest.approx(0, abs=1e-9)
    assert after[12:] == pytest.approx(-1, abs=0.01)
    assert replaced[6:9] == pytest.approx(1, abs=0.01)
    assert replaced[12:] == pytest.approx(0.6, abs=0.01)
