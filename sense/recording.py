"""Recordings: what the fibres gave while a probe pressed known places, and the run directory that keeps it.

A run directory holds `start.json` (what was recorded, with what), `readings.bin` (the stream of readings, see
`stream`) and `journal.ndjson`: one line as a press begins, with its place and the index of its first reading, and one
as it is done. Readings are on the disk before the journal says that a press is done, so after a kill every press the
journal calls done can be used.
"""

import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from reprlib import repr as shortened
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from design.errors import InputError
from design.files import read_json, write_json

from .journal import read_journal
from .limits import MAX_FIBRES, MAX_MM, MAX_RATE_HZ, MAX_S, MAX_VOLTS, MIN_RATE_HZ, numbers, refuse_beyond
from .output import refuse_unwritable, writing
from .stream import BlockWriter, read_blocks

FORMAT = "padforge-recording/1"
START, JOURNAL, READINGS = "start.json", "journal.ndjson", "readings.bin"

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Recording:
    """Readings of a pad and the presses made meanwhile.

    Attributes:
        readings: (R, C) volts, one row per reading, one column per fibre.
        times_s: (R,) ascending, s.
        presses_mm: (Q, 2) places, mm from the pad's centre.
        begun: (Q,) index of the first reading after the probe was sent down.
        lifted: (Q,) index of the first reading after it was sent up; R if none was taken.
        source: where the recording came from; free JSON.
        torn_presses: presses that were left out because the end of the stream was torn off.

    Raises:
        InputError: no numbers, shapes that do not fit together, values that are not finite or beyond the limits of
            this module, times that do not ascend, presses that overlap, one without a reading before it, or a
            source that JSON cannot hold.
    """

    readings: Array
    times_s: Array
    presses_mm: Array
    begun: Indices
    lifted: Indices
    source: Mapping[str, Any] = field(default_factory=dict, compare=False)
    torn_presses: int = field(default=0, compare=False)

    def __post_init__(self) -> None:
        for name, kind in (
            ("readings", np.float64),
            ("times_s", np.float64),
            ("presses_mm", np.float64),
            ("begun", np.int64),
            ("lifted", np.int64),
        ):
            array = numbers(getattr(self, name), kind, name)
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        _validate(self)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Recording):
            return NotImplemented
        names = ("readings", "times_s", "presses_mm", "begun", "lifted")
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)

    __hash__ = None  # type: ignore[assignment]

    @property
    def fibres(self) -> int:
        """C, the number of recorded fibres."""
        return self.readings.shape[1]

    @property
    def rate_hz(self) -> float:
        """Readings per second, by the median interval."""
        return 1 / float(np.median(np.diff(self.times_s)))

    @property
    def digest(self) -> str:
        """Hex SHA-256 of all readings and presses, wherever they are kept."""
        digest = hashlib.sha256()
        for array in (self.readings, self.times_s, self.presses_mm, self.begun, self.lifted):
            digest.update(repr(array.shape).encode() + array.tobytes())
        return digest.hexdigest()

    @classmethod
    def open(cls, path: str | Path) -> "Recording":
        """Read a run directory, finished or not; a torn tail is cut off, with the presses it had.

        Raises:
            InputError: no run directory, a file damaged elsewhere than at its end, or no press in it.
        """
        path = Path(path)
        if not (path / START).is_file():
            raise InputError(f"{path}: no recording, expected a folder with {START}, {JOURNAL} and {READINGS}")
        start = read_json(path / START, FORMAT)
        fibres = start.get("fibres")
        if type(fibres) is not int or not 1 <= fibres <= MAX_FIBRES:
            raise InputError(f"{path / START}: fibres is {fibres!r}, allowed is 1 to {MAX_FIBRES}")
        rows, _ = read_blocks(path / READINGS, fibres)
        done = read_journal(path / JOURNAL)
        presses = [press for press in done if press[3] <= len(rows)]
        table = np.array(presses, dtype=np.float64).reshape(-1, 4)
        try:
            return cls(
                readings=rows[:, 1:],
                times_s=rows[:, 0],
                presses_mm=table[:, :2],
                begun=table[:, 2].astype(np.int64),
                lifted=table[:, 3].astype(np.int64),
                source=start.get("source", {}),
                torn_presses=len(done) - len(presses),
            )
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def save(self, path: str | Path, provenance: Mapping[str, Any]) -> None:
        """Write a run directory that appears whole or not at all.

        Raises:
            InputError: `path` exists and is not an empty directory (a recording is never written over, not even one
                that appeared meanwhile), or cannot be written.
        """
        path = Path(path).resolve()
        refuse_existing(path)
        unfinished = path.with_name(f".{path.name}-{uuid.uuid4().hex}")
        try:
            with Recorder(unfinished, self.fibres, self.source, provenance) as recorder:
                recorder.append(self.times_s, self.readings)
                for place, begun, lifted in zip(self.presses_mm, self.begun, self.lifted, strict=True):
                    recorder.begin(place, int(begun))
                    recorder.done(int(lifted))
            _put(unfinished, path)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)


