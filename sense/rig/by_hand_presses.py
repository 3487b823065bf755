"""Presses by hand: the state machine of what a person is asked to do, and the validation of each press by its readings.

States are the phases of `HandPhase`; times are those of readings, s.

    SETTLE --ready--> PRESS --touch--> HOLD --held for hold_s--> LIFT --release--> WAIT --ready--> PRESS ... DONE

A touch that comes in SETTLE, WAIT or DONE leads to LIFT at once and is rejected, as is a press that was held for too
short or too long a time, and one whose readings say that it was too weak or that the finger moved. Readings speak
against the press detector, too: one that takes a finger that slid for one that was lifted takes the lift for the next
touch, and so on. But a pad that nothing touches reads as it did untouched before.
"""

from collections import deque
from enum import StrEnum

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.localizer.features import REST

# In the published recording, with presses detected as here, one press in 370 is weaker than MIN_RESPONSE of the usual
# one, and one in 80 changes by more than MIN_COSINE while it is held.
MIN_RESPONSE = 0.15  # share of the usual response, all fibres together, below which a press tells too little
MIN_COSINE = 0.95  # of the responses early in a press and at its end, below which it was not at one position
MIN_PRESSES = 5  # accepted presses from which on the usual response is known
TOUCHED, UNTOUCHED = 0.5, 0.25  # distance from the baseline, share of the usual response: more, less than that
SINK_S, RELEASE_S = 0.4, 1.0  # a touch has sunk in; a release has ended but for slow creep

SETTLE_S = 2.0  # before the first press: the baseline and its noise are learnt from that
MIN_SHOWN_S = 0.6  # a press sooner after its target was shown was meant for the one before, or is its echo
MIN_HOLD, MAX_HOLD = 0.8, 4.0  # shares of the hold that a press has to last, and may: people lift early

Position = tuple[float, float]


class HandPhase(StrEnum):
    """What a person is asked to do."""

    SETTLE = "settle"  # keep hands off before the first press
    WAIT = "wait"  # until the pad has recovered
    PRESS = "press"
    HOLD = "hold"
    LIFT = "lift"
    DONE = "done"  # all presses are made


