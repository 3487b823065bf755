"""The press loop in virtual time: every press is kept, whatever breaks, and the arm is stopped first."""

import json
import time

import numpy as np
import pytest

from sense.recordings.press_journal import read_journal
from sense.recordings.press_plan import PressPlan
from sense.recordings.recorder import Recorder
from sense.recordings.recording import Recording
from sense.rig.devices.protocols import RigFault
from sense.rig.session.press_loop import Session, require_safe_plan
from tests.sense.rig.devices.fakes import RIG, FakeArm, FakeConverter, Time

PLAN = PressPlan(np.array([[0, 0], [5, 3], [-5, 4], [2, -6], [0, 5], [3, 3]], float), np.full(6, 4.0))
FOUR = PressPlan(PLAN.places_mm[:4], PLAN.depths_mm[:4])


def rig(tmp_path, **settings):
    arm = FakeArm(Time())
    options = RIG.model_copy(update=settings)
    return arm, FakeConverter(arm), options


def recorder(tmp_path):
    path = tmp_path / "run"
    return Recorder.resume(path) if path.exists() else Recorder(path, 4, {"kind": "fake"}, {})


def run(tmp_path, arm, converter, options, plan=PLAN, **more):
    with recorder(tmp_path) as keep:
        Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep, **more).run(plan)


def test_every_press_of_the_plan_is_recorded(tmp_path):
    run(tmp_path, *rig(tmp_path))
    recording = Recording.open(tmp_path / "run")
    assert np.array_equal(recording.presses_mm, PLAN.places_mm)
    assert recording.rate_hz == pytest.approx(100, rel=0.01)
    assert np.diff(recording.times_s).max() < 0.011
    held = recording.lifted - recording.begun
    assert ((held >= 18) & (held <= 24)).all()
    rest = np.stack([recording.readings[b - 10 : b - 1].mean(axis=0) for b in recording.begun])
    down = np.stack([recording.readings[u - 6 : u - 1].mean(axis=0) for u in recording.lifted])
    assert (np.abs(down - rest).max(axis=1) > 0.02).all()
    journal = [json.loads(line) for line in (tmp_path / "run" / "journal.ndjson").read_text().splitlines()]
    reached = np.array([event["at_mm"] for event in journal if event["event"] == "done"])
    assert reached[:, :2] == pytest.approx(PLAN.places_mm, abs=0.1)
    assert reached[:, 2] == pytest.approx(4.0, abs=0.1)


def test_a_dry_run_never_touches_the_pad(tmp_path):
    arm, converter, options = rig(tmp_path)
    run(tmp_path, arm, converter, options, dry=True)
    assert min(pose[2] for pose in arm.moves) >= 50 + options.clearance_mm / 2
    assert len(Recording.open(tmp_path / "run").presses_mm) == len(PLAN)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"plan": PressPlan(np.array([[0.0, 0.0], [150.0, 0.0]]), np.full(2, 4.0))}, "x 150 mm"),
        ({"plan": PressPlan(np.zeros((1, 2)), np.array([6.5]))}, "depth 6.5 mm"),
        ({"contact_mm": None}, "contact_mm"),
        ({"box_mm": None}, "box_mm"),
        ({"pad_mm": None}, "pad_mm"),
    ],
)
def test_nothing_moves_before_all_of_the_plan_is_safe(tmp_path, change, cause):
    plan = change.pop("plan", PLAN)
    arm, converter, options = rig(tmp_path, **change)
    with pytest.raises(RigFault, match=cause) as fault:
        run(tmp_path, arm, converter, options, plan)
    assert fault.value.cause == "refused"
    assert arm.moves == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"force_n": None}, 'max_force_n is 60, but this arm tells no force; allowed "unwatched"'),
        ({"pose": (0.0, -400.0, 100.0, np.pi * np.cos(0.5), np.pi * np.sin(0.5), 0.0)}, "held 123 degrees away"),
    ],
)
def test_an_arm_that_is_not_ready_is_not_moved(tmp_path, change, said):
    arm, converter, options = rig(tmp_path)
    for name, value in change.items():
        setattr(arm, name, value)
    with pytest.raises(RigFault, match=said) as fault:
        run(tmp_path, arm, converter, options)
    assert fault.value.cause == "refused"
    assert arm.moves == []


