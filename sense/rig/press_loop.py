"""The press loop: an arm presses as planned while a board reads, and a run directory stores everything.

The arm moves only after the whole plan has passed the limits. During every wait the loop reads the devices, records,
and checks the arm. A thread writes to the disk, so that a slow disk delays no check; a press begins only when the
previous one is on the disk. On a fault the loop stops the arm, lifts the tool off, completes the recording on the disk,
and then raises the fault.
"""

import contextlib
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import takewhile
from types import FrameType
from typing import Any, Self

import numpy as np

from padforge.common.progress import OnProgress, ignore_progress
from padforge.sense.arrays import Array
from padforge.sense.recording.press_plan import PressPlan
from padforge.sense.recording.run_directory import STATE_COLUMNS, Recorder
from padforge.sense.rig import clock
from padforge.sense.rig.config import RobotFrame
from padforge.sense.rig.devices import Arm, Board, Pose, RigFault
from padforge.sense.rig.safety import (
    POLL_S,
    Limits,
    check_start_state,
    check_state,
    check_target,
    retreat,
    wait_until_still,
)
from padforge.sense.rig.streams import Averager
from padforge.sense.settings import RigSettings

_READING_DEADLINE_S = 3.0  # longest wait for a reading
_DISK_DEADLINE_S = 30.0  # longest wait for the disk


class DiskThread(ThreadPoolExecutor):
    """A thread that executes calls in their order, and none after a call that failed."""

    def __init__(self) -> None:
        super().__init__(1, "disk")
        self._last: Future[None] = Future()
        self._last.set_result(None)

    def submit(self, call: Callable[..., Any], /, *arguments: Any, **more: Any) -> Future[Any]:
        """Queue a call."""
        previous = self._last

        def work() -> None:
            previous.result()  # raises if a call before this one failed
            call(*arguments, **more)

        self._last = super().submit(work)
        return self._last

    def check(self) -> None:
        """Re-raise the exception of a failed call."""
        if self._last.done():  # true soon after a failure: later calls fail at once
            self._last.result()


