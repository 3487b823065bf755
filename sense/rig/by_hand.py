"""Recording by hand: a person is asked to press targets, and the presses are detected in the readings.

A rejected press is recorded at an unknown position, since it influences the readings of the next presses. The view of a
session is JSON, for the page (`live/pages/hand.html`), and a few lines of text for the terminal.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.paths.curves import flatten
from padforge.sense.arrays import Array
from padforge.sense.localizer.features import REST, interpolate_gaps
from padforge.sense.recording.press_plan import fit_pad_settings, make_plan, pressable_test
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import JOURNAL, Recorder, check_new_recording, read_journal
from padforge.sense.rig.config import RigConfig, open_recorder, read_source
from padforge.sense.rig.devices import Board, RigFault
from padforge.sense.rig.streams import HISTORY, SLACK, RingBuffer, stream_board
from padforge.sense.signals.press_detection import RELEASE_DELAY_S, TOUCH_DELAY_S, PressDetector

KIND = "hand"  # kind of source of a recording by hand, whose depths are unknown
# A uniform plan is ordered by short distances within rounds of this many targets. Each round covers the whole pad, so
# that a session may end early, and drift with time is not confused with position.
ROUND = 25
UNKNOWN = (np.nan, np.nan)  # position of a rejected press
COMMANDS = (
    {"key": "b", "command": "back", "text": "Take the last press back"},
    {"key": "s", "command": "skip", "text": "Skip this place"},
    {"key": "f", "command": "free", "text": "Nothing touches the pad"},
    {"key": "q", "command": "quit", "text": "End"},
)
"""Commands of a person, by a key or a button."""
BAR = 30  # characters of the progress bar

# In the published recording, with the same detection, one press in 370 has a response below MIN_RESPONSE, and one in
# 80 a cosine below MIN_COSINE. Responses are relative to the median norm of the responses of accepted presses.
MIN_RESPONSE = 0.15  # relative response below which a press is too weak
MIN_COSINE = 0.95  # between the responses early and late in a press, below which the finger moved
MIN_PRESSES = 5  # accepted presses after which relative responses are defined
TOUCHED = 0.5  # relative deviation from the baseline above which the pad is touched
UNTOUCHED = 0.25  # relative deviation below which it is not
SINK_S = 0.4  # time after a touch when the finger has reached its depth
RELEASE_S = 1.0  # time after a release when the pad has recovered, except for slow creep

SETTLE_S = 2.0  # time before the first press, in which baseline and noise are measured
MIN_SHOWN_S = 0.6  # a touch sooner after a target is shown was meant for the previous one, or is the echo of it
MIN_HOLD = 0.8  # minimum duration of a press, relative to `hold_s`, since people lift early
MAX_HOLD = 4.0  # maximum duration of a press, relative to `hold_s`

Position = tuple[float, float]
OnView = Callable[[dict[str, Any]], None]
PollCommands = Callable[[], Sequence[str]]


def plan_targets(config: RigConfig) -> Array:
    """Return the targets (Q, 2) of `[rig]`, mm: a grid or a file in its order, or uniform ones ordered in rounds.

    Uniform targets are rounded to millimetres, which a person finds on squared paper.
    """
    rig = config.rig
    if rig.plan == "adaptive":
        raise InputError("[rig] plan is adaptive, by hand allowed are uniform, grid, serpentine or a .csv of positions")
    positions_mm = make_plan(config.pad, rig, np.random.default_rng(rig.seed), config.pad_settings).positions_mm
    if rig.plan != "uniform":
        return positions_mm
    rounded_mm = np.rint(positions_mm)
    free = pressable_test(config.pad, fit_pad_settings(config.pad, config.pad_settings))(rounded_mm)
    return _order_in_rounds(np.where(free[:, None], rounded_mm, positions_mm))


def _order_in_rounds(positions_mm: Array) -> Array:
    """Order positions (Q, 2) by nearest neighbour in rounds of `ROUND`; a round starts where the previous one ended."""
    ordered = np.empty_like(positions_mm)
    position = positions_mm[0]
    for first in range(0, len(positions_mm), ROUND):
        remaining = positions_mm[first : first + ROUND]
        for row in range(first, first + len(remaining)):
            nearest = int(np.argmin(np.linalg.norm(remaining - position, axis=1)))
            position = ordered[row] = remaining[nearest]
            remaining = np.delete(remaining, nearest, axis=0)
    return ordered


def open_recorder_by_hand(config: RigConfig, board: Mapping[str, Any], resume: bool) -> tuple[Recorder, Array, Array]:
    """Return the recorder, new or resumed, the targets (Q, 2) of its plan, and the remaining targets (P, 2), mm."""
    targets_mm = np.array(read_source(config, KIND)["plan"]["presses"], np.float64) if resume else plan_targets(config)
    recorder = open_recorder(config, targets_mm.tolist(), config.out, resume, {"board": board}, KIND)
    remaining = targets_mm.tolist()
    for press in read_journal(config.out / JOURNAL).values() if resume else ():
        if list(press[:2]) in remaining:
            remaining.remove(list(press[:2]))
    return recorder, targets_mm, np.array(remaining).reshape(-1, 2)


HandPhase = Literal["settle", "wait", "press", "hold", "lift", "done"]
"""State of a session: what the person is asked to do.