class Recorder:
    """Writes a run directory as it is recorded: append readings, begin a press, end it, `sync`.

    Nothing is promised to be on the disk before `sync` returns; leaving the `with` block syncs and closes.

    Raises:
        InputError: `path` exists and is not an empty directory, or cannot be written.
    """

    def __init__(self, path: Path, fibres: int, source: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
        refuse_existing(path)
        document = {"format": FORMAT, "fibres": fibres, "source": dict(source), "provenance": dict(provenance)}
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
            try:
                self._stream = (path / READINGS).open("xb")  # of two that start at once, one makes this file
            except FileExistsError:
                refuse_existing(path)
                raise
            write_json(path / START, document)
            self._journal = (path / JOURNAL).open("x", encoding="utf-8")
        self._blocks = BlockWriter(self._stream, fibres)
        self._lines: list[str] = []
        self._press = 0

    def append(self, times_s: ArrayLike, readings: ArrayLike) -> None:
        """Add (n,) times in s and (n, C) volts."""
        self._blocks.append(np.column_stack([np.asarray(times_s, dtype=np.float64), readings]))

    def begin(self, place_mm: ArrayLike, reading: int) -> None:
        """Note that the probe is sent down at `place_mm` (2,); `reading` is the index of the reading that follows."""
        x, y = np.asarray(place_mm, dtype=np.float64).tolist()
        self._note({"event": "begun", "press": self._press, "reading": reading, "x_mm": x, "y_mm": y})

    def done(self, reading: int) -> None:
        """Note that the probe is sent up; `reading` is the index of the reading that follows."""
        self._note({"event": "done", "press": self._press, "reading": reading})
        self._press += 1

    def _note(self, event: Mapping[str, Any]) -> None:
        self._lines.append(json.dumps(event, allow_nan=False) + "\n")

    def sync(self) -> None:
        """Put all so far on the disk: the readings first, then what the journal says of them."""
        self._blocks.flush()
        os.fsync(self._stream.fileno())
        self._journal.writelines(self._lines)
        self._lines.clear()
        self._journal.flush()
        os.fsync(self._journal.fileno())

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stream, self._journal:
            self.sync()


def refuse_existing(path: Path) -> None:
    """Raise InputError if `path` is anything but absent or an empty directory, or cannot be written."""
    refuse_unwritable(path)
    if path.exists() and any(path.iterdir()):
        raise InputError(f"{path}: exists and is not empty, recordings are never written over; choose another folder")


def _put(unfinished: Path, path: Path) -> None:
    """Rename a run directory to `path`, unless another came there first."""
    with writing(path):
        try:
            if path.exists():
                path.rmdir()
            unfinished.rename(path)
        except OSError:
            refuse_existing(path)
            raise


def _validate(recording: Recording) -> None:
    if not isinstance(recording.source, Mapping):
        raise InputError(f"source is {shortened(recording.source)}, expected a mapping")
    try:
        json.dumps(dict(recording.source), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"source is {shortened(dict(recording.source))}, expected what JSON can hold ({error})"
        ) from error
    readings, presses = recording.readings, recording.presses_mm
    if readings.ndim != 2 or not 1 <= readings.shape[1] <= MAX_FIBRES or len(readings) < 2:
        raise InputError(f"readings have shape {readings.shape}, expected (R, C), R >= 2, C = 1 to {MAX_FIBRES}")
    if recording.times_s.shape != (len(readings),):
        raise InputError(f"times have shape {recording.times_s.shape}, expected ({len(readings)},)")
    if presses.ndim != 2 or presses.shape[1] != 2 or len(presses) == 0:
        raise InputError(f"presses have shape {presses.shape}, expected (Q, 2) with at least one press")
    if recording.begun.shape != (len(presses),) or recording.lifted.shape != (len(presses),):
        raise InputError(f"{len(presses)} presses have {recording.begun.size} begins and {recording.lifted.size} ends")
    for name, values, limit, unit in (
        ("readings", readings, MAX_VOLTS, "V"),
        ("times", recording.times_s, MAX_S, "s"),
        ("presses", presses, MAX_MM, "mm"),
    ):
        refuse_beyond(name, values.reshape(len(values), -1), limit, unit)
    if (np.diff(recording.times_s) <= 0).any():
        row = int(np.argmax(np.diff(recording.times_s) <= 0)) + 1
        raise InputError(f"times do not ascend at reading {row}, expected every reading later than the one before")
    if not MIN_RATE_HZ <= recording.rate_hz <= MAX_RATE_HZ:
        raise InputError(
            f"times give {recording.rate_hz:g} readings a second, allowed is {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g}"
        )
    edges = np.column_stack([recording.begun, recording.lifted]).ravel()
    late = np.diff(edges, prepend=0, append=len(readings) + 1) < 1
    if late.any():
        press = min(int(np.argmax(late)) // 2, len(presses) - 1)
        raise InputError(
            f"press {press} goes from reading {recording.begun[press]} to {recording.lifted[press]}, "
            f"expected presses that do not overlap, each after at least one reading and within {len(readings)}"
        )
