"""Recordings from and to CSV.

Columns are `time_s`, one of volts per fibre (of any name; an empty cell is a missing reading), `x_mm` and `y_mm`. These
are the position of the press while the probe is sent down, `?` if it is unknown, and empty on all other lines. A press
is a run of equal positions; if no line or every line has one, presses are detected in the readings. `depth_mm`
(commanded), `reached_mm` and `force_n` follow if any press has them. A mapping (`columns`) names other columns.
"""

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from padforge.common.files import atomic_file, reraise_write_error
from padforge.common.validation import InputError, join_names, naming_file, short_repr
from padforge.sense.arrays import MAX_FIBRES, Array
from padforge.sense.formats.assembly import MEASURES, Arrays, ForeignArrays, assemble_recording
from padforge.sense.formats.columns import (
    UNITS,
    ColumnEntry,
    check_export,
    check_import,
    match_columns,
    order_notes,
    parse_columns,
    read_entries,
)
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.tables import UNKNOWN, Table, read_table

QUANTITIES = ("time", "rate", "fibres", "x", "y", "depth", "reached", "force", "press")
"""Quantities that a column may hold."""
PRESS_COLUMNS = {
    "down": "down_s",
    "up": "up_s",
    "duration": "duration_s",
    "x": "x_mm",
    "y": "y_mm",
    "depth": "depth_mm",
    "reached": "reached_mm",
    "force": "force_n",
}
"""Quantities of a table of presses, and the names of their columns."""
_MEASURED = {PRESS_COLUMNS[quantity]: quantity for quantity in MEASURES}


def import_csv(path: str | Path, columns: str = "", encoding: str = "", presses: Arrays = ()) -> Recording:
    """Read a recording from a table of text.

    Args:
        path: path of the file.
        columns: mapping of its columns, such as `time=t_ms:ms,fibres=ch*`; by default the columns of `export_csv`.
        encoding: encoding of the text; by default detected.
        presses: presses from a separate table, see `read_presses`.
    """
    path, columns = check_import(path, columns)
    entries = parse_columns(columns, QUANTITIES) if columns else None
    table = read_table(path, encoding)
    with naming_file(path):
        matched = match_columns(entries or _exported_entries(table), table.names)
    arrays = _read_matched(table, matched)
    if not columns:
        _check_positions(table, arrays)
    content = ForeignArrays(
        path,
        arrays,
        {"kind": "csv", "file": path.name} | ({"columns": columns} if columns else {}),
        [*table.notes, *(order_notes(matched) if columns else [])],
        table.line_number,
        is_own=not columns,
    )
    return assemble_recording(content, presses)


def read_presses(path: Path, columns: str = "", encoding: str = "") -> Arrays:
    """Read the times and positions of presses from a table with a line for each press, for `assemble_recording`.

    `columns` is a mapping such as `down=t0:ms,duration=d:ms,x=px,y=py`; by default columns have the names of
    `PRESS_COLUMNS`. `down` and one of `up` and `duration` are required. The encoding is detected by default.
    """
    path, columns = check_import(path, columns)
    table = read_table(path, encoding)
    usual = [ColumnEntry(quantity, name) for quantity, name in PRESS_COLUMNS.items() if name in table.names]
    with naming_file(path):
        entries = parse_columns(columns, tuple(PRESS_COLUMNS)) if columns else usual
        named = {entry.quantity for entry in entries}
        if "down" not in named or len(named & {"up", "duration"}) != 1:
            allowed = "down (down_s) and one of up (up_s) and duration (duration_s)"
            raise InputError(f"columns are {', '.join(table.names)}, expected {allowed}; --press-columns names others")
        arrays = {array[0].quantity: array for array in _read_matched(table, match_columns(entries, table.names))}

    def pop_seconds(quantity: str) -> Array:
        entry, values = arrays.pop(quantity)
        return values * (entry.factor or 1.0)

    down = pop_seconds("down")
    up = pop_seconds("up") if "up" in arrays else down + pop_seconds("duration")
    commands = [(ColumnEntry("down_command", "down", 1.0), down), (ColumnEntry("up_command", "up", 1.0), up)]
    return [*commands, *arrays.values()]


