"""The run directory of a recording, written so that no finished press is lost.

It contains `start.json` (source and provenance), `readings.bin` and, for an arm, `states.bin` (see `block_file`), and
`journal.ndjson`, with a line when a press starts, with its position and the index of its first reading, and a line when
it is done or aborted. Readings are on the disk before the journal says that a press is done: after a kill all presses
that are done by the journal can be used, and the others are repeated. `start.json` is written last when a recording is
created; a folder without it is empty or was abandoned, and can be used for a recording.
"""

import contextlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from padforge.common.files import (
    LOCK,
    UNFINISHED,
    check_writable,
    locked,
    read_bytes,
    read_json,
    reraise_write_error,
    sync,
    to_disk,
    write_json,
)
from padforge.common.validation import InputError, check_int, check_mapping, check_path, short_repr
from padforge.sense.arrays import MAX_FIBRES, MAX_INDEX, Array, check_numbers
from padforge.sense.recording.block_file import BlockWriter, read_blocks, write_at

FORMAT = "padforge-recording/1"
START, JOURNAL, READINGS, STATES = "start.json", "journal.ndjson", "readings.bin", "states.bin"
FILES = START, JOURNAL, READINGS, STATES
STATE_COLUMNS = ("time_s", "x_mm", "y_mm", "z_mm", "rx", "ry", "rz", "speed_mm_s", "force_n", "safety")
"""Columns of a state of the arm; force is NaN without a sensor, safety 1 normal and 0 stopped."""
_NEW_START = UNFINISHED + START
_BEFORE_START = (JOURNAL, READINGS, _NEW_START)  # files that are created before `start.json`, in this order


class Press(NamedTuple):
    """A press that is done, with the values of the arrays of a `Recording`; NaN if unknown."""

    x_mm: float
    y_mm: float
    down_command: int
    up_command: int
    depth_mm: float
    reached_mm: float
    force_n: float


def read_journal(path: Path) -> dict[int, Press]:
    """Return the presses that are done by their ascending numbers; of a repeated press the last one counts."""
    started: dict[int, Mapping[str, Any]] = {}  # entries of presses that are neither done nor aborted
    done: dict[int, Press] = {}
    for line_number, line in enumerate(io.BytesIO(read_bytes(path)), start=1):
        if not line.endswith(b"\n"):
            break  # a torn line
        try:
            event = json.loads(line)
            press, kind = event["press"], event["event"]
            if kind == "started":
                started[press] = event
                done.pop(press, None)
            elif kind == "done" and press in started:
                done[press] = _finished_press(started.pop(press), event)
            elif kind == "aborted":
                started.pop(press, None)
                done.pop(press, None)
            else:
                raise ValueError(f"event {kind!r} of press {press}")
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise InputError(f"{path}: line {line_number} is no journal entry ({error})") from error
    return dict(sorted(done.items()))


def _finished_press(started: Mapping[str, Any], done: Mapping[str, Any]) -> Press:
    position = started["x_mm"], started["y_mm"]
    measures = started.get("depth_mm"), done.get("at_mm", [None] * 3)[2], done.get("force_n")
    x, y, *numbers = (float("nan") if value is None else float(value) for value in (*position, *measures))
    return Press(x, y, int(started["reading"]), int(done["reading"]), *numbers)


