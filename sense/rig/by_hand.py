"""Where a person is asked to press, in an order that is kind to the hand and fair to what is learnt.

The run directory of a recording by hand: a new one, or one to go on with.

A session by hand: what the fibres give is kept, presses are found in it, and a person is told what to do next.
A press that does not count stays in the recording, as one at an unknown place: what it does to the pad shows in the
presses around it.

What of a session by hand is shown besides its own view: the pad as it is planned, and all of it as text.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from padforge.design import Morphology
from padforge.design.common.files import provenance
from padforge.design.common.validation import InputError
from padforge.design.paths.curves import flatten
from padforge.sense.arrays import MAX_MM, Array, check_magnitude, check_numbers
from padforge.sense.localizer.features import REST, interpolate_gaps
from padforge.sense.recording.press_plan import free_of, planned, size_of
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import JOURNAL, START, Recorder, read_journal, refuse_begun
from padforge.sense.rig.by_hand_presses import GONE_S, MOST, SOON_S, Judge, Phase, Place, Turns, answers
from padforge.sense.rig.config import RigConfig, begun_source, require_same_devices, source_of
from padforge.sense.rig.devices import Board, RigFault
from padforge.sense.rig.streams import HISTORY, SLACK, RingBuffer, stream_board
from padforge.sense.signals.press_detection import SENT_DOWN_S, SENT_UP_S, PressDetector

ROUND = 25
"""Places of a uniform plan that are gone through by a short way, before the next ones. Whoever stops early has been
all over the pad, and what drifts with time is not taken for what changes with the place."""


def targets_of(setup: RigConfig) -> Array:
    """(Q, 2) places in mm as `[rig]` asks for them: of a grid or a file in that order, or uniform ones in short rounds.

    Uniform places are whole millimetres: nobody hits fractions, and whole ones are found on squared paper.

    Raises:
        InputError: an adaptive plan, or a file of places that is none.
    """
    rig = setup.rig
    if rig.plan == "adaptive":
        raise InputError("[rig] plan is adaptive, by hand allowed are uniform, grid, boustrophedon or a .csv of places")
    positions_mm = planned(setup.pad, rig, np.random.default_rng(rig.seed), setup.size).positions_mm
    if rig.plan != "uniform":
        return positions_mm
    whole_mm = np.rint(positions_mm)
    free = free_of(setup.pad, size_of(setup.pad, setup.size))(whole_mm)
    return in_rounds(np.where(free[:, None], whole_mm, positions_mm))


def in_rounds(positions_mm: Array) -> Array:
    """(Q, 2) places, `ROUND` at a time, each round from where the last one ended always to the nearest that is left."""
    ordered = np.empty_like(positions_mm)
    at = positions_mm[0]
    for first in range(0, len(positions_mm), ROUND):
        left = positions_mm[first : first + ROUND]
        for row in range(first, first + len(left)):
            nearest = int(np.argmin(np.linalg.norm(left - at, axis=1)))
            at = ordered[row] = left[nearest]
            left = np.delete(left, nearest, axis=0)
    return ordered


def still_to_make(targets_mm: Array, made_mm: Array) -> Array:
    """(P, 2) those of the targets (Q, 2), in their order, that are not among the places (R, 2) of presses made."""
    made = [tuple(place) for place in made_mm.tolist()]
    left = []
    for place in targets_mm.tolist():
        if tuple(place) in made:
            made.remove(tuple(place))
        else:
            left.append(place)
    return np.array(left).reshape(-1, 2)


KIND = "hand"
"""Of the source of such a recording: nobody knows how deep its presses were."""


def opened(setup: RigConfig, converter: Mapping[str, Any], resume: bool) -> tuple[Recorder, Array, Array]:
    """The recorder, the places (Q, 2) mm of its plan, and those (P, 2) that are still to be pressed.

    Args:
        converter: what it says of itself. resume: go on with what is in `setup.out`, if anything is.

    Raises:
        InputError: places that cannot be, another recording in the way, or one that was begun otherwise.
    """
    board = {"board": converter}
    if resume and (setup.out / START).exists():
        source = begun_source(setup, setup.rig, KIND)
        targets = _kept_targets(setup, source)
        require_same_devices(setup.out, source, board)
        recorder = Recorder.resume(setup.out)
        made = [press[:2] for press in read_journal(setup.out / JOURNAL).values()]
        return recorder, targets, still_to_make(targets, np.array(made).reshape(-1, 2))
    targets = targets_of(setup)
    plan = {"columns": ["x_mm", "y_mm"], "presses": targets.tolist()}
    made_by = provenance(setup.command, setup.rig.seed, setup.inputs)
    source = source_of(setup, setup.rig, KIND, plan, board)
    return Recorder(setup.out, converter["channels"], source, made_by), targets, targets


def _kept_targets(setup: RigConfig, source: Mapping[str, Any]) -> Array:
    """The places of a recording that is to be gone on with."""
    targets = check_numbers(source["plan"]["presses"], np.float64, "places of the plan")
    if targets.ndim != 2 or targets.shape[1] != 2:
        raise InputError(f"{setup.out}: its plan has shape {targets.shape}, expected (Q, 2)")
    check_magnitude("places of the plan", targets, MAX_MM, "mm")
    return targets


TRAIL = 12
"""Presses that are kept to be shown."""
UNKNOWN = (np.nan, np.nan)
WORDS = (
    {"key": "b", "word": "back", "text": "Take the last press back"},
    {"key": "s", "word": "skip", "text": "Skip this place"},
    {"key": "f", "word": "free", "text": "Nothing touches the pad"},
    {"key": "q", "word": "quit", "text": "End"},
)
"""What a person may say, by a key or a button."""

Show = Callable[[dict[str, Any]], None]
Said = Callable[[], Sequence[str]]


class HandSession:
    """One stretch of recording by hand.

    Args:
        recorder: new or resumed, of so many fibres. targets_mm: (Q, 2) places to press, in this order; `made` presses
            were made before them.
        hold_s: for how long a press is to be held, and the pad left alone after it.
    """

    def __init__(self, recorder: Recorder, fibres: int, targets_mm: Array, hold_s: float, made: int = 0) -> None:
        self._recorder, self._fibres = recorder, fibres
        # Times of a recording begin at 0, and go on a second after the last ones where it is resumed.
        self._start_s = recorder.last_s + 1 if np.isfinite(recorder.last_s) else 0.0
        self._zero_s: float | None = None
        self._first = recorder.readings
        self._number = max(recorder.done, default=-1) + 1
        self._made = made
        self._turns = Turns(targets_mm, hold_s, self._start_s)
        self._ring, self._now_s = RingBuffer(1 + fibres), self._start_s
        self._finder: PressDetector | None = PressDetector(fibres)  # None while it has lost its way
        self._found_from, self._judge = 0, Judge()
        self._touched = self._down_command = self._free = 0
        self._free_s = self._start_s
        self._rest = np.zeros(fibres)  # before the press under way
        self._kept: list[tuple[int, int, int]] = []  # number, begun and lifted in the recording
        self._most_v = 1e-3
        self._told, self._refused = "", None

    def run(self, blocks: Iterable[tuple[Array, Array]], show: Show, said: Said = lambda: ()) -> None:
        """Go on until all presses are made, or it is said to end.

        Args:
            blocks: times (n,) s and readings (n, C) V as they come. show: given what there is to show, see `view`.
            said: the words of `WORDS` that were said since it was called last.

        Raises:
            RigFault: the board failed, or the disk; what is done is on the disk.
        """
        try:
            for times_s, readings in blocks:
                for word in said():
                    if word == "quit":
                        return
                    self._obey(word)
                if len(times_s):
                    self.feed(times_s, readings)
                    show(self.view())
                if self._phase() == "done":
                    return
        except OSError as error:
            raise RigFault("disk", f"the recording cannot be written ({error.strerror or error})") from error
        finally:
            self._recorder.abort("the session ended")

    def feed(self, times_s: Array, readings: Array) -> None:
        """Take readings, and what they bring to light."""
        if self._zero_s is None:
            self._zero_s = float(times_s[0]) - self._start_s
        times_s = times_s - self._zero_s
        self._recorder.append(times_s, readings)
        for row in np.column_stack([times_s, readings]):
            self._ring.append(row)
            self._now_s = float(row[0])
            for event in self._finder.feed(row[:1], row[None, 1:]) if self._finder else ():
                reading = self._found_from + event.reading
                self._touch(reading) if event.down else self._release(reading)
        self._doubt()

    def _touch(self, touched: int) -> None:
        place = self._turns.touch(self._time_s(touched))
        self._touched = touched
        self._down_command = max(self._ring.command_index(touched, SENT_DOWN_S), self._free + 1)
        self._rest = self._rest_before(self._down_command)
        self._refused = None
        self._recorder.begin(place or UNKNOWN, self._first + self._down_command, self._number)
        self._recorder.sync()

    def _release(self, released: int) -> None:
        up_command = max(self._ring.command_index(released, SENT_UP_S), self._touched + 1, self._down_command + 1)
        target, fault = self._turns.target, self._turns.release(self._time_s(released))
        answered = self._answers(up_command)
        fault = fault or self._judge.fault_of(answered)
        if fault:
            self._refuse(self._number, self._first + self._down_command, self._first + up_command, fault)
            self._told, self._refused = f"not counted: {fault}", target
        else:
            self._recorder.finish(self._first + up_command)
            self._kept.append((self._number, self._first + self._down_command, self._first + up_command))
            self._judge.keep(answered, self._rest)
            self._most_v = max(self._most_v, float(np.abs(answered).max()))
            self._turns.keep(self._now_s)
            self._told = f"counted: {shown(target)}"
        self._recorder.sync()
        self._number, self._free = self._number + 1, up_command
        self._free_s = self._now_s

    def _refuse(self, press: int, down_command: int, up_command: int, why: str) -> None:
        """Note that a press was at an unknown place."""
        self._recorder.begin(UNKNOWN, down_command, press)
        self._recorder.finish(up_command, refused=why)

    def _obey(self, word: str) -> None:
        if word == "skip":
            self._turns.skip(self._now_s)
        elif word == "back":
            if self._turns.take_back(self._now_s):
                self._refuse(*self._kept.pop(), "it was taken back")
                self._recorder.sync()
                self._judge.take_back()
                self._told = "the last press was taken back"
        elif word == "free":
            self._judge.rest_anew()
            self._let_go()

    def _doubt(self) -> None:
        """Where readings say otherwise than the finder of presses, believe them and begin to find anew."""
        volts = self._late()
        if self._turns.pressed:
            if self._judge.untouched(volts, self._rest, self._turns.held_s(self._now_s)):
                self._let_go()
        elif self._now_s - self._free_s > GONE_S:
            touched = self._judge.touched(volts)
            if touched and self._finder is not None:
                self._finder = None
            elif touched is False and self._finder is None:
                self._let_go()

    def _let_go(self) -> None:
        """Nothing touches the pad, whatever was found."""
        if self._turns.pressed:
            self._turns.drop()
            self._release(self._ring.end - 1)
        self._turns.wait(self._now_s)
        self._finder, self._found_from = PressDetector(self._fibres), self._ring.end

    def _late(self) -> Array:
        """(C,) V, mean of the latest readings."""
        rows = self._ring.rows(max(self._ring.end - HISTORY, 0), self._ring.end)
        return interpolate_gaps(rows[np.searchsorted(rows[:, 0], self._now_s - SOON_S) :, 1:]).mean(axis=0)

    def _time_s(self, reading: int) -> float:
        return float(self._ring.rows(reading, reading + 1)[0, 0])

    def _answers(self, up_command: int) -> Array:
        """See `judging.answers`; of a press of which the begin is forgotten, by its end alone."""
        first = max(self._down_command + REST[0], self._free, self._ring.end - HISTORY - SLACK)
        readings = self._ring.rows(first, self._ring.end)[:, 1:]
        return answers(readings, max(self._down_command - first, 1), up_command - first)

    def _rest_before(self, at: int) -> Array:
        """(C,) V, mean of the readings just before index `at`."""
        return interpolate_gaps(self._ring.rows(at + REST[0], at)[:, 1:]).mean(axis=0)

    def view(self) -> dict[str, Any]:
        """What there is to show now, as JSON.

        Returns:
            "phase" and "progress", see `Turns`; "said", what is asked for, and "told", what became of the last press,
            a line each; "target", and "refused", the place of the last press if that did not count, [x, y] mm or None;
            "done" and "of" presses; "presses" kept last, "x_mm" and "y_mm"; "fibres", for each its "swing" (from its
            rest, as a share of the largest so far; None where there is no reading) and "state".
        """
        turns, now_s = self._turns, self._now_s
        end = self._ring.end
        rest = self._rest if turns.pressed else self._rest_before(end)
        swings = (self._ring.rows(end - 1, end)[0, 1:] - rest) / self._most_v
        done = self._made + len(turns.kept)
        return {
            "phase": self._phase(),
            "progress": round(turns.progress(now_s), 3),
            "said": self._asked(),
            "told": self._told,
            "target": turns.target,
            "refused": self._refused,
            "done": done,
            "of": done + turns.left,
            "presses": [{"x_mm": x, "y_mm": y} for x, y in turns.kept[-TRAIL:]],
            "fibres": [
                {"swing": None, "state": "missing"} if np.isnan(swing) else {"swing": round(swing, 3), "state": ""}
                for swing in swings.tolist()
            ],
        }

    def _phase(self) -> Phase:
        return "lift" if self._finder is None else self._turns.phase(self._now_s)

    def _asked(self) -> str:
        """What is asked for now, in a line."""
        turns, phase = self._turns, self._phase()
        at = shown(turns.target)
        if self._finder is None or turns.held_s(self._now_s) > MOST * turns.hold_s:
            return "lift; if nothing touches the pad, say so (f)"
        return {
            "settle": "hands off the pad",
            "wait": f"next {at}: wait" if at else "hands off the pad",
            "press": f"press {at}",
            "hold": "hold",
            "lift": "lift",
            "done": "all presses are made",
        }[phase]


def record_by_hand(
    setup: RigConfig, converter: Board, show: Show, said: Said = lambda: (), resume: bool = False
) -> Recording:
    """Record presses by hand into `setup.out`; what is done is on the disk whatever happens.

    Args:
        converter: not yet connected. show, said: see `HandSession.run`. resume: go on with what is in `setup.out`.

    Raises:
        InputError: settings, places or a run directory that cannot be, or no press was made.
        RigFault: the board failed, or the disk.
    """
    if not resume:
        refuse_begun(setup.out)
    rig = setup.rig
    source = stream_board(converter, rig.rate_hz)
    recorder, targets, left = opened(setup, source.board, resume)
    with recorder:
        hold_s = rig.readings_per_press / 2 / source.rate_hz
        HandSession(recorder, source.fibres, left, hold_s, len(targets) - len(left)).run(source.blocks, show, said)
    return Recording.open(setup.out)


def shown(place: Place | None) -> str:
    """A place as a person reads it."""
    return "" if place is None else "x {}, y {} mm".format(*(f"{value:.1f}".removesuffix(".0") for value in place))


TOLERANCE = 0.02
"""Of the courses drawn, grid units."""
COLUMNS, ROWS = 49, 21
"""Of the map of a square pad on a terminal, whose characters are about twice as high as wide; of another one at most so
many."""
BAR = 30
"""Characters of the bar of a wait or a hold."""


def pad_view(pad: Morphology, title: str, mirrored: bool = False) -> dict[str, Any]:
    """The part of the view that stays, as JSON: frame, fibres' courses in mm, and what may be said.

    Places are those of the plan; of a pad that lies `mirrored`, with its tracks up, x runs to the left.
    """
    courses = [np.round(pad.to_mm(course), 1).tolist() for course in flatten(pad, TOLERANCE)]
    return {
        "title": title,
        "origin_mm": [0.0, 0.0],
        "half_mm": [side / 2 for side in pad.layout.size_mm],
        "mirrored": mirrored,
        "courses": courses,
        "words": WORDS,
        "ended": "",
    }


def view_lines(view: Mapping[str, Any]) -> list[str]:
    """All there is to show (`pad_view` and `HandSession.view`) as text; the pad as a map seen from above."""
    full = round(BAR * view["progress"])
    return [
        view["said"].upper(),
        f"[{'#' * full}{'.' * (BAR - full)}]",
        *_map(view),
        f"{view['done']} of {view['of']} presses   {view['told']}",
        "   ".join(f"{each['key']}: {each['text'].lower()}" for each in WORDS),
    ]


def _map(view: Mapping[str, Any]) -> list[str]:
    """The pad's edge, the places pressed last (.), one that did not count (x), and the next (O)."""
    width, height = view["half_mm"]
    columns = max(round(COLUMNS * width / max(width, height)), 3)
    rows = [[" "] * columns for _ in range(max(round(ROWS * height / max(width, height)), 3))]

    def put(place: tuple[float, float], mark: str) -> None:
        x, y = np.clip((np.array(place) / (width, height) + 1) / 2, 0, 1).tolist()
        right = 1 - x if view["mirrored"] else x
        rows[round((1 - y) * (len(rows) - 1))][round(right * (columns - 1))] = mark

    for press in view["presses"]:
        put((press["x_mm"], press["y_mm"]), ".")
    for name, mark in (("refused", "x"), ("target", "O")):
        if view[name] is not None:
            put(view[name], mark)
    edge = f"+{'-' * columns}+"
    return [edge, *(f"|{''.join(row)}|" for row in rows), edge]
