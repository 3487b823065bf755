"""Recordings from and to CSV.

The form of padforge has a header and one line a reading: `time_s`, one column of volts per fibre (any names; an empty
cell is a missing reading), then `x_mm` and `y_mm`. The last two hold the place of the press while the probe is sent
down, `?` where it is not known, and are empty on every other line; so the first line of a run of equal places is where
a press begins, and the first line after it where it ends. Where they are known of any press, `depth_mm` (commanded),
`reached_mm` and `force_n` follow. Where no line has a place, every line has one, or the two columns are not there,
presses are found in the readings (`press_detection`).

Other forms are told by a mapping (see `mapping`)."""

import csv
from math import isnan
from pathlib import Path
from reprlib import repr as shortened

import numpy as np

from padforge.design.common.files import atomic_file, reraise_write_error
from padforge.design.common.validation import InputError
from padforge.sense.arrays import MAX_FIBRES, Array
from padforge.sense.formats.annotations import export_path
from padforge.sense.formats.columns import MEASURES, Part, assembled, chosen, file_and_mapping, parse_mapping
from padforge.sense.recording.csv_table import CsvTable
from padforge.sense.recording.recording import Recording

QUANTITIES = ("time", "fibres", "x", "y", "depth", "reached", "force", "press")
"""What a line can hold."""
TIME, FIBRES, PLACES = Part("time", "time_s"), Part("fibres", "*"), (Part("x", "x_mm"), Part("y", "y_mm"))
MEASURED = (Part("depth", "depth_mm"), Part("reached", "reached_mm"), Part("force", "force_n"))
"""Columns of padforge's own form; the last ones are there where any of their values is known."""


def import_csv(path: str | Path, mapping: str = "") -> Recording:
    """Read a recording in the CSV form of this module, or in one that a mapping tells, as `time=t_ms:ms,fibres=ch*`.

    Raises:
        InputError: the file is no such CSV, or no press is in it; the message names the line.
    """
    path, mapping = file_and_mapping(path, mapping)
    parts = parse_mapping(mapping, QUANTITIES) if mapping else None
    table = CsvTable(path)
    try:
        columns = chosen(parts or _own(table.names), table.names)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    numbers = [at for _, places in columns for at in places]
    unknown = [places[0] for part, places in columns if part.quantity in "xy"]
    values = table.columns(numbers, unknown)
    _refuse_half(table, values, numbers, unknown)
    ends = np.cumsum([len(places) for _, places in columns])
    arrays = np.split(values, ends[:-1], axis=1)
    source = {"kind": "csv", "file": path.name} | ({"mapping": mapping} if mapping else {})
    return assembled(path, [(part, array) for (part, _), array in zip(columns, arrays, strict=True)], source)


def _own(names: list[str]) -> list[Part]:
    """What the columns of padforge's own form hold."""
    places = [part for part in PLACES if part.name in names]
    places += [part for part in MEASURED if places and part.name in names]
    fibres = len(names) - 1 - len(places)
    if TIME.name not in names or len(places) == 1 or not 1 <= fibres <= MAX_FIBRES:
        raise InputError(
            f"header is {shortened(','.join(names) or 'nothing')}, expected time_s, one column per fibre, x_mm, y_mm; "
            f"a mapping tells what other columns hold"
        )
    return [TIME, *places, FIBRES]


def _refuse_half(table: CsvTable, values: Array, numbers: list[int], unknown: list[int]) -> None:
    """Raise InputError where a line has one coordinate alone."""
    empty = np.isnan(values[:, [numbers.index(at) for at in unknown]])
    half = empty.any(axis=1) & ~empty.all(axis=1)
    if half.any():
        x, y = (table.names[at] for at in unknown)
        line = table.line(int(np.argmax(half)))
        raise InputError(f"{table.path}: line {line} has one of {x} and {y}, expected both or neither")


def export_csv(recording: Recording, path: str | Path) -> None:
    """Write `recording` in the CSV form of this module, atomically; importing it gives the same numbers.

    Raises:
        InputError: `path` cannot be written.
    """
    path = export_path(recording, path)
    measures = {part.name: getattr(recording, MEASURES[part.quantity]) for part in MEASURED}
    measures = {name: values for name, values in measures.items() if not np.isnan(values).all()}
    header = ["time_s", *(f"fibre_{i}_v" for i in range(recording.fibres)), "x_mm", "y_mm", *measures]
    places: list[list[float | str]] = [[""] * (2 + len(measures)) for _ in recording.times_s]
    presses = np.column_stack([recording.presses_mm, *measures.values()]).tolist()
    for press, down_command, up_command in zip(presses, recording.down_command, recording.up_command, strict=True):
        place: list[float | str] = ["?", "?"] if isnan(press[0]) else press[:2]
        cells = [*place, *("" if isnan(value) else value for value in press[2:])]
        places[down_command:up_command] = [cells] * int(up_command - down_command)
    with (
        reraise_write_error(path),
        atomic_file(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(header)
        for time, volts, place in zip(recording.times_s.tolist(), recording.readings.tolist(), places, strict=True):
            writer.writerow([time, *("" if isnan(value) else value for value in volts), *place])
