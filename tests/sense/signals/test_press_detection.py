"""Press detection in the published recording, in simulated ones, and in disturbed readings."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design import Morphology
from padforge.sense import PressDetector, Recording, RigSettings, detect_presses, import_mat, simulate
from padforge.sense.signals.press_detection import Presses, align_to_detected, estimate_commands
from padforge.sense.simulation.pad_model import Divider, Strain
from tests.helpers.golden import Golden
from tests.helpers.rigs import ideal_rig

RATE_HZ, COUNT_V = 14.0, 3.3 / 1023
TOUCH_DELAY_S, RELEASE_DELAY_S, BLOCK_S = 0.16, 0.08, 0.03
MAX_LEAD = 3
"""Readings before its command at which a touch may be dated: earlier noise may count as part of it."""
Spans = list[tuple[float, float]]


def evaluate(presses: Presses, recording: Recording) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Recall, false positives per press, and offsets of touches and releases from their commands, readings."""
    down_command, up_command = recording.down_command, recording.up_command
    command = np.searchsorted(down_command - MAX_LEAD, presses.touched, side="right") - 1
    inside = (command >= 0) & (presses.touched < up_command[command])
    detected, first = np.unique(command[inside], return_index=True)
    touches = presses.touched[inside][first] - down_command[detected]
    releases = presses.released[inside][first] - up_command[detected]
    n_false = len(presses.touched) - len(detected)
    return len(detected) / len(down_command), n_false / len(down_command), touches, releases


def test_detect_presses_of_the_published_recording(published: Path) -> None:
    # As measured: 4480 detected, 2 false; 13 of the 20 missed move all fibres together by less than 6 steps of the
    # converter. Touches show 2.2 (standard deviation 1.0) readings after their command, releases 0.5.
    recording = import_mat(published / "para5_long_first4500.mat")
    presses = detect_presses(recording.readings, recording.times_s)
    recall, false, touches, releases = evaluate(presses, recording)
    assert recall >= 0.995
    assert false <= 0.002
    assert np.median(touches) == 2
    assert touches.std() < 1.2
    assert np.mean(np.abs(releases - 0.5) <= 1.5) > 0.995
    down_command, up_command = estimate_commands(presses, recording.times_s)
    command = np.searchsorted(recording.down_command - MAX_LEAD, presses.touched, side="right") - 1
    assert abs(np.mean(down_command - recording.down_command[command])) < 0.5
    assert abs(np.median(up_command - recording.up_command[command])) < 1


@pytest.mark.parametrize(
    ("grid", "rig"),
    [
        (4, RigSettings(presses=150, noise_mv=5, drift_mv=150)),
        (4, RigSettings(presses=150, hysteresis=0.5, creep=0.4)),
        (4, RigSettings(presses=150, depth_mm=2.5)),
        (4, RigSettings(presses=150, rate_hz=5, readings_per_press=20)),
        (4, RigSettings(presses=20, rate_hz=1000, readings_per_press=2000)),
        (1, RigSettings(presses=150)),
    ],
)
def test_detect_presses_of_simulated_pads(grid: int, rig: RigSettings) -> None:
    recording = simulate(Morphology.straight(grid), rig)
    recall, false, touches, releases = evaluate(detect_presses(recording.readings, recording.times_s), recording)
    # at half the depth some places answer by no more than a few times the noise
    assert recall >= (0.985 if rig.press_depths_mm == (5.0,) else 0.88)
    assert false <= (0.015 if rig.press_depths_mm == (5.0,) else 0.06)
    for offsets in (touches, releases):  # commands take up to 0.22 s to show, and a block or two of 0.07 s passes
        assert np.mean((offsets / rig.rate_hz > -0.1) & (offsets / rig.rate_hz < 0.5)) >= 0.95


def evenly(presses: int, held_s: float, pause_s: float) -> Spans:
    starts = 3 + np.arange(presses) * (held_s + pause_s)
    return [(start, start + held_s) for start in starts.tolist()]


