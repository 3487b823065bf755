"""The pipeline behind `padforge sense live`: from readings as they arrive to the position of each press.

Blocks of readings of any size go in; events come out: the position of a press at every reading from its touch until
its release is complete, with radii that hold at that moment; faulty fibres, which are masked from the next press on;
and that the latest presses are those of another pad, of which no fibre is masked.
"""

from collections import deque
from dataclasses import asdict, dataclass
from math import hypot
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.validation import InputError
from padforge.sense.arrays import Array, Mask, check_stream
from padforge.sense.health.fault_detector import FaultMonitor, FibreFault
from padforge.sense.health.health_model import HealthModel
from padforge.sense.health.trace_model import RELEASED
from padforge.sense.localizer.doubts import OTHER_PAD
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
from padforge.sense.localizer.localizer import Localizer
from padforge.sense.localizer.model import MEASURE_COLUMNS, LocalizerModel
from padforge.sense.localizer.model_files import check_same_pad
from padforge.sense.localizer.moments import MODULATED, PRESS_WINDOWS, RELEASE_WINDOWS, REST, complete_windows
from padforge.sense.localizer.scaler import ScaledFeatures
from padforge.sense.localizer.single_press import MIN_PRESSES, find_misfits, is_other_pad
from padforge.sense.recording.frames import FrameStream
from padforge.sense.rig.streams import HISTORY, SLACK, RingBuffer
from padforge.sense.signals.press_detection import RELEASE_DELAY_S, TOUCH_DELAY_S, PressDetector

MAX_SHOWN = 12  # latest presses that are shown
MAX_TRACK = 64  # latest places of the press under way that are shown
SHARPER = 0.75  # share of its radius from which on an estimate is worth telling again
LEAD = MEDIAN_OFFSET + MEDIAN_WIDTH // 2  # readings before `down_command` that features look at, their history aside
OPENING = PRESS_WINDOWS[-1][1]  # readings after `down_command` that features look at
LATEST = 20  # readings before the moment, or the release, that are kept of a press that is held for longer
RELEASE = max(RELEASE_WINDOWS[-1][1], RELEASED)  # readings after `up_command` with which a press is complete


@dataclass(frozen=True)
class Estimate:
    """The position of a press, estimated at one moment."""

    press: int  # index, from 0
    time_s: float  # of its touch, by the clock of the readings
    now_s: float  # of the latest reading that it looks at
    since: Literal["touch", "lift"]  # whether the finger still rested, by what was known
    readings: int  # that it looks at since the touch showed, or since the lift
    since_s: float  # from the touch, or the lift, to the latest reading
    final: bool  # whether it is the last of the press
    x_mm: float
    y_mm: float
    std_x_mm: float
    std_y_mm: float
    r50_mm: float  # radius that holds the true position in 50 % of cases
    r90_mm: float
    failed: tuple[int, ...]  # indices of the fibres that were masked
    unlike: bool = False  # whether no single press explains the responses, as of two fingers; it may be anywhere
    depth_mm: float | None = None  # None where the localizer does not predict it, as the three that follow
    depth_r90_mm: float | None = None  # half width of its 90 % interval
    force_n: float | None = None
    force_r90_n: float | None = None

    @property
    def measures_text(self) -> str:
        """Depth and force, as far as they were learnt."""
        depth = "" if self.depth_mm is None else f", {self.depth_mm:.1f} ± {self.depth_r90_mm:.1f} mm deep"
        return depth + ("" if self.force_n is None else f", {self.force_n:.1f} ± {self.force_r90_n:.1f} N")

    @property
    def moment_text(self) -> str:
        return f"{self.since_s:.2f} s after the {self.since}"

    @property
    def text(self) -> str:
        if self.unlike:
            return f"press {self.press}: no single press, but several fingers? ({self.moment_text})"
        return (
            f"press {self.press}: {self.x_mm:.1f}, {self.y_mm:.1f} mm, within {self.r50_mm:.1f} mm at 50 %, "
            f"{self.r90_mm:.1f} mm at 90 %{self.measures_text} ({self.moment_text})"
        )

    def has_moved_from(self, earlier: "Estimate") -> bool:
        """Return whether the finger is so far from where it was that no error explains it.

        Args:
            earlier: estimate of the same press.
        """
        distance = hypot(self.x_mm - earlier.x_mm, self.y_mm - earlier.y_mm)
        return distance > max(self.r90_mm, earlier.r90_mm)

    def is_sharper_than(self, earlier: "Estimate") -> bool:
        """Return whether its radius is smaller by a quarter or more.

        Args:
            earlier: estimate of the same press.
        """
        return self.r90_mm <= SHARPER * earlier.r90_mm

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON, without what was not learnt."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class OtherPad:
    """The latest presses are those of another pad than that of the calibration, or of one cast again by its plan."""

    press: int  # index of the last of them
    text: str = OTHER_PAD


