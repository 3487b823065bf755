"""The press loop in virtual time: every press is kept, whatever breaks, and the arm is stopped and lifted off first."""

import json
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.recording.press_plan import PressPlan
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import Recorder, read_journal
from padforge.sense.rig.devices import BoardSamples, RigFault
from padforge.sense.rig.press_loop import Averager, Session, require_safe_plan
from tests.sense.rig.fakes import RIG, FakeArm, FakeConverter, Time

PLAN = PressPlan(np.array([[0, 0], [5, 3], [-5, 4], [2, -6], [0, 5], [3, 3]], float), np.full(6, 4.0))
FOUR = PressPlan(PLAN.positions_mm[:4], PLAN.depths_mm[:4])


def rig(**settings):
    arm = FakeArm(Time())
    return arm, FakeConverter(arm), RIG.model_copy(update=settings)


def recorder(path):
    return Recorder.resume(path) if path.exists() else Recorder(path, 4, {"kind": "fake"}, {})


def run(path, arm, converter, options, plan=PLAN, **more):
    with recorder(path) as keep:
        Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep, **more).run(plan)


def fault_of(path, arm, converter, options, match, plan=PLAN):
    with pytest.raises(RigFault, match=match) as fault:
        run(path, arm, converter, options, plan)
    assert "\n" not in str(fault.value)
    return fault.value.cause


def finished(path):
    return len(read_journal(path / "journal.ndjson"))


def test_every_press_of_the_plan_is_recorded_and_lost_samples_leave_a_gap_and_shift_nothing(tmp_path):
    run(tmp_path / "run", *rig())
    recording = Recording.open(tmp_path / "run")
    assert np.array_equal(recording.presses_mm, PLAN.positions_mm)
    assert recording.rate_hz == pytest.approx(100, rel=0.01)
    assert np.diff(recording.times_s).max() < 0.011
    held = recording.up_command - recording.down_command
    assert ((held >= 18) & (held <= 24)).all()
    rest = np.stack([recording.readings[b - 10 : b - 1].mean(axis=0) for b in recording.down_command])
    down = np.stack([recording.readings[u - 6 : u - 1].mean(axis=0) for u in recording.up_command])
    assert (np.abs(down - rest).max(axis=1) > 0.02).all()
    journal = [json.loads(line) for line in (tmp_path / "run" / "journal.ndjson").read_text().splitlines()]
    reached = np.array([event["at_mm"] for event in journal if event["event"] == "done"])
    assert reached == pytest.approx(np.column_stack([PLAN.positions_mm, PLAN.depths_mm]), abs=0.1)
    arm, converter, options = rig()
    arm.hook = lambda arm: setattr(converter, "lose", 35 if 101.0 < arm.time() < 101.05 else 0)
    run(tmp_path / "lost", arm, converter, options)
    recording = Recording.open(tmp_path / "lost")
    assert len(recording.presses_mm) == len(PLAN)
    assert 0.02 < np.diff(recording.times_s).max() < 0.06
    assert "lost" in (tmp_path / "lost" / "journal.ndjson").read_text()


def test_a_press_begins_with_the_first_reading_after_the_command(tmp_path):
    """On a clock and at a rate that are powers of two, a reading is taken at the very moment of each command."""
    arm, downs = FakeArm(Time(least_s=1 / 128)), []
    move = arm.move

    def noted(pose, speed_mm_s, acceleration_mm_s2):
        if pose[2] < 50:
            downs.append(arm.time() - 100)
        move(pose, speed_mm_s, acceleration_mm_s2)

    arm.move = noted
    options = RIG.model_copy(update={"rate_hz": 128, "board_rate_hz": 128})
    run(tmp_path / "run", arm, FakeConverter(arm, options), options, FOUR)
    recording = Recording.open(tmp_path / "run")
    assert recording.times_s[recording.down_command] - downs == pytest.approx(1 / 128)


def test_a_dry_run_never_touches_the_pad_and_lifts_a_tool_that_was_left_on_it(tmp_path):
    arm, converter, options = rig()
    arm.pose = (5.0, -395.0, 46.0, *arm.pose[3:])
    run(tmp_path / "run", arm, converter, options, dry=True)
    assert arm.moves[0][:3] == (5.0, -395.0, 60.0)
    assert min(pose[2] for pose in arm.moves) >= 50 + options.clearance_mm / 2
    assert len(Recording.open(tmp_path / "run").presses_mm) == len(PLAN)


