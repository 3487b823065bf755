"""The press loop in virtual time: every press is kept, whatever breaks, and the arm is stopped and lifted off first."""

import contextlib
import signal
import threading
import time
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.recording.press_plan import PressPlan
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import Recorder, read_journal
from padforge.sense.rig.devices import BoardSamples, RigFault
from padforge.sense.rig.press_loop import Averager, DiskThread, PressLoop, check_plan
from tests.sense.rig import fakes
from tests.sense.rig.fakes import RIG, FakeArm, FakeBoard, Time

PLAN = PressPlan(np.array([[0, 0], [5, 3], [-5, 4], [2, -6], [0, 5], [3, 3]], float), np.full(6, 4.0))
FOUR = PressPlan(PLAN.positions_mm[:4], PLAN.depths_mm[:4])


def rig(**settings):
    arm = FakeArm(Time())
    return arm, FakeBoard(arm), RIG.model_copy(update=settings)


def open_run(path):
    return Recorder.resume(path) if path.exists() else Recorder(path, 4, {"kind": "fake"}, {})


def press(arm, board, recorder, options, plan=PLAN, dry=False, **more):
    with arm.time.of_all():
        PressLoop(arm, board, recorder, options, dry=dry).run(plan, **more)


def run(path, arm, board, options, plan=PLAN, **more):
    with open_run(path) as recorder:
        press(arm, board, recorder, options, plan, **more)


def fault_of(path, arm, board, options, match, plan=PLAN):
    with pytest.raises(RigFault, match=match) as fault:
        run(path, arm, board, options, plan)
    assert "\n" not in str(fault.value)
    return fault.value.cause


def n_done(path):
    return len(read_journal(path / "journal.ndjson"))


def test_press_begins_with_the_first_reading_after_the_command(tmp_path):
    """On a clock and at a rate that are powers of two, a reading is taken at the very moment of each command."""
    arm, downs = FakeArm(Time(least_s=1 / 128)), []
    move = arm.move

    def noting_move(pose, speed_mm_s, acceleration_mm_s2):
        if pose[2] < 50:
            downs.append(arm.time() - 100)
        move(pose, speed_mm_s, acceleration_mm_s2)

    arm.move = noting_move
    options = RIG.model_copy(update={"rate_hz": 128, "board_rate_hz": 128})
    run(tmp_path / "run", arm, FakeBoard(arm, options), options, FOUR)
    recording = Recording.open(tmp_path / "run")
    assert recording.times_s[recording.down_command] - downs == pytest.approx(1 / 128)


def test_dry_run_lifts_the_tool_and_never_touches_the_pad(tmp_path):
    arm, board, options = rig()
    arm.pose = (5.0, -395.0, 46.0, *arm.pose[3:])
    run(tmp_path / "run", arm, board, options, dry=True)
    assert arm.moves[0][:3] == (5.0, -395.0, 60.0)
    assert min(pose[2] for pose in arm.moves) >= 50 + options.clearance_mm / 2
    assert len(Recording.open(tmp_path / "run").presses_mm) == len(PLAN)


@pytest.mark.parametrize(
    ("settings", "plan", "arm_state", "message"),
    [
        ({}, PressPlan(np.array([[0.0, 0.0], [150.0, 0.0]]), np.full(2, 4.0)), {}, "x 150 mm"),
        ({}, PressPlan(np.zeros((1, 2)), np.array([6.5])), {}, "depth 6.5 mm"),
        ({"clearance_mm": 70.5}, PLAN, {}, r"z 120\.5 mm; allowed 40 to 120 mm"),
        ({"contact_mm": None}, PLAN, {}, "contact_mm"),
        ({}, PLAN, {"force_n": None}, 'max_force_n is 60, but this arm measures no force; allowed "unwatched"'),
        ({}, PLAN, {"pose": (0.0, -400.0, 100.0, np.pi * np.cos(0.5), np.pi * np.sin(0.5), 0.0)}, "held 123 degrees"),
        ({}, PLAN, {"pose": (150.0, -400.0, 100.0, 0.0, np.pi, 0.0)}, r"stands at 150\.0, -400\.0, 100\.0 mm, outside"),
    ],
)
def test_run_moves_nothing_before_all_is_safe(tmp_path, settings, plan, arm_state, message):
    arm, board, options = rig(**settings)
    vars(arm).update(arm_state)
    assert fault_of(tmp_path / "run", arm, board, options, message, plan) == "refused"
    assert arm.moves == []
    check_plan(PLAN, RIG.model_copy(update={"clearance_mm": 70.0}))


def test_run_checks_a_changed_plan_before_its_next_press(tmp_path):
    arm, board, options = rig()
    outside = PressPlan(PLAN.positions_mm + 150.0, PLAN.depths_mm)
    with open_run(tmp_path / "run") as recorder, pytest.raises(RigFault, match="x 150 mm"):
        press(arm, board, recorder, options, planner=lambda plan, press: outside if press == 1 else plan)
    assert len(arm.moves) == 3  # of the press before


