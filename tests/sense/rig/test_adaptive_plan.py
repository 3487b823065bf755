import numpy as np

from padforge.sense.localizer.calibration import calibrate
from padforge.sense.recording.press_plan import PressPlan, make_plan
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import Recorder
from padforge.sense.rig.operation import EVERY, AdaptivePlanner, uncertainty
from padforge.sense.rig.press_loop import Session
from padforge.sense.settings import LocalizerSettings
from tests.sense.rig.fakes import FIBRES, PAD, RIG, FakeArm, FakeConverter, Time


def test_what_there_is_to_learn_is_the_mean_error_of_five_presses_times_the_way_to_the_nearest():
    known = np.column_stack([np.arange(1.0, 8.0), np.zeros(7)])
    errors = np.array([1.0, 2.0, 3.0, 4.0, 10.0, 100.0, 1000.0])
    worth = uncertainty(np.array([[0.0, 0.0], [1.0, 3.0]]), known, errors, known)
    np.testing.assert_allclose(worth, [4.0 * 1, 4.0 * 3])
    chosen = np.vstack([known, [0.0, 0.0]])  # a place just chosen is not chosen again
    np.testing.assert_allclose(uncertainty(np.array([[0.0, 0.0], [0.0, 0.25]]), known, errors, chosen), [0, 4.0 / 4])
    few = uncertainty(np.array([[0.0, 0.0]]), known[:2], errors[:2], np.array([[0.0, 0.5]]))
    np.testing.assert_allclose(few, [1.5 * 0.5])


def test_a_recording_steers_itself_where_the_localizer_is_poor(tmp_path):
    """Two presses in three of those chosen lie in the half of the pad the localizer never saw."""
    time = Time(least_s=0.02)
    arm = FakeArm(time)
    fast = {"readings_per_press": 24, "press_mm_s": 250, "clearance_mm": 5}
    options = RIG.model_copy(update={"presses": EVERY + 10, "plan": "adaptive", **fast})
    plan = make_plan(PAD, options, np.random.default_rng(3))
    learnt = make_plan(PAD, options, np.random.default_rng(4))
    known = PressPlan(
        np.column_stack([-np.abs(learnt.positions_mm[:, 0]), learnt.positions_mm[:, 1]]), learnt.depths_mm
    )
    converter = FakeConverter(arm)
    with Recorder(tmp_path / "known", FIBRES, {}, {}) as recorder:
        Session(arm, converter, recorder, options, clock=time, sleep=time.sleep).run(known)
    small = LocalizerSettings(members=1, hidden=32, layers=1, epochs=30, max_failures=0)
    localizer, _ = calibrate(Recording.open(tmp_path / "known"), small)
    with Recorder(tmp_path / "run", FIBRES, {}, {}) as recorder:
        steering = AdaptivePlanner(
            localizer, tmp_path / "run", np.random.default_rng(5), lambda positions_mm: np.ones(len(positions_mm), bool)
        )
        Session(arm, converter, recorder, options, clock=time, sleep=time.sleep).run(plan, steer=steering)
    made = Recording.open(tmp_path / "run").presses_mm
    assert np.array_equal(made[:EVERY], plan.positions_mm[:EVERY])
    assert (made[EVERY:] != plan.positions_mm[EVERY:]).any(axis=1).all()
    assert np.abs(made).max() <= np.abs(plan.positions_mm).max()
    assert (made[EVERY:, 0] > 0).mean() > 2 / 3