@pytest.mark.parametrize(
    ("spans", "rate_hz", "ramp_s"),
    [
        ([(3.0, 4.5)], RATE_HZ, 0.15),
        (evenly(100, 0.15, 1.5), RATE_HZ, 0.15),
        (evenly(100, 0.4, 0.4), 100.0, 0.15),
        (evenly(100, 1.0, 0.3), RATE_HZ, 0.15),
        (evenly(3, 120.0, 60.0), RATE_HZ, 0.15),
        (evenly(60, 1.5, 2.0), RATE_HZ, 0.4),
    ],
    ids=["one", "taps", "quick 100 Hz", "close", "held long", "slow"],
)
def test_detect_presses_of_any_protocol(spans: Spans, rate_hz: float, ramp_s: float) -> None:
    """A press without an end lasts to the end of the recording."""
    rng = np.random.default_rng(0)
    times = np.arange(int((spans[-1][1] + 4) * rate_hz)) / rate_hz
    strain = Strain(*np.zeros((3, len(times), 6)))
    for down, up in spans:
        depth = np.clip((times - down) / ramp_s, 0, 1) - np.clip((times - up) / ramp_s, 0, 1)
        responses = np.clip(rng.normal(0.3, 0.4, 6), 0, None)
        responses[rng.integers(6)] += 0.5
        strain.pressed[:] += depth[:, None] * responses
        strain.residue[:] += 0.2 * np.maximum(-np.diff(depth, prepend=0.0), 0)[:, None] * responses
    readings = Divider(6, rate_hz, ideal_rig(), rng)(strain)
    touched, released = detect_presses(readings, times)
    assert abs(len(touched) - len(spans)) <= 0.05 * len(spans)
    tolerance_s = ramp_s + 2.5 / rate_hz + 2 * BLOCK_S
    detected_s = times[touched], np.append(times, np.inf)[released]
    for detected, true in zip(detected_s, zip(*spans, strict=True), strict=True):
        distance = np.abs(detected[:, None] - np.array(true)).min(axis=0)
        assert np.mean(distance < tolerance_s) >= 0.95
    if spans[-1][1] - spans[-1][0] >= 1:
        cut = int(np.mean(spans[-1]) * rate_hz)
        presses = detect_presses(readings[:cut], times[:cut])
        assert presses.released[-1] == estimate_commands(presses, times[:cut])[1][-1] == cut


@settings(max_examples=10)
@given(
    fibres=st.sampled_from([1, 2, 6, 100]),
    std=st.sampled_from([0.0, 0.1 * COUNT_V, 0.3 * COUNT_V, COUNT_V, 0.1]),
    step=st.sampled_from([0.0, COUNT_V]),
    rate_hz=st.sampled_from([5.0, 14.0, 1000.0]),
    seed=st.integers(0, 1000),
)
def test_detect_presses_finds_none_in_noise(fibres: int, std: float, step: float, rate_hz: float, seed: int) -> None:
    readings = 2 + std * np.random.default_rng(seed).standard_normal((5000, fibres))
    readings = np.rint(readings / step) * step if step else readings
    for nothing in (readings, np.full((300, 3), np.nan), np.zeros((1, 3))):
        assert len(detect_presses(nothing, np.arange(len(nothing)) / rate_hz).touched) == 0


