"""The study of drift, in small: levels of readings, drift compensation, and what the networks may see."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.design import Morphology, signals
from padforge.design.published.networks import training_presses
from padforge.design.published.objective import idle_share
from padforge.design.settings import PUBLISHED_CONTACT, between_fibres
from padforge.sense import Recording
from padforge.sense.localizer.calibration import split_presses
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.studies import drift
from padforge.sense.studies.drift import COMPENSATIONS, drift_study, level_indices, network_inputs
from padforge.sense.studies.study import run
from tests.helpers.constants import with_constants

PAD = Morphology.random(2, knots=3, seed=5)
STRONG = RigSettings(presses=180, drift_mv=300, creep=0, hysteresis=0)
CYCLES = 5
small = with_constants((drift, {"MEMBERS": 2, "HIDDEN": 8, "EPOCHS": 15, "RIG": STRONG}))
DOWN, UP = 40 * np.arange(CYCLES) + 20, 40 * np.arange(1, CYCLES + 1)


@pytest.fixture(scope="module")
def recorded() -> Recording:
    """200 presses, not marked as simulated; some readings of a fibre are missing, and one position."""
    recording = simulate(PAD, RigSettings(presses=200, seed=3))
    readings, positions_mm = recording.readings.copy(), recording.presses_mm.copy()
    readings[100:110, 0] = np.nan
    positions_mm[7] = np.nan
    return replace(recording, readings=readings, presses_mm=positions_mm, source={"kind": "test"})


def test_levels_are_the_readings_10_30_and_50_of_a_cycle() -> None:
    levels = level_indices(40 * CYCLES, DOWN, UP)
    assert levels[1].tolist() == [50, 70, 90]
    assert levels[-1].tolist() == [170, 190, 199]  # there are no readings after the last press
    # those of short cycles stay within their phase
    levels = level_indices(20, np.array([3, 9, 15]), np.array([6, 12, 18]))
    assert levels.tolist() == [[0, 5, 8], [6, 11, 14], [12, 17, 19]]


def test_network_inputs_subtract_the_baseline_of_their_compensation() -> None:
    readings = np.random.default_rng(0).normal(2, 0.1, (40 * CYCLES, 3))
    training = np.arange(CYCLES)
    before, pressed, after = readings[level_indices(len(readings), DOWN, UP).T]
    inputs = {name: network_inputs(name, readings, DOWN, UP, training) for name in COMPENSATIONS}
    np.testing.assert_array_equal(inputs["none"], pressed)
    np.testing.assert_array_equal(inputs["baseline"], pressed - before)
    np.testing.assert_array_equal(inputs["published"], np.hstack([before, pressed, after]))
    slow = [np.median(before[: press + 1], axis=0) for press in range(CYCLES)]
    np.testing.assert_allclose(inputs["slow baseline"], pressed - slow)
    assert inputs["windows"].shape == inputs["published"].shape
    shifted = network_inputs("windows", readings + np.array([1, 2, 3]), DOWN, UP, training)
    np.testing.assert_allclose(shifted, inputs["windows"], atol=1e-9)
    # components are those of training presses: the readings of other ones change no inputs of theirs
    changed, training = readings.copy(), np.arange(CYCLES - 2)
    changed[UP[-2] :] *= 3
    windows, other = (network_inputs("windows", each, DOWN, UP, training)[training] for each in (readings, changed))
    np.testing.assert_allclose(windows, other, atol=1e-9)


@pytest.mark.slow
def test_study_finds_that_compensation_reduces_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors are means over filters: two networks on presses that scatter may be off by a fifth with one."""
    monkeypatch.setattr(drift, "COMPENSATIONS", ("none", "baseline", "slow baseline"))
    rows = run(drift_study({"winding": PAD}, {}), tmp_path)["rows"]
    for key in ("mean_mm", "mean_last_mm"):
        plain, baseline, slow = (
            np.mean([row[key] for row in rows if row["compensation"] == compensation])
            for compensation in ("none", "baseline", "slow baseline")
        )
        assert baseline < 0.7 * plain
        assert slow < plain


def test_networks_do_not_depend_on_positions_of_test_presses(
    recorded: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of test presses that are said to be 50 m to the right, and to the left, add up if predicted alike."""
    monkeypatch.setattr(drift, "COMPENSATIONS", ("baseline",))
    known, rng, far_mm = np.flatnonzero(recorded.has_position), np.random.default_rng([7, 0]), 5e4
    others, last = split_presses(known, "chronological", drift.TEST_SHARE, rng)
    _, test = split_presses(others, "random", drift.TEST_SHARE, rng)
    held_out = np.isin(np.arange(len(recorded.presses_mm)), np.append(test, last))

    def errors(shift_mm: float) -> dict[str, np.ndarray]:
        positions_mm = recorded.presses_mm + np.where(held_out[:, None], [shift_mm, 0.0], 0.0)
        return drift_study({}, {"real": replace(recorded, presses_mm=positions_mm)}).tasks[0].compute()

    right, left = errors(far_mm), errors(-far_mm)
    for key, count in (("test_0", len(test)), ("last_0", len(last))):
        assert right[key].shape == (2, count)
        np.testing.assert_allclose(right[key] + left[key], 2 * far_mm, rtol=0, atol=0.01)


def test_idle_share_of_the_published_pad(published: Path) -> None:
    pad = Morphology.load(published / "5para_dis.mat")
    presses = training_presses(between_fibres(pad.layout), drift.SIDE, 0)
    assert idle_share(signals(pad, presses, PUBLISHED_CONTACT)) == pytest.approx(0.58, abs=0.01)
