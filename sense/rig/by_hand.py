"""Recording by hand: a person is asked where to press, presses are detected in the readings, and all of it is kept.

Targets come in an order with short ways that still covers the whole pad every few presses. A rejected press stays in
the recording at an unknown position: its effect on the pad shows in the presses around it. The view of a session is
JSON, for the page (`live/pages/hand.html`), and a few lines of text for the terminal.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Any

import numpy as np

from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.paths.curves import flatten
from padforge.sense.arrays import Array
from padforge.sense.localizer.features import REST, interpolate_gaps
from padforge.sense.recording.press_plan import fit_pad_settings, make_plan, pressable_test
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import JOURNAL, START, Recorder, check_new_recording, read_journal
from padforge.sense.rig.config import RigConfig, open_recorder, read_source
from padforge.sense.rig.devices import Board, RigFault
from padforge.sense.rig.streams import HISTORY, SLACK, RingBuffer, stream_board
from padforge.sense.signals.press_detection import RELEASE_DELAY_S, TOUCH_DELAY_S, PressDetector

KIND = "hand"  # of the source of such a recording, whose depths are unknown
# Targets of a uniform plan that are ordered by a short way before the next ones: a session that ends early has covered
# the whole pad, and drift with time is not confused with position.
ROUND = 25
TRAIL = 12  # presses that the view shows
UNKNOWN = (np.nan, np.nan)
COMMANDS = (
    {"key": "b", "command": "back", "text": "Take the last press back"},
    {"key": "s", "command": "skip", "text": "Skip this place"},
    {"key": "f", "command": "free", "text": "Nothing touches the pad"},
    {"key": "q", "command": "quit", "text": "End"},
)
"""Commands of a person, by a key or a button."""
PATH_TOLERANCE = 0.02  # of the paths drawn, grid units
BAR = 30  # characters of the progress bar

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
OnView = Callable[[dict[str, Any]], None]
PollCommands = Callable[[], Sequence[str]]


def plan_targets(config: RigConfig) -> Array:
    """Return the targets (Q, 2) that `[rig]` asks for: of a grid or a file in that order, or uniform ones in rounds.

    Uniform targets are whole millimetres: nobody hits fractions, and whole ones are found on squared paper.
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
    """Order positions (Q, 2) by nearest neighbour, `ROUND` at a time, each round from where the last one ended."""
    ordered = np.empty_like(positions_mm)
    position = positions_mm[0]
    for first in range(0, len(positions_mm), ROUND):
        remaining = positions_mm[first : first + ROUND]
        for row in range(first, first + len(remaining)):
            nearest = int(np.argmin(np.linalg.norm(remaining - position, axis=1)))
            position = ordered[row] = remaining[nearest]
            remaining = np.delete(remaining, nearest, axis=0)
    return ordered


def _remaining_targets(targets_mm: Array, pressed_mm: Array) -> Array:
    """Return those of the targets (Q, 2), in order, without the positions (R, 2) already pressed, one for one."""
    pressed, remaining = pressed_mm.tolist(), []
    for position in targets_mm.tolist():
        if position in pressed:
            pressed.remove(position)
        else:
            remaining.append(position)
    return np.array(remaining).reshape(-1, 2)


def open_recorder_by_hand(config: RigConfig, board: Mapping[str, Any], resume: bool) -> tuple[Recorder, Array, Array]:
    """Return the recorder, new or resumed, the targets (Q, 2) of its plan, and those (P, 2) still to press, mm."""
    is_resumed = resume and (config.out / START).exists()
    if is_resumed:
        presses = read_source(config, config.rig, KIND)["plan"]["presses"]
        targets_mm = np.array(presses, np.float64)
    else:
        targets_mm = plan_targets(config)
    recorder = open_recorder(config, config.rig, targets_mm.tolist(), config.out, resume, {"board": board}, KIND)
    pressed = [press[:2] for press in read_journal(config.out / JOURNAL).values()] if is_resumed else []
    return recorder, targets_mm, _remaining_targets(targets_mm, np.reshape(pressed, (-1, 2)))


