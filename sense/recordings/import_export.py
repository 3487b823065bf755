"""Recordings from and to other formats: the published MATLAB files, and CSV.

The CSV form has a header and one line a reading: `time_s`, one column of volts per fibre (any names; an empty cell is
a missing reading), then `x_mm` and `y_mm`. The last two hold the place of the press while the probe is sent down, `?`
where it is not known, and are empty on every other line; so the first line of a run of equal places is where a press
begins, and the first line after it where it ends. Where no line has a place, or the two columns are not there, presses
are found in the readings (`press_detection`).
"""

import csv
from collections.abc import Callable
from math import isnan
from pathlib import Path
from reprlib import repr as shortened

import numpy as np

from design.common.errors import InputError
from design.common.files import atomic, writing
from design.pad.published_files import load_mat
from sense.recordings.processing.limits import MAX_FIBRES, Array

from .csv_table import read_csv
from .recording import Recording

FILES = (".mat", ".csv", ".h5")
"""Ends of the names of files that hold a recording: published, of any origin, and exported."""

READINGS_PER_PRESS = 40
"""Length of the published cycle of a press, readings."""
DOWN_AT = 20
"""Reading of the published cycle at which the probe is sent down; it is sent up at the end of the cycle."""

FOUND = {"presses": "found"}
"""What the source of a recording says whose presses were found in its readings."""
UNKNOWN = -1.7e308
"""Stands for `?` among numbers; far beyond any place."""


