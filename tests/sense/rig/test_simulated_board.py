"""A simulated board is of the pad of a simulated recording, and is found by the model that was trained on that."""

from pathlib import Path

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.design.settings import PUBLISHED_CONTACT, Contact, PadSettings
from padforge.sense.rig.simulated_board import SimulatedBoard, simulated_board_of
from padforge.sense.rig.streams import RECORDED
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.rigs import quiet_rig
from tests.sense.rig.fakes import Time


def test_simulated_board_is_the_pad_of_the_recording() -> None:
    pad = Morphology.random(2, knots=3, seed=5)
    rig = quiet_rig(presses=20, seed=4)
    recorded, time = simulate(pad, rig), Time(least_s=0)
    board = SimulatedBoard(pad, rig, PUBLISHED_CONTACT)
    with time.of_all():
        started_s = time()
        assert board.connect().items() >= {"name": "simulated", "channels": 4, "rate_hz": rig.rate_hz}.items()
        samples = []
        for pause_s in [0.0, 0.3, 0.01, 5.0] + 30 * [1.0]:
            time.sleep(pause_s)
            samples.append(board.read())
    volts = np.concatenate([each.volts for each in samples])
    times_s = np.concatenate([each.times_s for each in samples])
    np.testing.assert_allclose(np.diff(times_s), 1 / rig.rate_hz)
    assert times_s[0] == pytest.approx(started_s + 1 / rig.rate_hz)
    # The same fibres at rest, and as many presses that answer as strongly.
    np.testing.assert_array_equal(volts[:19], recorded.readings[:19])
    swings = np.abs(volts - volts[0]).sum(axis=1)
    assert (np.diff((swings > swings.max() / 5).astype(int)) == 1).sum() == round(len(volts) / 40)
    assert 0.5 < np.abs(volts - volts[0]).max() / np.abs(recorded.readings - volts[0]).max() < 2


def test_simulated_board_is_pressed_to_its_depths_in_turn() -> None:
    rig = quiet_rig(presses=4, seed=4, depths_mm=(0.5, 5.0), readings_per_press=20)
    time = Time(least_s=0)
    board = SimulatedBoard(Morphology.straight(2), rig, Contact())
    with time.of_all():
        board.connect()
        time.sleep(4.01 * 20 / rig.rate_hz)
        volts = board.read().volts
    swings = [np.ptp(volts[20 * press : 20 * press + 20], axis=0).sum() for press in range(4)]
    assert max(swings[0::2]) < 0.5 * min(swings[1::2])


def test_simulated_board_of_a_model_is_that_of_its_simulated_recording(tmp_path: Path) -> None:
    """Pressed where that was: within what is sensed, and beside the keep-outs."""
    hole = ((2.0, -6.0), (9.0, -6.0), (9.0, 6.0), (2.0, 6.0))
    size = PadSettings(horizontals=3, verticals=2, pitch_mm=(8.0, 15.0), keep_out_mm=(hole,), sensed_mm=(10.0, 12.0))
    pad, rig, time = Morphology.straight(size.layout), quiet_rig(presses=4, readings_per_press=10), Time(least_s=0)
    simulate(pad, rig, pad_settings=size).save(tmp_path / RECORDED, {})
    boards = simulated_board_of(tmp_path), *(SimulatedBoard(pad, rig, Contact(), each) for each in (size, None))
    with time.of_all():
        for board in boards:
            board.connect()
        time.sleep(10.0)
        same, told, elsewhere = (board.read().volts for board in boards)
    np.testing.assert_array_equal(same, told)
    assert not np.array_equal(same, elsewhere)