class HandPhase(StrEnum):
    """What a person is asked to do.

    SETTLE --ready--> PRESS --touch--> HOLD --held for hold_s--> LIFT --release--> WAIT --ready--> PRESS ... DONE

    A touch that comes in SETTLE, WAIT or DONE leads to LIFT at once and is rejected, as is a press that was held for
    too short or too long a time, and one whose readings say that it was too weak or that the finger moved.
    """

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
    """Learns the usual response and the pad's baseline from accepted presses, and checks others by them.

    The detector, too: one that takes a finger that slid for one that was lifted takes the lift for the next touch, and
    so on. But a pad that nothing touches reads as it did untouched before.
    """

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


class HandSession:
    """A session of recording by hand, of the targets (Q, 2) in this order; `n_done` presses were made before."""

    def __init__(self, recorder: Recorder, n_fibres: int, targets_mm: Array, hold_s: float, n_done: int = 0) -> None:
        self._recorder, self._n_fibres, self._n_done = recorder, n_fibres, n_done
        # Times of a recording begin at 0, and go on a second after the last ones if it is resumed.
        self._start_s = recorder.last_s + 1 if np.isfinite(recorder.last_s) else 0.0
        self._zero_s: float | None = None
        self._first = recorder.n_readings  # of this session, in the recording; other indices count from it
        self._number = max(recorder.done, default=-1) + 1
        self._sequence = PressSequence(targets_mm, hold_s, self._start_s)
        self._ring, self._now_s = RingBuffer(1 + n_fibres), self._start_s
        self._detector: PressDetector | None = PressDetector(n_fibres)  # None while it is not to be believed
        self._detector_start, self._validator = 0, PressValidator()
        self._touched = self._down_command = self._released = 0
        self._released_s = self._start_s
        self._baseline = np.zeros(n_fibres)  # before the press under way
        self._accepted: list[tuple[int, int, int]] = []  # number, down and up command in the recording
        self._max_response_v = 1e-3
        self._message, self._rejected_mm = "", None

    def run(self, blocks: Iterable[tuple[Array, Array]], on_view: OnView, poll_commands: PollCommands) -> None:
        """Record blocks of times (n,) s and readings (n, C) V until all presses are made or the command quit comes."""
        try:
            for times_s, readings in blocks:
                for command in poll_commands():
                    if command == "quit":
                        return
                    self._execute(command)
                if len(times_s):
                    self.feed(times_s, readings)
                    on_view(self.view())
                if self._phase() is HandPhase.DONE:
                    return
        except OSError as error:
            raise RigFault("disk", f"the recording cannot be written ({error.strerror or error})") from error
        finally:
            self._recorder.abort("the session ended")

    def feed(self, times_s: Array, readings: Array) -> None:
        """Record readings (n, C) V at times (n,) s, and handle the touches and releases in them."""
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
        # Of a press whose begin is no longer in the ring, by its end alone.
        first = max(self._down_command + REST[0], self._released, self._ring.end - HISTORY - SLACK)
        readings = self._ring.rows(first, self._ring.end)[:, 1:]
        responses = press_responses(readings, max(self._down_command - first, 1), up_command - first)
        rejection = rejection or self._validator.rejection(responses)
        press = self._number, self._first + self._down_command, self._first + up_command
        if rejection:
            self._record_rejected(*press, rejection)
            self._message, self._rejected_mm = f"not counted: {rejection}", target
        else:
            self._recorder.finish(self._first + up_command)
            self._accepted.append(press)
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
        """Believe the readings if they contradict the detector, and restart it."""
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
        """Nothing touches the pad, whatever was detected."""
        if self._sequence.is_pressed:
            self._sequence.reject("nothing touches the pad")
            self._release(self._ring.end - 1)
        self._sequence.wait(self._now_s)
        self._detector, self._detector_start = PressDetector(self._n_fibres), self._ring.end

    def _time_s(self, reading: int) -> float:
        return float(self._ring.rows(reading, reading + 1)[0, 0])

    def view(self) -> dict[str, Any]:
        """Return what there is to show now, as JSON: lines, numbers of presses, and positions [x, y] in mm or None.

        "progress" is of the phase, 0 to 1; "rejected" is the target of the last press if that was rejected; "swing" of
        a fibre the difference from its baseline as a share of the largest response, None if missing.
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
            "presses": [{"x_mm": x, "y_mm": y} for x, y in sequence.accepted_mm[-TRAIL:]],
            "fibres": [
                {"swing": None, "state": "missing"} if np.isnan(swing) else {"swing": round(swing, 3), "state": ""}
                for swing in swings.tolist()
            ],
        }

    def _phase(self) -> HandPhase:
        return HandPhase.LIFT if self._detector is None else self._sequence.phase(self._now_s)

    def _prompt(self) -> str:
        sequence = self._sequence
        if self._detector is None or sequence.held_s(self._now_s) > MAX_HOLD * sequence.hold_s:
            return "lift; if nothing touches the pad, say so (f)"
        target = _position_text(sequence.target)
        return {
            HandPhase.SETTLE: "hands off the pad",
            HandPhase.WAIT: f"next {target}: wait" if target else "hands off the pad",
            HandPhase.PRESS: f"press {target}",
            HandPhase.HOLD: "hold",
            HandPhase.LIFT: "lift",
            HandPhase.DONE: "all presses are made",
        }[self._phase()]


def record_by_hand(
    config: RigConfig, board: Board, on_view: OnView, poll_commands: PollCommands, resume: bool = False
) -> Recording:
    """Record presses by hand into `config.out`, with a board that is not yet connected; `resume` what is there, if any.

    What is done is on the disk whatever happens. `on_view` receives what there is to show, see `HandSession.view`;
    `poll_commands` returns the commands, of `COMMANDS`, since its last call. Raises InputError for settings, targets or
    a run directory that cannot be, or if no press was made; RigFault if the board or the disk failed.
    """
    if not resume:
        check_new_recording(config.out)
    stream = stream_board(board, config.rig.rate_hz)
    recorder, targets_mm, remaining_mm = open_recorder_by_hand(config, stream.board, resume)
    with recorder:
        hold_s = config.rig.readings_per_press / 2 / stream.rate_hz
        n_done = len(targets_mm) - len(remaining_mm)
        session = HandSession(recorder, stream.fibres, remaining_mm, hold_s, n_done)
        session.run(stream.blocks, on_view, poll_commands)
    return Recording.open(config.out)


def _position_text(position_mm: Position | None) -> str:
    if position_mm is None:
        return ""
    return "x {}, y {} mm".format(*(f"{value:.1f}".removesuffix(".0") for value in position_mm))


def pad_view(pad: Morphology, title: str, mirrored: bool = False) -> dict[str, Any]:
    """Return the constant part of the view, as JSON; of a pad `mirrored`, with its tracks up, x runs to the left."""
    return {
        "title": title,
        "centre_mm": [0.0, 0.0],
        "half_mm": [side / 2 for side in pad.layout.size_mm],
        "mirrored": mirrored,
        "paths": [np.round(pad.to_mm(path), 1).tolist() for path in flatten(pad, PATH_TOLERANCE)],
        "commands": COMMANDS,
        "ended": "",
    }


def view_lines(view: Mapping[str, Any]) -> list[str]:
    """Write the view of `HandSession.view` as text."""
    full = round(BAR * view["progress"])
    return [
        view["prompt"].upper(),
        f"[{'#' * full}{'.' * (BAR - full)}]",
        f"{view['done']} of {view['total']} presses   {view['message']}",
        "   ".join(f"{row['key']}: {row['text'].lower()}" for row in COMMANDS),
    ]