@pytest.mark.parametrize(("silent_s", "end_mm"), [(0.9, 60), (3.0, 46)])
def test_run_retreats_as_soon_as_states_come_again(tmp_path, silent_s, end_mm):
    """A state that is too old ends the recording, and the tool is pressed into the pad."""
    arm, board, options = rig()
    state, since_s = arm.state, [np.inf]

    def last_state():
        if arm.pose[2] < 46.001 and not arm.stops:
            since_s[0] = min(since_s[0], arm.time())
        if 0.02 < arm.time() - since_s[0] < silent_s:
            raise RigFault("stale", "the last state is old")
        return state()

    arm.state = last_state
    assert fault_of(tmp_path / "run", arm, board, options, "the last state is old") == "stale"
    assert arm.pose[2] == pytest.approx(end_mm)


def both_vanish(arm, board):
    board.lost = arm.time() > 101.1
    arm.lost = arm.stops > 0


def no_stop_is_confirmed(arm, board):
    def stop():
        raise RigFault("lost", "the arm did not confirm the stop", "look at it")

    arm.stop, arm.lost = stop, arm.time() > 101.1


def ctrl_c_at_a_protective_stop(arm, board):
    arm.protective_stop = arm.stops > 0
    if arm.pose[2] < 48 and not arm.stops:
        raise KeyboardInterrupt


def board_lost(arm, board, **change):
    vars(board).update(change if arm.time() > 101.1 else {})


def pressed_hard(arm, board, stays):
    arm.force_n = 80.0 if arm.pose[2] < 48 or (stays and arm.force_n) else 0.0


def sensor_lost(arm, board):
    arm.force_n = None if arm.pose[2] < 48 or arm.force_n is None else 0.0


def arm_fails(arm, board, cause, time_s):
    setattr(arm, cause, arm.time() > 100 + time_s)


FAULTS = {
    "a protective stop at first": (partial(arm_fails, cause="protective_stop", time_s=0.05), "protective_stop", None),
    "an emergency stop": (partial(arm_fails, cause="emergency_stop", time_s=0.5), "emergency_stop", None),
    "the link is lost above the pad": (partial(arm_fails, cause="lost", time_s=0.71), "lost", None),
    "the link is lost": (partial(arm_fails, cause="lost", time_s=1.3), "lost", None),
    "the board vanishes": (partial(board_lost, lost=True), "lost", 60),
    "the board stalls": (partial(board_lost, stalled=True), "stale", 60),
    "the board is silent, but raises nothing": (partial(board_lost, rate_hz=1e-3), "deadline", 60),
    "too much force": (partial(pressed_hard, stays=False), "force", 60),
    "a force that stays": (partial(pressed_hard, stays=True), "force", 50),
    "the force sensor fails in a press": (sensor_lost, "force", 60),
    "both vanish": (both_vanish, "lost", None),
    "no stop is confirmed": (no_stop_is_confirmed, "lost", None),
    "Ctrl-C at a protective stop": (ctrl_c_at_a_protective_stop, None, None),
}
"""What breaks at every poll, the cause of the fault, and the height of the tool at the end if it can be lifted."""


def test_run_stops_retreats_says_whether_the_tool_stays_on_the_pad_and_is_resumed(tmp_path, golden):
    reports = []
    for name, (trouble, cause, end_mm) in FAULTS.items():
        arm, board, options = rig()
        arm.hook = partial(trouble, board=board)
        with pytest.raises((RigFault, KeyboardInterrupt)) as caught:
            run(tmp_path / name, arm, board, options, FOUR)
        assert getattr(caught.value, "cause", None) == cause, name
        assert "was not lifted off" in str(caught.value) or end_mm == 60, name
        if end_mm is not None:
            assert arm.stops >= 1, name
            assert arm.pose[2] == pytest.approx(end_mm, abs=2), name
        assert arm.time() < 110, name
        done = n_done(tmp_path / name)
        reports.append(f"{name}, {done} presses done:\n    [{cause}] {caught.value}")
        arm, board, options = rig()
        run(tmp_path / name, arm, board, options, FOUR)  # what was done is not pressed again
        assert np.array_equal(Recording.open(tmp_path / name).presses_mm, FOUR.positions_mm), name
        assert len(arm.moves) == 3 * (len(FOUR) - done), name
    golden("rig/faults.txt", "\n".join(reports))


def run_on_disk(path, arm, board, disturb, **more):
    """Record on a disk that is disturbed each time before it synchronises."""
    with open_run(path) as recorder:
        sync = recorder.sync

        def disturbed():
            disturb(recorder)
            sync()

        recorder.sync = disturbed
        try:
            press(arm, board, recorder, RIG, FOUR, **more)
        finally:
            recorder.sync = sync


def test_run_loses_nothing_on_a_full_disk(tmp_path):
    def fill(recorder):
        if len(recorder.done) >= 3:
            raise OSError(28, "No space left on device")

    arm, board, _ = rig()
    fakes.fault_of(lambda: run_on_disk(tmp_path / "run", arm, board, fill), "disk", "No space left")
    assert arm.stops >= 1
    assert n_done(tmp_path / "run") >= 2