Event = Estimate | FibreFault | OtherPad


@dataclass
class BufferedPress:
    """The press under way; indices are those of readings in the stream."""

    number: int  # of presses before it
    time_s: float  # when the pad was touched
    touched: int  # first reading that shows it
    down_command: int  # first reading after the probe was sent down, or would have been
    previous_end: int  # `up_command` of the press before, < `down_command`
    baseline: Array  # (1, C) V before it
    history: Array  # (1, C, J) V, see `PressFeatures`
    up_command: int | None = None  # first reading after the probe was sent up; None while it is held
    up_s: float = 0.0  # its time
    _opening: Array | None = None

    def release(self, up_command: int, buffer: RingBuffer) -> None:
        """End the press, one reading after its begin at the earliest."""
        self.up_command = max(up_command, self.down_command + 1)
        last = min(self.up_command, buffer.end - 1)
        self.up_s = float(buffer.rows(last, last + 1)[0, 0])

    def store_opening(self, buffer: RingBuffer) -> None:
        """Copy its first readings, and those just before it, once they have arrived: it may be held for hours."""
        if self._opening is None and buffer.end >= self.down_command + OPENING:
            self._opening = buffer.rows(self.down_command - LEAD, self.down_command + OPENING)[:, 1:].copy()

    def excerpt(self, buffer: RingBuffer, until: int) -> tuple[Array, int, int, int]:
        """Return its readings before index `until`, without those in its middle that no features look at.

        And the indices in them of its commands, and of the end of the press before. A press that is held has
        `up_command` at their end.
        """
        up_command = until if self.up_command is None else min(self.up_command, until)
        opened = min(self.down_command + OPENING, until)
        latest = max(up_command - LATEST, opened)
        if self._opening is None:
            opening = buffer.rows(self.down_command - LEAD, opened)[:, 1:]
        else:
            opening = self._opening[: len(self._opening) + opened - (self.down_command + OPENING)]
        first = opened - len(opening)
        readings = np.concatenate([opening, buffer.rows(latest, until)[:, 1:]])
        up = up_command - first - (latest - opened)
        return readings, self.down_command - first, up, max(self.previous_end - first, 0)


