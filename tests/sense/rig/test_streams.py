"""Streams of a recording, and of a simulated board, which is the pad of a simulated recording."""

import json
from pathlib import Path

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.design import Morphology
from padforge.design.settings import PUBLISHED_CONTACT, Contact
from padforge.sense import Recording
from padforge.sense.recording.run_directory import FORMAT, START
from padforge.sense.rig.simulated_board import SimulatedBoard, simulated_board_of
from padforge.sense.rig.streams import RECORDED, is_pad_mirrored, stream_recording
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.rigs import RECTANGLE, quiet_rig
from tests.sense.rig.fakes import Time


def test_stream_recording_gives_every_reading_when_it_is_due(brief: Recording) -> None:
    time, blocks = Time(least_s=0), []
    with time.of_all():
        stream = stream_recording(brief, 10.0)
        for times_s, readings in stream.blocks:
            if len(times_s):
                late_s = (time() - 100.0) * 10 - (times_s[-1] - brief.times_s[0])
                assert 0 <= late_s < 10 * (0.01 + 1e-6) + 1.3 / brief.rate_hz
            blocks.append(np.column_stack([times_s, readings]))
    assert (stream.fibres, stream.rate_hz) == (brief.fibres, brief.rate_hz)
    np.testing.assert_array_equal(np.concatenate(blocks), np.column_stack([brief.times_s, brief.readings]))
    assert max(map(len, blocks)) <= 64
    with pytest.raises(InputError, match="speed is"):
        stream_recording(brief, 0.0)  # it would wait for ever


@pytest.mark.parametrize(
    ("setting", "recorded", "expected"),
    [(None, True, True), (None, False, False), (None, None, False), (True, False, True), (False, True, False)],
)
def test_is_pad_mirrored_asks_the_rig(tmp_path, setting: bool | None, recorded: bool | None, expected: bool) -> None:
    rig = RigSettings(mirrored=setting)
    assert is_pad_mirrored(tmp_path, rig) is bool(setting)  # no recording lies beside the model
    (tmp_path / RECORDED).mkdir()
    start = {"format": FORMAT, "source": {"kind": "rig", "rig": {"mirrored": recorded}}}
    (tmp_path / RECORDED / START).write_text(json.dumps(start))
    assert is_pad_mirrored(tmp_path, rig) is expected


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


def test_simulated_board_is_pressed_to_its_depths_in_turn_and_that_of_a_model_as_it_was(tmp_path: Path) -> None:
    rig = quiet_rig(presses=4, seed=4, depths_mm=(0.5, 5.0), readings_per_press=20)
    time = Time(least_s=0)
    board = SimulatedBoard(Morphology.straight(2), rig, Contact())
    with time.of_all():
        board.connect()
        time.sleep(4.01 * 20 / rig.rate_hz)
        volts = board.read().volts
    swings = [np.ptp(volts[20 * press : 20 * press + 20], axis=0).sum() for press in range(4)]
    assert max(swings[0::2]) < 0.5 * min(swings[1::2])
    # of a model: pressed where its recording was, within what is sensed, and beside the keep-outs
    size = RECTANGLE.model_copy(update={"sensed_mm": (10.0, 12.0)})
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
