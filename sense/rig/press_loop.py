"""From the samples of a converter to the readings of a recording: means over a whole number of samples.

A thread that waits for the disk, so that whoever watches the arm never does.

Ctrl-C, and whatever else ends a program, at an arm in motion: never missed, and never in the way of its retreat.

What an arm does after a fault, once it is stopped: it takes the tool off the pad, slowly, and stands.

The press loop: an arm presses as planned while a converter reads, and a run directory keeps all of it.
Nothing moves before the whole plan is found safe. Every wait reads, records and watches, and none is for the disk:
a thread of its own puts the recording there, and no press begins before the one before it lies there. On a fault the
arm is stopped first, then lifted off, then what came so far is brought to the disk, then the fault is told.
"""

import contextlib
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType
from typing import Any, Self

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.recording.press_plan import PressPlan
from padforge.sense.recording.run_directory import STATE_COLUMNS, Recorder
from padforge.sense.rig.config import RobotFrame
from padforge.sense.rig.devices import Arm, ArmState, Board, Pose, RigFault
from padforge.sense.rig.safety import POLL_S, Limits, require_ready, require_safe, wait_until_still, watch
from padforge.sense.rig.streams import Averager
from padforge.sense.settings import RigSettings


class DiskThread:
    """Does what it is given in its order, in a thread of its own; after a failure it does nothing more.

    A context, which it is ended with.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "disk")
        self._last: Future[None] = Future()
        self._last.set_result(None)

    def do(self, call: Callable[..., Any], *arguments: Any, **more: Any) -> None:
        """Give it a call to make after all that it was given before."""
        before = self._last

        def work() -> None:
            before.result()
            call(*arguments, **more)

        self._last = self._pool.submit(work)

    def idle(self, within_s: float = 0.0) -> bool:
        """Wait for so long at most; whether all it was given is done. Raises what a call that failed did raise."""
        done = bool(wait([self._last], within_s).done)
        if done:
            self._last.result()
        return done

    def end(self) -> None:
        """Wait until all is done that could be; raises nothing."""
        self._pool.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()


_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


class Interrupts:
    """A context that notes the first signal to end, and then does with it what was done before.

    More signals are passed over until what is `held` is through.
    An exception that a signal raises is lost where it happens to meet a callback of C code or a finalizer, so that it
    has to be asked for as well. Only the main thread hears signals; in another one nothing is done.
    """

    def __init__(self) -> None:
        self._heard = self._held = False
        self._before: dict[int, Any] = {}

    @contextmanager
    def held(self) -> Iterator[None]:
        """Within, signals are passed over: what is done is short, and has to come to its end."""
        self._held = True
        yield
        self._heard = self._held = False

    def check(self) -> None:
        """Raise KeyboardInterrupt if a signal has come."""
        if self._heard:
            raise KeyboardInterrupt

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for name in set(_SIGNALS) & set(dir(signal)):
                number = getattr(signal, name)
                if callable(before := signal.getsignal(number)):  # else it is ignored, as under nohup, or not ours
                    self._before[number] = before
                    signal.signal(number, self._handler(before))
        return self

    def __exit__(self, *error: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _handler(self, before: Callable[[int, FrameType | None], Any]) -> Callable[[int, FrameType | None], None]:
        def hear(number: int, frame: FrameType | None) -> None:
            if not (self._held or self._heard):
                self._heard = True
                before(number, frame)

        return hear


SPEED_MM_S = 10.0
HEIGHT_MM = 10.0
"""How far above the pad the tool ends, and above where it was while the force was too great."""
START_S, FALL_S = 0.2, 1.0
"""When a force that was too great has to begin to fall, and when it has to be below its limit."""
RISE_N = 5.0
"""How far it may rise above the least it was: what sensors are off by."""
EDGE_MM = 1.0
"""How far outside the box a tool may stand that was sent to its edge: no arm stands quite where it was sent."""


def retreat(
    arm: Arm, limits: Limits, acceleration_mm_s2: float, clock: Callable[[], float], sleep: Callable[[float], None]
) -> None:
    """Lift the tool straight up, unless it is above the pad already and no force is too great.

    All is watched as in any move, but that a force or depth beyond its limit has to become less, and that the tool may
    stand at the edge of the box. The arm is stopped where the force does not become less.

    Raises:
        RigFault: see `watch` and `require_safe`; "force" where the force does not fall.
    """
    state = arm.state()
    if limits.contact_mm is None:
        return
    z, most_n = state.pose[2], limits.max_force_n
    pressed = most_n is not None and _force(state) > most_n
    sides = ((low - EDGE_MM, high + EDGE_MM) for low, high in limits.box_mm[:2])
    eased = replace(
        limits,
        box_mm=(*sides, limits.box_mm[2]),
        max_force_n=None if pressed else most_n,
        max_depth_mm=max(limits.max_depth_mm, limits.contact_mm - z),
    )
    watch(state, eased, clock())
    free = max(limits.contact_mm, z if pressed else z - HEIGHT_MM) + HEIGHT_MM
    up: Pose = (*state.pose[:2], min(free, limits.box_mm[2][1]), *state.pose[3:])
    if up[2] <= z:
        return
    speed_mm_s = min(SPEED_MM_S, limits.max_speed_mm_s)
    require_safe(up, speed_mm_s, acceleration_mm_s2, eased)
    arm.move(up, speed_mm_s, acceleration_mm_s2)
    falling = _falling(arm, _force(state), most_n, clock) if most_n is not None and pressed else lambda: None
    watch(wait_until_still(arm, eased, clock, sleep, falling), limits, clock())


def _falling(arm: Arm, first_n: float, most_n: float, clock: Callable[[], float]) -> Callable[[], None]:
    """What raises RigFault("force") unless the force of an arm falls from now on."""
    begun_s, least_n = clock(), first_n

    def require_fall() -> None:
        nonlocal least_n
        force_n = _force(arm.state())
        least_n = min(least_n, force_n)
        left = min((begun_s + FALL_S - clock()) / (FALL_S - START_S), 1.0)
        if not force_n <= max(most_n, min(least_n + RISE_N, most_n + (first_n + RISE_N - most_n) * left)):
            raise RigFault("force", f"the force does not fall, it is {force_n:.1f} N", "free the tool by hand")

    return require_fall


def _force(state: ArmState) -> float:
    """Force on the tool, whatever its direction, N; 0 where the arm tells none."""
    return state.pushed_n or 0.0


_SPARE_S = 3.0
"""A reading that is waited for may take this long."""
_DISK_S = 30.0
"""What was recorded of a press is on the disk by then."""
_SETTLE_S = 0.1
_KEPT = 4096
"""Readings whose times are remembered, to tell which came after a command."""

Report = Callable[[int, int], None]
"""Told after every press, once it is on the disk: how many are done, and how many there are."""


class Session:
    """One stretch of recording with one arm and one converter, both connected.

    Args:
        recorder: new or resumed; presses it has are not made again.
        dry: press nothing: the arm stays above the pad all the time.
        clock, sleep: for rigs whose time is not that of the wall.
    """

    def __init__(
        self,
        arm: Arm,
        converter: Board,
        recorder: Recorder,
        rig: RigSettings,
        *,
        dry: bool = False,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._arm, self._converter, self._recorder, self._rig = arm, converter, recorder, rig
        self._clock, self._sleep, self._dry = clock, sleep, dry
        self._frame, self._limits = RobotFrame.of(rig), Limits.of(rig)
        ratio = max(1, round(rig.board_rate_hz / rig.rate_hz))
        self._half_s = rig.readings_per_press / 2 * ratio / rig.board_rate_hz
        self._averager = Averager(ratio, recorder.fibres)
        self._recent: deque[float] = deque(maxlen=_KEPT)
        self._disk, self._readings = DiskThread(), recorder.readings
        self._interrupts = Interrupts()
        self._zero_s = 0.0
        self._forces_n: list[float] = []  # since the probe last came to rest

    def run(
        self,
        plan: PressPlan,
        report: Report = lambda done, of: None,
        steer: Callable[[PressPlan, int], PressPlan] = lambda plan, press: plan,
    ) -> None:
        """Make every press of the plan that the recorder does not have.

        Args:
            report: told of progress. steer: may move the presses from the next one on.

        Raises:
            RigFault: the plan is not safe, or the rig failed; the arm stands still and what is done is on the disk.
        """
        require_safe_plan(plan, self._rig)
        require_ready(self._arm.state(), self._limits)
        self._begin()
        with self._interrupts, self._disk, self._safely():
            self._lift()  # the tool may stand anywhere in the box, even on the pad
            for press in range(len(plan)):
                if press not in self._recorder.done:
                    if (steered := steer(plan, press)) is not plan:
                        require_safe_plan(steered, self._rig)
                        plan = steered
                    self._press(press, plan.positions_mm[press], float(plan.depths_mm[press]))
                    self._await_disk()
                    report(len(self._recorder.done), len(plan))
            self._go_on_until(self._clock() + self._half_s)  # the release after the last press
            self._disk.do(self._recorder.sync)
            self._await_disk()

    def _begin(self) -> None:
        """Times of a recording begin at 0, and go on a second after the last ones where it is resumed.

        What came while the devices were connected, which may take longer, is none of it.
        """
        self._converter.read()
        self._arm.drain()
        last_s = self._recorder.last_s
        self._zero_s = self._clock() - (last_s + 1 if np.isfinite(last_s) else 0.0)

    def _press(self, press: int, place_mm: Array, depth_mm: float) -> None:
        above = self._above(place_mm)
        began = self._clock()
        self._move(above, self._rig.travel_mm_s)
        self._still()
        self._go_on_until(began + self._half_s)
        down_s = self._clock()
        target = self._frame.pose(place_mm, -self._rig.clearance_mm / 2 if self._dry else depth_mm)
        self._move(target, self._rig.press_mm_s)
        self._await_reading(down_s)
        self._disk.do(self._recorder.begin, place_mm, self._reading(down_s), press, depth_mm=depth_mm)
        self._disk.do(self._recorder.sync)
        self._still()
        self._forces_n.clear()
        self._go_on_until(down_s + self._half_s)
        held = {"force_n": float(np.median(np.abs(self._forces_n)))} if self._forces_n else {}
        tip, depths = self._frame.tip(np.array([self._arm.state().pose]))
        up_s = self._clock()
        self._move(above, self._rig.press_mm_s)
        self._await_reading(up_s)
        reached = {"at_mm": [*tip[0].round(4).tolist(), round(float(depths[0]), 4)], "lost": self._averager.n_missing} | held
        self._disk.do(self._recorder.finish, self._reading(up_s), **reached)
        self._disk.do(self._recorder.sync)
        self._still()

    def _above(self, place_mm: Array) -> Pose:
        return self._frame.pose(place_mm, -self._rig.clearance_mm)

    def _move(self, pose: Pose, speed_mm_s: float) -> None:
        watch(self._arm.state(), self._limits, self._clock())
        try:
            self._arm.move(pose, speed_mm_s, self._rig.acceleration_mm_s2)
        except RigFault:
            self._sleep(_SETTLE_S)  # the next state tells why, where the arm was stopped a moment ago
            watch(self._arm.state(), self._limits, self._clock())
            raise

    def _still(self) -> None:
        wait_until_still(self._arm, self._limits, self._clock, self._sleep, self._pump)

    def _go_on_until(self, moment_s: float) -> None:
        """Read, record and watch until a moment, at least once."""
        self._pump()
        while self._clock() < moment_s:
            self._sleep(POLL_S)
            self._pump()

    def _await_reading(self, moment_s: float) -> None:
        """Read, record and watch until a reading has come that was taken after a moment."""
        deadline = self._clock() + _SPARE_S
        self._pump()
        while self._after(moment_s) is None:
            if self._clock() >= deadline:
                raise RigFault("deadline", f"no reading came within {_SPARE_S:.1f} s", "look at the board")
            self._sleep(POLL_S)
            self._pump()

    def _await_disk(self) -> None:
        """Read, record and watch until all that was to be synced is on the disk."""
        deadline = self._clock() + _DISK_S
        while not self._disk.idle(POLL_S):
            if self._clock() >= deadline:
                raise RigFault("disk", f"the disk took more than {_DISK_S:.0f} s for a press", "look at the disk")
            self._pump()

    def _pump(self) -> None:
        """See that all is well, before anything else; then take what the devices have, and have it kept."""
        self._interrupts.check()
        watch(self._arm.state(), self._limits, self._clock())
        self._disk.idle()
        times_s, volts = self._averager.feed(self._converter.read())
        if len(times_s):
            self._disk.do(self._recorder.append, times_s - self._zero_s, volts)
            self._readings += len(times_s)
            self._recent.extend(times_s.tolist())
        states = self._arm.drain()
        forces_n = states[:, STATE_COLUMNS.index("force_n")]
        self._forces_n += forces_n[~np.isnan(forces_n)].tolist()
        if len(states):
            self._disk.do(self._recorder.append_states, states - np.eye(1, states.shape[1]) * self._zero_s)

    def _after(self, moment_s: float) -> int | None:
        """How many of the recent readings came after a moment; None before the first."""
        count = 0
        for reading_s in reversed(self._recent):
            if reading_s <= moment_s:
                break
            count += 1
        return count or None

    def _reading(self, moment_s: float) -> int:
        """Index of the first reading after a moment."""
        return self._readings - (self._after(moment_s) or 0)

    @contextlib.contextmanager
    def _safely(self) -> Iterator[None]:
        """On any failure: stop the arm, lift it off where that is safe, keep the data, then tell."""
        try:
            yield
        except BaseException as error:
            with self._interrupts.held():
                stuck = self._retreat()
            self._disk.end()
            with contextlib.suppress(Exception):
                self._recorder.abort(str(error) or type(error).__name__)
                self._recorder.sync()
            if (told := _told(error, stuck)) is error:
                raise
            raise told from error

    def _retreat(self) -> str | None:
        """Stop the arm and lift the tool off the pad after a fault; why it may still press the pad, if so."""
        stopped = ""
        try:
            self._arm.stop()
        except Exception as error:
            stopped = str(error)
        try:
            retreat(self._arm, self._limits, self._rig.acceleration_mm_s2, self._clock, self._sleep)
        except Exception as error:
            return stopped or str(error)
        return None

    def _lift(self) -> None:
        """Lift the tool straight up to its travelling height, unless the controller or a person stopped the arm.

        Raises:
            RigFault: the tool is outside the box, or something else is amiss.
        """
        state = self._arm.state()
        watch(state, self._limits, self._clock())
        raised = self._frame.contact_mm + self._rig.clearance_mm
        if any(not low <= x <= high for x, (low, high) in zip(state.pose, self._limits.box_mm, strict=False)):
            at = ", ".join(f"{x:.1f}" for x in state.pose[:3])
            raise RigFault("refused", f"the tool stands at {at} mm, outside the box", "move it there by hand")
        up: Pose = (*state.pose[:2], max(raised, state.pose[2]), *state.pose[3:])
        require_safe(up, self._rig.press_mm_s, self._rig.acceleration_mm_s2, self._limits)
        if up != state.pose:
            self._arm.move(up, self._rig.press_mm_s, self._rig.acceleration_mm_s2)
            wait_until_still(self._arm, self._limits, self._clock, self._sleep)


def require_safe_plan(plan: PressPlan, rig: RigSettings) -> None:
    """Refuse a plan of which any pose or move is beyond the limits of `[rig]`; raises RigFault("refused")."""
    frame, limits = RobotFrame.of(rig), Limits.of(rig)
    for place, depth in zip(plan.positions_mm, plan.depths_mm.tolist(), strict=True):
        require_safe(frame.pose(place, -rig.clearance_mm), rig.travel_mm_s, rig.acceleration_mm_s2, limits)
        require_safe(frame.pose(place, depth), rig.press_mm_s, rig.acceleration_mm_s2, limits)


def _told(error: BaseException, stuck: str | None) -> BaseException:
    """What is raised for an error, once it is known whether the tool was lifted off, and why not: `stuck`."""
    if isinstance(error, OSError):
        error = RigFault("disk", f"the recording cannot be written ({error.strerror or error})")
    force = isinstance(error, RigFault) and error.cause == "force"
    if stuck is None and not force:
        return error
    how = "the tool was lifted off" if stuck is None else "the tool was not lifted off"
    if stuck is not None and stuck != str(error):
        how += f": {stuck}"
    if isinstance(error, RigFault):
        return RigFault(error.cause, str(error), how)
    return KeyboardInterrupt(how) if isinstance(error, KeyboardInterrupt) else error