def test_an_arm_without_a_force_moves_once_it_is_said_that_nobody_watches(tmp_path):
    arm, converter, options = rig(tmp_path, max_force_n=None)
    arm.force_n = None
    run(tmp_path, arm, converter, options, FOUR)
    assert len(arm.moves) == 3 * len(FOUR)


def test_a_pose_above_the_pad_is_as_safe_as_the_press_below_it():
    require_safe_plan(PLAN, RIG.model_copy(update={"clearance_mm": 70.0}))
    with pytest.raises(RigFault, match=r"z 120\.5 mm; allowed 40 to 120 mm"):
        require_safe_plan(PLAN, RIG.model_copy(update={"clearance_mm": 70.5}))


def test_an_arm_outside_its_box_is_not_moved(tmp_path):
    arm, converter, options = rig(tmp_path)
    arm.pose = (150.0, -400.0, 100.0, *arm.pose[3:])
    with pytest.raises(RigFault, match=r"stands at 150\.0, -400\.0, 100\.0 mm, outside the box"):
        run(tmp_path, arm, converter, options)
    assert arm.moves == []


def test_a_tool_left_on_the_pad_is_lifted_first(tmp_path):
    arm, converter, options = rig(tmp_path)
    arm.pose = (5.0, -395.0, 46.0, *arm.pose[3:])
    run(tmp_path, arm, converter, options)
    assert arm.moves[0][:3] == (5.0, -395.0, 60.0)


def broken_at(moment_s, what):
    def hook(arm):
        if arm.time() > 100 + moment_s:
            setattr(arm, what, True)

    return hook


@pytest.mark.parametrize("moment_s", [0.05, 0.5, 0.71, 1.0, 1.3, 2.2])
@pytest.mark.parametrize("what", ["protective_stop", "emergency_stop", "lost"])
def test_a_fault_of_the_arm_loses_no_finished_press(tmp_path, moment_s, what):
    arm, converter, options = rig(tmp_path)
    arm.hook = broken_at(moment_s, what)
    with pytest.raises(RigFault) as fault:
        run(tmp_path, arm, converter, options, FOUR)
    assert fault.value.cause == what
    assert arm.stops >= 1
    assert arm.time() - 100 < moment_s + 1
    finished = len(read_journal(tmp_path / "run" / "journal.ndjson"))
    arm, converter, options = rig(tmp_path)
    run(tmp_path, arm, converter, options, FOUR)
    recording = Recording.open(tmp_path / "run")
    assert np.array_equal(recording.presses_mm, FOUR.places_mm)
    assert len(arm.moves) == 3 * (len(FOUR) - finished)


@pytest.mark.parametrize(("what", "cause"), [("lost", "lost"), ("stalled", "stale")])
def test_a_fault_of_the_board_stops_and_lifts_the_arm(tmp_path, what, cause):
    arm, converter, options = rig(tmp_path)
    arm.hook = lambda arm: setattr(converter, what, True) if arm.time() > 101.1 else None
    with pytest.raises(RigFault) as fault:
        run(tmp_path, arm, converter, options)
    assert fault.value.cause == cause
    assert arm.stops >= 1
    assert arm.moves[-1][2] == 50 + options.clearance_mm


def test_too_much_force_stops_the_arm(tmp_path):
    arm, converter, options = rig(tmp_path)
    arm.hook = lambda arm: setattr(arm, "force_n", 80.0 if arm.pose[2] < 48 else 0.0)
    with pytest.raises(RigFault, match=r"force is 80\.0 N; allowed 60 N; the tool was lifted off"):
        run(tmp_path, arm, converter, options)
    assert arm.stops >= 1
    assert arm.pose[2] == 60


def test_a_force_that_stays_is_told_as_well(tmp_path):
    arm, converter, options = rig(tmp_path)
    arm.hook = lambda arm: setattr(arm, "force_n", 80.0 if arm.pose[2] < 48 or arm.force_n else 0.0)
    with pytest.raises(RigFault, match=r"80\.0 N; allowed 60 N; the tool was not lifted off: the force does not fall"):
        run(tmp_path, arm, converter, options)
    assert arm.pose[2] < 52