@pytest.mark.parametrize(
    ("settings", "plan", "arm_is", "said"),
    [
        ({}, PressPlan(np.array([[0.0, 0.0], [150.0, 0.0]]), np.full(2, 4.0)), {}, "x 150 mm"),
        ({}, PressPlan(np.zeros((1, 2)), np.array([6.5])), {}, "depth 6.5 mm"),
        ({"clearance_mm": 70.5}, PLAN, {}, r"z 120\.5 mm; allowed 40 to 120 mm"),
        ({"contact_mm": None}, PLAN, {}, "contact_mm"),
        ({"box_mm": None}, PLAN, {}, "box_mm"),
        ({"pad_mm": None}, PLAN, {}, "pad_mm"),
        ({}, PLAN, {"force_n": None}, 'max_force_n is 60, but this arm tells no force; allowed "unwatched"'),
        ({}, PLAN, {"pose": (0.0, -400.0, 100.0, np.pi * np.cos(0.5), np.pi * np.sin(0.5), 0.0)}, "held 123 degrees"),
        ({}, PLAN, {"pose": (150.0, -400.0, 100.0, 0.0, np.pi, 0.0)}, r"stands at 150\.0, -400\.0, 100\.0 mm, outside"),
    ],
)
def test_nothing_moves_before_all_is_safe(tmp_path, settings, plan, arm_is, said):
    arm, converter, options = rig(**settings)
    for name, value in arm_is.items():
        setattr(arm, name, value)
    assert fault_of(tmp_path / "run", arm, converter, options, said, plan) == "refused"
    assert arm.moves == []
    require_safe_plan(PLAN, RIG.model_copy(update={"clearance_mm": 70.0}))


def test_a_steered_plan_is_checked_before_its_next_press(tmp_path):
    arm, converter, options = rig()
    astray = PressPlan(PLAN.positions_mm + 150.0, PLAN.depths_mm)
    with recorder(tmp_path / "run") as keep:
        session = Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep)
        with pytest.raises(RigFault, match="x 150 mm"):
            session.run(PLAN, steer=lambda plan, press: astray if press == 1 else plan)
    assert len(arm.moves) == 3  # of the press before


def broken_at(moment_s, what):
    def hook(arm):
        if arm.time() > 100 + moment_s:
            setattr(arm, what, True)

    return hook


@pytest.mark.parametrize("moment_s", [0.05, 0.5, 0.71, 1.0, 1.3, 2.2])
@pytest.mark.parametrize("what", ["protective_stop", "emergency_stop", "lost"])
def test_a_fault_of_the_arm_loses_no_finished_press(tmp_path, moment_s, what):
    arm, converter, options = rig()
    arm.hook = broken_at(moment_s, what)
    assert fault_of(tmp_path / "run", arm, converter, options, ".", FOUR) == what
    assert arm.stops >= 1
    assert arm.time() - 100 < moment_s + 1
    done = finished(tmp_path / "run")
    arm, converter, options = rig()
    run(tmp_path / "run", arm, converter, options, FOUR)
    assert np.array_equal(Recording.open(tmp_path / "run").presses_mm, FOUR.positions_mm)
    assert len(arm.moves) == 3 * (len(FOUR) - done)


@pytest.mark.parametrize(
    ("change", "cause", "said"),
    [
        ({"lost": True}, "lost", "."),
        ({"stalled": True}, "stale", "."),
        ({"rate_hz": 1e-3}, "deadline", r"no reading came within 3\.0 s"),  # it sends nothing and says nothing
    ],
)
def test_a_fault_of_the_board_stops_and_lifts_the_arm(tmp_path, change, cause, said):
    arm, converter, options = rig()
    arm.hook = lambda arm: vars(converter).update(change) if arm.time() > 101.1 else None
    assert fault_of(tmp_path / "run", arm, converter, options, said) == cause
    assert arm.stops >= 1
    assert arm.moves[-1][2] == 50 + options.clearance_mm


@pytest.mark.parametrize(
    ("force_n", "said", "ends_mm"),
    [
        (lambda arm: 80.0 if arm.pose[2] < 48 else 0.0, r"80\.0 N; allowed 60 N; the tool was lifted off", 60),
        (
            lambda arm: 80.0 if arm.pose[2] < 48 or arm.force_n else 0.0,
            r"80\.0 N; allowed 60 N; the tool was not lifted off: the force does not fall",
            50,
        ),
    ],
    ids=["falls", "stays"],
)
def test_too_much_force_stops_the_arm_and_is_taken_off(tmp_path, force_n, said, ends_mm):
    arm, converter, options = rig()
    arm.hook = lambda arm: setattr(arm, "force_n", force_n(arm))
    assert fault_of(tmp_path / "run", arm, converter, options, said) == "force"
    assert arm.stops >= 1
    assert arm.pose[2] == pytest.approx(ends_mm, abs=2)


def both_go(arm, converter):
    converter.lost = arm.time() > 101.1
    arm.lost = arm.stops > 0


def no_stop_is_confirmed(arm, converter):
    def stop():
        raise RigFault("lost", "the arm did not confirm the stop", "look at it")

    arm.stop, arm.lost = stop, arm.time() > 101.1


def ctrl_c_at_a_protective_stop(arm, converter):
    arm.protective_stop = arm.stops > 0
    if arm.pose[2] < 48 and not arm.stops:
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("trouble", "error", "said"),
    [
        (both_go, RigFault, "the board is gone; the tool was not lifted off: the arm is gone"),
        (no_stop_is_confirmed, RigFault, "the arm is gone; the tool was not lifted off: the arm did not confirm the"),
        (ctrl_c_at_a_protective_stop, KeyboardInterrupt, "was not lifted off: the arm is in a protective stop"),
    ],
)
def test_a_tool_that_stays_on_the_pad_is_told_whatever_the_fault(tmp_path, trouble, error, said):
    arm, converter, options = rig()
    arm.hook = lambda arm: trouble(arm, converter)
    with pytest.raises(error, match=said):
        run(tmp_path / "run", arm, converter, options)