def press_responses(readings: Array, down_command: int, up_command: int) -> Array:
    """Return the responses (2, C) of a press early, once it has sunk in, and at its end.

    They are the differences from the baseline before it, V, 0 where missing; of readings (n, C), NaN where missing.
    """
    quarter = max((up_command - down_command) // 4, 1)
    early, last = down_command + quarter, up_command - 1  # the last reading may show the finger leave
    parts = (
        readings[max(down_command + REST[0], 0) : down_command],
        readings[early : early + quarter],
        readings[max(last - quarter, down_command) : last],
    )
    with np.errstate(invalid="ignore"):  # 0 / 0: no reading, NaN
        baseline, *held = (np.nansum(part, axis=0) / np.count_nonzero(~np.isnan(part), axis=0) for part in parts)
    return np.nan_to_num(np.array(held) - baseline)


class PressValidator:
    """Learns the usual response and the pad's baseline from accepted presses, and checks others by them."""

    def __init__(self) -> None:
        self._norms_v: list[float] = []
        self._baseline: Array | None = None

    def accept(self, responses: Array, baseline: Array) -> None:
        """Learn from a press with these `press_responses`, from a baseline (C,) V."""
        self._norms_v.append(float(np.linalg.norm(responses[1])))
        self._baseline = baseline

    def undo(self) -> None:
        """Forget the last accepted press."""
        self._norms_v.pop()

    def relative_response(self, volts: Array) -> float:
        """Return the norm of (C,) V as a share of the usual response; inf before that is known."""
        if len(self._norms_v) < MIN_PRESSES:
            return np.inf
        return float(np.linalg.norm(np.nan_to_num(volts)) / np.median(self._norms_v))

    def rejection(self, responses: Array) -> str:
        """Return why a press with these `press_responses` is rejected, or ""."""
        if self.relative_response(responses[1]) < MIN_RESPONSE:
            return "it was much weaker than the others, press deeper"
        early, end = np.linalg.norm(responses, axis=1)
        if responses[0] @ responses[1] < MIN_COSINE * early * end:
            return "it changed while it was held, press one place with one finger"
        return ""

    def is_untouched(self, volts: Array, before: Array, held_s: float) -> bool:
        """Return whether nothing touches a pad that the detector has touched.

        Either the readings (C,) are as before the touch: that was none, or its end was missed. Or they are back at the
        baseline: that was the end of a press that the detector had ended too soon.
        """
        if held_s > RELEASE_S and self.relative_response(volts - before) < MIN_RESPONSE:
            return True
        if held_s < SINK_S or self._baseline is None:
            return False
        was_touched = TOUCHED < self.relative_response(before - self._baseline) < np.inf
        return was_touched and self.relative_response(volts - self._baseline) < UNTOUCHED

    def is_touched(self, volts: Array) -> bool | None:
        """Return whether something touches a pad with readings (C,) V, whatever was detected; None if that is unclear.

        If nothing does, these are the baseline from now on: it drifts.
        """
        share = np.inf if self._baseline is None else self.relative_response(volts - self._baseline)
        if share < UNTOUCHED:
            self._baseline = volts
            return False
        return True if TOUCHED < share < np.inf else None

    def reset_baseline(self) -> None:
        """Learn the baseline anew, from the next accepted press: nothing touches the pad, whatever it reads."""
        self._baseline = None


class PressSequence:
    """Targets (Q, 2) to press one after the other, each asked for until a press of it is accepted.

    A press is to be held for `hold_s`, and the pad to be left alone for as long after it.
    """

    def __init__(self, targets_mm: Array, hold_s: float, now_s: float) -> None:
        self.remaining: deque[Position] = deque((x, y) for x, y in targets_mm.tolist())
        self.hold_s, self.accepted_mm = hold_s, list[Position]()
        self._since_s, self._ready_s, self._is_settling = now_s, now_s + SETTLE_S, True
        self._touched_s: float | None = None
        self._rejection = ""  # of the press under way

    @property
    def target(self) -> Position | None:
        """The position to press; None when all are done."""
        return self.remaining[0] if self.remaining else None

    @property
    def is_pressed(self) -> bool:
        """Whether the pad is pressed."""
        return self._touched_s is not None

    def held_s(self, now_s: float) -> float:
        """Return for how long the pad has been pressed; 0 if it is not."""
        return 0.0 if self._touched_s is None else now_s - self._touched_s

    def phase(self, now_s: float) -> HandPhase:
        """Return the state at a time."""
        if self.is_pressed:
            is_over = self._rejection or self.held_s(now_s) >= self.hold_s
            return HandPhase.LIFT if is_over else HandPhase.HOLD
        if now_s < self._ready_s:
            return HandPhase.SETTLE if self._is_settling else HandPhase.WAIT
        return HandPhase.PRESS if self.remaining else HandPhase.DONE

    def progress(self, now_s: float) -> float:
        """Return how far the wait or the hold has gone, 0 to 1."""
        waited = (now_s - self._since_s) / (self._ready_s - self._since_s)
        return min(max(self.held_s(now_s) / self.hold_s if self.is_pressed else waited, 0.0), 1.0)

    def touch(self, time_s: float) -> Position | None:
        """Note a touch; return the target it was meant for, None if none was asked for."""
        self._touched_s = time_s
        self._rejection = "" if self.remaining and time_s >= self._ready_s else "it came before it was asked for"
        return None if self._rejection else self.remaining[0]

    def release(self, time_s: float) -> str:
        """Note a release; return why the press is rejected, or ""."""
        held_s, rejection = self.held_s(time_s), self._rejection
        if not rejection and held_s < MIN_HOLD * self.hold_s:
            rejection = f"it was held for {held_s:.1f} s, hold it for {self.hold_s:.1f} s"
        elif not rejection and held_s > MAX_HOLD * self.hold_s:
            rejection = f"it was held for {held_s:.1f} s, lift after {self.hold_s:.1f} s"
        self._touched_s, self._is_settling = None, False
        self.wait(time_s)
        return rejection

    def wait(self, now_s: float) -> None:
        """Wait until the pad, which is released now, has recovered."""
        self._wait_until(now_s, now_s + self.hold_s)

    def accept(self, now_s: float) -> None:
        """Accept the press released last, and go on to the next target."""
        self.accepted_mm.append(self.remaining.popleft())
        self._wait_until(now_s, self._ready_s)

    def skip(self, now_s: float) -> None:
        """Leave the target out, and reject the press under way, if any."""
        self.reject("its place was skipped")
        if self.remaining:
            self.remaining.popleft()
        self._wait_until(now_s, self._ready_s)

    def undo(self, now_s: float) -> bool:
        """Ask again for the press under way, or for the one accepted last; return whether it was that."""
        if self.is_pressed or not self.accepted_mm:
            self.reject("it was taken back")
            return False
        self.remaining.appendleft(self.accepted_mm.pop())
        self._wait_until(now_s, self._ready_s)
        return True

    def reject(self, reason: str) -> None:
        """Reject the press under way, if any; the first reason counts."""
        self._rejection = self._rejection or reason if self.is_pressed else ""

    def _wait_until(self, now_s: float, until_s: float) -> None:
        """Wait until a time, and at least until the target can have been seen."""
        self._since_s, self._ready_s = now_s, max(until_s, now_s + MIN_SHOWN_S)
