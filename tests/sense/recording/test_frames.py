"""Readings of any rate become frames of one length."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padforge.common.progress import ignore_progress
from padforge.sense import Recording
from padforge.sense.live.pipeline import Estimate, Live
from padforge.sense.localizer.evaluation import errors_by_moment
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.recording.frames import FRAME_S, FrameStream, frame_rate_hz, framed, reading_edges, time_means


def repeated(recording: Recording, times: int) -> Recording:
    """Return a recording at `times` as many readings a second, of even frames; each reading is that many equal ones."""
    even_s = FRAME_S * np.arange(len(recording.readings))
    parts_s = FRAME_S * ((np.arange(times) + 0.5) / times - 0.5)
    return replace(
        recording,
        readings=np.repeat(recording.readings, times, axis=0),
        times_s=(even_s[:, None] + parts_s).ravel(),
        down_command=times * recording.down_command,
        up_command=times * recording.up_command,
    )


def uneven(rate_hz: float, seed: int, seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    times_s = np.cumsum(rng.uniform(0.5, 1.5, int(seconds * rate_hz)) / rate_hz)
    readings = rng.standard_normal((len(times_s), 2))
    return times_s, np.where(rng.random(readings.shape) < 0.1, np.nan, readings)


@given(st.sampled_from((3.0, 11.0, 60.0, 400.0)), st.integers(0, 2**32 - 1))
def test_frames_are_means_over_time(rate_hz: float, seed: int) -> None:
    """Beside the sum over every reading of the time that it stands for within the frame."""
    times_s, readings = uneven(rate_hz, seed)
    edges = reading_edges(times_s)
    frame_edges = np.arange(edges[0], edges[-1], FRAME_S)
    means = time_means(edges, readings, frame_edges)
    for n in range(0, len(means), 7):
        begin, end = frame_edges[n : n + 2]
        within_s = np.clip(np.minimum(edges[1:], end) - np.maximum(edges[:-1], begin), 0, None)
        for fibre, mean in enumerate(means[n]):
            present = ~np.isnan(readings[:, fibre])
            read_s = within_s[present].sum()
            if read_s < 0.25 * FRAME_S:
                assert np.isnan(mean)
            else:
                assert mean == pytest.approx((within_s * readings[:, fibre])[present].sum() / read_s, abs=1e-9)


@pytest.mark.parametrize("rate_hz", [5.0, 31.0, 100.0, 1000.0])
def test_no_frame_mixes_what_was_before_a_command_with_what_came_after(rate_hz: float) -> None:
    times_s, readings = uneven(rate_hz, 0, seconds=20.0)
    commands = (len(times_s) * np.array([0.21, 0.44, 0.46, 0.9])).astype(int)
    level = np.searchsorted(commands, np.arange(len(times_s)), side="right")
    recording = Recording(
        readings * 0.0 + level[:, None].astype(float), times_s, np.zeros((2, 2)), commands[::2], commands[1::2]
    )
    frames = framed(recording)
    found = np.stack([frames.down_command, frames.up_command], axis=1).ravel()
    expected = np.searchsorted(found, np.arange(len(frames.readings)), side="right")
    seen = np.isfinite(frames.readings)
    assert seen.mean() > 0.9
    np.testing.assert_allclose(frames.readings[seen], np.broadcast_to(expected[:, None], seen.shape)[seen], atol=1e-9)
    assert abs(frames.times_s[found] - times_s[commands]).max() <= FRAME_S / 2 + 1 / rate_hz
    assert frames.rate_hz == pytest.approx(frame_rate_hz(rate_hz)) == pytest.approx(1 / FRAME_S)
    assert framed(frames) is frames


@pytest.mark.parametrize("rate_hz", [12.5, 13.3, 14.4])
def test_readings_of_about_the_length_of_a_frame_are_frames(rate_hz: float) -> None:
    times_s, readings = uneven(rate_hz, 1)
    recording = Recording(readings, times_s, np.zeros((1, 2)), np.array([5]), np.array([20]))
    assert framed(recording) is recording
    even_s = np.arange(40) / rate_hz
    times, means = FrameStream(rate_hz, 2).feed(even_s, readings[:40])
    np.testing.assert_array_equal(times, even_s)
    np.testing.assert_array_equal(means, readings[:40])


@given(st.sampled_from((4.0, 40.0, 500.0)), st.lists(st.integers(1, 60), min_size=1), st.integers(0, 2**32 - 1))
def test_frames_of_a_stream_do_not_depend_on_how_it_is_cut(rate_hz: float, lengths: list[int], seed: int) -> None:
    times_s, readings = uneven(rate_hz, seed)
    whole, stream, parts, begin = FrameStream(rate_hz, 2).feed(times_s, readings), FrameStream(rate_hz, 2), [], 0
    for length in [*lengths, len(times_s)]:
        parts.append(stream.feed(times_s[begin : begin + length], readings[begin : begin + length]))
        begin += length
    for part, expected in zip(map(np.concatenate, zip(*parts, strict=True)), whole, strict=True):
        np.testing.assert_allclose(part, expected, atol=1e-9)
    assert len(whole[0]) == pytest.approx((times_s[-1] - times_s[0]) / FRAME_S, abs=1.5 + 1.5 / (rate_hz * FRAME_S))


def test_a_night_without_readings_makes_few_frames() -> None:
    """In a recording and in a stream; their times are those of the clock."""
    times_s = np.arange(2000) / 100 + np.repeat([0.0, 1e9], 1000)
    readings = np.repeat([[0.0], [1.0]], 1000, axis=0)
    frames = framed(Recording(readings, times_s, np.zeros((2, 2)), np.array([300, 1300]), np.array([500, 1500])))
    stream = FrameStream(100.0, 1)
    parts = [stream.feed(times_s[i : i + 7], readings[i : i + 7]) for i in range(0, 2000, 7)]
    for found_s, values in ((frames.times_s, frames.readings), map(np.concatenate, zip(*parts, strict=True))):
        assert (np.diff(found_s) > 0).all()
        assert len(found_s) == pytest.approx(21 / FRAME_S, abs=3)
        np.testing.assert_array_equal(values[found_s < 10], 0)
        np.testing.assert_allclose(values[found_s > 1e9 + 10], 1)
    np.testing.assert_allclose(frames.times_s[frames.down_command], times_s[[300, 1300]], atol=FRAME_S)


def test_more_readings_of_the_same_locate_alike(localizer: LocalizerModel, brief: Recording) -> None:
    once, often = repeated(brief, 1), repeated(brief, 6)
    at_once, at_often = localizer.predict(once), localizer.predict(often)
    np.testing.assert_allclose(at_often.positions_mm, at_once.positions_mm, atol=1e-4)
    np.testing.assert_allclose(at_often.r90_mm, at_once.r90_mm, atol=1e-4)
    errors = [errors_by_moment(localizer, each, np.arange(9), (0,), ignore_progress) for each in (once, often)]
    at_once, at_often = ([[row["time_s"], row["mean_mm"]] for row in each["by_moment"]] for each in errors)
    np.testing.assert_allclose(at_often, at_once, atol=1e-4)


def test_live_averages_a_faster_stream(localizer: LocalizerModel, recording: Recording) -> None:
    def estimates(times: int) -> np.ndarray:
        stream = repeated(recording, times)
        live = Live(localizer, rate_hz=stream.rate_hz)
        end = int(stream.down_command[6])
        found = [e for e in live.update(stream.times_s[:end], stream.readings[:end]) if isinstance(e, Estimate)]
        return np.array([(e.press, e.since == "lift", e.readings, e.final, e.x_mm, e.y_mm, e.r90_mm) for e in found])

    once, often = estimates(1), estimates(6)
    assert len(once) > 100
    assert len(once) - len(often) <= 1  # the last frame is not complete
    np.testing.assert_allclose(often, once[: len(often)], rtol=0, atol=1e-4)
