"""Where live readings come from."""

import json
from pathlib import Path

import numpy as np
import pytest

import padforge.sense.rig.streams
from padforge.design import Morphology
from padforge.design.common.validation import InputError
from padforge.design.settings import PUBLISHED_CONTACT, Contact
from padforge.sense import Recording
from padforge.sense.recording.run_directory import FORMAT, START
from padforge.sense.rig.devices import BoardSamples, RigFault
from padforge.sense.rig.streams import RECORDED, connected, lies_mirrored, replayed, simulated
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.virtual.virtual_pad import SimulatedConverter
from tests.sense.rig.fakes import Time


@pytest.fixture
def still(monkeypatch: pytest.MonkeyPatch) -> Time:
    """A clock that stands still but where somebody waits."""
    time = Time(least_s=0)
    monkeypatch.setattr(padforge.sense.rig.streams.time, "monotonic", time)
    monkeypatch.setattr(padforge.sense.rig.streams.time, "sleep", time.sleep)
    return time


def test_a_replay_gives_every_reading_once_when_it_is_due(brief: Recording, still: Time) -> None:
    source = replayed(brief, 10.0)
    assert (source.fibres, source.rate_hz) == (brief.fibres, brief.rate_hz)
    times, readings = [], []
    for times_s, block in source.blocks:
        if len(times_s):
            late_s = (still() - 100.0) * 10 - (times_s[-1] - brief.times_s[0])
            assert 0 <= late_s < 10 * (0.01 + 1e-6) + 1.3 / brief.rate_hz
        times.append(times_s)
        readings.append(block)
    np.testing.assert_array_equal(np.concatenate(times), brief.times_s)
    np.testing.assert_array_equal(np.concatenate(readings), brief.readings)
    assert max(map(len, times)) <= 64
    for speed in (float("nan"), 0.0, -1.0):  # it would wait for ever
        with pytest.raises(InputError, match="speed is"):
            replayed(brief, speed)


def test_samples_are_averaged_to_the_rate_of_the_localizer(still: Time) -> None:
    class Ramp:
        def connect(self) -> dict:
            return {"channels": 2, "rate_hz": 1000.0}

        def read(self) -> BoardSamples:
            if still() > 102:
                raise RigFault("lost", "the board is gone")
            times_s = np.arange(still(), still() + 0.01, 0.001)[:10]
            return BoardSamples(times_s, np.stack([times_s, -times_s], axis=1), np.zeros(10, np.int64))

        def close(self) -> None:
            pass

    source = connected(Ramp(), 13.4)
    assert (source.fibres, source.rate_hz) == (2, pytest.approx(1000 / 75))
    blocks = [next(source.blocks) for _ in range(100)]
    times_s, readings = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    assert len(times_s) == 1000 // 75
    np.testing.assert_allclose(np.diff(times_s), 0.075)
    np.testing.assert_allclose(readings, np.stack([times_s, -times_s], axis=1))
    with pytest.raises(RigFault, match="the board is gone"):
        list(source.blocks)


def test_the_simulated_rig_presses_the_pad_that_was_recorded() -> None:
    pad = Morphology.random(2, knots=3, seed=5)
    rig = RigSettings(presses=20, seed=4, noise_mv=0.0, drift_mv=0.0)
    recorded, time = simulate(pad, rig), Time(least_s=0)
    converter = SimulatedConverter(pad, rig, PUBLISHED_CONTACT, time)
    with pytest.raises(RigFault, match="not connected"):
        converter.read()
    assert converter.connect().items() >= {"name": "simulated", "channels": 4, "rate_hz": rig.rate_hz}.items()
    samples = []
    for pause_s in [0.0, 0.3, 0.01, 5.0] + 30 * [1.0]:
        time.sleep(pause_s)
        samples.append(converter.read())
    volts = np.concatenate([each.volts for each in samples])
    times_s = np.concatenate([each.times_s for each in samples])
    np.testing.assert_allclose(np.diff(times_s), 1 / rig.rate_hz)
    # The same fibres at rest, and as many presses that answer as strongly.
    np.testing.assert_array_equal(volts[:19], recorded.readings[:19])
    swings = np.abs(volts - volts[0]).sum(axis=1)
    assert (np.diff((swings > swings.max() / 5).astype(int)) == 1).sum() == round(len(volts) / 40)
    assert 0.5 < np.abs(volts - volts[0]).max() / np.abs(recorded.readings - volts[0]).max() < 2


def test_the_simulated_rig_presses_to_its_depths_in_turn() -> None:
    rig = RigSettings(presses=4, seed=4, noise_mv=0.0, drift_mv=0.0, depths_mm=(0.5, 5.0), readings_per_press=20)
    time = Time(least_s=0)
    converter = SimulatedConverter(Morphology.straight(2), rig, Contact(), time)
    converter.connect()
    time.sleep(4.01 * 20 / rig.rate_hz)
    volts = converter.read().volts
    swings = [np.ptp(volts[20 * press : 20 * press + 20], axis=0).sum() for press in range(4)]
    assert max(swings[0::2]) < 0.5 * min(swings[1::2])


@pytest.mark.parametrize(
    ("said", "recorded", "lies"),
    [(None, True, True), (None, False, False), (None, None, False), (True, False, True), (False, True, False)],
)
def test_a_pad_lies_as_the_rig_says_or_else_as_it_was_recorded(
    tmp_path: Path, said: bool | None, recorded: bool | None, lies: bool
) -> None:
    rig = RigSettings(mirrored=said)
    assert lies_mirrored(tmp_path, rig) is bool(said)  # no recording lies beside the model
    (tmp_path / RECORDED).mkdir()
    start = {"format": FORMAT, "source": {"kind": "rig", "rig": {"mirrored": recorded}}}
    (tmp_path / RECORDED / START).write_text(json.dumps(start))
    assert lies_mirrored(tmp_path, rig) is lies


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "rig"}, "of no simulated pad"),
        ({"twin": {"presses": 1500}}, "of a pad simulated by its twin"),
        ({"rig": {"rate_hz": -1}}, "rig rate_hz: got -1"),
        ({"morphology": {}}, "no pad that can be simulated"),
        ({"morphology": {"pitch_mm": 1, "knots": [[1, 2]]}}, "there are 1 fibres"),
        ({"morphology": {"pitch_mm": 1, "knots": [[1, 2], [3, 4]]}}, "knots"),
    ],
)
def test_the_simulated_pad_is_that_of_the_model(brief: Recording, tmp_path: Path, change: dict, said: str) -> None:
    with pytest.raises(InputError, match=r"start\.json: not there"):
        simulated(tmp_path)
    brief.save(tmp_path / RECORDED, {})
    path = tmp_path / RECORDED / START
    source = simulate(Morphology.straight(2), RigSettings(presses=1)).source
    path.write_text(json.dumps({"format": FORMAT, "source": source}))
    assert simulated(tmp_path).connect()["channels"] == 4
    path.write_text(json.dumps({"format": FORMAT, "source": {**source, **change}}))
    with pytest.raises(InputError, match=said):
        simulated(tmp_path)