def test_lost_samples_leave_a_gap_and_shift_nothing(tmp_path):
    arm, converter, options = rig(tmp_path)

    def lose(arm):
        converter.lose = 35 if 101.0 < arm.time() < 101.05 else 0

    arm.hook = lose
    run(tmp_path, arm, converter, options)
    recording = Recording.open(tmp_path / "run")
    assert len(recording.presses_mm) == len(PLAN)
    gaps = np.diff(recording.times_s)
    assert 0.02 < gaps.max() < 0.06
    assert "lost" in (tmp_path / "run" / "journal.ndjson").read_text()


def test_a_full_disk_is_told_and_loses_nothing(tmp_path, monkeypatch):
    arm, converter, options = rig(tmp_path)
    with recorder(tmp_path) as keep:
        session = Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep)
        real = keep.sync

        def full():
            if len(keep.done) >= 3:
                raise OSError(28, "No space left on device")
            real()

        keep.sync = full
        with pytest.raises(RigFault, match="No space left") as fault:
            session.run(PLAN)
        keep.sync = real
    assert fault.value.cause == "disk"
    assert arm.stops >= 1
    assert len(read_journal(tmp_path / "run" / "journal.ndjson")) >= 2


def test_a_press_is_told_to_be_done_once_it_is_on_the_disk(tmp_path):
    """However long that takes; and no press begins before."""
    arm, converter, options = rig(tmp_path)
    told = []

    def report(done, of):
        told.append((done, len(read_journal(tmp_path / "run" / "journal.ndjson"))))

    with recorder(tmp_path) as keep:
        sync = keep.sync

        def slow():
            time.sleep(0.02)
            sync()

        keep.sync = slow
        Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep).run(FOUR, report)
    assert told == [(done, done) for done in range(1, 5)]


def test_times_of_a_resumed_recording_go_on(tmp_path):
    arm, converter, options = rig(tmp_path)
    arm.hook = broken_at(1.5, "lost")
    with pytest.raises(RigFault):
        run(tmp_path, arm, converter, options)
    run(tmp_path, *rig(tmp_path))
    times = Recording.open(tmp_path / "run").times_s
    assert (np.diff(times) > 0).all()
    assert np.diff(times).max() == pytest.approx(1, abs=0.2)


def test_what_came_before_a_recording_goes_on_is_none_of_it(tmp_path):
    """To connect an arm may take longer than the second between the last reading and the next."""
    for presses in (1, 2):
        arm, converter, options = rig(tmp_path)
        arm.time.sleep(3.0)
        run(tmp_path, arm, converter, options, PressPlan(PLAN.places_mm[:presses], PLAN.depths_mm[:presses]))
    recording = Recording.open(tmp_path / "run")
    assert recording.times_s[0] < 0.05
    assert np.sort(np.diff(recording.times_s))[-2:] == pytest.approx([0.01, 1.01], abs=0.02)


def test_a_reading_of_the_very_moment_came_before_the_command(tmp_path):
    arm, converter, options = rig(tmp_path)
    with recorder(tmp_path) as keep:
        session = Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep)
        session._recent.extend([0.25, 0.5, 0.75])
        assert [session._after(moment_s) for moment_s in (0.0, 0.25, 0.5, 0.74, 0.75)] == [3, 2, 1, 1, None]


def test_depth_and_force_of_a_held_press_are_kept(tmp_path):
    arm, converter, options = rig(tmp_path)
    arm.hook = lambda arm: setattr(arm, "force_n", -7.5 if arm.pose[2] <= 46.001 else 0.0)
    plan = PressPlan(PLAN.places_mm[:2], np.array([4.0, 5.0]))
    run(tmp_path, arm, converter, options, plan)
    recording = Recording.open(tmp_path / "run")
    assert recording.depths_mm.tolist() == [4.0, 5.0]
    assert recording.reached_mm == pytest.approx([4.0, 5.0], abs=0.1)
    assert recording.forces_n == pytest.approx(7.5)
    blind, converter, options = rig(tmp_path, max_force_n=None)
    blind.force_n = None
    run(tmp_path / "without", blind, converter, options, plan)
    assert np.isnan(Recording.open(tmp_path / "without" / "run").forces_n).all()
