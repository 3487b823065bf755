"""The pipeline behind `padforge sense live`: from readings as they arrive to the position of each press.

Blocks of readings of any size go in; events come out: the position of a press, first from the few readings that one
localizer needs, refined by others that need more; and faulty fibres, which are masked from the next press on.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError, check_float, check_int, check_type, short_repr
from padforge.sense.arrays import MAX_FIBRES, MAX_RATE_HZ, MIN_RATE_HZ, Array, Mask, check_stream
from padforge.sense.health.fault_detector import FaultMonitor, FibreFault
from padforge.sense.health.health_model import HealthModel
from padforge.sense.health.trace_model import RELEASED
from padforge.sense.localizer.features import DOWN, FEATURES, REST, UP, compute_features
from padforge.sense.localizer.model import MEASURE_COLUMNS, LocalizerModel
from padforge.sense.localizer.model_files import check_same_pad
from padforge.sense.localizer.scaler import ScaledFeatures
from padforge.sense.rig.streams import HISTORY, RingBuffer
from padforge.sense.signals.press_detection import RELEASE_DELAY_S, TOUCH_DELAY_S, PressDetector

MAX_SHOWN = 12  # latest presses that are shown
OPENING = DOWN[-1][1]  # readings after `down_command` that features look at; until `up_command`, they look at no more
RELEASE = max(UP[-1][1], RELEASED)  # readings after `up_command` with which a press is complete


@dataclass(frozen=True)
class Estimate:
    """The position of a press, estimated by one localizer."""

    press: int  # index, from 0
    time_s: float  # of its touch, by the clock of the readings
    features: str  # of the localizer
    final: bool  # whether no other localizer will refine it
    x_mm: float
    y_mm: float
    std_x_mm: float
    std_y_mm: float
    r50_mm: float  # radius that holds the true position in 50 % of cases
    r90_mm: float
    failed: tuple[int, ...]  # indices of the fibres that were masked
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
    def text(self) -> str:
        return (
            f"press {self.press}: {self.x_mm:.1f}, {self.y_mm:.1f} mm, within {self.r50_mm:.1f} mm at 50 %, "
            f"{self.r90_mm:.1f} mm at 90 %{self.measures_text} ({self.features})"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON, without what was not learnt."""
        return {name: value for name, value in asdict(self).items() if value is not None}


Event = Estimate | FibreFault


@dataclass
class BufferedPress:
    """The press under way; indices are those of readings in the stream."""

    number: int  # of presses before it
    time_s: float  # when the pad was touched
    touched: int  # first reading that shows it
    down_command: int  # first reading after the probe was sent down, or would have been
    previous_end: int  # `up_command` of the press before, < `down_command`
    rest: Array  # (C,) V before it
    up_command: int | None = None  # first reading after the probe was sent up; None while it is held
    n_estimates: int = 0  # number of localizers that have estimated its position
    _opening: Array | None = None

    def release(self, up_command: int) -> None:
        """End the press, one reading after its begin at the earliest."""
        self.up_command = max(up_command, self.down_command + 1)

    def end_of(self, features: str) -> int | None:
        """Return the index after the last reading that `features` need; None while that is not known."""
        after_down, after_up = FEATURES[features].readings_needed
        if after_up:
            return None if self.up_command is None else self.up_command + after_up
        end = self.down_command + after_down
        return end if self.up_command is None else min(end, self.up_command)

    def store_opening(self, buffer: RingBuffer) -> None:
        """Copy the readings before it and its first ones once they have arrived: it may be held for hours."""
        if self._opening is None and self.up_command is None and buffer.end >= self.down_command + OPENING:
            self._opening = buffer.rows(self.down_command - HISTORY, self.down_command + OPENING)[:, 1:].copy()

    def excerpt(self, buffer: RingBuffer, end: int) -> tuple[Array, int, int, int]:
        """Return its readings before index `end`, without those in its middle that no features look at.

        And the indices in them of its commands, and of the end of the press before.
        """
        up_command = end if self.up_command is None else min(self.up_command, end)
        if self._opening is None or up_command <= self.down_command + OPENING:
            readings = buffer.rows(self.down_command - HISTORY, end)[:, 1:]
            down = len(readings) - (end - self.down_command)
            up = down + up_command - self.down_command
        else:
            readings = np.concatenate([self._opening, buffer.rows(up_command, end)[:, 1:]])
            up = len(self._opening)
            down = up - OPENING
        return readings, down, up, max(down - (self.down_command - self.previous_end), 0)


