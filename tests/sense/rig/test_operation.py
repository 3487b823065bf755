"""Adaptive plans press where a localizer errs, beside the same by hand; a simulated recording names its files."""

import json
from types import SimpleNamespace

import numpy as np

from padforge.common.files import sha256
from padforge.common.settings import Spec
from padforge.design import Contact
from padforge.design.settings import PadSettings
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.recording.press_plan import PressPlan
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import Recorder
from padforge.sense.rig.config import RigConfig
from padforge.sense.rig.operation import ADAPT_EVERY, acquisition, make_planner, record_simulated
from padforge.sense.settings import RigSettings
from tests.sense.rig.fakes import FIBRES, PAD


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


def test_adaptive_planner_presses_where_the_localizer_is_poor(tmp_path, monkeypatch):
    """It errs by 10 mm in the right half, and hardly in the left; presses already made are left alone, and holes."""
    rng = np.random.default_rng(3)
    plan = PressPlan(rng.uniform(-10, 10, (2 * ADAPT_EVERY + 5, 2)), np.resize([1.0, 2.0, 4.0], 2 * ADAPT_EVERY + 5))
    with Recorder(tmp_path / "run", FIBRES, {}, {}) as recorder:
        recorder.append(np.arange(200.0), np.ones((200, FIBRES)))
        for press, position_mm in enumerate(plan.positions_mm[:ADAPT_EVERY]):
            recorder.begin(position_mm, 5 + 8 * press, press)
            recorder.finish(9 + 8 * press)

    def located(recording: Recording) -> SimpleNamespace:
        error_mm = np.where(recording.presses_mm[:, :1] > 0, [10.0, 0.0], [0.1, 0.0])
        return SimpleNamespace(positions_mm=recording.presses_mm + error_mm)

    monkeypatch.setattr(LocalizerModel, "load", lambda folder: SimpleNamespace(predict=located))
    hole = PadSettings(keep_out_mm=(((-15, -15), (15, -15), (15, -5), (-15, -5)),))
    configs = [
        RigConfig(PAD, Contact(), RigSettings(plan="adaptive", seed=seed), tmp_path / "run", "test", pad_settings=hole)
        for seed in (5, 6)
    ]
    planner, other = (make_planner(config, tmp_path) for config in configs)
    assert planner
    assert other
    assert planner(plan, 0) is planner(plan, ADAPT_EVERY + 1) is plan
    moved = planner(plan, ADAPT_EVERY)
    chosen_mm = moved.positions_mm[ADAPT_EVERY : 2 * ADAPT_EVERY]
    assert not np.isin(other(plan, ADAPT_EVERY).positions_mm[ADAPT_EVERY : 2 * ADAPT_EVERY], chosen_mm).any()
    for same in (slice(ADAPT_EVERY), slice(2 * ADAPT_EVERY, None)):
        np.testing.assert_array_equal(moved.positions_mm[same], plan.positions_mm[same])
    np.testing.assert_array_equal(moved.depths_mm, plan.depths_mm)
    assert (chosen_mm[:, 0] > 0).mean() > 2 / 3
    assert (chosen_mm[:, 1] > -5).all()
    assert (np.abs(chosen_mm) <= np.abs(plan.positions_mm).max(axis=0)).all()
    apart_mm = np.linalg.norm(chosen_mm[:, None] - moved.positions_mm[None, : 2 * ADAPT_EVERY], axis=2)
    assert np.sort(apart_mm, axis=1)[:, 1].min() > 1.0  # from any other press


def test_simulated_recording_names_its_plan_among_its_inputs(tmp_path):
    (tmp_path / "pad.toml").write_text("")
    (tmp_path / "places.csv").write_text("x_mm,y_mm\n3,-1\n0,2\n")
    spec = Spec({"rig": {"plan": str(tmp_path / "places.csv")}})
    recording = record_simulated(spec, PAD, tmp_path / "run", {"seed": 4}, [tmp_path / "pad.toml"])
    assert recording.presses_mm.tolist() == [[3, -1], [0, 2]]
    made_by = json.loads((tmp_path / "run" / "start.json").read_text())["provenance"]
    assert made_by["inputs"] == {name: sha256(tmp_path / name) for name in ("pad.toml", "places.csv")}
    assert made_by["seed"] == 4
