"""Recording by hand: a person is asked where to press, presses are detected in the readings, and all of it is kept.

Targets come in an order with short ways that still covers the whole pad every few presses. A rejected press stays in
the recording at an unknown position: its effect on the pad shows in the presses around it. The view of a session is
JSON, for the page (`live/pages/hand.html`) and as text for the terminal.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.paths.curves import flatten
from padforge.sense.arrays import MAX_MM, Array, check_magnitude, check_numbers
from padforge.sense.localizer.features import REST, interpolate_gaps
from padforge.sense.recording.press_plan import fit_pad_settings, make_plan, pressable_test
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import JOURNAL, START, Recorder, check_new_recording, read_journal
from padforge.sense.rig.by_hand_presses import (
    MAX_HOLD,
    RELEASE_S,
    SINK_S,
    HandPhase,
    Position,
    PressSequence,
    PressValidator,
    press_responses,
)
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
MAP_COLUMNS, MAP_ROWS = 49, 21  # at most, of the map on a terminal, whose characters are twice as high as wide
BAR = 30  # characters of the progress bar

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
    """Open the run directory of a recording by hand, new or resumed, of a board with that identity.

    Returns the recorder, the targets (Q, 2) of its plan, and those (P, 2) still to press, mm.
    """
    is_resumed = resume and (config.out / START).exists()
    if is_resumed:
        presses = read_source(config, config.rig, KIND)["plan"]["presses"]
        targets_mm = check_numbers(presses, np.float64, "positions of the plan")
        if targets_mm.ndim != 2 or targets_mm.shape[1] != 2:
            raise InputError(f"{config.out}: its plan has shape {targets_mm.shape}, expected (Q, 2)")
        check_magnitude("positions of the plan", targets_mm, MAX_MM, "mm")
    else:
        targets_mm = plan_targets(config)
    recorder = open_recorder(config, config.rig, targets_mm.tolist(), config.out, resume, {"board": board}, KIND)
    pressed = [press[:2] for press in read_journal(config.out / JOURNAL).values()] if is_resumed else []
    return recorder, targets_mm, _remaining_targets(targets_mm, np.reshape(pressed, (-1, 2)))


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

    def run(
        self, blocks: Iterable[tuple[Array, Array]], on_view: OnView, poll_commands: PollCommands = lambda: ()
    ) -> None:
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
        self._baseline = self._mean_before(self._down_command)
        self._rejected_mm = None
        self._recorder.begin(target or UNKNOWN, self._first + self._down_command, self._number)
        self._recorder.sync()

    def _release(self, released: int) -> None:
        up_command = max(self._ring.command_index(released, RELEASE_DELAY_S), self._touched + 1, self._down_command + 1)
        target, rejection = self._sequence.target, self._sequence.release(self._time_s(released))
        responses = self._responses(up_command)
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

    def _responses(self, up_command: int) -> Array:
        """See `press_responses`; of a press whose begin is no longer in the ring, by its end alone."""
        first = max(self._down_command + REST[0], self._released, self._ring.end - HISTORY - SLACK)
        readings = self._ring.rows(first, self._ring.end)[:, 1:]
        return press_responses(readings, max(self._down_command - first, 1), up_command - first)

    def _mean_before(self, reading: int) -> Array:
        """(C,) V, mean of the readings just before an index."""
        return interpolate_gaps(self._ring.rows(reading + REST[0], reading)[:, 1:]).mean(axis=0)

    def view(self) -> dict[str, Any]:
        """Return what there is to show now, as JSON.

        It has "phase", a `HandPhase`, and "progress", 0 to 1; "prompt", what is asked for, and "message", the outcome
        of the last press, a line each; "target", and "rejected", the target of the last press if that was rejected,
        [x, y] mm or None; "done" and "total", numbers of presses; "presses" accepted last, "x_mm" and "y_mm";
        "fibres", each with "swing" (from its baseline, as a share of the largest response; None if missing) and
        "state".
        """
        sequence, end = self._sequence, self._ring.end
        baseline = self._baseline if sequence.is_pressed else self._mean_before(end)
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
    config: RigConfig,
    board: Board,
    on_view: OnView,
    poll_commands: PollCommands = lambda: (),
    resume: bool = False,
) -> Recording:
    """Record presses by hand into `config.out`; what is done is on the disk whatever happens.

    Args:
        config: What is recorded.
        board: Not yet connected.
        on_view: Receives what there is to show, see `HandSession.view`.
        poll_commands: Returns the commands, of `COMMANDS`, since its last call.
        resume: Whether to resume what is in `config.out`, if anything is.

    Raises:
        InputError: Settings, targets or a run directory that cannot be, or no press was made.
        RigFault: The board failed, or the disk.
    """
    if not resume:
        check_new_recording(config.out)
    rig = config.rig
    stream = stream_board(board, rig.rate_hz)
    recorder, targets_mm, remaining_mm = open_recorder_by_hand(config, stream.board, resume)
    with recorder:
        hold_s = rig.readings_per_press / 2 / stream.rate_hz
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
        "origin_mm": [0.0, 0.0],
        "half_mm": [side / 2 for side in pad.layout.size_mm],
        "mirrored": mirrored,
        "paths": [np.round(pad.to_mm(path), 1).tolist() for path in flatten(pad, PATH_TOLERANCE)],
        "commands": COMMANDS,
        "ended": "",
    }


def view_lines(view: Mapping[str, Any]) -> list[str]:
    """Write the view (`pad_view` and `HandSession.view`) as text, with the pad as a map seen from above."""
    full = round(BAR * view["progress"])
    return [
        view["prompt"].upper(),
        f"[{'#' * full}{'.' * (BAR - full)}]",
        *_map_lines(view),
        f"{view['done']} of {view['total']} presses   {view['message']}",
        "   ".join(f"{row['key']}: {row['text'].lower()}" for row in COMMANDS),
    ]


def _map_lines(view: Mapping[str, Any]) -> list[str]:
    """The pad's edge, the last accepted presses (.), a rejected one (x), and the target (O)."""
    width, height = view["half_mm"]
    columns = max(round(MAP_COLUMNS * width / max(width, height)), 3)
    rows = [[" "] * columns for _ in range(max(round(MAP_ROWS * height / max(width, height)), 3))]

    def put(position_mm: Position, mark: str) -> None:
        x, y = np.clip((np.array(position_mm) / (width, height) + 1) / 2, 0, 1).tolist()
        right = 1 - x if view["mirrored"] else x
        rows[round((1 - y) * (len(rows) - 1))][round(right * (columns - 1))] = mark

    for press in view["presses"]:
        put((press["x_mm"], press["y_mm"]), ".")
    for name, mark in (("rejected", "x"), ("target", "O")):
        if view[name] is not None:
            put(view[name], mark)
    edge = f"+{'-' * columns}+"
    return [edge, *(f"|{''.join(row)}|" for row in rows), edge]