def test_a_full_disk_is_told_and_loses_nothing(tmp_path):
    arm, converter, options = rig()
    with recorder(tmp_path / "run") as keep:
        real = keep.sync

        def full():
            if len(keep.done) >= 3:
                raise OSError(28, "No space left on device")
            real()

        keep.sync = full
        with pytest.raises(RigFault, match="No space left") as fault:
            Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep).run(PLAN)
        keep.sync = real
    assert fault.value.cause == "disk"
    assert arm.stops >= 1
    assert finished(tmp_path / "run") >= 2


def test_a_press_is_told_to_be_done_once_it_is_on_the_disk_and_none_begins_before(tmp_path):
    arm, converter, options = rig()
    told = []
    with recorder(tmp_path / "run") as keep:
        sync = keep.sync

        def slow():
            time.sleep(0.02)
            sync()

        keep.sync = slow
        Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep).run(
            FOUR, lambda done, of: told.append((done, finished(tmp_path / "run"), len(arm.moves)))
        )
    assert told == [(done, done, 3 * done) for done in range(1, 5)]


def test_a_disk_that_hangs_is_a_fault(tmp_path):
    arm, converter, options = rig()
    go_on = threading.Event()
    with recorder(tmp_path / "run") as keep:
        sync = keep.sync

        def hangs():
            go_on.wait(20)
            sync()

        def hook(arm):
            if len(arm.moves) >= 3 and arm.pose[2] == 60:
                arm.time.sleep(1.0)
                converter.read()
            if arm.stops:
                go_on.set()

        keep.sync, arm.hook = hangs, hook
        with pytest.raises(RigFault, match="the disk took more than 30 s") as fault:
            Session(arm, converter, keep, options, clock=arm.time, sleep=arm.time.sleep).run(PLAN)
    assert fault.value.cause == "disk"
    assert len(arm.moves) == 3


def test_what_came_before_a_recording_goes_on_is_none_of_it(tmp_path):
    """To connect an arm may take longer than the second between the last reading and the next."""
    for presses in (1, 2):
        arm, converter, options = rig()
        arm.time.sleep(3.0)
        run(tmp_path / "run", arm, converter, options, PressPlan(PLAN.positions_mm[:presses], PLAN.depths_mm[:presses]))
    recording = Recording.open(tmp_path / "run")
    assert recording.times_s[0] < 0.05
    assert np.sort(np.diff(recording.times_s))[-2:] == pytest.approx([0.01, 1.01], abs=0.02)


def test_depth_and_force_of_a_held_press_are_kept(tmp_path):
    """Of an arm without a sensor, which moves once it is said that nobody watches, there is no force."""
    arm, converter, options = rig()
    arm.hook = lambda arm: setattr(arm, "force_n", -7.5 if arm.pose[2] <= 46.001 else 0.0)
    plan = PressPlan(PLAN.positions_mm[:2], np.array([4.0, 5.0]))
    run(tmp_path / "run", arm, converter, options, plan)
    recording = Recording.open(tmp_path / "run")
    assert recording.depths_mm.tolist() == [4.0, 5.0]
    assert recording.reached_mm == pytest.approx([4.0, 5.0], abs=0.1)
    assert recording.forces_n == pytest.approx(7.5)
    blind, converter, options = rig(max_force_n=None)
    blind.force_n = None
    run(tmp_path / "without", blind, converter, options, plan)
    assert len(blind.moves) == 3 * len(plan)
    assert np.isnan(Recording.open(tmp_path / "without").forces_n).all()


@settings(max_examples=40)
@given(st.integers(1, 12), st.integers(1, 200), st.sets(st.integers(0, 199), max_size=60), st.data())
def test_readings_are_means_of_whole_stretches_whatever_the_pieces(ratio, count, lost, data):
    kept = np.array([i for i in range(count) if i not in lost], dtype=np.int64)
    whole = kept / 1000, np.column_stack([kept, -kept]).astype(float), np.diff(kept, prepend=-1) - 1
    cuts = sorted(data.draw(st.lists(st.integers(0, len(kept)), max_size=6)))
    averager = Averager(ratio, 2)
    pieces = [
        averager.feed(BoardSamples(whole[0][a:b], whole[1][a:b], whole[2][a:b]))
        for a, b in zip([0, *cuts], [*cuts, len(kept)], strict=True)
    ]
    times, volts = (np.concatenate(column) for column in zip(*pieces, strict=True))
    last = int(kept[-1]) if len(kept) else -1
    stretches = [kept[kept // ratio == number] for number in range((last + 1) // ratio)]
    expected = [stretch.mean() for stretch in stretches if len(stretch)]
    assert np.allclose(volts[:, 0], expected)
    assert np.allclose(volts[:, 1], -np.array(expected))
    assert np.allclose(1000 * times, expected)
    assert averager.n_missing == sum(i <= last for i in lost)
