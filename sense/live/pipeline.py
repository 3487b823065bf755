"""The pipeline of `padforge sense live`: from blocks of readings to the positions of presses.

It returns events: the position of a press at every reading from its touch to the end of its release, with radii that
are valid at that moment; faulty fibres, which are masked from the next press on; and a notice if the latest presses are
those of another pad, on which no fibre counts as faulty. A second finger that lands while the first one rests is a
press of its own, localized from the change since then; the position of the first one is no longer updated.
"""

from collections import deque
from dataclasses import asdict, dataclass, replace
from math import hypot
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.validation import InputError, check_float
from padforge.sense.arrays import MAX_RATE_HZ, MIN_RATE_HZ, Array, Indices, Mask, check_stream
from padforge.sense.health.fault_detector import FaultMonitor, FibreFault
from padforge.sense.health.health_model import HealthModel
from padforge.sense.health.trace_model import RELEASED
from padforge.sense.localizer.features import (
    MEDIAN_OFFSET,
    MEDIAN_WIDTH,
    PressFeatures,
    compute_features,
    compute_history,
    interpolate_gaps,
    mean_at_rest,
    valid_fibres,
    windows_from_rest,
)
from padforge.sense.localizer.model import MEASURE_COLUMNS, UNIFORM, FittedLocalizer, LocalizerModel, fitted_model
from padforge.sense.localizer.model_files import check_same_pad
from padforge.sense.localizer.moments import (
    EARLY_WINDOWS,
    MODULATED,
    N_PRESS_WINDOWS,
    PRESS_WINDOWS,
    RELEASE_WINDOWS,
    REST,
    complete_windows,
)
from padforge.sense.localizer.press_course import PressCourse
from padforge.sense.localizer.single_press import MIN_PRESSES, OTHER_PAD, find_misfits, is_other_pad
from padforge.sense.recording.frames import FrameStream
from padforge.sense.rig.streams import HISTORY, SLACK, RingBuffer
from padforge.sense.signals.press_detection import RELEASE_DELAY_S, TOUCH_DELAY_S, PressDetector

MAX_TRACK = 64  # latest positions of the current press in the view
SHARPER = 0.75  # ratio of radii below which a new estimate at the same position replaces the earlier one
LEAD = MEDIAN_OFFSET + MEDIAN_WIDTH // 2  # readings before `down_command` that features use, without their history
OPENING = PRESS_WINDOWS[-1][1]  # readings after `down_command` that features use
LATEST = 20  # readings before the present, or the release, that features of a long press use
MIN_COMPLETE = 3  # complete windows of a change from which on it may be taken for a second finger
MIN_EXPLAINED = 0.8  # minimum share of such a change that a press at its position explains
MAX_DEEPENING = 0.6  # maximum share that the first finger, pressing deeper or less deep, explains
LIFT_WINDOWS = 2, 3  # `RELEASE_WINDOWS` that show which of two fingers lifts off
MAX_ERROR_RATIO = 0.5  # maximum ratio of squared errors, best explanation to second-best
RELEASE = max(RELEASE_WINDOWS[-1][1], RELEASED)  # readings after `up_command` that complete a press


