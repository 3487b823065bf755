"""Reading `journal.ndjson`: which presses of a run directory are done, where, how deep and with which force.

The run directory that keeps a recording, written so that nothing finished is ever lost.
It holds `start.json` (what was recorded, with what), `readings.bin` and, of a real or emulated arm, `states.bin`
(see `block_file`), and `journal.ndjson`: one line as a press begins, with its place and the index of its first
reading, and one as it is done or aborted. Readings are on the disk before the journal says that a press is done, so
after a kill every press the journal calls done can be used, and the others are repeated. `start.json` comes last when a
recording is born: a folder without it holds nothing, and a recording can begin there.
"""

import contextlib
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from reprlib import repr as shortened
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.files import (
    UNFINISHED,
    check_writable,
    lock,
    read_bytes,
    read_json,
    reraise_write_error,
    sync,
    to_disk,
    write_json,
)
from padforge.design.common.validation import InputError, check_int, check_mapping, short_repr
from padforge.design.common.validation import check_path as as_path
from padforge.sense.arrays import MAX_FIBRES, MAX_INDEX, MAX_MM, MAX_N, Array, check_numbers
from padforge.sense.recording.block_file import BlockWriter, open_in_place, read_blocks, write_at


class Press(NamedTuple):
    """A press that is done; see `Recording`, whose arrays hold one entry of each. NaN where something is not known."""

    x_mm: float
    y_mm: float
    down_command: int
    up_command: int
    depth_mm: float
    reached_mm: float
    force_n: float


def read_journal(path: Path) -> dict[int, Press]:
    """Every press that is done, by its number.

    Numbers ascend. A press that was aborted and begun again counts as it was begun last.

    Raises:
        InputError: the file is missing, or a line other than a torn last one is no entry.
    """
    try:
        text = read_bytes(path).decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: no journal ({error})") from error
    down_command: dict[int, tuple[float, float, int, float]] = {}
    done: dict[int, tuple[int, float, float]] = {}
    for number, line in enumerate(text.split("\n")[:-1], start=1):  # what follows the last newline is a torn line
        try:
            event = json.loads(line)
            if not isinstance(event, dict):
                raise ValueError(f"{shortened(event)}, expected an object")
            press, reading = _whole(event, "press"), _whole(event, "reading")
            if event.get("event") == "started":
                place = (_number(event, "x_mm", MAX_MM), _number(event, "y_mm", MAX_MM))
                down_command[press] = (*place, reading, _number(event, "depth_mm", MAX_MM, None))
                done.pop(press, None)
            elif event.get("event") == "done" and press in down_command:
                done[press] = (reading, _reached(event), _number(event, "force_n", MAX_N, None))
            elif event.get("event") == "aborted" and press in down_command:
                del down_command[press]
                done.pop(press, None)
            else:
                raise ValueError(f"event {shortened(event.get('event'))} of press {press}")
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: line {number} is no journal entry ({error})") from error
    presses = ((press, *down_command[press], *done[press]) for press in sorted(done))
    return {
        press: Press(x, y, first, up_command, depth, reached, force)
        for press, x, y, first, depth, up_command, reached, force in presses
    }


