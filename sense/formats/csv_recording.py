"""Recordings from and to CSV.

Columns are `time_s`, one of volts per fibre (of any name; an empty cell is a missing reading), `x_mm` and `y_mm`: the
position of the press while the probe is sent down, `?` where it is unknown, and empty on all other lines. A press is a
run of equal positions; where no line or every line has one, presses are detected in the readings. `depth_mm`
(commanded), `reached_mm` and `force_n` follow where any press has them. A mapping (`columns`) names other columns.
"""

import csv
from collections.abc import Iterator
from itertools import repeat
from pathlib import Path

import numpy as np

from padforge.common.files import atomic_file, reraise_write_error
from padforge.common.validation import InputError, short_repr
from padforge.sense.arrays import MAX_FIBRES, Array
from padforge.sense.formats.annotations import check_export
from padforge.sense.formats.columns import (
    MEASURES,
    ColumnEntry,
    assemble_recording,
    check_import,
    match_columns,
    naming_file,
    parse_columns,
)
from padforge.sense.recording.csv_table import CsvTable
from padforge.sense.recording.recording import Recording

QUANTITIES = ("time", "fibres", "x", "y", "depth", "reached", "force", "press")
"""Quantities that a column may hold."""
_MEASURED = {"depth_mm": "depth", "reached_mm": "reached", "force_n": "force"}


def import_csv(path: str | Path, columns: str = "") -> Recording:
    """Read a recording from a CSV file.

    Args:
        path: of the file.
        columns: what its columns hold, as `time=t_ms:ms,fibres=ch*`; by default they are padforge's own.
    """
    path, columns = check_import(path, columns)
    entries = parse_columns(columns, QUANTITIES) if columns else None
    table = CsvTable(path)
    with naming_file(path):
        matched = match_columns(entries or _own_entries(table.names), table.names)
    indices = [i for _, i in matched]
    x_y = [i for entry, i in matched if entry.quantity in "xy"]
    values = table.read_columns(indices, x_y)
    missing = np.isnan(values[:, [indices.index(i) for i in x_y]])
    if (incomplete := missing.any(axis=1) & ~missing.all(axis=1)).any():
        x, y = (table.names[i] for i in x_y)
        line = table.line_number(int(np.argmax(incomplete)))
        raise InputError(f"{path}: line {line} has one of {x} and {y}, expected both or neither")
    arrays = [(entry, column) for (entry, _), column in zip(matched, values.T, strict=True)]
    return assemble_recording(
        path, arrays, {"kind": "csv", "file": path.name} | ({"columns": columns} if columns else {})
    )


def _own_entries(names: list[str]) -> list[ColumnEntry]:
    entries = [ColumnEntry(name[0], name) for name in ("x_mm", "y_mm") if name in names]
    if entries:
        entries += [ColumnEntry(quantity, name) for name, quantity in _MEASURED.items() if name in names]
    fibres = len(names) - 1 - len(entries)
    if "time_s" not in names or len(entries) == 1 or not 1 <= fibres <= MAX_FIBRES:
        raise InputError(
            f"header is {short_repr(','.join(names) or 'nothing')}, expected time_s, one column per fibre, x_mm, y_mm; "
            f"columns (--columns) say what others hold"
        )
    return [ColumnEntry("time", "time_s"), *entries, ColumnEntry("fibres", "*")]


def export_csv(recording: Recording, path: str | Path) -> None:
    """Write a recording as CSV, atomically; importing it gives the same numbers.

    Args:
        recording: to write.
        path: of the file, which is replaced.

    Raises:
        InputError: the file cannot be written.
    """
    path = check_export(recording, path)
    measures = {name: getattr(recording, MEASURES[quantity]) for name, quantity in _MEASURED.items()}
    measures = {name: values for name, values in measures.items() if not np.isnan(values).all()}
    with (
        reraise_write_error(path),
        atomic_file(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(["time_s", *(f"fibre_{i}_v" for i in range(recording.fibres)), "x_mm", "y_mm", *measures])
        press_cells = _press_cells(recording, list(measures.values()))
        for time, volts, press in zip(recording.times_s, recording.readings, press_cells, strict=True):
            writer.writerow([float(time), *_cells(volts), *press])


def _press_cells(recording: Recording, measures: list[Array]) -> Iterator[list[float | str]]:
    """Yield the cells of each reading that say where and how the pad is pressed; empty while it is not."""
    idle: list[float | str] = [""] * (2 + len(measures))
    end = 0
    of_presses = zip(recording.presses_mm, *measures, recording.down_command, recording.up_command, strict=True)
    for (x, y), *press_measures, down, up in of_presses:
        yield from repeat(idle, int(down) - end)
        cells = ["?", "?"] if np.isnan(x) else [float(x), float(y)]
        end = int(up)
        yield from repeat(cells + _cells(press_measures), end - int(down))
    yield from repeat(idle, len(recording.times_s) - end)


def _cells(values: "np.ndarray | list") -> list[float | str]:
    return ["" if value != value else value for value in np.asarray(values).tolist()]  # NaN is missing