def test_run_begins_no_press_before_the_last_one_is_on_the_disk(tmp_path):
    arm, board, _ = rig()
    progress = []

    def note(done, total, what):
        progress.append((done, n_done(tmp_path / "run"), len(arm.moves)))

    run_on_disk(tmp_path / "run", arm, board, lambda recorder: time.sleep(0.02), on_progress=note)
    assert progress == [(done, done, 3 * done) for done in range(1, 5)]


def test_run_raises_a_disk_that_hangs(tmp_path):
    arm, board, _ = rig()
    resume = threading.Event()

    def hook(arm):
        if len(arm.moves) >= 3 and arm.pose[2] == 60:
            arm.time.sleep(1.0)
            board.read()
        if arm.stops:
            resume.set()

    arm.hook = hook
    hangs = partial(run_on_disk, tmp_path / "run", arm, board, lambda recorder: resume.wait(20))
    fakes.fault_of(hangs, "disk", "the disk took more than 30 s")
    assert len(arm.moves) == 3


def test_resumed_run_drops_what_came_while_it_connected(tmp_path):
    """To connect an arm may take longer than the second between the last reading and the next."""
    for presses in (1, 2):
        arm, board, options = rig()
        arm.time.sleep(3.0)
        run(tmp_path / "run", arm, board, options, PressPlan(PLAN.positions_mm[:presses], PLAN.depths_mm[:presses]))
    recording = Recording.open(tmp_path / "run")
    assert recording.times_s[0] < 0.05
    assert np.sort(np.diff(recording.times_s))[-2:] == pytest.approx([0.01, 1.01], abs=0.02)


@settings(max_examples=20)
@given(st.integers(1, 12), st.integers(1, 200), st.sets(st.integers(0, 199), max_size=60), st.data())
def test_averager_takes_means_however_samples_arrive(ratio, count, lost, data):
    index = np.array([i for i in range(count) if i not in lost], dtype=np.int64)
    times_s, missing = index / 1000, np.diff(index, prepend=-1) - 1
    rows = np.column_stack([index, -index]).astype(float)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(index)), max_size=6)))
    averager = Averager(ratio, 2)
    pieces = [
        averager.feed(BoardSamples(times_s[a:b], rows[a:b], missing[a:b]))
        for a, b in zip([0, *cuts], [*cuts, len(index)], strict=True)
    ]
    times, volts = (np.concatenate(column) for column in zip(*pieces, strict=True))
    last = int(index[-1]) if len(index) else -1
    blocks = [index[index // ratio == number] for number in range((last + 1) // ratio)]
    expected = np.array([block.mean() for block in blocks if len(block)])
    np.testing.assert_allclose(volts, np.column_stack([expected, -expected]).reshape(-1, 2))
    np.testing.assert_allclose(1000 * times, expected)
    assert averager.n_missing == sum(i <= last for i in lost)


def test_disk_thread_stops_after_a_failure() -> None:
    done, full = list[int](), Mock(side_effect=OSError(28, "No space left on device"))
    with DiskThread() as disk:
        disk.submit(done.append, 1)
        disk.submit(full)
        for call in (lambda: disk.submit(done.append, 2).result(5), disk.check) * 2:
            with pytest.raises(OSError, match="No space"):
                call()
    assert done == [1]


def run_until(arm: FakeArm, path: Path, error: type[BaseException]) -> None:
    """Record until that is raised; the tool is lifted off the pad then, and signal handlers are as before."""
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(error):
        run(path, arm, FakeBoard(arm), RIG, FOUR)
    assert arm.pose[2] == 50 + 10
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_interrupts_notice_a_signal_whose_exception_was_lost(tmp_path: Path, name: str) -> None:
    def lose_once(arm: FakeArm) -> None:
        if arm.pose[2] < 48 and not raised_s:
            raised_s.append(arm.time())
            with contextlib.suppress(KeyboardInterrupt):  # as a callback of C code does
                signal.raise_signal(signal.Signals[name])

    arm, raised_s = FakeArm(Time()), []
    arm.hook = lose_once
    handlers = {name: signal.signal(signal.Signals[name], signal.default_int_handler) for name in ("SIGTERM", "SIGHUP")}
    try:
        run_until(arm, tmp_path / "run", KeyboardInterrupt)
    finally:
        for other, handler in handlers.items():
            signal.signal(signal.Signals[other], handler)
    assert arm.time() - raised_s[0] < 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, RigFault])
def test_interrupts_do_not_keep_the_tool_on_the_pad(tmp_path: Path, error: type[BaseException]) -> None:
    def interrupt_often(arm: FakeArm) -> None:
        if arm.pose[2] < 48 and not arm.stops and error is RigFault:
            arm.force_n = 80.0
        elif arm.pose[2] < 48 or arm.stops:
            arm.force_n = 0.0
            signal.raise_signal(signal.SIGINT)

    arm = FakeArm(Time())
    arm.hook = interrupt_often
    run_until(arm, tmp_path / "run", error)