def cut_torn_line(path: Path) -> None:
    """Take away what follows the last whole line of a journal."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with open_in_place(path) as file:
            file.truncate(whole)


def _whole(event: Mapping[str, Any], key: str) -> int:
    value = event.get(key)
    if type(value) is not int or not 0 <= value <= MAX_INDEX:
        raise ValueError(f"{key} is {shortened(value)}, expected a whole number from 0 to {MAX_INDEX}")
    return value


def _reached(event: Mapping[str, Any]) -> float:
    """The last of `at_mm`, where the tip was on the pad: x, y and depth."""
    at = event.get("at_mm", [None] * 3)
    if not isinstance(at, list) or len(at) != 3:
        raise ValueError(f"at_mm is {shortened(at)}, expected x, y and depth")
    return _number({"at_mm": at[2]}, "at_mm", MAX_MM)


def _number(event: Mapping[str, Any], key: str, limit: float, missing: object = "missing") -> float:
    value = event.get(key, missing)
    if value is None:
        return float("nan")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= limit:
        raise ValueError(f"{key} is {shortened(value)}, expected a number from {-limit:g} to {limit:g}, or null")
    return float(value)


FORMAT = "padforge-recording/2"
START, JOURNAL, READINGS, STATES = FILES = "start.json", "journal.ndjson", "readings.bin", "states.bin"
_UNBORN = UNFINISHED + START
_BIRTH = (JOURNAL, READINGS, _UNBORN)
"""What is made before `start.json`, in this order."""


class Recorder:
    """Writes a run directory as it is recorded: append readings, begin a press, end it, `sync`.

    Nothing is promised to be on the disk before `sync` returns; leaving the `with` block syncs and closes.

    Attributes:
        fibres: C, values of a reading.
        done: numbers of the presses that are done.
        readings: how many readings there are.
        last_s: time of the last reading or state, s; -inf where there is none.

    Raises:
        InputError: `check_path` is in the way, see `refuse_begun`, or cannot be written, or too few or many fibres.
    """

    def __init__(self, path: Path, fibres: int, source: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
        fibres, path = check_int("fibres", fibres, 1, MAX_FIBRES), as_path("path", path)
        told = {
            "source": dict(check_mapping("source", source)),
            "provenance": dict(check_mapping("provenance", provenance)),
        }
        refuse_begun(path)
        document = {"format": FORMAT, "fibres": fibres, **told}
        with reraise_write_error(path):
            path.mkdir(parents=True, exist_ok=True)
            there = {file.name for file in path.iterdir()}
            self._journal: BinaryIO = _claimed(path)
            with contextlib.ExitStack() as undo:
                undo.callback(self._journal.close)  # the last thing, for it lets others in
                for name in {*_BIRTH, START} - there:
                    undo.callback((path / name).unlink, missing_ok=True)
                self._stream: BinaryIO = _opened(path / READINGS)
                undo.callback(self._stream.close)
                write_json(path / _UNBORN, document)
                sync(path / _UNBORN)
                (path / _UNBORN).replace(path / START)
                sync(path)
                sync(path.parent)
                undo.pop_all()
        self._begin_with(path, BlockWriter(self._stream, fibres), 0)

    def _begin_with(self, path: Path, blocks: BlockWriter, noted: int) -> None:
        self._path, self._blocks, self.fibres = path, blocks, blocks.fibres
        self._noted = noted  # bytes of the journal
        self._states: tuple[BlockWriter, BinaryIO] | None = None
        self._lines: list[str] = []
        self._press, self._down = 0, False
        self.done: set[int] = set()
        self.readings = 0
        self.last_s = -np.inf

    @classmethod
    def resume(cls, path: Path) -> "Recorder":
        """Go on with a run directory that was left unfinished; torn tails are cut off.

        Raises:
            InputError: no run directory, damage elsewhere than at its end, links, or presses without any reading.
        """
        fibres = fibres_of(path := as_path("path", path))
        self = cls.__new__(cls)
        with reraise_write_error(path):
            for name in (JOURNAL, READINGS) if unborn(path) else ():  # broken off before the first reading
                (path / name).touch()
            self._journal = open_in_place(path / JOURNAL)
            try:
                lock(self._journal, busy(path))
                done = read_journal(path / JOURNAL)
                _refuse_other_readings(path, fibres, len(done))
                blocks, self._stream, rows = BlockWriter.resume(path / READINGS, fibres)
            except InputError:
                self._journal.close()
                raise
            cut_torn_line(path / JOURNAL)
            self._begin_with(path, blocks, (path / JOURNAL).stat().st_size)
            self._note_time(rows)
            if (path / STATES).exists():
                states, file, state_rows = BlockWriter.resume(path / STATES, len(STATE_COLUMNS) - 1)
                self._states = (states, file)
                self._note_time(state_rows)
        self.done = {press for press, entry in done.items() if entry[3] <= len(rows)}
        self.readings = len(rows)
        for press in sorted(set(done) - self.done):  # or they would count again as soon as enough rows follow
            gone = {"event": "aborted", "press": press, "reading": len(rows), "reason": "its readings were torn off"}
            self._note(gone)
        self.sync()
        self._press = max(self.done, default=-1) + 1
        return self

    def append(self, times_s: ArrayLike, readings: ArrayLike) -> None:
        """Add (n,) times in s and (n, C) volts.

        Raises:
            InputError: shapes that do not fit, or times that are not finite.
            OSError: the disk is full or gone; then nothing was added.
        """
        times, volts = check_numbers(times_s, np.float64, "times"), check_numbers(readings, np.float64, "readings")
        if times.ndim != 1 or volts.shape != (len(times), self.fibres) or not np.isfinite(times).all():
            raise InputError(
                f"times have shape {times.shape} and readings {volts.shape}, expected (n,) finite numbers and "
                f"(n, {self.fibres})"
            )
        rows = np.column_stack([times, volts])
        self._blocks.append(rows)
        self._note_time(rows)
        self.readings += len(rows)

    def append_states(self, rows: Array) -> None:
        """Add (n, 10) states of the arm, by `STATE_COLUMNS`."""
        if self._states is None:
            file = (self._path / STATES).open("xb", buffering=0)
            self._states = (BlockWriter(file, len(STATE_COLUMNS) - 1), file)
        self._states[0].append(rows)
        self._note_time(rows)

    def _note_time(self, rows: Array) -> None:
        if len(rows):
            self.last_s = max(self.last_s, float(rows[-1, 0]))

    def begin(self, place_mm: ArrayLike, reading: int, press: int | None = None, **more: Any) -> None:
        """Note that the probe is sent down at `place_mm` (2,); `reading` is the index of the reading that follows.

        Args:
            place_mm: NaN where it is not known.
            press: its number, by default one more than that of the last.
            more: what else is known of it, as JSON.

        Raises:
            InputError: a place, index or number that no press has, or what JSON cannot hold.
        """
        place = check_numbers(place_mm, np.float64, "place")
        if place.shape != (2,) or not (np.isnan(place).all() or (np.abs(place) <= MAX_MM).all()):
            raise InputError(f"place is {short_repr(place_mm)}, expected x and y up to {MAX_MM:g} mm, or NaN twice")
        number = self._press if press is None else check_int("press", press, 0, MAX_INDEX)
        reading = check_int("reading", reading, 0, MAX_INDEX)
        x, y = (None if np.isnan(value) else value for value in place.tolist())
        self._note({"event": "started", "press": number, "reading": reading, "x_mm": x, "y_mm": y, **more})
        self._press, self._down = number, True

    def finish(self, reading: int, **more: Any) -> None:
        """Note that the probe is sent up; `reading` is the index of the reading that follows.

        Raises:
            InputError: no press was begun, an index that no reading has, or `more` is what JSON cannot hold.
        """
        if not self._down:
            raise InputError(f"press {self._press} was not begun, so it cannot be finished")
        reading = check_int("reading", reading, 0, MAX_INDEX)
        self._note({"event": "done", "press": self._press, "reading": reading, **more})
        self.done.add(self._press)
        self._press, self._down = self._press + 1, False

    def abort(self, reason: str) -> None:
        """Note that the press that was begun, if any is, did not come to its end."""
        if not self._down:
            return
        self._down = False
        self._note({"event": "aborted", "press": self._press, "reading": self.readings, "reason": reason})

    def _note(self, event: Mapping[str, Any]) -> None:
        try:
            self._lines.append(json.dumps(event, allow_nan=False) + "\n")
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError(f"press {event['press']}: {short_repr(event)}, expected what JSON can hold") from error

    def sync(self) -> None:
        """Put all so far on the disk: the readings and states first, then what the journal says of them."""
        self._blocks.flush()
        to_disk(self._stream.fileno())
        if self._states is not None:
            self._states[0].flush()
            to_disk(self._states[1].fileno())
        lines = "".join(self._lines).encode()
        write_at(self._journal, self._noted, lines)
        self._noted += len(lines)
        self._lines.clear()
        to_disk(self._journal.fileno())

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        with contextlib.ExitStack() as files:
            for file in (self._journal, self._stream, *(self._states or ())[1:]):
                files.enter_context(file)
            with contextlib.suppress(*([OSError] if kind else [])):  # the error under way tells more
                self.sync()


def busy(path: Path) -> str:
    """What to say where a recording is locked by the recorder that is at work."""
    return f"{path}: another program is recording into it"


def _refuse_other_readings(path: Path, fibres: int, presses: int) -> None:
    """Raise InputError where no break has left the readings as they are: nothing of them is to be cut off then."""
    times_s = read_blocks(path / READINGS, fibres)[0][:, 0]
    if (presses and not len(times_s)) or not (np.diff(times_s) > 0).all():
        raise InputError(f"{path / READINGS}: not the readings of {presses} presses of {fibres} fibres, told beside it")


def _opened(path: Path) -> BinaryIO:
    path.touch()
    return path.open("r+b", buffering=0)


def _claimed(path: Path) -> BinaryIO:
    """The journal of a recording that is to be born in `check_path`, kept from others; of several that come, one gets
    it."""
    journal = _opened(path / JOURNAL)
    try:
        lock(journal, busy(path))
        if not os.path.samestat(os.fstat(journal.fileno()), (path / JOURNAL).stat()):
            raise InputError(busy(path))  # who had it first gave up and took it away
        refuse_begun(path)
    except BaseException:
        journal.close()
        raise
    return journal


def unborn(path: Path) -> bool:
    """Whether a folder holds nothing but what is made before `start.json`, and that itself; no reading, no press."""
    return all(
        stat.S_ISREG(file.lstat().st_mode)
        and (file.name in (START, _UNBORN) or (file.name in _BIRTH and file.stat().st_size == 0))
        for file in path.iterdir()
    )


def fibres_of(path: Path) -> int:
    """The number of fibres a run directory was recorded of.

    Raises:
        InputError: no run directory, or one that does not say.
    """
    if not (path / START).is_file():
        raise InputError(f"{path}: no recording, expected a folder with {START}, {JOURNAL} and {READINGS}")
    fibres = read_json(path / START, FORMAT).get("fibres")
    if type(fibres) is not int or not 1 <= fibres <= MAX_FIBRES:
        raise InputError(f"{path / START}: fibres is {fibres!r}, allowed is 1 to {MAX_FIBRES}")
    return fibres


def refuse_begun(path: Path) -> None:
    """As `refuse_existing`, but for a recording that was broken off while it was being born: one can begin there."""
    check_writable(path)
    if path.exists() and ((path / START).exists() or not unborn(path)):
        refuse_existing(path)


def refuse_existing(path: Path) -> None:
    """Raise InputError if `check_path` is anything but absent or an empty directory, or cannot be written."""
    check_writable(path)
    if path.exists() and any(path.iterdir()):
        raise InputError(f"{path}: exists and is not empty, recordings are never written over; choose another folder")


STATE_COLUMNS = ("time_s", "x_mm", "y_mm", "z_mm", "rx", "ry", "rz", "speed_mm_s", "force_n", "safety")
"""Columns of a row of `Arm.drain`; force is NaN where the arm has no sensor, safety 1 normal, 0 stopped."""
