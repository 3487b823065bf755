"""From readings as they come to places as they are pressed: the pipeline behind `padforge sense live`.

Readings go in, in blocks of any size. Out comes what they bring to light: where each press was, first from the few
readings that one localizer can do with, refined by others, and which fibres are bad. Those are left out from the next
press on."""

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError, check_float, check_int, check_type, short_repr
from padforge.sense.arrays import MAX_FIBRES, MAX_RATE_HZ, MIN_RATE_HZ, Array, Mask, stream_of
from padforge.sense.health.fault_detector import FaultDetector, FibreFault
from padforge.sense.health.health_model import HealthModel
from padforge.sense.localizer.features import FEATURES, REST, compute_features, interpolate_gaps
from padforge.sense.localizer.model import MEASURE_COLUMNS, LocalizerModel
from padforge.sense.localizer.model_files import check_same_pad
from padforge.sense.localizer.scaler import ScaledFeatures
from padforge.sense.rig.streams import DONE, NEEDS, BufferedPress, Ring
from padforge.sense.signals.press_detection import SENT_DOWN_S, SENT_UP_S, PressDetector

TRAIL = 12
"""Presses that are kept to be shown."""


@dataclass(frozen=True)
class Estimate:
    """Where a press was, by one localizer.

    Attributes:
        press: its number, counted from 0. time_s: of its touch, by the clock of the readings.
        features: which the localizer takes. final: whether no other localizer will refine it.
        x_mm, y_mm: place. sd_x_mm, sd_y_mm: standard deviations.
        r50_mm, r90_mm: radius around the place that holds the press in 50 % and in 90 % of cases.
        lost: fibres that were left out, by index.
        depth_mm, force_n: how deep and hard it was, where that was learnt. depth_r90_mm, force_r90_n: how far beside
            them 90 % of presses are at most.
    """

    press: int
    time_s: float
    features: str
    final: bool
    x_mm: float
    y_mm: float
    sd_x_mm: float
    sd_y_mm: float
    r50_mm: float
    r90_mm: float
    lost: tuple[int, ...]
    depth_mm: float | None = None
    depth_r90_mm: float | None = None
    force_n: float | None = None
    force_r90_n: float | None = None

    @property
    def measured(self) -> str:
        """Depth and force, as far as they were learnt."""
        depth = "" if self.depth_mm is None else f", {self.depth_mm:.1f} ± {self.depth_r90_mm:.1f} mm deep"
        return depth + ("" if self.force_n is None else f", {self.force_n:.1f} ± {self.force_r90_n:.1f} N")

    @property
    def text(self) -> str:
        """One line."""
        return (
            f"press {self.press}: {self.x_mm:.1f}, {self.y_mm:.1f} mm, "
            f"within {self.r50_mm:.1f} mm at 50 %, {self.r90_mm:.1f} mm at 90 %{self.measured} ({self.features})"
        )

    @property
    def document(self) -> dict[str, Any]:
        """As JSON, without what was not learnt."""
        return {name: value for name, value in asdict(self).items() if value is not None}


Event = Estimate | FibreFault