class Recorder:
    """Writes a run directory during a recording: append readings, begin a press, finish it, `sync`.

    Data are guaranteed to be on the disk when `sync` returns; leaving the `with` block syncs and closes.

    Args:
        path: the run directory.
        fibres: number of fibres C.
        source: source of the recording; JSON.
        provenance: provenance of the recording; JSON.

    Attributes:
        done: numbers of the presses that are done.
        n_readings: number of readings so far.
        last_s: time of the last reading or state, s; -inf if there is none.
    """

    def __init__(self, path: Path, fibres: int, source: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
        fibres, path = check_int("fibres", fibres, 1, MAX_FIBRES), check_path("path", path)
        document: dict[str, Any] = {"format": FORMAT, "fibres": fibres}
        for key, value in (("source", source), ("provenance", provenance)):
            document[key] = dict(check_mapping(key, value))
        check_new_recording(path)
        with reraise_write_error(path), contextlib.ExitStack() as lock:
            path.mkdir(parents=True, exist_ok=True)
            lock.enter_context(locked(path, busy_message(path)))
            check_new_recording(path)  # again, under the lock
            present = {file.name for file in path.iterdir()}
            with contextlib.ExitStack() as undo:
                for name in {*_BEFORE_START, START} - present:
                    undo.callback((path / name).unlink, missing_ok=True)
                (path / JOURNAL).touch()
                (path / READINGS).touch()
                write_json(path / _NEW_START, document)
                sync(path / _NEW_START)
                (path / _NEW_START).replace(path / START)
                sync(path)
                sync(path.parent)
                undo.pop_all()
            self._open(path, fibres)
            self._lock = lock.pop_all()

    @classmethod
    def resume(cls, path: Path) -> "Recorder":
        """Continue an unfinished run directory; torn ends are cut off, other damage raises InputError.

        Args:
            path: the run directory.
        """
        fibres = read_fibres(path := check_path("path", path))
        self = cls.__new__(cls)
        with reraise_write_error(path), contextlib.ExitStack() as lock:
            lock.enter_context(locked(path, busy_message(path)))
            if is_uncommitted(path):  # interrupted before the first reading
                for name in (JOURNAL, READINGS):
                    (path / name).touch()
            self._open(path, fibres)
            self._lock = lock.pop_all()
        self.sync()
        return self

    def _open(self, path: Path, fibres: int) -> None:
        """Open the files of a locked run directory, and cut off torn ends."""
        journal = read_journal(path / JOURNAL)
        times_s, _ = read_blocks(path / READINGS, fibres)
        if (journal and not len(times_s)) or not (np.diff(times_s) > 0).all():
            # No interruption can cause this, so nothing is cut off.
            expected = f"ascending readings of {fibres} fibres, for {len(journal)} presses in the journal"
            raise InputError(f"{path / READINGS}: does not fit the recording, expected {expected}")
        self._path, self.fibres, self.last_s = path, fibres, -np.inf
        self._blocks, times_s = BlockWriter.resume(path / READINGS, fibres)
        self._update_last_time(times_s)
        self._states: BlockWriter | None = None
        if (path / STATES).exists():
            self._states, state_times_s = BlockWriter.resume(path / STATES, len(STATE_COLUMNS) - 1)
            self._update_last_time(state_times_s)
        self._journal: BinaryIO = (path / JOURNAL).open("r+b", buffering=0)
        self._journal_bytes = (path / JOURNAL).read_bytes().rfind(b"\n") + 1
        self._journal.truncate(self._journal_bytes)  # without a torn line
        self._lines: list[str] = []
        self.n_readings = len(times_s)
        self.done = {number for number, press in journal.items() if press.up_command <= len(times_s)}
        for number in sorted(journal.keys() - self.done):  # otherwise further readings would make them valid again
            self._write_event("aborted", number, len(times_s), reason="its readings were torn off")
        self._press, self._is_down = max(self.done, default=-1) + 1, False

    def append(self, times_s: ArrayLike, readings: ArrayLike) -> None:
        """Add readings; after an OSError (a full disk) none is added.

        Args:
            times_s: times, ascending; shape (n,), s.
            readings: readings, NaN where missing; shape (n, C), V.
        """
        times, volts = check_numbers(times_s, np.float64, "times"), check_numbers(readings, np.float64, "readings")
        if times.ndim != 1 or volts.shape != (len(times), self.fibres) or not np.isfinite(times).all():
            raise InputError(
                f"times have shape {times.shape} and readings {volts.shape}, expected (n,) finite numbers and "
                f"(n, {self.fibres})"
            )
        rows = np.column_stack([times, volts])
        self._blocks.append(rows)
        self._update_last_time(rows[:, 0])
        self.n_readings += len(rows)

    def append_states(self, rows: Array) -> None:
        """Add states of the arm.

        Args:
            rows: states, by `STATE_COLUMNS`; shape (n, 10).
        """
        if self._states is None:
            self._states = BlockWriter((self._path / STATES).open("xb", buffering=0), len(STATE_COLUMNS) - 1)
            sync(self._path)
        self._states.append(rows)
        self._update_last_time(rows[:, 0])

    def _update_last_time(self, times_s: Array) -> None:
        if len(times_s):
            self.last_s = max(self.last_s, float(times_s[-1]))

    def begin(self, position_mm: ArrayLike, reading: int, press: int | None = None, **more: Any) -> None:
        """Record the start of a press.

        Args:
            position_mm: position (2,); NaN if unknown.
            reading: index of the first reading after the command.
            press: number of the press, by default that of the last one plus 1.
            more: further JSON of the entry, such as `depth_mm`.
        """
        position = check_numbers(position_mm, np.float64, "position")
        if position.shape != (2,) or not (np.isnan(position).all() or np.isfinite(position).all()):
            raise InputError(f"position is {short_repr(position_mm)}, expected x and y in mm, or NaN twice")
        number = self._press if press is None else check_int("press", press, 0, MAX_INDEX)
        reading = check_int("reading", reading, 0, MAX_INDEX)
        x, y = (None if np.isnan(value) else value for value in position.tolist())
        self._write_event("started", number, reading, x_mm=x, y_mm=y, **more)
        self._press, self._is_down = number, True

    def finish(self, reading: int, **more: Any) -> None:
        """Record the end of a press.

        Args:
            reading: index of the first reading after the command.
            more: further JSON of the entry, such as `at_mm` and `force_n`.
        """
        if not self._is_down:
            raise InputError(f"press {self._press} was not begun, so it cannot be finished")
        self._write_event("done", self._press, check_int("reading", reading, 0, MAX_INDEX), **more)
        self.done.add(self._press)
        self._press, self._is_down = self._press + 1, False

    def abort(self, reason: str) -> None:
        """Record that the current press, if any, was aborted for a reason.

        Args:
            reason: the reason, in words.
        """
        if self._is_down:
            self._is_down = False
            self._write_event("aborted", self._press, self.n_readings, reason=reason)

    def _write_event(self, event: str, press: int, reading: int, **more: Any) -> None:
        document = {"event": event, "press": press, "reading": reading, **more}
        try:
            self._lines.append(json.dumps(document, allow_nan=False) + "\n")
        except (TypeError, ValueError) as error:
            raise InputError(f"press {press}: {short_repr(document)}, expected what JSON can hold") from error

    def sync(self) -> None:
        """Write everything to the disk: first readings and states, then the journal."""
        self._blocks.sync()
        if self._states is not None:
            self._states.sync()
        lines = "".join(self._lines).encode()
        write_at(self._journal, self._journal_bytes, lines)
        self._journal_bytes += len(lines)
        self._lines.clear()
        to_disk(self._journal.fileno())

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        with self._lock, contextlib.ExitStack() as files:
            for file in filter(None, (self._journal, self._blocks, self._states)):
                files.callback(file.close)
            with contextlib.suppress(*([OSError] if kind else [])):  # do not hide the error of the body
                self.sync()


def read_fibres(path: Path) -> int:
    """Return the number of fibres of a run directory."""
    if not (path / START).is_file():
        inner = path / "recording"  # name of the recording in the folder of a pad
        expected = inner if (inner / START).is_file() else f"a folder with {START}, {JOURNAL} and {READINGS}"
        raise InputError(f"{path}: no recording, expected {expected}")
    fibres = read_json(path / START, FORMAT).get("fibres")
    if type(fibres) is not int or not 1 <= fibres <= MAX_FIBRES:
        raise InputError(f"{path / START}: fibres is {fibres!r}, allowed is 1 to {MAX_FIBRES}")
    return fibres


def check_new_folder(path: Path) -> None:
    """Raise InputError unless a path is absent or an empty folder, and can be written."""
    check_writable(path)
    if path.exists() and any(file.name != LOCK for file in path.iterdir()):
        raise InputError(f"{path}: exists and is not empty, recordings are never written over; choose another folder")


def check_new_recording(path: Path) -> None:
    """Check like `check_new_folder`, but allow a recording that was interrupted while it was created."""
    check_writable(path)
    if path.exists() and ((path / START).exists() or not is_uncommitted(path)):
        check_new_folder(path)


def is_uncommitted(path: Path) -> bool:
    """Return whether a folder has only files that are created up to `start.json`, without a reading or press."""
    return all(
        file.name in (START, _NEW_START) or (file.name in _BEFORE_START and file.stat().st_size == 0)
        for file in path.iterdir()
        if file.name != LOCK
    )


def busy_message(path: Path) -> str:
    """Return the message for a recording that another recorder has locked."""
    return f"{path}: another program is recording into it"