class Live:
    """Follow the readings of a pad. Memory is bounded, however long it runs and a press is held.

    Args:
        localizers: of the pad, at least one; the one that needs the fewest readings answers first.
        health: of the pad; None to look for no faults.
        fibres: number of fibres that are read.
        rate_hz: readings per second.

    Attributes:
        presses: the latest estimate of each of the last presses, oldest first.
        faults: all faults so far, oldest first.

    Raises:
        InputError: no localizer, or a model of a pad with other fibres or of another rate.
    """

    def __init__(
        self, localizers: Sequence[LocalizerModel], health: HealthModel | None, fibres: int, rate_hz: float
    ) -> None:
        fibres = check_int("fibres", fibres, 1, MAX_FIBRES)
        rate_hz = check_float("rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ)
        if not isinstance(localizers, Sequence) or not localizers:
            raise InputError(f"localizers are {short_repr(localizers)}, expected at least one")
        for model in localizers:
            check_same_pad(check_type("localizers", model, LocalizerModel), "the localizer", fibres, rate_hz)
        self._monitor = None if health is None else FaultMonitor(health)
        if health is not None:
            check_same_pad(health, "health", fibres, rate_hz)
        self._localizers = sorted(localizers, key=lambda model: FEATURES[model.features].readings_needed[::-1])
        scaler, n_windows = self._localizers[-1].scaler, FEATURES[self._localizers[-1].features].n_windows
        response_v = (np.abs(scaler.mean_v) + 2 * scaler.scale_v)[:, :n_windows].max(axis=1)
        self._response_v = np.where(response_v > 0, response_v, 1.0)  # that a press goes up to
        self._detector = PressDetector(fibres)
        self._buffer = RingBuffer(1 + fibres)  # times, then volts
        self._press: BufferedPress | None = None
        self._n_presses = self._previous_end = 0
        self.presses: deque[Estimate] = deque(maxlen=MAX_SHOWN)
        self.faults: list[FibreFault] = []

    @property
    def pressed(self) -> bool:
        """Whether the pad is pressed now."""
        return self._press is not None and self._press.up_command is None

    @property
    def failed(self) -> tuple[int, ...]:
        """Indices of the fibres that are masked."""
        return () if self._monitor is None else self._monitor.failed

    def feed(self, times_s: Array, readings: Array) -> list[Event]:
        """Process readings. The events do not depend on how readings are cut into blocks.

        Args:
            times_s: (n,) ascending, s.
            readings: (n, C) V, NaN where missing.

        Returns:
            Estimates and faults in the order in which they were made.

        Raises:
            InputError: arrays that `check_stream` refuses, or times that do not follow those of the last block.
        """
        events: list[Event] = []
        times, rows = check_stream(times_s, readings, len(self._response_v))
        end = self._buffer.end
        if len(times) and end and not times[0] > self._buffer.rows(end - 1, end)[0, 0]:
            raise InputError(f"times begin at {times[0]:g} s, expected later than those of the last readings")
        for row in np.column_stack([times, rows]):
            self._buffer.append(row)
            for event in self._detector.update(row[:1], row[None, 1:]):
                if event.down:
                    events += self._begin(event.reading)
                elif self._press is not None:
                    command = self._buffer.command_index(event.reading, RELEASE_DELAY_S)
                    self._press.release(max(command, self._press.touched))
            events += self._advance()
        return events

    def view(self) -> dict[str, Any]:
        """Return the state of the pad as JSON.

        Returns:
            "pressed"; "fibres", for each its "swing" (deviation from its rest in units of its typical response, None
            without a reading) and "state"; "presses": `Estimate.to_dict` with "measures_text" and "text"; "faults":
            a line each.
        """
        swings, end = np.full(len(self._response_v), np.nan), self._buffer.end
        if end:
            rest = self._buffer.rest(end) if self._press is None else self._press.rest
            swings = (self._buffer.rows(end - 1, end)[0, 1:] - rest) / self._response_v
        return {
            "pressed": self.pressed,
            "fibres": [
                {"swing": None if np.isnan(swing) else round(swing, 3), "state": state}
                for swing, state in zip(swings.tolist(), self._states(np.isnan(swings)), strict=True)
            ],
            "presses": [
                press.to_dict() | {"measures_text": press.measures_text, "text": press.text} for press in self.presses
            ],
            "faults": [fault.text for fault in self.faults],
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
        down_command = self._buffer.command_index(touched, TOUCH_DELAY_S)
        events = self._advance(down_command)
        down_command = max(down_command, self._previous_end + 1)
        time_s = float(self._buffer.rows(touched, touched + 1)[0, 0])
        rest = self._buffer.rest(down_command)
        self._press = BufferedPress(self._n_presses, time_s, touched, down_command, self._previous_end, rest)
        self._n_presses += 1
        return events

    def _advance(self, cut: int | None = None) -> list[Event]:
        """Return the events that the readings so far allow, or all of a press that the next one cuts off at `cut`."""
        press, now = self._press, self._buffer.end
        if press is None:
            return []
        if cut is not None:
            now = max(cut, press.down_command + 1)
            if press.up_command is None:
                press.release(cut)
        press.store_opening(self._buffer)
        events: list[Event] = []
        for localizer in self._localizers[press.n_estimates :]:
            end = press.end_of(localizer.features)
            if end is None or (end > now and cut is None):
                break
            press.n_estimates += 1
            events.append(self._estimate(press, localizer, min(end, now)))
        if press.up_command is not None and (now >= press.up_command + RELEASE or cut is not None):
            events += self._check_fibres(press, min(press.up_command + RELEASE, now))
            self._previous_end, self._press = press.up_command, None
        return events

    def _estimate(self, press: BufferedPress, localizer: LocalizerModel, end: int) -> Estimate:
        readings, down_command, up_command, previous_end = press.excerpt(self._buffer, end)
        downs, ups = [down_command], [up_command]
        if previous_end > 0:  # a stand-in for the press before, so that the rest of this one reaches back no further
            downs, ups = [previous_end - 1, *downs], [previous_end, *ups]
        features = compute_features(readings, np.array(downs), np.array(ups), localizer.features)[-1:]
        scaled = localizer.scaler.transform(features)
        fibre_mask = scaled.fibre_mask.copy()
        fibre_mask[:, list(self.failed)] = False
        result = localizer.predict_features(ScaledFeatures(scaled.inputs, fibre_mask))
        numbers = np.concatenate([result.positions_mm[0], result.std_mm[0], result.r50_mm, result.r90_mm]).tolist()
        measures = {
            column: float(values[0])
            for name, measure in result.measures.items()
            for column, values in zip(MEASURE_COLUMNS[name], (measure.values, measure.r90), strict=True)
        }
        final, failed = localizer is self._localizers[-1], tuple(np.flatnonzero(~fibre_mask[0]).tolist())
        estimate = Estimate(press.number, press.time_s, localizer.features, final, *numbers, failed=failed, **measures)
        if self.presses and self.presses[-1].press == press.number:
            self.presses.pop()
        self.presses.append(estimate)
        return estimate

    def _check_fibres(self, press: BufferedPress, end: int) -> list[FibreFault]:
        """Return the faults that a complete press brings to light."""
        if self._monitor is None:
            return []
        readings, down_command, up_command, previous_end = press.excerpt(self._buffer, end)
        first = max(down_command + REST[0], previous_end)
        faults = self._monitor.update(readings[first:], down_command - first, up_command - first)
        self.faults += faults
        return faults
