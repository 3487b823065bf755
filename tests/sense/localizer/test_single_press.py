"""Two fingers are no single press, another pad is said to be one; deeper presses and failed fibres are neither."""

from dataclasses import replace

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense import Recording
from padforge.sense.arrays import Indices
from padforge.sense.localizer.features import MODULATED, compute_features
from padforge.sense.localizer.model import UNIFORM, LocalizerModel
from padforge.sense.localizer.moments import N_PRESS_WINDOWS, N_TIMED, complete_at
from padforge.sense.localizer.scaler import FeatureScaler, ScaledFeatures, leave_one_out_residuals
from padforge.sense.localizer.single_press import (
    MIN_PRESSES,
    STAGES,
    SinglePressTest,
    find_misfits,
    find_unlike,
    is_other_pad,
)
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.example import PLAN
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.once import Once
from tests.helpers.presses import changed

TRAINED, HELD_BACK, PRESSES = 1000, 100, 1300
MIN_MM = 12.0  # between two fingers
OTHER_PADS = range(20, 26)  # their seeds


def press_features(scaler: FeatureScaler, recording: Recording, n_complete: int = N_TIMED) -> ScaledFeatures:
    commands = recording.down_command, recording.up_command
    return scaler.transform(compute_features(recording.readings, *commands, complete_at(n_complete, *commands)))


@pytest.fixture(scope="module")
def pad(once: Once) -> Recording:
    return once("single-press-pad", lambda _: simulate(Morphology.load(PLAN), RigSettings(presses=PRESSES, seed=1)))


@pytest.fixture(scope="module")
def others(once: Once) -> list[Recording]:
    """The same plan, cast again."""
    plan = Morphology.load(PLAN)
    return once("cast-again", lambda _: [simulate(plan, RigSettings(presses=30, seed=seed)) for seed in OTHER_PADS])


class Trained:
    """Tests of a pad, fitted as a calibration does, and the presses that neither training nor calibration saw."""

    def __init__(self, pad: Recording) -> None:
        commands, trained = (pad.down_command, pad.up_command), np.arange(TRAINED)
        features, positions_mm = compute_features(pad.readings, *commands)[trained], pad.presses_mm[trained]
        self.scaler, table = FeatureScaler.fit(features, positions_mm, None, MODULATED)
        presses = leave_one_out_residuals(self.scaler.training_presses(features, positions_mm), table)
        self.zero = self.scaler.mean_v / self.scaler.scale_v
        fitted = (SinglePressTest.fit(table, presses, self.zero, n_complete) for n_complete in STAGES)
        held_back = np.arange(TRAINED, TRAINED + HELD_BACK)
        self.tests = tuple(
            test.calibrated(press_features(self.scaler, pad, n_complete)[held_back])
            for test, n_complete in zip(fitted, STAGES, strict=True)
        )
        self.rows = np.arange(TRAINED + HELD_BACK, PRESSES)
        self.positions_mm = pad.presses_mm[self.rows]

    def later(self, pad: Recording, n_complete: int = N_TIMED) -> ScaledFeatures:
        return press_features(self.scaler, pad, n_complete)[self.rows]

    def superposed(self, presses: ScaledFeatures, first: Indices, second: Indices) -> ScaledFeatures:
        """Two fingers at once: responses add."""
        inputs = presses.inputs[first] + presses.inputs[second] + self.zero
        return replace(presses[first], inputs=inputs.astype(np.float32))

    def is_other_pad(self, presses: ScaledFeatures) -> bool:
        return is_other_pad(self.tests, find_misfits(self.tests, presses))


@pytest.fixture(scope="module")
def trained(once: Once, pad: Recording) -> Trained:
    return once("single-press-tests", lambda _: Trained(pad))


def fail(pad: Recording, fibres: list[int]) -> Recording:
    """They do not respond."""
    return changed(pad, "readings", np.s_[:, fibres], np.median(pad.readings, axis=0)[fibres])


@pytest.mark.parametrize(("n_complete", "least"), [(N_PRESS_WINDOWS, 0.65), (N_TIMED, 0.85)])
def test_two_fingers_are_unlike_a_single_press(trained: Trained, pad: Recording, n_complete: int, least: float) -> None:
    presses = trained.later(pad, n_complete)
    assert find_unlike(trained.tests, presses).mean() <= 0.03
    first, second = np.random.default_rng(0).integers(len(presses), size=(2, 400))
    apart = np.hypot(*(trained.positions_mm[first] - trained.positions_mm[second]).T) > MIN_MM
    two = trained.superposed(presses, first[apart], second[apart])
    assert find_unlike(trained.tests, two).mean() >= least