class Live:
    """Follows the readings of a pad. Memory is bounded, however long it runs and a press is held.

    Attributes:
        presses: the latest estimates, one for each of the last `TRAIL` presses, oldest first.
        findings: all that was found of the fibres, oldest first.
    """

    def __init__(
        self, localizers: Sequence[LocalizerModel], health: HealthModel | None, fibres: int, rate_hz: float
    ) -> None:
        """Get ready for readings of so many fibres, `rate_hz` a second.

        Args:
            localizers: of that pad, at least one; the one that needs the fewest readings answers first.
            health: of that pad; without it no fibre is found bad.

        Raises:
            InputError: there is none, or one was learnt from other fibres, or at another rate.
        """
        fibres, rate_hz = (
            check_int("fibres", fibres, 1, MAX_FIBRES),
            check_float("rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ),
        )
        if not isinstance(localizers, Sequence) or not localizers:
            raise InputError(f"localizers are {short_repr(localizers)}, expected at least one")
        self._monitor = None if health is None else FaultDetector(health)
        models = [check_type("localizers", each, LocalizerModel) for each in localizers]
        for model in models:
            check_same_pad(model, "the localizer", fibres, rate_hz)
        if health is not None:
            check_same_pad(health, "health", fibres, rate_hz)
        self._localizers = sorted(localizers, key=lambda each: NEEDS[each.features][::-1])
        self._usual = _usual(self._localizers[-1])
        self._finder = PressDetector(fibres)
        self._ring = Ring(1 + fibres)
        self._press: BufferedPress | None = None
        self._count = self._free = 0
        self.presses: deque[Estimate] = deque(maxlen=TRAIL)
        self.findings: list[FibreFault] = []

    @property
    def pressed(self) -> bool:
        """Whether the pad is pressed now."""
        return self._press is not None and self._press.up_command is None

    @property
    def lost(self) -> tuple[int, ...]:
        """Fibres that are left out, by index."""
        return () if self._monitor is None else self._monitor.lost

    def feed(self, times_s: Array, readings: Array) -> list[Event]:
        """Take readings; what they bring to light does not depend on how they are cut into blocks.

        Args:
            times_s: (n,) ascending, s. readings: (n, C) volts, NaN where missing.

        Returns:
            Estimates and findings, in the order in which they were made.

        Raises:
            InputError: as `limits.stream_of`, or times before those that were fed last.
        """
        events: list[Event] = []
        times, rows = stream_of(times_s, readings, len(self._usual))
        if len(times) and self._ring.end and not times[0] > self._ring.rows(self._ring.end - 1, self._ring.end)[0, 0]:
            raise InputError(f"times begin at {times[0]:g} s, expected later than those of the last readings")
        for row in np.column_stack([times, rows]):
            self._ring.append(row)
            for change in self._finder.feed(row[:1], row[None, 1:]):
                if change.down:
                    events += self._begin(change.reading)
                elif self._press is not None:
                    self._press.let_go(max(self._ring.sent(change.reading, SENT_UP_S), self._press.touched))
            events += self._advance()
        return events

    def view(self) -> dict[str, Any]:
        """What there is to show now, as JSON.

        Returns:
            "pressed"; "fibres", for each its "swing" (from its rest, as a share of the usual; None where there is no
            reading) and "state"; "presses", see `Estimate.document`, "measured" and "text"; "findings", a line each.
        """
        swings = self._swings()
        states = self._states(np.isnan(swings))
        return {
            "pressed": self.pressed,
            "fibres": [
                {"swing": None if np.isnan(swing) else round(swing, 3), "state": state}
                for swing, state in zip(swings.tolist(), states, strict=True)
            ],
            "presses": [press.document | {"measured": press.measured, "text": press.text} for press in self.presses],
            "findings": [finding.text for finding in self.findings],
        }

    def _swings(self) -> Array:
        """(C,) how far each fibre is from its rest, as a share of the usual; NaN where there is no reading."""
        end = self._ring.end
        if end == 0:
            return np.full(len(self._usual), np.nan)
        rest = self._rest(end) if self._press is None else self._press.rest
        return (self._ring.rows(end - 1, end)[0, 1:] - rest) / self._usual

    def _states(self, missing: Mask) -> list[str]:
        kinds = {fibre: finding.kind for finding in self.findings for fibre in finding.fibres}
        usual = "unwatched" if self._monitor is None else "sound"
        return [
            kinds.get(fibre, "dead") if fibre in self.lost else "missing" if gone else usual
            for fibre, gone in enumerate(missing)
        ]

    def _rest(self, at: int) -> Array:
        """(C,) V, mean of the readings just before index `at`."""
        return interpolate_gaps(self._ring.rows(at + REST[0], at)[:, 1:]).mean(axis=0)

    def _begin(self, touched: int) -> list[Event]:
        """The pad is touched; what was still to come of the press before comes now."""
        down_command = self._ring.sent(touched, SENT_DOWN_S)
        events = self._advance(down_command)
        down_command = max(down_command, self._free + 1)
        time_s = float(self._ring.rows(touched, touched + 1)[0, 0])
        self._press = BufferedPress(self._count, time_s, touched, down_command, self._free, self._rest(down_command))
        self._count += 1
        return events

    def _advance(self, over: int | None = None) -> list[Event]:
        """Do with the press under way what the readings allow, or all there is to do if it was over at index `over`."""
        press, now = self._press, self._ring.end
        if press is None:
            return []
        if over is not None:
            now = max(over, press.down_command + 1)
            if press.up_command is None:
                press.let_go(over)
        press.keep_opening(self._ring)
        events: list[Event] = []
        for localizer in self._localizers[press.told :]:
            enough = press.enough(localizer.features)
            if enough is None or (enough > now and over is None):
                break
            press.told += 1
            events.append(self._estimate(press, localizer, min(enough, now)))
        if press.up_command is not None and (now >= press.up_command + DONE or over is not None):
            events += self._judge(press, min(press.up_command + DONE, now))
            self._free, self._press = press.up_command, None
        return events

    def _estimate(self, press: BufferedPress, localizer: LocalizerModel, end: int) -> Estimate:
        readings, down_command, up_command, free = press.excerpt(self._ring, end)
        # The press before stands in by its end alone: the rest of this one reaches back no further.
        begins, ends = ([free - 1, down_command], [free, up_command]) if free > 0 else ([down_command], [up_command])
        raw = compute_features(readings, np.array(begins), np.array(ends), localizer.features)[-1:]
        presses = localizer.scaler.transform(raw)
        fibre_mask = presses.fibre_mask.copy()
        fibre_mask[:, list(self.lost)] = False
        found = localizer.predict_features(ScaledFeatures(presses.inputs, fibre_mask))
        numbers = np.concatenate([found.positions_mm[0], found.std_mm[0], found.r50_mm, found.r90_mm]).tolist()
        final, lost = localizer is self._localizers[-1], tuple(np.flatnonzero(~fibre_mask[0]).tolist())
        measured = {
            column: float(values[0])
            for name, each in found.measures.items()
            for column, values in zip(MEASURE_COLUMNS[name], (each.values, each.r90), strict=True)
        }
        estimate = Estimate(press.number, press.time_s, localizer.features, final, *numbers, lost=lost, **measured)
        if self.presses and self.presses[-1].press == press.number:
            self.presses.pop()
        self.presses.append(estimate)
        return estimate

    def _judge(self, press: BufferedPress, end: int) -> list[FibreFault]:
        """What a press that is over says of the fibres."""
        if self._monitor is None:
            return []
        readings, down_command, up_command, free = press.excerpt(self._ring, end)
        first = max(down_command + REST[0], free)
        findings = self._monitor.update(readings[first:], down_command - first, up_command - first)
        self.findings += findings
        return findings


def _usual(localizer: LocalizerModel) -> Array:
    """(C,) V, what a fibre's answer to a press goes up to."""
    scaling, windows = localizer.scaler, FEATURES[localizer.features].n_windows
    usual = (np.abs(scaling.mean_v) + 2 * scaling.scale_v)[:, :windows].max(axis=1)
    return np.where(usual > 0, usual, 1.0)