def describe_table(path: Path, encoding: str = "") -> list[str]:
    """Return a line for each column of a table, with its unit and first values."""
    table = read_table(path, encoding)
    values = table.read_columns(range(len(table.names)))
    lines = [f"table of {len(values)} lines, text in {table.encoding}" + ("" if table.has_header else ", no header")]
    for name, unit, *cells in zip(table.names, table.units, *table.rows[:3], strict=True):
        in_unit, first_values = f" [{unit}]" if unit else "", ", ".join(cell or "-" for cell in cells)
        lines.append(f"{name or '(no name)'}{in_unit}: {first_values}, ...")
    return lines + table.notes


def _read_matched(table: Table, matched: Sequence[tuple[ColumnEntry, int]]) -> Arrays:
    """Read the columns of entries, by default in the unit of the line of units or in brackets in the header."""
    indices = list(dict.fromkeys(i for _, i in matched if i >= 0))
    values = table.read_columns(indices, [i for entry, i in matched if entry.quantity in "xy"])
    stated, converted = [], dict[str, list[str]]()
    for entry, i in matched:
        bracketed = re.search(r"[\[(]([^\])]+)[\])]$", table.names[i])
        unit = table.units[i].strip("[]() ") or (bracketed[1] if bracketed else "")
        if entry.factor is None and (factor := UNITS[entry.quantity].get(unit)):
            entry = entry._replace(factor=factor)
            if factor != 1:
                converted.setdefault(unit, []).append(table.names[i])
        stated.append((entry, i))
    table.notes += [
        f"{join_names(names)} {'is' if len(names) == 1 else 'are'} in {unit}, as the file says"
        for unit, names in converted.items()
    ]
    return read_entries(stated, lambda i: values[:, indices.index(i)])


def _check_positions(table: Table, arrays: Arrays) -> None:
    """Raise InputError if a line of an exported table has only one of x and y."""
    x_y = [np.isnan(values) for entry, values in arrays if entry.quantity in ("x", "y")]
    if x_y and (incomplete := x_y[0] != x_y[1]).any():
        line = table.line_number(int(np.argmax(incomplete)))
        raise InputError(f"{table.path}: line {line} has one of x_mm and y_mm, expected both or neither")


def _exported_entries(table: Table) -> list[ColumnEntry]:
    """Return the entries of the columns of an exported table."""
    names = table.names
    entries = [ColumnEntry(name[0], name) for name in ("x_mm", "y_mm") if name in names]
    if entries:
        entries += [ColumnEntry(quantity, name) for name, quantity in _MEASURED.items() if name in names]
    fibres = len(names) - 1 - len(entries)
    if not table.has_header:
        last = f"its columns are 1 to {len(names)}, which --columns names, as time=1,fibres=2-{len(names)}"
        raise InputError(f"no line names its columns; {last} (rate=HZ where it has no time)")
    if "time_s" not in names or len(entries) == 1 or not 1 <= fibres <= MAX_FIBRES:
        raise InputError(
            f"header is {short_repr(','.join(names) or 'nothing')}, expected time_s, one column per fibre, x_mm, y_mm; "
            f"columns (--columns) say what others hold"
        )
    return [ColumnEntry("time", "time_s"), *entries, ColumnEntry("fibres", "*")]


def export_csv(recording: Recording, path: str | Path) -> None:
    """Write a recording as CSV, atomically; importing it gives the same numbers.

    Args:
        recording: recording to write.
        path: path of the file, which is replaced.

    Raises:
        InputError: the file cannot be written.
    """
    path = check_export(recording, path)
    measures = {name: getattr(recording, MEASURES[quantity]) for name, quantity in _MEASURED.items()}
    measures = {name: values for name, values in measures.items() if not np.isnan(values).all()}
    positions = np.where(np.isnan(recording.presses_mm), UNKNOWN, recording.presses_mm)
    of_press = np.column_stack([positions, *measures.values()])
    of_press = np.vstack([of_press, np.full_like(of_press[:1], np.nan)])  # the last row is that of no press
    press = np.full(len(recording.times_s), -1)
    for number, span in enumerate(zip(recording.down_command, recording.up_command, strict=True)):
        press[slice(*span)] = number
    with (
        reraise_write_error(path),
        atomic_file(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(["time_s", *(f"fibre_{i}_v" for i in range(recording.fibres)), "x_mm", "y_mm", *measures])
        for row in np.column_stack([recording.times_s, recording.readings, of_press[press]]).tolist():
            writer.writerow(["" if value != value else "?" if value == UNKNOWN else value for value in row])