def test_stronger_presses_and_failed_fibres_are_no_second_finger(trained: Trained, pad: Recording) -> None:
    presses = trained.later(pad)
    presses, whole = presses[::2], presses
    for strength in (0.5, 2.0):
        inputs = (strength * (presses.inputs + trained.zero) - trained.zero).astype(np.float32)
        assert find_unlike(trained.tests, replace(presses, inputs=inputs)).mean() <= 0.12
    failed = [find_unlike(trained.tests, trained.later(fail(pad, [fibre]))[::2]).mean() for fibre in range(pad.fibres)]
    assert np.mean(failed) <= 0.1
    masked = replace(whole, fibre_mask=np.tile(np.arange(pad.fibres) != 2, (len(whole), 1)))
    assert find_unlike(trained.tests, masked).mean() <= 0.04
    # presses before the first stage and without fibres are not judged
    two = trained.superposed(whole, np.arange(100), np.arange(100, 200))
    assert find_unlike(trained.tests, two).any()
    for n_complete in (0, N_PRESS_WINDOWS - 1):
        early = np.tile(np.arange(N_TIMED) < n_complete, (100, 1))
        assert not find_unlike(trained.tests, replace(two, complete=early)).any()
    assert not find_unlike(trained.tests, replace(two, fibre_mask=np.zeros_like(two.fibre_mask))).any()


def test_pads_cast_again_are_other_pads_unless_presses_are_few(trained: Trained, others: list[Recording]) -> None:
    said = [trained.is_other_pad(press_features(trained.scaler, other)) for other in others]
    assert np.mean(said) > 0.8
    presses = press_features(trained.scaler, others[0])
    assert trained.is_other_pad(presses[:MIN_PRESSES])
    assert not trained.is_other_pad(presses[: MIN_PRESSES - 1])
    uncalibrated = tuple(replace(test, n_presses=np.zeros(1)) for test in trained.tests)
    assert not is_other_pad(uncalibrated, find_misfits(trained.tests, presses))


def test_pads_that_drift_or_have_failed_fibres_are_no_other_pads(trained: Trained, pad: Recording) -> None:
    rng = np.random.default_rng(3)
    rest_v = np.median(pad.readings, axis=0)
    gains = np.exp(0.1 * rng.standard_normal((2, pad.fibres)))
    drifted = [rest_v + 0.1 * rng.standard_normal(pad.fibres) + gain * (pad.readings - rest_v) for gain in gains]
    inverted = np.where(np.arange(pad.fibres) == 3, 2 * rest_v - pad.readings, pad.readings)
    swapped = pad.readings[:, [0, 4, 2, 3, 1, 5]]
    others = (replace(pad, readings=readings) for readings in (*drifted, inverted, swapped))
    for recording in (pad, fail(pad, [1]), fail(pad, [0, 4]), *others):
        presses = trained.later(recording)
        for first in range(0, len(presses) - MIN_PRESSES, 90):
            assert not trained.is_other_pad(presses[first : first + MIN_PRESSES])


def test_radii_of_what_is_no_single_press_hold_any_position(localizer: LocalizerModel, recording: Recording) -> None:
    presses = localizer.scaled_features(recording)
    zero = localizer.scaler.mean_v / localizer.scaler.scale_v
    two = replace(presses, inputs=(presses.inputs + np.roll(presses.inputs, 7, axis=0) + zero).astype(np.float32))
    judged, plain = localizer.localize(two), localizer.predict_features(two)
    assert judged.unlike is not None
    assert 0.2 < judged.unlike.mean() < 1
    np.testing.assert_array_equal(judged.positions_mm, plain.positions_mm)
    np.testing.assert_array_equal(judged.r90_mm[~judged.unlike], plain.r90_mm[~judged.unlike])
    np.testing.assert_allclose(judged.r90_mm[judged.unlike], UNIFORM[2] * localizer.scaler.scale_mm)
    single = localizer.predict(recording).unlike
    assert single is not None
    assert single.mean() < 0.05