def disturb(readings: np.ndarray) -> dict[str, np.ndarray]:
    """Disturbances of one fibre, always or from the middle on, or of any at random."""
    rng, rows = np.random.default_rng(0), len(readings)
    one = np.arange(readings.shape[1]) == 1
    later = one & (np.arange(rows)[:, None] >= rows // 2)
    noise, chance = 0.1 * rng.standard_normal((rows, 1)), rng.random(readings.shape)
    return {
        "dead": np.where(one, 1.5, readings),
        "missing": np.where(one, np.nan, readings),
        "saturating": np.where(later, 3.3, readings),
        "breaking": np.where(later, 0.0, readings),
        "offset": readings + 0.2 * later,
        "noisy": readings + one * noise,
        "later noisy": readings + later * noise,
        "spikes": readings + 0.5 * (chance < 2e-3),
        "missing entries": np.where(chance < 0.05, np.nan, readings),
        "missing rows": np.where(chance[:, :1] < 0.1, np.nan, readings),
    }


def test_detect_presses_in_disturbed_readings(recording: Recording, golden: Golden) -> None:
    """What is detected is kept: models are trained on it, so that a change must be intended."""
    lines = []
    for kind, readings in disturb(recording.readings).items():
        presses = detect_presses(readings, recording.times_s)
        recall, false, *_ = evaluate(presses, recording)
        assert recall >= 0.98, kind
        assert false <= 0.02, kind
        lines.append(f"{kind}: {len(presses.touched)}, sums {presses.touched.sum()} and {presses.released.sum()}")
    golden("sense/detected.txt", "\n".join(lines))


@settings(max_examples=10)
@given(cuts=st.lists(st.integers(0, 2000), max_size=20))
def test_update_does_not_depend_on_the_size_of_blocks(recording: Recording, cuts: list[int]) -> None:
    readings, times = recording.readings[:2000], recording.times_s[:2000]
    detector = PressDetector(recording.fibres)
    edges = [0, *sorted(cuts), 2000]
    events = [event for a, b in pairwise(edges) for event in detector.update(times[a:b], readings[a:b])]
    touched, released = detect_presses(readings, times)
    assert [event.reading for event in events if event.down] == touched.tolist()
    assert [event.reading for event in events if not event.down] == released[released < 2000].tolist()
    assert [event.down for event in events] == [True, False] * (len(events) // 2) + [True] * (len(events) % 2)
    # reading by reading, events are reported within two
    one = PressDetector(recording.fibres)
    lags = [i - each.reading for i in range(600) for each in one.update(times[i : i + 1], readings[i : i + 1])]
    assert min(lags) >= 1
    assert np.mean(np.array(lags) <= 2) > 0.95


@settings(max_examples=10)
@given(
    scale=st.sampled_from([-4.0, -1.0, 0.25, 2.0]),
    shift=st.sampled_from([-1.0, 0.0, 0.5]),
    start_s=st.sampled_from([-1e4, 0.0, 2.0**31]),
)
def test_detect_presses_is_invariant_to_polarity_scale_offset_and_clock(
    recording: Recording, scale: float, shift: float, start_s: float
) -> None:
    readings, times = recording.readings[:2000], recording.times_s[:2000]
    plain = detect_presses(readings, times)
    other = detect_presses(scale * readings + shift, times + start_s)
    assert len(plain.touched) == 50
    assert np.abs(other.touched - plain.touched).max() <= 1
    assert np.abs(other.released - plain.released).max() <= 1


@settings(max_examples=25)
@given(
    gaps=st.lists(st.integers(1, 6), min_size=2, max_size=30),
    after=st.integers(0, 20),
    rate_hz=st.sampled_from([2.0, 14.0, 300.0]),
    seed=st.integers(0, 99),
)
def test_estimate_commands_makes_a_valid_recording(gaps: list[int], after: int, rate_hz: float, seed: int) -> None:
    edges = np.cumsum(gaps[: len(gaps) // 2 * 2])
    presses = Presses(edges[::2], edges[1::2])
    times = np.cumsum(np.random.default_rng(seed).exponential(1 / rate_hz, edges[-1] + max(after, 1)) + 1e-4)
    down_command, up_command = estimate_commands(presses, times)
    Recording(np.ones((len(times), 1)), times, np.full((len(down_command), 2), np.nan), down_command, up_command)
    assert (down_command <= presses.touched).all()
    assert (up_command <= presses.released).all()
    assert (up_command > presses.touched).all()
    waited = down_command == np.concatenate([[0], up_command[:-1]]) + 1
    assert (waited | (times[presses.touched] - times[down_command] <= TOUCH_DELAY_S)).all()
    at_once = up_command == presses.touched + 1
    assert (at_once | (times[presses.released] - times[up_command] <= RELEASE_DELAY_S)).all()


def test_align_to_detected_moves_presses_by_a_few_readings_and_keeps_those_not_detected(recording: Recording) -> None:
    commanded = recording.down_command, recording.up_command
    down_command, up_command = align_to_detected(recording.readings, recording.times_s, *commanded)
    for aligned, command in zip((down_command, up_command), commanded, strict=True):
        assert np.abs(aligned - command).max() <= 6
        assert 0 < np.abs(aligned - command).mean() < 3  # the simulated probe takes up to 0.35 s to leave
    assert (up_command > down_command).all()
    assert (down_command[1:] >= up_command[:-1]).all()

    def align(first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        readings = recording.readings.copy()
        readings[first:last] = readings[first - 1]
        return align_to_detected(readings, recording.times_s, recording.down_command, recording.up_command)

    down, up = recording.down_command, recording.up_command
    down_command, up_command = align(int(down[10]) - 3, int(down[12]) - 10)
    np.testing.assert_array_equal(down_command[10:12], down[10:12])
    assert up_command[10] == up[10]
    down_command, up_command = align(int(up[20]) - 2, int(down[21]) + 10)  # two presses look like one
    assert (down_command[20], up_command[20]) == (down[20], up[20])
    np.testing.assert_array_equal(align(1, len(recording.readings)), (down, up))
    readings, late = recording.readings.copy(), int(up[30]) + 2  # it is felt once the probe has been sent up
    readings[down[30] - 2 : late] = readings[down[30] - 3]
    readings[late : late + 10] = recording.readings[up[30] - 10 : up[30]]
    touched, _ = detect_presses(readings, recording.times_s)
    assert ((touched >= up[30]) & (touched < down[31] - MAX_LEAD)).any()
    down_command, up_command = align_to_detected(readings, recording.times_s, down, up)
    assert (down_command[30], up_command[30]) == (down[30], up[30])