class Interrupts:
    """A context that hands the first signal that asks the program to end to its previous handler, and ignores others.

    An exception raised by a signal handler is lost if it occurs in a callback of C code or in a finalizer; `check`
    raises it again. Only the main thread receives signals; in another thread this context does nothing.
    """

    def __init__(self) -> None:
        self._received = self._blocked = False
        self._previous: dict[int, Callable[[int, FrameType | None], Any]] = {}

    @contextlib.contextmanager
    def blocked(self) -> Iterator[None]:
        """Return a context that ignores signals, for a short task that must not be interrupted."""
        self._blocked = True
        yield
        self._received = self._blocked = False

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has been received."""
        if self._received:
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                if callable(previous := signal.getsignal(number)):  # otherwise it is ignored, as under nohup
                    self._previous[number] = previous
                    signal.signal(number, self._handle)
        return self

    def __exit__(self, *error: object) -> None:
        for number, previous in self._previous.items():
            signal.signal(number, previous)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not (self._blocked or self._received):
            self._received = True
            self._previous[number](number, frame)


class PressLoop:
    """Records presses with one arm and one board, both connected.

    Presses that the recorder already has are skipped; if `dry`, the arm never touches the pad.
    """

    def __init__(self, arm: Arm, board: Board, recorder: Recorder, rig: RigSettings, *, dry: bool = False) -> None:
        self._arm, self._board, self._recorder, self._rig, self._dry = arm, board, recorder, rig, dry
        self._frame, self._limits = RobotFrame.from_settings(rig), Limits.from_settings(rig)
        self._half_cycle_s = rig.half_cycle_s
        self._averager = Averager(rig.samples_per_reading, recorder.fibres)
        self._recent: deque[float] = deque(maxlen=4096)  # times of the latest readings
        self._disk, self._n_readings = DiskThread(), recorder.n_readings
        self._interrupts = Interrupts()
        self._zero_s = 0.0  # host time that is 0 in the recording
        self._forces_n: list[float] = []  # measured since the probe came to rest

    def run(
        self,
        plan: PressPlan,
        on_progress: OnProgress = ignore_progress,
        planner: Callable[[PressPlan, int], PressPlan] | None = None,
    ) -> None:
        """Make every press of the plan that the recorder does not have.

        `on_progress` is called after every press, once it is on the disk. `planner` is called before every press with
        the plan and the number of the press, and returns the plan, or another one in which this and later presses are
        moved. After a RigFault the arm stands still, and completed presses are on the disk.
        """
        check_plan(plan, self._rig)
        check_start_state(self._arm.state(), self._limits)
        self._start_clock()
        with self._interrupts, self._disk, self._safely():
            self._lift()  # the tool may stand anywhere in the box, even on the pad
            for press in range(len(plan)):
                if press not in self._recorder.done:
                    if planner is not None and (changed := planner(plan, press)) is not plan:
                        check_plan(changed, self._rig)
                        plan = changed
                    self._await_disk(self._press(press, plan.positions_mm[press], float(plan.depths_mm[press])))
                    on_progress(len(self._recorder.done), len(plan), "")
            self._record_until(clock.now() + self._half_cycle_s)  # the release after the last press
            self._await_disk(self._disk.submit(self._recorder.sync))

    def _start_clock(self) -> None:
        """Start times at 0, or 1 s after the last reading of a resumed recording; discard buffered samples."""
        self._board.read()
        self._arm.drain()
        self._zero_s = clock.now() - max(self._recorder.last_s + 1, 0.0)

    def _press(self, press: int, position_mm: Array, depth_mm: float) -> Future[Any]:
        """Make a press; return the queued call that writes it to the disk."""
        above = self._frame.pose(position_mm, -self._rig.clearance_mm)
        # 1. Travel, and let the pad recover for half a cycle.
        start_s = clock.now()
        self._move(above, self._rig.travel_mm_s)
        self._await_still()
        self._record_until(start_s + self._half_cycle_s)
        # 2. Down; the journal on the disk lists the press while it is held for half a cycle.
        down_s = clock.now()
        target = self._frame.pose(position_mm, -self._rig.clearance_mm / 2 if self._dry else depth_mm)
        self._move(target, self._rig.press_mm_s)
        self._await_reading(down_s)
        self._disk.submit(self._recorder.begin, position_mm, self._reading_after(down_s), press, depth_mm=depth_mm)
        self._disk.submit(self._recorder.sync)
        self._await_still()
        self._forces_n.clear()
        self._record_until(down_s + self._half_cycle_s)
        reached: dict[str, Any] = {}
        if self._forces_n:
            reached["force_n"] = float(np.median(np.abs(self._forces_n)))
        tip_mm, depths_mm = self._frame.tip(np.array([self._arm.state().pose]))
        reached["at_mm"] = [*tip_mm[0].round(4).tolist(), round(float(depths_mm[0]), 4)]
        # 3. Up; the press is complete once the journal on the disk says so.
        up_s = clock.now()
        self._move(above, self._rig.press_mm_s)
        self._await_reading(up_s)
        reached["lost"] = self._averager.n_missing
        self._disk.submit(self._recorder.finish, self._reading_after(up_s), **reached)
        synced = self._disk.submit(self._recorder.sync)
        self._await_still()
        return synced

    def _move(self, pose: Pose, speed_mm_s: float) -> None:
        check_state(self._arm.state(), self._limits, clock.now())
        try:
            self._arm.move(pose, speed_mm_s, self._rig.acceleration_mm_s2)
        except RigFault:
            clock.sleep(0.1)  # if the arm was just stopped, the next state shows the reason
            check_state(self._arm.state(), self._limits, clock.now())
            raise

    def _await_still(self) -> None:
        wait_until_still(self._arm, self._limits, self._poll)

    def _record_until(self, time_s: float) -> None:
        self._poll()
        while clock.now() < time_s:
            clock.sleep(POLL_S)
            self._poll()

    def _await_reading(self, time_s: float) -> None:
        """Record until a reading after a time has arrived."""
        deadline_s = clock.now() + _READING_DEADLINE_S
        self._poll()
        while not self._count_after(time_s):
            if clock.now() >= deadline_s:
                raise RigFault("deadline", f"no reading came within {_READING_DEADLINE_S:.1f} s", "look at the board")
            clock.sleep(POLL_S)
            self._poll()

    def _await_disk(self, synced: Future[Any]) -> None:
        """Record until a call of the disk thread is done, without waiting for calls queued after it."""
        deadline_s = clock.now() + _DISK_DEADLINE_S
        while not wait([synced], POLL_S).done:
            if clock.now() >= deadline_s:
                message = f"the disk took more than {_DISK_DEADLINE_S:.0f} s for a press"
                raise RigFault("disk", message, "look at the disk")
            self._poll()
        synced.result()

    def _poll(self) -> None:
        """Check signals, arm and disk; then read the devices and queue the data for the disk."""
        self._interrupts.check()
        check_state(self._arm.state(), self._limits, clock.now())
        self._disk.check()
        times_s, volts = self._averager.feed(self._board.read())
        if len(times_s):
            self._disk.submit(self._recorder.append, times_s - self._zero_s, volts)
            self._n_readings += len(times_s)
            self._recent.extend(times_s.tolist())
        states = self._arm.drain()
        forces_n = states[:, STATE_COLUMNS.index("force_n")]
        self._forces_n += forces_n[~np.isnan(forces_n)].tolist()
        if len(states):
            offset = np.where(np.array(STATE_COLUMNS) == "time_s", self._zero_s, 0.0)
            self._disk.submit(self._recorder.append_states, states - offset)

    def _count_after(self, time_s: float) -> int:
        """Count the recent readings that were taken after a time."""
        return sum(1 for _ in takewhile(lambda reading_s: reading_s > time_s, reversed(self._recent)))

    def _reading_after(self, time_s: float) -> int:
        """Return the index of the first reading after a time."""
        return self._n_readings - self._count_after(time_s)

    @contextlib.contextmanager
    def _safely(self) -> Iterator[None]:
        """On any failure: stop the arm, lift it off if that is safe, save the data, then raise."""
        try:
            yield
        except BaseException as error:
            with self._interrupts.blocked():
                obstacle = self._stop_and_retreat()
            self._disk.shutdown()
            with contextlib.suppress(Exception):
                self._recorder.abort(str(error) or type(error).__name__)
                self._recorder.sync()
            if (raised := _with_retreat(error, obstacle)) is error:
                raise
            raise raised from error

    def _stop_and_retreat(self) -> str | None:
        """Stop the arm and lift the tool off the pad; return what prevented that, None if the tool is off the pad."""
        stop_error = ""
        try:
            self._arm.stop()
        except Exception as error:
            stop_error = str(error)
        try:
            retreat(self._arm, self._limits)
        except Exception as error:
            return stop_error or str(error)
        return None

    def _lift(self) -> None:
        """Lift the tool straight up to travelling height; raises RigFault if outside the box, or the arm stopped."""
        state = self._arm.state()
        check_state(state, self._limits, clock.now())
        if any(not low <= x <= high for x, (low, high) in zip(state.pose, self._limits.box_mm, strict=False)):
            at = ", ".join(f"{x:.1f}" for x in state.pose[:3])
            raise RigFault("refused", f"the tool stands at {at} mm, outside the box", "move it there by hand")
        height_mm = max(self._frame.contact_mm + self._rig.clearance_mm, state.pose[2])
        up: Pose = (*state.pose[:2], height_mm, *state.pose[3:])
        check_target(up, self._rig.press_mm_s, self._rig.acceleration_mm_s2, self._limits)
        if up != state.pose:
            self._arm.move(up, self._rig.press_mm_s, self._rig.acceleration_mm_s2)
            wait_until_still(self._arm, self._limits)


def check_plan(plan: PressPlan, rig: RigSettings) -> None:
    """Raise RigFault("refused") if any pose or move of a plan is beyond the limits of `[rig]`."""
    frame, limits = RobotFrame.from_settings(rig), Limits.from_settings(rig)
    for position_mm, depth_mm in zip(plan.positions_mm, plan.depths_mm.tolist(), strict=True):
        check_target(frame.pose(position_mm, -rig.clearance_mm), rig.travel_mm_s, rig.acceleration_mm_s2, limits)
        check_target(frame.pose(position_mm, depth_mm), rig.press_mm_s, rig.acceleration_mm_s2, limits)


def _with_retreat(error: BaseException, obstacle: str | None) -> BaseException:
    """Return the exception to raise for an error, with the outcome of the retreat; `obstacle` is what prevented it."""
    if isinstance(error, OSError):
        error = RigFault("disk", f"the recording cannot be written ({error.strerror or error})")
    if obstacle is None and not (isinstance(error, RigFault) and error.cause == "force"):
        return error
    outcome = "the tool was lifted off" if obstacle is None else "the tool was not lifted off"
    if obstacle is not None and obstacle != str(error):
        outcome += f": {obstacle}"
    if isinstance(error, RigFault):
        return RigFault(error.cause, str(error), outcome)
    return KeyboardInterrupt(outcome) if isinstance(error, KeyboardInterrupt) else error
