"""Recordings from and to other formats, the published MATLAB files and CSV, and places found as CSV.

The CSV form has a header and one line a reading: `time_s`, one column of volts per fibre (any names), then `x_mm` and
`y_mm`. The last two hold the place of the press while the probe is sent down, and are empty on every other line; so
the first line of a run of equal places is where a press begins, and the first line after it where it ends.
"""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from design.errors import InputError
from design.files import atomic, write_text
from design.published import load_mat

from .limits import MAX_FIBRES
from .output import writing
from .recording import Recording
from .tables import read_csv

READINGS_PER_PRESS = 40
"""Length of the published cycle of a press, readings."""
DOWN_AT = 20
"""Reading of the published cycle at which the probe is sent down; it is sent up at the end of the cycle."""

Array = NDArray[np.float64]


def import_mat(path: str | Path) -> Recording:
    """Read a published recording: `voltage` (R, C) volts, `pos` (2, Q) mm, `tim` (1, R) s, 40 readings a press.

    Raises:
        InputError: the file is torn, of another kind, or its variables do not fit together.
    """
    path = Path(path)
    content = load_mat(path, ("voltage", "pos", "tim"))
    voltage, pos, tim = (_numbers(content[name], f"{path}: {name}") for name in ("voltage", "pos", "tim"))
    if pos.ndim != 2 or pos.shape[0] != 2 or pos.shape[1] == 0:
        raise InputError(f"{path}: pos has shape {pos.shape}, expected (2, presses)")
    presses = pos.shape[1]
    least = READINGS_PER_PRESS * presses
    if voltage.ndim != 2 or not least <= len(voltage) < least + READINGS_PER_PRESS:
        raise InputError(
            f"{path}: voltage has shape {voltage.shape}, expected {READINGS_PER_PRESS} rows for each of the "
            f"{presses} presses of pos, {least} in all"
        )
    begun = READINGS_PER_PRESS * np.arange(presses) + DOWN_AT
    source = {"kind": "published", "file": path.name}
    try:
        return Recording(voltage, tim.ravel(), pos.T, begun, begun - DOWN_AT + READINGS_PER_PRESS, source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _numbers(values: NDArray[np.generic], what: str) -> Array:
    if values.dtype.kind not in "fiu":
        raise InputError(f"{what} holds {values.dtype}, expected real numbers")
    return values.astype(np.float64)


def import_csv(path: str | Path) -> Recording:
    """Read a recording in the CSV form of this module.

    Raises:
        InputError: the file is no such CSV; the message names the line.
    """
    path = Path(path)
    table = _read_table(path)
    places = table[:, -2:]
    empty = np.isnan(places)
    half = empty[:, 0] != empty[:, 1]
    if half.any():
        raise InputError(f"{path}: line {int(np.argmax(half)) + 2} has one of x_mm and y_mm, expected both or neither")
    down = ~empty.any(axis=1)
    before = np.vstack([np.full((1, 2), np.nan), places[:-1]])
    begun = np.flatnonzero(down & (places != before).any(axis=1))
    if len(begun) == 0:
        raise InputError(f"{path}: has no press, expected x_mm and y_mm on the lines where the probe is down")
    ends = np.append(np.flatnonzero(~down), len(table))
    lifted = np.minimum(ends[np.searchsorted(ends, begun)], np.append(begun[1:], len(table)))
    try:
        return Recording(table[:, 1:-2], table[:, 0], places[begun], begun, lifted, {"kind": "csv", "file": path.name})
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read_table(path: Path) -> Array:
    """The numbers of a CSV with the expected header; an empty cell is NaN."""
    names, lines = read_csv(path)
    if names[:1] != ["time_s"] or names[-2:] != ["x_mm", "y_mm"] or not 4 <= len(names) <= 3 + MAX_FIBRES:
        found = ",".join(names)[:60] or "nothing"
        hint = "; values are separated by commas, not by semicolons" if ";" in found else ""
        raise InputError(f"{path}: header is {found!r}, expected time_s, one column per fibre, x_mm, y_mm{hint}")
    table = np.empty((len(lines), len(names)))
    for number, line in enumerate(lines):
        if len(line) != len(names):
            raise InputError(f"{path}: line {number + 2} has {len(line)} values, expected {len(names)}")
        try:
            table[number] = [cell or "nan" for cell in line]
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
        places[begun:lifted] = [place] * int(lifted - begun)
    with (
        writing(path),
        atomic(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(header)
        for time, volts, place in zip(recording.times_s.tolist(), recording.readings.tolist(), places, strict=True):
            writer.writerow([time, *volts, *place])


def import_file(path: Path) -> Recording:
    """Read a recording from a published .mat, a .csv or a .h5, by the end of its name.

    Raises:
        InputError: a name with another end, or as the reader of that format.
    """
    from .hdf5 import import_hdf5

    readers = {".mat": import_mat, ".csv": import_csv, ".h5": import_hdf5}
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


def write_places(places_mm: Array, path: str | Path) -> None:
    """Write (Q, 2) places found, mm from the pad's centre, as CSV: press (counted from 0), x_mm, y_mm; atomically.

    Raises:
        InputError: `path` cannot be written.
    """
    lines = [f"{press},{x:.4f},{y:.4f}\n" for press, (x, y) in enumerate(places_mm.tolist())]
    with writing(Path(path)):
        write_text(Path(path), "press,x_mm,y_mm\n" + "".join(lines))
