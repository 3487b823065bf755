"""A program reads the latest state of a pad that a thread follows, and hears of faults."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import Live, Recording, RigSettings
from padforge.sense.live import pad_sensor
from padforge.sense.live.pad_sensor import PadSensor
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.rig.devices import BoardSamples, RigFault
from tests.sense.conftest import first_presses
from tests.sense.rig.fakes import fault_of

PRESSES = 3
LOST = RigFault("lost", "the board is gone")


class ReplayedBoard:
    """A board that sends the readings of a recording until `end` at once, and then nothing, or fails if `error`."""

    def __init__(self, recording: Recording, end: int, error: RigFault | None = None) -> None:
        self.recording, self.end, self.error, self.is_closed = recording, end, error, False

    def connect(self) -> Mapping[str, Any]:
        return {"channels": self.recording.fibres, "rate_hz": self.recording.rate_hz}

    def read(self) -> BoardSamples:
        end, self.end = self.end, 0
        if not end and self.error is not None:
            raise self.error
        return BoardSamples(self.recording.times_s[:end], self.recording.readings[:end], np.zeros(end, np.int64))

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture
def few(brief: Recording) -> Recording:
    return first_presses(brief, PRESSES + 1)


@pytest.fixture
def boards(few: Recording, monkeypatch: pytest.MonkeyPatch) -> list[ReplayedBoard]:
    """Boards that sensors open, the first one first."""
    boards = [ReplayedBoard(few, end) for end in (len(few.readings), 5)]
    opened: Iterator[ReplayedBoard] = iter(boards)
    monkeypatch.setattr(pad_sensor, "open_board", lambda *pad: next(opened))
    return boards


@pytest.fixture
def sensor(model: Path) -> Iterator[PadSensor]:
    sensor = PadSensor("simulated", model, RigSettings())
    yield sensor
    sensor.close()


@pytest.mark.parametrize("is_held", [False, True])
def test_sensor_reads_what_the_pipeline_says(boards, sensor: PadSensor, few: Recording, localizer, is_held) -> None:
    """Of the last press, or of the one under way."""
    end = boards[0].end = int(few.up_command[1]) - 1 if is_held else len(few.readings)
    with pytest.raises(InputError, match="the pad is not connected"):
        sensor.read()
    sensor.connect()
    assert sensor.is_connected
    with pytest.raises(InputError, match="connected already"):
        sensor.connect()
    values = sensor.read()
    assert tuple(values) == sensor.names
    pipeline = Live(localizer, rate_hz=few.rate_hz)
    pipeline.update(few.times_s[:end], few.readings[:end])
    latest = pipeline.presses[-1]
    assert (pipeline.pressed, latest.final) == (is_held, not is_held)
    assert latest.press == 1 if is_held else latest.press >= PRESSES - 1
    expected = {"pressed": float(is_held), "valid": 1.0}
    expected |= {name: getattr(latest, name) for name in ("x_mm", "y_mm", "r90_mm")}
    expected |= {f"fibre_{i}_v": volts for i, volts in enumerate(few.readings[end - 1])}
    assert {name: values[name] for name in expected} == pytest.approx(expected)
    sensor.close()
    assert boards[0].is_closed
    sensor.connect()  # again, to a pad that has not been pressed
    assert [sensor.read()[name] for name in ("pressed", "valid", "x_mm", "r90_mm")] == [0, 0, 0, 0]
    boards[1].error = LOST  # the pad is followed still
    fault_of(sensor.read, "lost", "the board is gone")


@pytest.mark.parametrize("rests", [False, True])
def test_a_position_from_before_is_not_that_of_a_press_under_way(boards, sensor, monkeypatch, rests: bool) -> None:
    """A model of method `published` estimates a press once it is over; of two that `rest` the later counts."""
    monkeypatch.setattr(Live, "pressed", True)
    if rests:
        shown = property(lambda live: [replace(live.presses[0], final=False, x_mm=x_mm) for x_mm in (3.0, 7.0)])
        monkeypatch.setattr(Live, "shown_presses", shown)
    sensor.connect()
    assert [sensor.read()[name] for name in ("pressed", "valid", "x_mm")] == [1, rests, 7 * rests]


def test_sensor_hears_of_faults(boards: list[ReplayedBoard], sensor: PadSensor, few: Recording) -> None:
    boards[0].end, boards[0].error = 5, LOST
    sensor.connect()
    fault_of(sensor.read, "lost", "the board is gone")
    assert boards[0].is_closed
    sensor.close()
    boards[1].end, boards[1].error = 0, LOST
    with pytest.raises(RigFault, match="the board is gone"):
        sensor.connect()
    assert not sensor.is_connected


def test_sensor_waits_for_no_silent_board(boards, sensor: PadSensor, monkeypatch) -> None:
    boards[0].end = 0
    monkeypatch.setattr(pad_sensor, "START_S", 0.1)
    with pytest.raises(RigFault, match=r"no reading has arrived in 0\.1 s; look at the board"):
        sensor.connect()
    assert boards[0].is_closed


def test_sensor_names_depth_and_force_where_they_were_learnt(deep_localizer: LocalizerModel, tmp_path: Path) -> None:
    deep_localizer.save(tmp_path / "deep")
    names = PadSensor("simulated", tmp_path / "deep", RigSettings()).names
    assert names[-8:] == ("x_mm", "y_mm", "r90_mm", "unlike", "depth_mm", "depth_r90_mm", "force_n", "force_r90_n")
