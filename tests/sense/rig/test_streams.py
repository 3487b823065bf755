"""Streams of a board and of a recording."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.recording.run_directory import FORMAT, START
from padforge.sense.rig.streams import RECORDED, is_pad_mirrored, stream_recording
from padforge.sense.settings import RigSettings
from tests.sense.rig.fakes import Time


@pytest.fixture
def still() -> Iterator[Time]:
    """A clock that goes on only in `sleep`."""
    time = Time(least_s=0)
    with time.of_all():
        yield time


def test_stream_recording_gives_every_reading_when_it_is_due(brief: Recording, still: Time) -> None:
    stream = stream_recording(brief, 10.0)
    assert (stream.fibres, stream.rate_hz) == (brief.fibres, brief.rate_hz)
    blocks = []
    for times_s, readings in stream.blocks:
        if len(times_s):
            late_s = (still() - 100.0) * 10 - (times_s[-1] - brief.times_s[0])
            assert 0 <= late_s < 10 * (0.01 + 1e-6) + 1.3 / brief.rate_hz
        blocks.append(np.column_stack([times_s, readings]))
    np.testing.assert_array_equal(np.concatenate(blocks), np.column_stack([brief.times_s, brief.readings]))
    assert max(map(len, blocks)) <= 64
    with pytest.raises(InputError, match="speed is"):
        stream_recording(brief, 0.0)  # it would wait for ever


@pytest.mark.parametrize(
    ("setting", "recorded", "expected"),
    [(None, True, True), (None, False, False), (None, None, False), (True, False, True), (False, True, False)],
)
def test_is_pad_mirrored_asks_the_rig_then_the_recording(
    tmp_path: Path, setting: bool | None, recorded: bool | None, expected: bool
) -> None:
    rig = RigSettings(mirrored=setting)
    assert is_pad_mirrored(tmp_path, rig) is bool(setting)  # no recording lies beside the model
    (tmp_path / RECORDED).mkdir()
    start = {"format": FORMAT, "source": {"kind": "rig", "rig": {"mirrored": recorded}}}
    (tmp_path / RECORDED / START).write_text(json.dumps(start))
    assert is_pad_mirrored(tmp_path, rig) is expected