settle --ready--> press --touch--> hold --held for hold_s--> lift --release--> wait --ready--> press ... done

The hands are off the pad in "settle", before the first press, and in "wait", while the pad recovers. A touch in these,
or in "done", leads to "lift" and is rejected. Presses that were held for too short or too long, were too weak, or
moved are rejected as well.
"""


def press_responses(readings: Array, down_command: int, up_command: int) -> Array:
    """Return the mean responses (2, C) of a press in the second and in the last quarter of its hold, V; 0 if missing.

    They are relative to the baseline before the press, in the readings (n, C), V, NaN where missing.
    """
    quarter = max((up_command - down_command) // 4, 1)
    early, last = down_command + quarter, up_command - 1  # the last reading may show the release
    windows = (
        readings[max(down_command + REST[0], 0) : down_command],
        readings[early : early + quarter],
        readings[max(last - quarter, down_command) : last],
    )
    with np.errstate(invalid="ignore"):  # 0 / 0 = NaN without readings
        baseline, *held = (np.nansum(rows, axis=0) / np.count_nonzero(~np.isnan(rows), axis=0) for rows in windows)
    return np.nan_to_num(np.array(held) - baseline)


class PressValidator:
    """Checks presses, and the press detector, against the responses and the baseline of accepted presses.

    A detector that mistakes a sliding finger for a release takes the real release for the next touch, and so on. The
    baseline reveals this: the readings of an untouched pad return to it.
    """

    def __init__(self) -> None:
        self._norms_v: list[float] = []  # of the late responses of accepted presses
        self._baseline: Array | None = None

    def accept(self, responses: Array, baseline: Array) -> None:
        """Add an accepted press with these `press_responses` from a baseline (C,), V."""
        self._norms_v.append(float(np.linalg.norm(responses[1])))
        self._baseline = baseline

    def undo(self) -> None:
        """Forget the last accepted press."""
        self._norms_v.pop()

    def relative_response(self, volts: Array) -> float:
        """Return the norm of a response (C,), V, over the median of accepted presses; inf before `MIN_PRESSES`."""
        if len(self._norms_v) < MIN_PRESSES:
            return np.inf
        return float(np.linalg.norm(np.nan_to_num(volts)) / np.median(self._norms_v))

    def rejection(self, responses: Array) -> str:
        """Return why a press with these `press_responses` is rejected, or ""."""
        early, late = responses
        if self.relative_response(late) < MIN_RESPONSE:
            return "it was much weaker than the others, press deeper"
        if early @ late < MIN_COSINE * np.linalg.norm(early) * np.linalg.norm(late):
            return "it changed while it was held, press one place with one finger"
        return ""

    def is_untouched(self, volts: Array, before: Array, held_s: float) -> bool:
        """Return whether nothing touches the pad although a touch was detected, by readings (C,) now and before it."""
        # 1. The readings equal those before the touch: it was a false detection, or the release was missed.
        if held_s > RELEASE_S and self.relative_response(volts - before) < MIN_RESPONSE:
            return True
        # 2. They are back at the baseline, and were not before: the touch was the release of an earlier press.
        if held_s < SINK_S or self._baseline is None:
            return False
        was_touched = TOUCHED < self.relative_response(before - self._baseline) < np.inf
        return was_touched and self.relative_response(volts - self._baseline) < UNTOUCHED

    def is_touched(self, volts: Array) -> bool | None:
        """Return whether the pad is touched, from its readings (C,), V, alone; None if that is unclear.

        The readings of an untouched pad become the baseline, which drifts.
        """
        deviation = np.inf if self._baseline is None else self.relative_response(volts - self._baseline)
        if deviation < UNTOUCHED:
            self._baseline = volts
            return False
        return True if TOUCHED < deviation < np.inf else None

    def reset_baseline(self) -> None:
        """Forget the baseline until the next accepted press."""
        self._baseline = None


class PressSequence:
    """Targets (Q, 2) to press one after the other, each until a press of it is accepted.

    A press is to be held for `hold_s`, and the pad is to recover from it for the same time.
    """

    def __init__(self, targets_mm: Array, hold_s: float, now_s: float) -> None:
        self.remaining: deque[Position] = deque((x, y) for x, y in targets_mm.tolist())
        self.hold_s, self.accepted_mm = hold_s, list[Position]()
        self._since_s, self._ready_s, self._is_settling = now_s, now_s + SETTLE_S, True
        self._touched_s: float | None = None
        self._rejection = ""  # why the current press is rejected

    @property
    def target(self) -> Position | None:
        """The position to press; None after the last one."""
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
            return "lift" if is_over else "hold"
        if now_s < self._ready_s:
            return "settle" if self._is_settling else "wait"
        return "press" if self.remaining else "done"

    def progress(self, now_s: float) -> float:
        """Return the elapsed fraction of the wait or the hold, 0 to 1."""
        waited = (now_s - self._since_s) / (self._ready_s - self._since_s)
        return min(max(self.held_s(now_s) / self.hold_s if self.is_pressed else waited, 0.0), 1.0)

    def touch(self, time_s: float) -> Position | None:
        """Begin a press; return its target, None if none was requested."""
        self._touched_s = time_s
        self._rejection = "" if self.remaining and time_s >= self._ready_s else "it came before it was asked for"
        return None if self._rejection else self.remaining[0]

    def release(self, time_s: float) -> str:
        """End a press; return why it is rejected, or ""."""
        held_s, rejection = self.held_s(time_s), self._rejection
        if not rejection and held_s < MIN_HOLD * self.hold_s:
            rejection = f"it was held for {held_s:.1f} s, hold it for {self.hold_s:.1f} s"
        elif not rejection and held_s > MAX_HOLD * self.hold_s:
            rejection = f"it was held for {held_s:.1f} s, lift after {self.hold_s:.1f} s"
        self._touched_s, self._is_settling = None, False
        self.wait(time_s)
        return rejection

    def wait(self, now_s: float) -> None:
        """Wait for the pad, released now, to recover."""
        self._wait_until(now_s, now_s + self.hold_s)

    def accept(self, now_s: float) -> None:
        """Accept the last press, and continue with the next target."""
        self.accepted_mm.append(self.remaining.popleft())
        self._wait_until(now_s, self._ready_s)

    def skip(self, now_s: float) -> None:
        """Skip the target, and reject the current press, if any."""
        self.reject("its place was skipped")
        if self.remaining:
            self.remaining.popleft()
        self._wait_until(now_s, self._ready_s)

    def undo(self, now_s: float) -> bool:
        """Reject the current press, or else withdraw the last accepted one; return whether the latter was done."""
        if self.is_pressed or not self.accepted_mm:
            self.reject("it was taken back")
            return False
        self.remaining.appendleft(self.accepted_mm.pop())
        self._wait_until(now_s, self._ready_s)
        return True

    def reject(self, reason: str) -> None:
        """Reject the current press, if any; the first reason is reported."""
        self._rejection = self._rejection or reason if self.is_pressed else ""

    def _wait_until(self, now_s: float, until_s: float) -> None:
        """Wait until a time, but at least until the person has seen the target."""
        self._since_s, self._ready_s = now_s, max(until_s, now_s + MIN_SHOWN_S)


class HandSession:
    """A session of recording by hand, of targets (Q, 2) in their order, after `n_done` presses of earlier sessions."""

    def __init__(self, recorder: Recorder, targets_mm: Array, hold_s: float, n_done: int = 0) -> None:
        self._recorder, self._n_done = recorder, n_done
        # Times begin at 0, or 1 s after the last reading of a resumed recording.
        self._start_s = max(recorder.last_s + 1, 0.0)
        self._zero_s: float | None = None
        self._first = recorder.n_readings  # index in the recording of reading 0 of the session
        self._number = max(recorder.done, default=-1) + 1
        self._sequence = PressSequence(targets_mm, hold_s, self._start_s)
        self._ring, self._now_s = RingBuffer(1 + recorder.fibres), self._start_s
        self._detector: PressDetector | None = PressDetector(recorder.fibres)  # None during a touch that it missed
        self._detector_start, self._validator = 0, PressValidator()
        self._touched = self._down_command = self._released = 0
        self._released_s = self._start_s
        self._baseline = np.zeros(recorder.fibres)  # before the current press
        self._accepted: list[tuple[int, int, int]] = []  # number, down and up command in the recording
        self._max_response_v = 1e-3
        self._message, self._rejected_mm = "", None

    def run(self, blocks: Iterable[tuple[Array, Array]], on_view: OnView, poll_commands: PollCommands) -> None:
        """Record blocks of times (n,), s, and readings (n, C), V, until all presses are made or the command is quit."""
        try:
            for times_s, readings in blocks:
                for command in poll_commands():
                    if command == "quit":
                        return
                    self._execute(command)
                if len(times_s):
                    self.feed(times_s, readings)
                    on_view(self.view())
                if self._phase() == "done":
                    return
        except OSError as error:
            raise RigFault("disk", f"the recording cannot be written ({error.strerror or error})") from error
        finally:
            self._recorder.abort("the session ended")

    def feed(self, times_s: Array, readings: Array) -> None:
        """Record readings (n, C), V, at times (n,), s, and handle the touches and releases in them."""
        if self._zero_s is None:
            self._zero_s = float(times_s[0]) - self._start_s
        times_s = times_s - self._zero_s
        self._recorder.append(times_s, readings)
        for row in np.column_stack([times_s, readings]):
            self._ring.append(row)
            self._now_s = float(row[0])
            for event in self._detector.update(row[:1], row[None, 1:]) if self._detector else ():
                reading = self._detector_start + event.reading
                self._touch(reading) if event.down else self._release(reading)
        self._check_detector()

    def _touch(self, touched: int) -> None:
        target = self._sequence.touch(self._time_s(touched))
        self._touched = touched
        self._down_command = max(self._ring.command_index(touched, TOUCH_DELAY_S), self._released + 1)
        self._baseline = self._ring.baseline(self._down_command)
        self._rejected_mm = None
        self._recorder.begin(target or UNKNOWN, self._first + self._down_command, self._number)
        self._recorder.sync()

    def _release(self, released: int) -> None:
        up_command = max(self._ring.command_index(released, RELEASE_DELAY_S), self._touched + 1, self._down_command + 1)
        target, rejection = self._sequence.target, self._sequence.release(self._time_s(released))
        # A press whose beginning has left the ring buffer is judged by its end.
        first = max(self._down_command + REST[0], self._released, self._ring.end - HISTORY - SLACK)
        readings = self._ring.rows(first, self._ring.end)[:, 1:]
        responses = press_responses(readings, max(self._down_command - first, 1), up_command - first)
        rejection = rejection or self._validator.rejection(responses)
        indices = self._first + self._down_command, self._first + up_command
        if rejection:
            self._record_rejected(self._number, *indices, rejection)
            self._message, self._rejected_mm = f"not counted: {rejection}", target
        else:
            self._recorder.finish(self._first + up_command)
            self._accepted.append((self._number, *indices))
            self._validator.accept(responses, self._baseline)
            self._max_response_v = max(self._max_response_v, float(np.abs(responses).max()))
            self._sequence.accept(self._now_s)
            self._message = f"counted: {_position_text(target)}"
        self._recorder.sync()
        self._number, self._released, self._released_s = self._number + 1, up_command, self._now_s

    def _record_rejected(self, press: int, down_command: int, up_command: int, reason: str) -> None:
        self._recorder.begin(UNKNOWN, down_command, press)
        self._recorder.finish(up_command, rejected=reason)

    def _execute(self, command: str) -> None:
        if command == "skip":
            self._sequence.skip(self._now_s)
        elif command == "back":
            if self._sequence.undo(self._now_s):
                self._record_rejected(*self._accepted.pop(), "it was taken back")
                self._recorder.sync()
                self._validator.undo()
                self._message = "the last press was taken back"
        elif command == "free":
            self._validator.reset_baseline()
            self._restart_detector()

    def _check_detector(self) -> None:
        """Restart the detector if the readings contradict it."""
        rows = self._ring.rows(max(self._ring.end - HISTORY, 0), self._ring.end)
        latest = rows[np.searchsorted(rows[:, 0], self._now_s - SINK_S) :, 1:]
        volts = interpolate_gaps(latest).mean(axis=0)
        if self._sequence.is_pressed:
            if self._validator.is_untouched(volts, self._baseline, self._sequence.held_s(self._now_s)):
                self._restart_detector()
        elif self._now_s - self._released_s > RELEASE_S:
            is_touched = self._validator.is_touched(volts)
            if is_touched and self._detector is not None:
                self._detector = None
            elif is_touched is False and self._detector is None:
                self._restart_detector()

    def _restart_detector(self) -> None:
        """Restart the detector for an untouched pad, and reject the current press, if any."""
        if self._sequence.is_pressed:
            self._sequence.reject("nothing touches the pad")
            self._release(self._ring.end - 1)
        self._sequence.wait(self._now_s)
        self._detector, self._detector_start = PressDetector(self._recorder.fibres), self._ring.end

    def _time_s(self, reading: int) -> float:
        return float(self._ring.rows(reading, reading + 1)[0, 0])

    def view(self) -> dict[str, Any]:
        """Return the present view as JSON; positions are [x, y], mm, or None.

        "rejected" is the target of the last press if that was rejected; "swing" the deviation of a fibre from its
        baseline over the maximum response so far, None if missing.
        """
        sequence, end = self._sequence, self._ring.end
        baseline = self._baseline if sequence.is_pressed else self._ring.baseline(end)
        swings = (self._ring.rows(end - 1, end)[0, 1:] - baseline) / self._max_response_v
        done = self._n_done + len(sequence.accepted_mm)
        return {
            "phase": self._phase(),
            "progress": round(sequence.progress(self._now_s), 3),
            "prompt": self._prompt(),
            "message": self._message,
            "target": sequence.target,
            "rejected": self._rejected_mm,
            "done": done,
            "total": done + len(sequence.remaining),
            "presses": [{"x_mm": x, "y_mm": y} for x, y in sequence.accepted_mm[-12:]],
            "fibres": [
                {"swing": None, "state": "missing"} if np.isnan(swing) else {"swing": round(swing, 3), "state": ""}
                for swing in swings.tolist()
            ],
        }

    def _phase(self) -> HandPhase:
        return "lift" if self._detector is None else self._sequence.phase(self._now_s)

    def _prompt(self) -> str:
        sequence = self._sequence
        if self._detector is None or sequence.held_s(self._now_s) > MAX_HOLD * sequence.hold_s:
            return "lift; if nothing touches the pad, say so (f)"
        target = _position_text(sequence.target)
        return {
            "settle": "hands off the pad",
            "wait": f"next {target}: wait" if target else "hands off the pad",
            "press": f"press {target}",
            "hold": "hold",
            "lift": "lift",
            "done": "all presses are made",
        }[self._phase()]


def record_by_hand(
    config: RigConfig, board: Board, on_view: OnView, poll_commands: PollCommands, resume: bool = False
) -> Recording:
    """Record presses by hand, with a board that is not yet connected.

    Completed presses are on the disk even if the session fails. `on_view` receives every `HandSession.view`;
    `poll_commands` returns the commands, of `COMMANDS`, since its last call.
    """
    if not resume:
        check_new_recording(config.out)
    stream = stream_board(board, config.rig.rate_hz)
    recorder, targets_mm, remaining_mm = open_recorder_by_hand(config, stream.board, resume)
    with recorder:
        hold_s = config.rig.readings_per_press / 2 / stream.rate_hz
        n_done = len(targets_mm) - len(remaining_mm)
        session = HandSession(recorder, remaining_mm, hold_s, n_done)
        session.run(stream.blocks, on_view, poll_commands)
    return Recording.open(config.out)


def _position_text(position_mm: Position | None) -> str:
    if position_mm is None:
        return ""
    return "x {}, y {} mm".format(*(f"{value:.1f}".removesuffix(".0") for value in position_mm))


def pad_view(pad: Morphology, title: str, mirrored: bool = False) -> dict[str, Any]:
    """Return the constant part of the view as JSON; if the pad is `mirrored`, with its tracks up, x points left."""
    return {
        "title": title,
        "centre_mm": [0.0, 0.0],
        "half_mm": [side / 2 for side in pad.layout.size_mm],
        "mirrored": mirrored,
        "paths": [np.round(pad.to_mm(path), 1).tolist() for path in flatten(pad, 0.02)],  # tolerance in grid units
        "commands": COMMANDS,
        "ended": "",
    }


def view_lines(view: Mapping[str, Any]) -> list[str]:
    """Return a view of `HandSession.view` as lines of text."""
    full = round(BAR * view["progress"])
    return [
        view["prompt"].upper(),
        f"[{'#' * full}{'.' * (BAR - full)}]",
        f"{view['done']} of {view['total']} presses   {view['message']}",
        "   ".join(f"{row['key']}: {row['text'].lower()}" for row in COMMANDS),
    ]
