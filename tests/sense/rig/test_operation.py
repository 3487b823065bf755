from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from padforge.sense.localizer.calibration import calibrate
from padforge.sense.recording.press_plan import PressPlan, make_plan
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import Recorder
from padforge.sense.rig.operation import ADAPT_EVERY, AdaptivePlanner, acquisition
from padforge.sense.rig.press_loop import PressLoop
from padforge.sense.settings import LocalizerSettings
from tests.sense.conftest import few_moments
from tests.sense.rig.fakes import FIBRES, PAD, RIG, FakeArm, FakeBoard, Time


def test_acquisition_is_mean_error_of_five_times_distance():
    evaluated = np.column_stack([np.arange(1.0, 8.0), np.zeros(7)])
    errors = np.array([1.0, 2.0, 3.0, 4.0, 10.0, 100.0, 1000.0])
    score = acquisition(np.array([[0.0, 0.0], [1.0, 3.0]]), evaluated, errors, evaluated)
    np.testing.assert_allclose(score, [4.0 * 1, 4.0 * 3])
    pressed = np.vstack([evaluated, [0.0, 0.0]])  # a position just chosen is not chosen again
    score = acquisition(np.array([[0.0, 0.0], [0.0, 0.25]]), evaluated, errors, pressed)
    np.testing.assert_allclose(score, [0, 4.0 / 4])
    few = acquisition(np.array([[0.0, 0.0]]), evaluated[:2], errors[:2], np.array([[0.0, 0.5]]))
    np.testing.assert_allclose(few, [1.5 * 0.5])


def test_adaptive_planner_presses_where_the_localizer_is_poor(tmp_path):
    """Two presses in three of those chosen lie in the half of the pad that the localizer never saw."""
    time = Time(least_s=0.02)
    arm = FakeArm(time)
    fast = {"readings_per_press": 24, "press_mm_s": 250, "clearance_mm": 5}
    options = RIG.model_copy(update={"presses": ADAPT_EVERY + 10, "plan": "adaptive", **fast})
    plan, training = (make_plan(PAD, options, np.random.default_rng(seed)) for seed in (3, 4))
    left_mm = np.column_stack([-np.abs(training.positions_mm[:, 0]), training.positions_mm[:, 1]])
    board = FakeBoard(arm)

    def record(name, plan, **more):
        with time.of_all(), Recorder(tmp_path / name, FIBRES, {}, {}) as recorder:
            PressLoop(arm, board, recorder, options).run(plan, **more)
        return Recording.open(tmp_path / name)

    training_recording = record("training", PressPlan(left_mm, training.depths_mm))
    small = LocalizerSettings(members=1, hidden=32, layers=1, epochs=10, max_failures=0)
    with few_moments():
        localizer, _ = calibrate(training_recording, small)
    planner = AdaptivePlanner(
        localizer, tmp_path / "run", np.random.default_rng(5), lambda positions_mm: np.ones(len(positions_mm), bool)
    )
    pressed_mm = record("run", plan, planner=planner).presses_mm
    assert np.array_equal(pressed_mm[:ADAPT_EVERY], plan.positions_mm[:ADAPT_EVERY])
    assert (pressed_mm[ADAPT_EVERY:] != plan.positions_mm[ADAPT_EVERY:]).any(axis=1).all()
    assert np.abs(pressed_mm).max() <= np.abs(plan.positions_mm).max()
    assert (pressed_mm[ADAPT_EVERY:, 0] > 0).mean() > 2 / 3


def test_adaptive_planner_stays_within_the_sides_of_its_plan(monkeypatch):
    """Of a plan 10 mm wide and 40 mm high; the errors do not matter, as all are the same."""
    pressed_mm = np.random.default_rng(0).uniform([-5, -20], [5, 20], (2 * ADAPT_EVERY, 2))
    recording = SimpleNamespace(presses_mm=pressed_mm[:ADAPT_EVERY])
    localizer: Any = SimpleNamespace(predict=lambda recording: SimpleNamespace(positions_mm=recording.presses_mm + 1.0))
    monkeypatch.setattr(Recording, "open", lambda run: recording)
    planner = AdaptivePlanner(
        localizer, Path(), np.random.default_rng(1), lambda positions_mm: np.ones(len(positions_mm), bool)
    )
    plan = PressPlan(pressed_mm, np.full(len(pressed_mm), 3.0))
    assert planner(plan, ADAPT_EVERY - 1) is plan
    moved_mm = planner(plan, ADAPT_EVERY).positions_mm
    np.testing.assert_array_equal(moved_mm[:ADAPT_EVERY], pressed_mm[:ADAPT_EVERY])
    assert (moved_mm[ADAPT_EVERY:] != pressed_mm[ADAPT_EVERY:]).any(axis=1).all()
    assert (np.abs(moved_mm) <= np.abs(pressed_mm).max(axis=0)).all()