def import_mat(path: str | Path) -> Recording:
    """Read a published recording: `voltage` (R, C) volts, `pos` (2, Q) mm, `tim` (1, R) s, 40 readings a press.

    `pos` may lie the other way, (Q, 2); without it, or where it is NaN, the places of the presses are unknown.

    Raises:
        InputError: the file is torn, of another kind, or its variables do not fit together.
    """
    path = Path(path)
    content = load_mat(path, ("voltage", "tim"))
    voltage, tim = (_numbers(content[name], f"{path}: {name}") for name in ("voltage", "tim"))
    if voltage.ndim != 2 or len(voltage) < READINGS_PER_PRESS:
        raise InputError(f"{path}: voltage has shape {voltage.shape}, expected at least {READINGS_PER_PRESS} rows")
    if "pos" in content:
        pos = _numbers(content["pos"], f"{path}: pos")
        if pos.ndim != 2 or 2 not in pos.shape or 0 in pos.shape:
            raise InputError(f"{path}: pos has shape {pos.shape}, expected (2, presses)")
        places = pos.T if pos.shape[0] == 2 else pos
    else:
        places = np.full((len(voltage) // READINGS_PER_PRESS, 2), np.nan)
    least = READINGS_PER_PRESS * len(places)
    if not least <= len(voltage) < least + READINGS_PER_PRESS:
        raise InputError(
            f"{path}: voltage has shape {voltage.shape}, expected {READINGS_PER_PRESS} rows for each of the "
            f"{len(places)} presses of pos, {least} in all"
        )
    begun = READINGS_PER_PRESS * np.arange(len(places)) + DOWN_AT
    source = {"kind": "published", "file": path.name}
    try:
        return Recording(voltage, tim.ravel(), places, begun, begun - DOWN_AT + READINGS_PER_PRESS, source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _numbers(values: object, what: str) -> Array:
    if not isinstance(values, np.ndarray):
        raise InputError(f"{what} is a {type(values).__name__}, expected a full matrix of real numbers")
    if values.dtype.kind not in "fiu":
        raise InputError(f"{what} holds {values.dtype}, expected real numbers")
    return values.astype(np.float64)


def import_csv(path: str | Path) -> Recording:
    """Read a recording in the CSV form of this module.

    Raises:
        InputError: the file is no such CSV, or no press is in it; the message names the line.
    """
    path = Path(path)
    table = _read_table(path)
    readings, times_s, places = table[:, 1:-2], table[:, 0], table[:, -2:]
    empty = np.isnan(places)
    half = empty[:, 0] != empty[:, 1]
    if half.any():
        raise InputError(f"{path}: line {int(np.argmax(half)) + 2} has one of x_mm and y_mm, expected both or neither")
    down = ~empty.any(axis=1)
    source = {"kind": "csv", "file": path.name}
    try:
        if not down.any():
            return _found(readings, times_s, source)
        before = np.vstack([np.full((1, 2), np.nan), places[:-1]])
        begun = np.flatnonzero(down & (places != before).any(axis=1))
        ends = np.append(np.flatnonzero(~down), len(table))
        lifted = np.minimum(ends[np.searchsorted(ends, begun)], np.append(begun[1:], len(table)))
        pressed = np.where(places[begun] == UNKNOWN, np.nan, places[begun])
        return Recording(readings, times_s, pressed, begun, lifted, source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _found(readings: Array, times_s: Array, source: dict[str, str]) -> Recording:
    """A recording of the presses that the readings show, their places unknown."""
    from sense.recordings.processing.press_detection import as_commanded, find_presses

    first = np.array([1])  # a press that is none: refuses what are no readings, before they are searched
    Recording(readings, times_s, np.zeros((1, 2)), first, first + 1, source)
    presses = find_presses(readings, times_s)
    if len(presses.touched) == 0:
        raise InputError("has no press: no line has x_mm and y_mm, and none is found in the readings")
    begun, lifted = as_commanded(presses, times_s)
    return Recording(readings, times_s, np.full((len(begun), 2), np.nan), begun, lifted, source | FOUND)


def _read_table(path: Path) -> Array:
    """The numbers of a CSV with the expected header, the places last; an empty cell is NaN, and `?` is `UNKNOWN`."""
    names, lines = read_csv(path)
    placed = names[-2:] == ["x_mm", "y_mm"]
    fibres = len(names) - (3 if placed else 1)
    if names[:1] != ["time_s"] or not 1 <= fibres <= MAX_FIBRES:
        found = ",".join(names) or "nothing"
        hint = "; values are separated by commas, not by semicolons" if ";" in found else ""
        raise InputError(
            f"{path}: header is {shortened(found)}, expected time_s, one column per fibre, x_mm, y_mm{hint}"
        )
    table = np.full((len(lines), fibres + 3), np.nan)
    for number, line in enumerate(lines):
        if len(line) != len(names):
            raise InputError(f"{path}: line {number + 2} has {len(line)} values, expected {len(names)}")
        places = [UNKNOWN if cell.strip() == "?" else cell for cell in line[1 + fibres :]]
        try:
            table[number, : len(names)] = [cell or "nan" for cell in (*line[: 1 + fibres], *places)]
        except ValueError as error:
            raise InputError(f"{path}: line {number + 2} holds no numbers ({error})") from error
    return table


def export_csv(recording: Recording, path: str | Path) -> None:
    """Write `recording` in the CSV form of this module, atomically; importing it gives the same numbers.

    Raises:
        InputError: `path` cannot be written.
    """
    path = Path(path)
    header = ["time_s", *(f"fibre_{i}_v" for i in range(recording.fibres)), "x_mm", "y_mm"]
    places: list[list[float | str]] = [["", ""] for _ in recording.times_s]
    for place, begun, lifted in zip(recording.presses_mm.tolist(), recording.begun, recording.lifted, strict=True):
        cells: list[float | str] = ["?", "?"] if isnan(place[0]) else place
        places[begun:lifted] = [cells] * int(lifted - begun)
    with writing(path), atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for time, volts, place in zip(recording.times_s.tolist(), recording.readings.tolist(), places, strict=True):
            writer.writerow([time, *("" if isnan(value) else value for value in volts), *place])


def open_recording(path: str | Path) -> Recording:
    """A recording, wherever it lies: a run directory, finished or not, or a file that `import_file` knows.

    Raises:
        InputError: as `Recording.open` and `import_file`.
    """
    path = Path(path)
    return import_file(path) if path.suffix.lower() in FILES and not path.is_dir() else Recording.open(path)


def is_recording(path: Path) -> bool:
    """Whether a path is that of a recording: a folder, or a file that holds readings."""
    if path.suffix.lower() == ".mat" and path.is_file():
        return "voltage" in load_mat(path, ())
    return path.is_dir() or path.suffix.lower() in FILES


def import_file(path: Path) -> Recording:
    """Read a recording from a published .mat, a .csv or a .h5, by the end of its name.

    Raises:
        InputError: a name with another end, or as the reader of that format.
    """
    from .hdf5 import import_hdf5

    readers: dict[str, Callable[[Path], Recording]] = {".mat": import_mat, ".csv": import_csv, ".h5": import_hdf5}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: ends in {path.suffix!r}, allowed are {', '.join(readers)}")
    return readers[path.suffix.lower()](path)


def export_file(recording: Recording, path: Path) -> None:
    """Write a recording as .csv or .h5, by the end of the name.

    Raises:
        InputError: a name with another end, or `path` cannot be written.
    """
    from .hdf5 import export_hdf5

    writers = {".csv": export_csv, ".h5": export_hdf5}
    if path.suffix.lower() not in writers:
        raise InputError(f"{path}: ends in {path.suffix!r}, allowed are {', '.join(writers)}")
    writers[path.suffix.lower()](recording, path)