@dataclass(frozen=True)
class Estimate:
    """The position of a press, estimated at one moment."""

    press: int  # index, from 0
    time_s: float  # time of the touch, by the clock of the readings
    now_s: float  # time of the latest reading
    since: Literal["touch", "lift"]  # "lift" if a release has been detected
    readings: int  # number of frames since the touch was detected, or since the lift
    since_s: float  # time from the touch, or the lift, to the latest reading
    final: bool  # whether it is the last estimate of the press
    x_mm: float
    y_mm: float
    std_x_mm: float
    std_y_mm: float
    r50_mm: float  # radius that contains the true position in 50 % of cases
    r90_mm: float
    failed: tuple[int, ...]  # indices of the masked fibres
    unlike: bool = False  # whether no single press explains the responses, for example with two fingers
    finger: int = 1  # 2 if it landed while finger 1 rested
    depth_mm: float | None = None  # None, like the next three, if the localizer does not predict it
    depth_r90_mm: float | None = None  # half width of the 90 % interval
    force_n: float | None = None
    force_r90_n: float | None = None

    @property
    def measures_text(self) -> str:
        """Depth and force, if the localizer predicts them."""
        depth = "" if self.depth_mm is None else f", {self.depth_mm:.1f} ± {self.depth_r90_mm:.1f} mm deep"
        return depth + ("" if self.force_n is None else f", {self.force_n:.1f} ± {self.force_r90_n:.1f} N")

    @property
    def moment_text(self) -> str:
        return f"{self.since_s:.2f} s after the {self.since}"

    @property
    def text(self) -> str:
        press = f"press {self.press}" + ", second finger" * (self.finger - 1)
        if self.unlike:
            return f"{press}: no single press, but several fingers? ({self.moment_text})"
        return (
            f"{press}: {self.x_mm:.1f}, {self.y_mm:.1f} mm, within {self.r50_mm:.1f} mm at 50 %, "
            f"{self.r90_mm:.1f} mm at 90 %{self.measures_text} ({self.moment_text})"
        )

    def has_moved_from(self, earlier: "Estimate") -> bool:
        """Return whether the distance to an earlier estimate of the same press exceeds both radii of 90 %.

        Args:
            earlier: estimate of the same press.
        """
        distance = hypot(self.x_mm - earlier.x_mm, self.y_mm - earlier.y_mm)
        return distance > max(self.r90_mm, earlier.r90_mm)

    def is_sharper_than(self, earlier: "Estimate") -> bool:
        """Return whether the radius of 90 % is at most `SHARPER` times that of an earlier estimate.

        Args:
            earlier: estimate of the same press.
        """
        return self.r90_mm <= SHARPER * earlier.r90_mm

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate as JSON, without values that are not predicted."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class OtherPad:
    """Notice that the latest presses are those of another pad than the calibrated one, even if of the same plan."""

    press: int  # index of the latest press
    text: str = OTHER_PAD


Event = Estimate | FibreFault | OtherPad


@dataclass
class BufferedPress:
    """A current press; indices are those of readings in the stream."""

    number: int  # index of the press, from 0
    time_s: float  # time of the touch
    touched: int  # first reading that shows the touch
    down_command: int  # first reading after the command down, estimated by the touch
    previous_end: int  # `up_command` of the previous press, < `down_command`
    untouched: Array  # readings (1, C) before any finger touched the pad, V
    baseline: Array  # readings (1, C) before the press, V; with a finger held before, those under that one
    history: Array  # history features (1, C, J), V, see `PressFeatures`
    up_command: int | None = None  # first reading after the command up; None while the press is held
    up_s: float = 0.0  # time of `up_command`
    finger: int = 1  # see `Estimate`
    other: "BufferedPress | None" = None  # press of the finger that was held before, whose relaxation is subtracted
    fixed: Estimate | None = None  # last estimate before another finger changed the readings
    course: PressCourse | None = None  # expected course at the last position
    _opening: Array | None = None  # readings around `down_command`, see `store_opening`

    def relaxation(self, rows: Indices) -> Array:
        """Return the change (n, C), V, of the response to the other finger from `down_command` to readings (n,)."""
        if self.other is None or self.other.course is None:
            return np.zeros((len(rows), 1))
        response = self.other.course.response(np.append(rows, self.down_command) - self.other.down_command)
        return response[:-1] - response[-1]

    def release(self, up_command: int, buffer: RingBuffer) -> None:
        """End the press, at least one reading after `down_command`."""
        self.up_command = max(up_command, self.down_command + 1)
        last = min(self.up_command, buffer.end - 1)
        self.up_s = float(buffer.rows(last, last + 1)[0, 0])

    def store_opening(self, buffer: RingBuffer) -> None:
        """Copy the first readings, and those just before the press, since a long hold removes them from the buffer."""
        if self._opening is None and buffer.end >= self.down_command + OPENING:
            self._opening = buffer.rows(self.down_command - LEAD, self.down_command + OPENING)[:, 1:].copy()

    def excerpt(self, buffer: RingBuffer, until: int) -> tuple[Array, int, int, int]:
        """Return the readings (n, C) of the press before index `until`, without those that no feature uses.

        Also returned are the indices in them of `down_command`, of `up_command` (n while the press is held), and of the
        end of the previous press.
        """
        # 1. The opening, and the latest readings of a long press
        up_command = until if self.up_command is None else min(self.up_command, until)
        opening_end = min(self.down_command + OPENING, until)
        if self._opening is None:
            opening = buffer.rows(self.down_command - LEAD, opening_end)[:, 1:]
        else:
            n_after_until = self.down_command + OPENING - opening_end
            opening = self._opening[: len(self._opening) - n_after_until]
        latest_first = max(up_command - LATEST, opening_end)
        latest = buffer.rows(latest_first, until)[:, 1:]
        # 2. Their change by the other finger is subtracted
        first = opening_end - len(opening)
        rows = np.append(np.arange(first, opening_end), np.arange(latest_first, until))
        readings = np.concatenate([opening, latest]) - self.relaxation(rows)
        up = up_command - first - (latest_first - opening_end)
        return readings, self.down_command - first, up, max(self.previous_end - first, 0)


