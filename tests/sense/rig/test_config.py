"""How the pad lies before the arm, which recordings may be resumed, and where adaptive plans press."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padforge.common.files import sha256
from padforge.common.settings import Spec
from padforge.common.validation import InputError
from padforge.design import Contact
from padforge.design.morphology import Morphology
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings
from padforge.design.twin import PlanTransform
from padforge.fabricate import build
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.recording.press_plan import PressPlan, make_plan
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import START, Recorder
from padforge.sense.rig.config import RigConfig, RobotFrame, load_or_make_plan, locate_on_bed, open_recorder
from padforge.sense.rig.devices import RigFault
from padforge.sense.rig.operation import ADAPT_EVERY, acquisition, make_planner, record_simulated
from padforge.sense.rig.press_loop import check_plan
from padforge.sense.settings import RigSettings
from tests.fabricate.planted import with_settings
from tests.sense.rig import fakes
from tests.sense.rig.fakes import FIBRES, PAD

MM = st.floats(-500, 500)
PRESSES = st.lists(st.tuples(MM, MM, st.floats(-20, 20)), min_size=1, max_size=5)


@given(st.booleans(), st.floats(-360, 360), st.tuples(MM, MM), PRESSES)
def test_robot_frame_inverts_and_agrees_with_the_plan_transform(mirrored, angle_deg, centre_mm, presses):
    """The plan transform of a twin takes the positions of an arm that was given no frame."""
    pad = {"mirrored": mirrored, "pad_angle_deg": angle_deg, "pad_mm": centre_mm}
    frame = RobotFrame.from_settings(fakes.RIG.model_copy(update=pad))
    positions, depths = np.array(presses)[:, :2], np.array(presses)[:, 2]
    poses = np.array([frame.pose(position, depth) for position, depth in zip(positions, depths, strict=True)])
    np.testing.assert_allclose(np.hypot(*(poses[:, :2] - centre_mm).T), np.hypot(*positions.T), atol=1e-9)
    tips, tip_depths = frame.tip(poses)
    np.testing.assert_allclose(tips, positions, atol=1e-9)
    np.testing.assert_allclose(tip_depths, depths, atol=1e-9)
    turned = PlanTransform(mirrored, angle_deg if mirrored else -angle_deg)
    transform = replace(turned, shift_mm=tuple(-turned.turned(np.array(centre_mm))))
    np.testing.assert_allclose(transform.to_plan(poses[:, :2]), positions, atol=1e-9)


HALF_MM = PAD.layout.size_mm[0] / 2
PRINTER = RigSettings(tcp_mm=(30.0, -5.0, -20.0), max_force_n=None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The folder of a pad with a holder."""
    folder = tmp_path_factory.mktemp("pad")
    build(PAD, folder, [], with_settings({"holder": True}, printer={"bed_mm": [200.0, 180.0, 150.0]}))
    return folder


@pytest.fixture
def with_frame(folder, tmp_path) -> Callable[..., Path]:
    """A folder whose file has another frame, by keys; those of None are removed."""

    def write(**frame: Any) -> Path:
        document = json.loads((folder / "fabrication.json").read_text())
        document["frame"] = {k: v for k, v in (document["frame"] | frame).items() if v is not None}
        (tmp_path / "fabrication.json").write_text(json.dumps(document))
        return tmp_path

    return write


def box_of(folder: Path, **settings: Any) -> list[float]:
    return list(locate_on_bed(PRINTER.model_copy(update=settings), folder).box_mm or ())


