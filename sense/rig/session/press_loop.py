"""The press loop: an arm presses as planned while a converter reads, and a run directory keeps all of it.

Nothing moves before the whole plan is found safe. Every wait reads, records and watches, and none is for the disk:
a thread of its own puts the recording there, and no press begins before the one before it lies there. On a fault the
arm is stopped first, then lifted off, then what came so far is brought to the disk, then the fault is told.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from padforge.sense.recordings.press_plan import PressPlan
from padforge.sense.recordings.processing.limits import Array
from padforge.sense.recordings.recorder import STATE_COLUMNS, Recorder
from padforge.sense.rig.devices.protocols import Arm, Converter, Pose, RigFault
from padforge.sense.rig.safety import POLL_S, Limits, require_ready, require_safe, wait_until_still, watch
from padforge.sense.settings import RigSettings

from padforge.sense.rig.session.averaging import Averager
from padforge.sense.rig.session.disk_thread import DiskThread
from padforge.sense.rig.session.interrupts import Interrupts
from padforge.sense.rig.session.pad_frame import Frame
from padforge.sense.rig.session.retreat import retreat

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
        converter: Converter,
        recorder: Recorder,
        rig: RigSettings,
        *,
        dry: bool = False,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._arm, self._converter, self._recorder, self._rig = arm, converter, recorder, rig
        self._clock, self._sleep, self._dry = clock, sleep, dry
        self._frame, self._limits = Frame.of(rig), Limits.of(rig)
        ratio = max(1, round(rig.converter_rate_hz / rig.rate_hz))
        self._half_s = rig.readings_per_press / 2 * ratio / rig.converter_rate_hz
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
                    self._press(press, plan.places_mm[press], float(plan.depths_mm[press]))
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
        reached = {"at_mm": [*tip[0].round(4).tolist(), round(float(depths[0]), 4)], "lost": self._averager.lost} | held
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
    frame, limits = Frame.of(rig), Limits.of(rig)
    for place, depth in zip(plan.places_mm, plan.depths_mm.tolist(), strict=True):
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