class Live:
    """Localizes presses in a stream of readings, with bounded memory.

    Args:
        localizer: fitted localizer of the pad, or its `model_`.
        rate_hz: readings per second.
        fibres: number of fibres that are read; None for that of the localizer.
        health: health model of the pad; None for no detection of faults.

    Attributes:
        presses: the latest estimate of each of the last presses, oldest first.
        track: estimates of the latest press at the last positions to which it has moved, oldest first.
        faults: all faults so far, oldest first.
        is_other_pad: whether the latest presses are those of another pad; then only dead fibres of `health` are masked.

    Raises:
        InputError: a rate out of range, a localizer that is not fitted or was fitted to arrays, or `check_same_pad`
            refuses a model.
    """

    def __init__(
        self,
        localizer: FittedLocalizer | LocalizerModel,
        *,
        rate_hz: float,
        fibres: int | None = None,
        health: HealthModel | None = None,
    ) -> None:
        rate_hz = check_float("rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ)
        localizer = fitted_model(localizer)
        fibres = localizer.fibres if fibres is None else fibres
        check_same_pad(localizer, "the localizer", fibres, rate_hz)
        if localizer.features == "array":
            raise InputError("the localizer was fitted to arrays of features, expected one that was fitted to readings")
        self._monitor = None if health is None else FaultMonitor(health)
        if health is not None:
            check_same_pad(health, "health", fibres, rate_hz)
        self._localizer, scaler = localizer, localizer.scaler
        n_windows = scaler.mean_v.shape[1] - (len(MODULATED) if localizer.features == "windows" else 0)
        response_v = (np.abs(scaler.mean_v) + 2 * scaler.scale_v)[:, :n_windows].max(axis=1)
        self._response_v = np.where(response_v > 0, response_v, 1.0)  # typical maximum, the scale of the view
        self._detector = PressDetector(fibres)
        self._frames = FrameStream(rate_hz, fibres)
        self._last_s = -np.inf  # time of the last reading
        self._buffer = RingBuffer(1 + fibres)  # times and voltages of frames
        self._presses: list[BufferedPress] = []  # current ones, in the order of their touches
        # A change that may be a second finger, and the estimate of the first one before it.
        self._candidate: tuple[BufferedPress, Estimate] | None = None
        self._lift: int | None = None  # `up_command` of one of two fingers, or of both
        self._n_presses = self._previous_end = 0
        self.presses: deque[Estimate] = deque(maxlen=12)  # latest presses in the view
        self.track: deque[Estimate] = deque(maxlen=MAX_TRACK)
        self.faults: list[FibreFault] = []
        self._misfits: deque[Array] = deque(maxlen=MIN_PRESSES)  # of the latest presses, see `find_misfits`
        self.is_other_pad = False
        self._unreported: list[FibreFault] = []  # detected while the pad was taken for another one

    @property
    def pressed(self) -> bool:
        """Whether the pad is pressed now."""
        return bool(self._held)

    @property
    def _held(self) -> list[BufferedPress]:
        return [press for press in self._presses if press.up_command is None]

    @property
    def shown_presses(self) -> list[Estimate]:
        """Latest estimates of the presses that are not over, oldest first; without any, that of the last press."""
        return [press for press in self.presses if not press.final] or list(self.presses)[-1:]

    @property
    def failed(self) -> tuple[int, ...]:
        """Indices of the fibres that are masked."""
        if self._monitor is None:
            return ()
        return self._monitor.model.dead if self.is_other_pad else self._monitor.failed

    def update(self, times_s: ArrayLike, readings: ArrayLike) -> list[Event]:
        """Process readings; the events do not depend on the division of readings into blocks.

        Args:
            times_s: time of a reading, or ascending times; s, scalar or shape (n,).
            readings: readings, NaN where missing; V, shape (C,) or (n, C).

        Returns:
            Events, in chronological order.

        Raises:
            InputError: `check_stream` refuses the arrays, or times do not follow those of the last block.
        """
        events: list[Event] = []
        times, rows = check_stream(np.atleast_1d(times_s), np.atleast_2d(readings), len(self._response_v))
        if len(times) and not times[0] > self._last_s:
            raise InputError(f"times begin at {times[0]:g} s, expected later than those of the last readings")
        self._last_s = float(times[-1]) if len(times) else self._last_s
        for frame in np.column_stack(self._frames.feed(times, rows)):  # time and voltages
            self._buffer.append(frame)
            for change in self._detector.update(frame[:1], frame[None, 1:]):
                events += self._begin(change.reading) if change.down else self._end(change.reading)
            for reading in self._detector.further:  # where a pad that was pressed is pressed further
                self._suspect(reading)
            events += self._advance()
        return events

    def view(self) -> dict[str, Any]:
        """Return the state of the pad as JSON.

        Returns:
            "pressed": whether the pad is pressed.
            "fibres": "swing" (deviation from the untouched pad over the typical response, None if missing) and "state".
            "presses": `Estimate.to_dict` with "measures_text", "moment_text" and "text".
            "track": positions [x, y] of the latest press, mm, more than one if the finger has moved.
            "faults": a line for each fault, or one on another pad.
        """
        swings, end = np.full(len(self._response_v), np.nan), self._buffer.end
        if end:
            baseline = self._presses[0].untouched[0] if self._presses else self._buffer.baseline(end)
            swings = (self._buffer.rows(end - 1, end)[0, 1:] - baseline) / self._response_v
        return {
            "pressed": self.pressed,
            "fibres": [
                {"swing": None if np.isnan(swing) else round(swing, 3), "state": state}
                for swing, state in zip(swings.tolist(), self._states(np.isnan(swings)), strict=True)
            ],
            "presses": [
                press.to_dict() | {name: getattr(press, name) for name in ("measures_text", "moment_text", "text")}
                for press in self.presses
            ],
            "track": [[estimate.x_mm, estimate.y_mm] for estimate in self.track],
            "faults": [OTHER_PAD] if self.is_other_pad else [fault.text for fault in self.faults],
        }

    def _states(self, missing: Mask) -> list[str]:
        kinds = {fibre: fault.kind for fault in self.faults for fibre in fault.fibres}
        healthy = "unmonitored" if self._monitor is None else "sound"
        return [
            kinds.get(fibre, "dead") if fibre in self.failed else "missing" if is_missing else healthy
            for fibre, is_missing in enumerate(missing)
        ]

    def _begin(self, touched: int) -> list[Event]:
        """Start a press, and return the remaining events of the previous one."""
        touched = max(touched, self._buffer.end - SLACK)  # a slow change may be recognised as a touch hours later
        # the command follows the releases of earlier presses, which end now
        released = [press.up_command for press in self._presses if press.up_command is not None]
        down_command = max([self._buffer.command_index(touched, TOUCH_DELAY_S), *(up + 1 for up in released)])
        events = self._cut(self._presses, down_command)
        self._candidate = self._lift = None
        down_command = max(down_command, self._previous_end + 1)
        time_s = float(self._buffer.rows(touched, touched + 1)[0, 0])
        readings = interpolate_gaps(self._buffer.rows(down_command - HISTORY, self._buffer.end)[:, 1:])
        first = self._buffer.end - len(readings)
        down, previous_end = (np.array([max(index - first, 0)]) for index in (down_command, self._previous_end))
        baseline, history = mean_at_rest(readings, down, previous_end), compute_history(readings, down)
        indices = touched, down_command, self._previous_end
        self._add(BufferedPress(self._n_presses, time_s, *indices, baseline, baseline, history))
        return events

    def _add(self, press: BufferedPress) -> None:
        self._presses.append(press)
        self.track.clear()
        self._n_presses += 1

    def _cut(self, presses: list[BufferedPress], end: int) -> list[Event]:
        """Return the last events of presses that end at a reading."""
        return [event for press in list(presses) for event in self._follow(press, end)]

    def _end(self, released: int) -> list[Event]:
        """End the press whose release shows at a reading; of two, `_release_one_or_both` finds which one later."""
        self._candidate, held = None, self._held
        if not held or self._lift is not None:
            return []
        up_command = max(self._buffer.command_index(released, RELEASE_DELAY_S), held[-1].touched)
        if len(held) > 1:
            self._lift = up_command
            return []
        events = self._cut([press for press in self._presses if press is not held[0]], up_command)
        held[0].release(up_command, self._buffer)
        return events

    def _suspect(self, touched: int) -> None:
        """Make a change that begins at a reading, during a press, the candidate for a second finger."""
        held = self._held
        if len(held) != 1 or self._localizer.features != "windows":
            return
        touched = max(touched, self._buffer.end - SLACK)
        first, down_command = held[0], self._buffer.command_index(touched, TOUCH_DELAY_S)
        sunk_in = first.down_command + EARLY_WINDOWS  # earlier readings belong to the touch of the first finger
        if down_command <= sunk_in:
            return
        time_s = float(self._buffer.rows(touched, touched + 1)[0, 0])
        before = first.fixed or self._estimate(first, down_command, False)
        if before.unlike:
            return
        indices, before_press = (touched, down_command, sunk_in), (first.untouched, first.baseline, first.history)
        press = BufferedPress(self._n_presses, time_s, *indices, *before_press)
        press.finger, press.other = 3 - first.finger, first  # the other one of fingers 1 and 2
        if first.fixed is None:
            first.course = self._course(first, down_command, before)
        rows = np.arange(max(sunk_in, down_command + REST[0]), down_command)
        readings = interpolate_gaps(self._buffer.rows(int(rows[0]), down_command)[:, 1:])
        press.baseline = (readings - press.relaxation(rows)).mean(axis=0)[None]
        self._candidate = press, before

    def _course(self, press: BufferedPress, until: int, estimate: Estimate) -> PressCourse:
        """Return the expected course of a press at an estimated position, scaled to its readings."""
        features = self._features_of_working_fibres(press, until)
        return PressCourse.fit(self._localizer, features, np.array([estimate.x_mm, estimate.y_mm]))

    def _advance(self) -> list[Event]:
        """Return the events at the latest reading."""
        events: list[Event] = []
        if self._lift is not None and self._buffer.end >= self._lift + RELEASE_WINDOWS[LIFT_WINDOWS[-1]][1]:
            events += self._release_one_or_both(self._lift)
            self._lift = None
        elif self._candidate is not None:
            events += self._judge(*self._candidate)
        for press in list(self._presses):
            events += self._follow(press)
        return events

    def _judge(self, press: BufferedPress, before: Estimate) -> list[Event]:
        """Start the candidate as a press if a second finger explains it; drop it once it is complete without that."""
        first, until = self._held[0], self._buffer.end
        press.store_opening(self._buffer)
        now = np.array([until])  # the press is held: its release may begin now at the earliest
        n_complete = int(complete_windows(np.array([press.down_command]), now, now).sum())
        if n_complete < MIN_COMPLETE or first.course is None:
            return []
        estimate = self._estimate(press, until, False)
        distance = hypot(estimate.x_mm - before.x_mm, estimate.y_mm - before.y_mm)
        elsewhere, deepening = (self._course(press, until, each) for each in (estimate, before))
        is_elsewhere = distance > before.r90_mm + estimate.r90_mm and elsewhere.explained_share > MIN_EXPLAINED
        share_of_first = max(deepening.explained_share, elsewhere.share_explained_by(first.course))
        if is_elsewhere and share_of_first < MAX_DEEPENING:
            events = self._cut([each for each in self._presses if each is not first], press.down_command)
            self._candidate, first.fixed = None, before
            self._add(press)
            return [*events, self._show(before)]
        if n_complete >= N_PRESS_WINDOWS:
            self._candidate = None
        return []

    def _release_one_or_both(self, lift: int) -> list[Event]:
        """Release that one of two fingers, or both, whose expected release best explains the change since a reading."""
        held, events = self._held, list[Event]()
        for press in held:
            if press.fixed is None:
                press.fixed = self._estimate(press, lift, False)
                press.course = self._course(press, lift, press.fixed)
        courses = [press.course for press in held if press.course is not None]
        # 1. The measured change, and the change that is expected if either finger lifts off
        first, end = RELEASE_WINDOWS[LIFT_WINDOWS[0]][0], RELEASE_WINDOWS[LIFT_WINDOWS[-1]][1]
        change = self._mean(lift + first, lift + end) - self._mean(lift - 3, lift)
        expected = np.array([course.changes_by_release[list(LIFT_WINDOWS)].mean(axis=0) for course in courses])
        # 2. The hypothesis of least squared error: the first finger, the second one, or both lift off
        hypotheses, mask = ([0], [1], [0, 1]), courses[0].fibre_mask & courses[1].fibre_mask
        errors = [float(((change - expected[fingers].sum(axis=0))[mask] ** 2).sum()) for fingers in hypotheses]
        best, second_best = np.argsort(errors)[:2]
        released = hypotheses[best]
        if errors[best] > MAX_ERROR_RATIO * errors[second_best]:
            released = [1]  # a guess: either may be the one that is still held, so both positions become unknown
            std_mm, r50_mm, r90_mm = (self._localizer.scaler.scale_mm * np.array(UNIFORM)).tolist()
            unknown = {"std_x_mm": std_mm, "std_y_mm": std_mm, "r50_mm": r50_mm, "r90_mm": r90_mm}
            for press in held:
                if press.fixed is not None:
                    press.fixed = replace(press.fixed, unlike=True, **unknown)
                    events.append(self._show(press.fixed))
        elif released == [1]:
            held[1].fixed = None  # only its own release changes the readings now, and locates it better
        for number in released:
            held[number].release(lift, self._buffer)
        if len(released) == 1:
            self._detector.hold(courses[1 - released[0]].pressed[-1])
        return events

    def _mean(self, first: int, end: int) -> Array:
        return interpolate_gaps(self._buffer.rows(first, end)[:, 1:]).mean(axis=0)

    def _follow(self, press: BufferedPress, cut: int | None = None) -> list[Event]:
        """Return the events of a press at the latest reading; with `cut`, the last ones of a press that ends there."""
        until = self._buffer.end if cut is None else max(cut, press.down_command + 1)
        if cut is not None and press.up_command is None:
            press.release(cut, self._buffer)
        press.store_opening(self._buffer)
        is_complete = False
        if press.up_command is not None:
            end = press.up_command + (0 if press.fixed else RELEASE)
            is_complete = until >= end or cut is not None
            until = min(until, end)
        # published features need a complete press, and after a lift it is not yet known which finger rests
        is_estimated_now = self._localizer.features == "windows" and self._lift is None
        events: list[Event] = []
        if press.fixed is None and (is_complete or is_estimated_now):
            events.append(self._show(self._estimate(press, until, is_complete)))
        elif press.fixed is not None and is_complete:
            events.append(self._show(replace(press.fixed, final=True)))
        return [*events, *self._finish(press, until)] if is_complete else events

    def _finish(self, press: BufferedPress, end: int) -> list[Event]:
        """Remove a complete press; return what it shows of the pad and its fibres, unless fingers overlapped."""
        events: list[Event] = []
        if press.fixed is None and press.other is None:
            events += [*self._check_pad(press, end), *self._check_fibres(press, end)]
        elif self._monitor is not None:  # it skips this press, but numbers those after it
            self._monitor.n_presses += 1
        assert press.up_command is not None
        self._previous_end = max(self._previous_end, press.up_command)
        self._presses.remove(press)
        press.other = None  # otherwise fingers that take turns without a rest form an endless chain
        return events

    def _estimate(self, press: BufferedPress, until: int, final: bool) -> Estimate:
        scaled = self._localizer.scaler.transform(self._features_of_working_fibres(press, until))
        result = self._localizer.localize(scaled)
        (x_mm, y_mm), (std_x_mm, std_y_mm) = result.positions_mm[0].tolist(), result.std_mm[0].tolist()
        measures = {
            column: float(values[0])
            for name, measure in result.measures.items()
            for column, values in zip(MEASURE_COLUMNS[name], (measure.values, measure.r90), strict=True)
        }
        now_s = float(self._buffer.rows(until - 1, until)[0, 0])
        since: Literal["touch", "lift"] = "touch"
        first, first_s = press.touched, press.time_s
        if press.up_command is not None and until > press.up_command:
            since, first, first_s = "lift", press.up_command, press.up_s
        return Estimate(
            press=press.number,
            time_s=press.time_s,
            now_s=now_s,
            since=since,
            readings=until - first,
            since_s=now_s - first_s,
            final=final,
            x_mm=x_mm,
            y_mm=y_mm,
            std_x_mm=std_x_mm,
            std_y_mm=std_y_mm,
            r50_mm=float(result.r50_mm[0]),
            r90_mm=float(result.r90_mm[0]),
            failed=tuple(np.flatnonzero(~scaled.fibre_mask[0]).tolist()),
            unlike=bool(result.unlike is not None and result.unlike[0]),
            finger=press.finger,
            **measures,
        )

    def _features_of_working_fibres(self, press: BufferedPress, until: int) -> PressFeatures:
        features = self._features(press, until)
        working = ~np.isin(np.arange(features.fibre_mask.shape[1]), self.failed)
        return replace(features, fibre_mask=features.fibre_mask & working)

    def _features(self, press: BufferedPress, until: int) -> PressFeatures:
        """Return the features of the press, as `compute_features` of all readings before `until` would."""
        readings, down, up, previous_end = press.excerpt(self._buffer, until)
        if self._localizer.features == "published":
            downs, ups = [down], [up]
            if previous_end > 0:  # a dummy previous press, which limits the baseline of this one
                downs, ups = [previous_end - 1, down], [previous_end, up]
            return compute_features(readings, np.array(downs), np.array(ups), is_published=True)[-1:]
        moment = np.array([down]), np.array([up]), np.array([len(readings)])
        windows = windows_from_rest(interpolate_gaps(readings), press.baseline, *moment)
        return PressFeatures(windows, press.history, valid_fibres(readings, *moment), complete_windows(*moment))

    def _show(self, estimate: Estimate) -> Estimate:
        """Replace the previous estimate of the press in `presses`, and add to `track` if the finger has moved."""
        numbers = [earlier.press for earlier in self.presses]
        if estimate.press in numbers:
            self.presses[numbers.index(estimate.press)] = estimate
        else:
            self.presses.append(estimate)
        if estimate.press != self.presses[-1].press:
            return estimate
        if self.track and not estimate.has_moved_from(self.track[-1]):
            if not estimate.is_sharper_than(self.track[-1]):
                return estimate
            self.track.pop()  # the same position with a smaller radius
        self.track.append(estimate)
        return estimate

    def _check_pad(self, press: BufferedPress, end: int) -> list[OtherPad]:
        """Update `is_other_pad` from a complete press; return an event if it becomes true."""
        scaled, was_other_pad = self._localizer.scaler.transform(self._features(press, end)), self.is_other_pad
        self._misfits.extend(find_misfits(self._localizer.single_press, scaled))
        self.is_other_pad = is_other_pad(self._localizer.single_press, np.array(self._misfits))
        return [OtherPad(press.number)] * (self.is_other_pad and not was_other_pad)

    def _check_fibres(self, press: BufferedPress, end: int) -> list[FibreFault]:
        """Return the faults that are detected and not yet returned; none while the pad is taken for another one."""
        if self._monitor is None:
            return []
        readings, down_command, up_command, previous_end = press.excerpt(self._buffer, end)
        first = max(down_command + REST[0], previous_end)
        self._unreported += self._monitor.update(readings[first:], down_command - first, up_command - first)
        if self.is_other_pad:
            return []
        faults, self._unreported = self._unreported, []
        self.faults += faults
        return faults