def test_locate_on_bed_reads_the_holder(folder, with_frame):
    rig, half = locate_on_bed(PRINTER, folder), HALF_MM
    assert (rig.pad_mm, rig.pad_angle_deg, rig.contact_mm, rig.mirrored) == ((100.0, 90.0), 0.0, 8.0, True)
    assert box_of(folder) == pytest.approx((100 - half, 100 + half, 90 - half, 90 + half, 3.0, 130.0), abs=1e-5)
    check_plan(make_plan(PAD, rig, np.random.default_rng(0)), rig)
    for position, depth in (((0.0, 0.0), 5.1), ((17.0, 0.0), 5.0), ((0.0, -17.0), 1.0)):  # into the bed or the holder
        with pytest.raises(RigFault, match="no move"):
            check_plan(PressPlan(np.array([position]), np.array([depth])), rig)
    assert box_of(folder, tcp_mm=(95.0, -90.0, -20.0))[0:4:3] == [95, 90]  # it ends where the nozzle does
    assert box_of(folder, tcp_mm=(-95.0, 95.0, -20.0))[1:3] == [105, 95]
    for angle_deg, more_deg, (x, y) in (
        (0.0, 0.0, (30.0, 10.0)),
        (90.0, 0.0, (10.0, 30.0)),
        (0.0, -90.0, (10.0, 30.0)),  # turned on the bed by hand
        (90.0, 90.0, (30.0, 10.0)),
    ):
        elsewhere = with_frame(pad_mm=[60.0, 20.0], angle_deg=angle_deg)
        assert box_of(elsewhere, pad_angle_deg=more_deg)[:4] == [100 - x, 100 + x, 90 - y, 90 + y]


def test_locate_on_bed_prefers_what_rig_sets_but_for_a_holder_that_stands_elsewhere(folder, with_frame, tmp_path):
    """That gives side and angle where all else is stated; without a holder, what is stated is the pose."""
    update = {"pad_mm": (50.0, 60.0), "contact_mm": 9.0, "pad_angle_deg": 90.0, "mirrored": False}
    rig = locate_on_bed(PRINTER.model_copy(update=update), folder)
    assert {name: getattr(rig, name) for name in update} == update
    assert box_of(folder, **update)[0] == 50 - HALF_MM
    assert locate_on_bed(PRINTER, with_frame(mirrored=False)).mirrored is False
    stated = {"pad_mm": (50.0, 60.0), "contact_mm": 9.0, "box_mm": (0.0, 100.0, 0.0, 100.0, 5.0, 50.0)}
    rig = PRINTER.model_copy(update=stated | {"pad_angle_deg": 5.0})
    assert locate_on_bed(rig, tmp_path / "none") is rig
    located = locate_on_bed(rig, with_frame(angle_deg=90.0))
    assert (located.mirrored, located.pad_angle_deg) == (True, 95.0)
    assert {name: getattr(located, name) for name in stated} == stated


RIG = RigSettings(presses=5, channels=(0, 1, 2, 3))
ARM = {"model": "UR5", "serial": "2018", "polyscope": "5.12.2", "tcp": [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]}
BOARD = {"name": "padforge-due", "serial": "ab12", "firmware": "1.0.0", "port": "/dev/ttyACM0"}
IDENTITIES: dict[str, dict[str, Any]] = {"arm": ARM, "board": BOARD}


def config_of(out: Path, pad: Morphology = PAD, rig: RigSettings = RIG) -> RigConfig:
    return RigConfig(pad, PUBLISHED_CONTACT, rig, out, "test")


def resumed_plan(out: Path, pad: Morphology = PAD, **settings: Any) -> list:
    return load_or_make_plan(config_of(out, pad, RIG.model_copy(update=settings)), resume=True).to_rows()


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A recording of no press so far, which nobody may change."""
    out, plan = tmp_path_factory.mktemp("run"), make_plan(PAD, RIG, np.random.default_rng(0))
    with open_recorder(config_of(out), plan.to_rows(), out, False, IDENTITIES):
        pass
    return out


def test_resume_keeps_the_plan_and_accepts_other_limits_addresses_and_controllers(run, tmp_path):
    """Another arm, tool, board or pad is in the table of refusals."""
    plan, out = resumed_plan(run), Path(shutil.copytree(run, tmp_path / "run"))
    limits = {"max_force_n": 30.0, "max_depth_mm": 5.5, "box_mm": (0, 1, 0, 1, 0, 1)}
    assert resumed_plan(run, **limits, host="arm", port="COM3", mirrored=False, seed=9, presses=3) == plan
    assert json.loads((run / START).read_text())["source"]["devices"] == IDENTITIES
    with open_recorder(config_of(out), plan, out, True, IDENTITIES | {"arm": ARM | {"polyscope": "5.13.0"}}):
        pass
    with pytest.raises(InputError, match="another pad"):  # rather than that its fibres are on other inputs
        resumed_plan(run, Morphology.straight(3), channels=())


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