class Live:
    """Follow the readings of a pad. Memory is bounded, however long it runs and a press is held.

    Args:
        localizer: of the pad.
        rate_hz: readings per second.
        fibres: number of fibres that are read; None for those of the localizer.
        health: of the pad; None to look for no faults.

    Attributes:
        presses: the latest estimate of each of the last presses, oldest first.
        track: estimates of the latest press at the last places that it has moved to, oldest first.
        faults: all faults so far, oldest first.
        is_other_pad: whether the latest presses are those of another pad; then no fibre is masked.

    Raises:
        InputError: a localizer that was fitted to arrays, or a model that `check_same_pad` refuses.
    """

    def __init__(
        self,
        localizer: Localizer | LocalizerModel,
        *,
        rate_hz: float,
        fibres: int | None = None,
        health: HealthModel | None = None,
    ) -> None:
        if isinstance(localizer, Localizer):
            localizer = localizer.model_
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
        self._response_v = np.where(response_v > 0, response_v, 1.0)  # that a press goes up to
        self._detector = PressDetector(fibres)
        self._frames, self._last_s = FrameStream(rate_hz, fibres), -np.inf  # time of the last reading
        self._buffer = RingBuffer(1 + fibres)  # times of frames, then volts
        self._press: BufferedPress | None = None
        self._n_presses = self._previous_end = 0
        self.presses: deque[Estimate] = deque(maxlen=MAX_SHOWN)
        self.track: deque[Estimate] = deque(maxlen=MAX_TRACK)
        self.faults: list[FibreFault] = []
        self._misfits: deque[Array] = deque(maxlen=MIN_PRESSES)  # of the latest presses, see `find_misfits`
        self.is_other_pad = False

    @property
    def pressed(self) -> bool:
        """Whether the pad is pressed now."""
        return self._press is not None and self._press.up_command is None

    @property
    def failed(self) -> tuple[int, ...]:
        """Indices of the fibres that are masked."""
        if self._monitor is None:
            return ()
        return self._monitor.model.dead if self.is_other_pad else self._monitor.failed

    def feed(self, times_s: ArrayLike, readings: ArrayLike) -> list[Event]:
        """Process readings. The events do not depend on how readings are cut into blocks.

        Args:
            times_s: of one reading, or of several, ascending; s, scalar or of shape (n,).
            readings: NaN where missing; V, shape (C,) or (n, C).

        Returns:
            Estimates and faults in the order in which they were made.

        Raises:
            InputError: arrays that `check_stream` refuses, or times that do not follow those of the last block.
        """
        events: list[Event] = []
        times, rows = check_stream(np.atleast_1d(times_s), np.atleast_2d(readings), len(self._response_v))
        if len(times) and not times[0] > self._last_s:
            raise InputError(f"times begin at {times[0]:g} s, expected later than those of the last readings")
        self._last_s = float(times[-1]) if len(times) else self._last_s
        for row in np.column_stack(self._frames.feed(times, rows)):
            self._buffer.append(row)
            for event in self._detector.update(row[:1], row[None, 1:]):
                if event.down:
                    events += self._begin(event.reading)
                elif self._press is not None:
                    command = self._buffer.command_index(event.reading, RELEASE_DELAY_S)
                    self._press.release(max(command, self._press.touched), self._buffer)
            events += self._advance()
        return events

    def view(self) -> dict[str, Any]:
        """Return the state of the pad as JSON.

        Returns:
            "pressed"; "fibres", for each its "swing" (deviation from its rest in units of its typical response, None
            without a reading) and "state"; "presses": `Estimate.to_dict` with "measures_text", "moment_text" and
            "text"; "track": places [x, y] of the latest press in mm, more than one if the finger has moved; "faults": a
            line each, and one of another pad.
        """
        swings, end = np.full(len(self._response_v), np.nan), self._buffer.end
        if end:
            baseline = self._buffer.baseline(end) if self._press is None else self._press.baseline[0]
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
            "track": [[place.x_mm, place.y_mm] for place in self.track],
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
        """Begin a press, after the press before has given all that is still to come of it."""
        touched = max(touched, self._buffer.end - SLACK)  # an unclear change may be seen to be a touch hours later
        down_command = self._buffer.command_index(touched, TOUCH_DELAY_S)
        if self._press is not None and self._press.up_command is not None:
            down_command = max(down_command, self._press.up_command + 1)
        events = self._advance(down_command)
        down_command = max(down_command, self._previous_end + 1)
        time_s = float(self._buffer.rows(touched, touched + 1)[0, 0])
        readings = interpolate_gaps(self._buffer.rows(down_command - HISTORY, self._buffer.end)[:, 1:])
        first = self._buffer.end - len(readings)
        down, previous_end = (np.array([max(index - first, 0)]) for index in (down_command, self._previous_end))
        baseline, history = mean_at_rest(readings, down, previous_end), compute_history(readings, down)
        self._press = BufferedPress(
            self._n_presses, time_s, touched, down_command, self._previous_end, baseline=baseline, history=history
        )
        self.track.clear()
        self._n_presses += 1
        return events

    def _advance(self, cut: int | None = None) -> list[Event]:
        """Return the events at the latest reading, or the last of a press that the next one cuts off at `cut`."""
        press, now = self._press, self._buffer.end
        if press is None:
            return []
        if cut is not None:
            now = max(cut, press.down_command + 1)
            if press.up_command is None:
                press.release(cut, self._buffer)
        press.store_opening(self._buffer)
        end = None if press.up_command is None else press.up_command + RELEASE
        is_complete = end is not None and (now >= end or cut is not None)
        until = now if end is None else min(now, end)
        events: list[Event] = []
        if is_complete or self._localizer.features == "windows":  # the published features are those of a whole press
            events.append(self._estimate(press, until, is_complete))
        if press.up_command is not None and is_complete:
            events += [*self._check_pad(press, until), *self._check_fibres(press, until)]
            self._previous_end, self._press = press.up_command, None
        return events

    def _estimate(self, press: BufferedPress, until: int, final: bool) -> Estimate:
        scaled = self._localizer.scaler.transform(self._features(press, until))
        fibre_mask = scaled.fibre_mask.copy()
        fibre_mask[:, list(self.failed)] = False
        result = self._localizer.localize(ScaledFeatures(scaled.inputs, fibre_mask, scaled.complete))
        numbers = np.concatenate([result.positions_mm[0], result.std_mm[0], result.r50_mm, result.r90_mm]).tolist()
        measures = {
            column: float(values[0])
            for name, measure in result.measures.items()
            for column, values in zip(MEASURE_COLUMNS[name], (measure.values, measure.r90), strict=True)
        }
        now_s = float(self._buffer.rows(until - 1, until)[0, 0])
        if press.up_command is None or until <= press.up_command:
            moment = "touch", until - press.touched, now_s - press.time_s
        else:
            moment = "lift", until - press.up_command, now_s - press.up_s
        failed = tuple(np.flatnonzero(~fibre_mask[0]).tolist())
        judged = {"failed": failed, "unlike": bool(result.unlike is not None and result.unlike[0])}
        estimate = Estimate(press.number, press.time_s, now_s, *moment, final, *numbers, **judged, **measures)
        self._show(estimate)
        return estimate

    def _features(self, press: BufferedPress, until: int) -> PressFeatures:
        """Return what `compute_features` would of all readings before `until`."""
        readings, down, up, previous_end = press.excerpt(self._buffer, until)
        if self._localizer.features == "published":
            downs, ups = [down], [up]
            if previous_end > 0:  # a stand-in for the press before: the rest of this one reaches back no further
                downs, ups = [previous_end - 1, down], [previous_end, up]
            return compute_features(readings, np.array(downs), np.array(ups), is_published=True)[-1:]
        moment = np.array([down]), np.array([up]), np.array([len(readings)])
        windows = windows_from_rest(interpolate_gaps(readings), press.baseline, *moment)
        return PressFeatures(windows, press.history, valid_fibres(readings, *moment), complete_windows(*moment))

    def _show(self, estimate: Estimate) -> None:
        """Show an estimate in place of the one before of the same press, and where the finger has moved."""
        if self.presses and self.presses[-1].press == estimate.press:
            self.presses.pop()
        self.presses.append(estimate)
        if self.track and not estimate.has_moved_from(self.track[-1]):
            if not estimate.is_sharper_than(self.track[-1]):
                return
            self.track.pop()  # the same place, better known
        self.track.append(estimate)

    def _check_pad(self, press: BufferedPress, end: int) -> list[OtherPad]:
        """Return whether a complete press makes the latest ones those of another pad."""
        scaled, was_other_pad = self._localizer.scaler.transform(self._features(press, end)), self.is_other_pad
        self._misfits.extend(find_misfits(self._localizer.single_press, scaled))
        self.is_other_pad = is_other_pad(self._localizer.single_press, np.array(self._misfits))
        return [OtherPad(press.number)] * (self.is_other_pad and not was_other_pad)

    def _check_fibres(self, press: BufferedPress, end: int) -> list[FibreFault]:
        """Return the faults that a complete press brings to light; of another pad, none."""
        if self._monitor is None:
            return []
        readings, down_command, up_command, previous_end = press.excerpt(self._buffer, end)
        first = max(down_command + REST[0], previous_end)
        faults = self._monitor.update(readings[first:], down_command - first, up_command - first)
        if self.is_other_pad:
            return []
        self.faults += faults
        return faults
