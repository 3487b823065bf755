"""Assembly of a recording from the arrays of a foreign file: readings, their times, and presses.

Values that cannot be right are corrected, with a note, if the correction is certain. Otherwise they are refused, and
the message names the mapping that would be right.
"""

import re
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.common.validation import InputError, naming_file
from padforge.sense.arrays import MAX_VOLTS, Array, Indices, Mask, check_numbers
from padforge.sense.formats.columns import ColumnEntry
from padforge.sense.recording.doubts import rate_doubts, suggest_unit
from padforge.sense.recording.recording import (
    FIBRE_NAMES,
    NOTE,
    PRESSES_DETECTED,
    Recording,
    detect_commands,
    median_rate_hz,
)
from padforge.sense.recording.tables import UNKNOWN, name_lines

Arrays = Sequence[tuple[ColumnEntry, NDArray[Any]]]  # arrays of a file, each with its entry of the mapping
MEASURES = {"depth": "depths_mm", "reached": "reached_mm", "force": "forces_n"}
"""Quantities with one value a press, and their attributes of a `Recording`."""
MAX_GAP = 3  # maximum readings without a position that are bridged within a press
MAX_JITTER_MM = 0.5  # maximum change from one reading to the next of a position measured within a press
MAX_NOISE_SHARE = 0.1  # maximum negative force, relative to the largest one, that is the offset of a load cell
MAX_LATE_SHARE = 0.01  # maximum fraction of readings that are left out since their times go back
WRAPS_S = (2**32 / 1e6, 2**32 / 1e3, 2**16 / 1e3, 2**16 / 1e6, 86400.0, 43200.0)
"""Periods of the clocks of boards: counters of us and ms with 32 and 16 bits, and times of day."""


@dataclass
class ForeignArrays:
    """The content of a file, read by a mapping.

    The arrays `time` and `press` have R values; `fibres` is one or more arrays (R, C), (C, R), (R,) or frames
    (R, h, w). `positions` is (n, 2) or (2, n), and x and y are (n,), for n readings or n presses.
    """

    path: Path
    arrays: Arrays
    source: Mapping[str, Any]  # source of the recording, without the names of its fibres
    notes: list[str] = field(default_factory=list)  # a line for each omission in reading
    line_number: Callable[[int], int] | None = None  # returns the line of a row, for messages; by default rows, from 0
    is_own: bool = False  # whether padforge wrote the file, so that positions are exact and every line is a reading
    is_held: bool = False  # whether each value was repeated up to the next one; then a position does not mean a press


def assemble_recording(content: ForeignArrays, presses: Arrays = ()) -> Recording:
    """Return the recording in the arrays of a file; `presses` from a separate table replace those in the file.

    Presses are defined by the first of these that the file has: `down_command` and `up_command`; `press`; positions
    that are missing between presses. Otherwise they are detected in the readings. Where positions, depths or forces
    have one value a reading, a press gets the value in its middle. Raises InputError if the arrays are inconsistent.
    """
    with naming_file(content.path):
        return _assemble(content, presses)


def _assemble(content: ForeignArrays, presses: Arrays) -> Recording:
    notes, arrays = list(content.notes), [*content.arrays, *presses]
    columns, fibres = _scale_arrays(arrays)
    times = columns.pop("time")
    fibres = [(entry, _by_readings(values, len(times))) for entry, values in fibres]
    readings = fibres[0][1] if len(fibres) == 1 else np.column_stack([values for _, values in fibres])
    _check_level(readings, content.source)
    names = [name for entry, values in fibres for name in _fibre_names(entry, values)]
    # 1. Leave out lines without a reading, and repair times.
    by_line = {name: values for name, values in columns.items() if len(values) == len(times)}
    is_reading, is_held = np.ones(len(times), bool), content.is_held
    if not content.is_own:
        is_reading = ~np.isnan(readings).all(axis=1)
        if not is_reading.all() and is_reading.any():
            present = [~np.isnan(values.reshape(len(times), -1)).all(axis=1) for values in by_line.values()]
            if present and not np.any(present & is_reading):  # readings and other values are logged in separate lines
                is_held = True
                columns |= {name: _hold(values) for name, values in by_line.items()}
            notes.append(f"{(~is_reading).sum()} lines without a value of any fibre are not read as readings")
    rows, times = _repair_times(np.where(is_reading, times, np.nan), is_reading, notes, content.line_number)
    if len(rows) < len(is_reading):
        readings = readings[rows]
        columns |= {name: columns[name][rows] for name in by_line}
    # 2. Find the presses.
    timed = {entry.quantity for entry, _ in arrays if entry.factor is not None}
    for name in timed & {"down_command", "up_command"}:
        # The tolerance is for times that were converted to another unit and back, and rounded.
        tolerance = 1e-3 * np.median(np.diff(times)) if len(times) > 1 else 0.0
        columns[name] = np.searchsorted(times, columns[name] - tolerance).astype(np.float64)
    columns = _within(columns, len(times), notes) if presses else columns
    positions, position_rows = _join_positions(columns), np.arange(len(times))
    jitter_mm = 0.0 if content.is_own else MAX_JITTER_MM
    if positions is not None and not content.is_own:
        is_half = np.isnan(positions).any(axis=1)
        if n_half := int((is_half & ~np.isnan(positions).all(axis=1)).sum()):
            notes.append(f"{n_half} positions have one of x and y, and count as missing")
            positions = np.where(is_half[:, None], np.nan, positions)
    if positions is not None and len(positions) == len(times) and not {"press", "down_command"} & columns.keys():
        position_rows = _bridge_gaps(positions, jitter_mm)
        positions = positions[position_rows]
        if n_bridged := int((position_rows != np.arange(len(times))).sum()):
            notes.append(f"{n_bridged} readings within presses lack a position; gaps of up to {MAX_GAP} are bridged")
    commands = _find_presses(columns, None if is_held else positions, len(times), jitter_mm)
    source = {**content.source, FIBRE_NAMES: names}
    if commands is None:
        try:
            commands, source = detect_commands(readings, times, source), {**source, **PRESSES_DETECTED}
        except InputError as error:
            raise InputError("; ".join([str(error), *rate_doubts(median_rate_hz(times), source)])) from error
    down, up = commands

    def at_presses(name: str, values: Array) -> Array:
        if len(values) == len(down):
            return values
        if len(values) != len(times):
            n_expected = f"{len(down)} presses or {len(times)} readings"
            raise InputError(f"{name} are {len(values)}, expected one for each of {n_expected}")
        return values[position_rows[np.clip((down + up) // 2, 0, len(times) - 1)]]

    # 3. Give each press its depth, force and position.
    measures = {name: at_presses(MEASURES[name], columns[name]) for name in MEASURES if name in columns}
    entries = {entry.quantity: entry for entry, _ in arrays}  # those of the table of presses replace earlier ones
    for name in ("depth", "force"):
        if name in measures:
            measures[name] = _correct_sign(entries[name], measures[name], notes)
    presses_mm = np.full((len(down), 2), np.nan) if positions is None else at_presses("positions", positions)
    presses_mm = np.where(presses_mm == UNKNOWN, np.nan, presses_mm)
    source |= {NOTE: "; ".join(notes)} if notes else {}
    by_attribute: dict[str, Any] = {MEASURES[name]: values for name, values in measures.items()}
    return Recording(readings, times, presses_mm, down, up, source, **by_attribute)


def _scale_arrays(arrays: Arrays) -> tuple[dict[str, Array], list[tuple[ColumnEntry, Array]]]:
    """Return the arrays in s, V, mm and N: all except fibres by quantity, and fibres with their entries."""
    columns: dict[str, Array] = {}
    fibres: list[tuple[ColumnEntry, Array]] = []
    for entry, array in arrays:
        values = _scale(entry, entry.select(array))
        if entry.quantity == "fibres":
            fibres.append((entry, values))
        elif entry.quantity == "positions":
            columns["positions"] = values
        elif values.size in values.shape:  # a row or a column
            columns[entry.quantity] = values.ravel()
        else:
            raise InputError(f"{entry.quantity} has shape {values.shape}, expected one row or column")
    if "rate" in columns:
        columns["time"] = np.arange(max(fibres[0][1].shape)) / columns.pop("rate")[0]
    return columns, fibres


def _check_level(readings: Array, source: Mapping[str, Any]) -> None:
    """Raise InputError if most readings are above MAX_VOLTS, and name the unit that they may have."""
    if not np.nanmax(np.abs(readings), initial=0) <= MAX_VOLTS:
        level_v = float(np.nanmedian(np.abs(readings)))
        if np.isfinite(level_v) and level_v > MAX_VOLTS:
            hint = suggest_unit(source, "fibres", readings)
            raise InputError(f"fibres rest at {level_v:.4g} V, allowed is {MAX_VOLTS:g} V; are they {hint}?")


def _scale(entry: ColumnEntry, array: NDArray[Any]) -> Array:
    """Convert values to s, V, mm or N; UNKNOWN is not converted."""
    array = np.asarray(array)
    array = array.astype(np.uint8) if array.dtype.kind == "b" else array
    values = check_numbers(array, np.float64, entry.quantity, copy=False)
    if entry.factor in (None, 1):
        return values
    with np.errstate(over="ignore"):  # a recording refuses infinity
        return np.where(values == UNKNOWN, UNKNOWN, values * entry.factor)


def _by_readings(values: Array, n_readings: int) -> Array:
    """Return (R, c) readings from (R, c), (c, R), (R,), or frames with R along their first or last axis."""
    if values.ndim == 0 or n_readings not in (values.shape[0], values.shape[-1]):
        expected = f"({n_readings}, C) or (C, {n_readings}), {n_readings} as in time"
        raise InputError(f"fibres have shape {values.shape}, expected {expected}")
    by_readings = values if len(values) == n_readings else np.moveaxis(values, -1, 0)
    return by_readings.reshape(n_readings, -1)


def _fibre_names(entry: ColumnEntry, values: Array) -> list[str]:
    """Return the names of the fibres in an array (R, c): its name, with an index if it holds several fibres."""
    if not entry.index and values.shape[1] == 1:
        return [entry.name]
    first = int(re.search(r"\d*", entry.index.lstrip("[:, "))[0] or 0)  # type: ignore[index]
    return [f"{entry.name}[{first + i}]" for i in range(values.shape[1])]


def _hold(values: Array) -> Array:
    """Fill missing values (n, ...) by the last one before them."""
    missing = np.isnan(values.reshape(len(values), -1)).all(axis=1)
    last = np.maximum.accumulate(np.where(missing, -1, np.arange(len(values))))
    return np.where((last < 0).reshape(-1, *[1] * (values.ndim - 1)), np.nan, values[np.maximum(last, 0)])


def _repair_times(
    times_s: Array, is_reading: Mask, notes: list[str], line_number: Callable[[int], int] | None
) -> tuple[Indices, Array]:
    """Make the times (R,) of all rows ascend; return the rows (n,) of the remaining readings, and their times (n,), s.

    Wraps of a clock are undone. Readings whose times are missing (NaN) or go back are left out if they are few;
    otherwise InputError is raised. Equal times are spread between their neighbours. Each correction adds a note.
    """

    def name_rows(rows: Indices) -> str:
        if line_number:
            return name_lines([line_number(int(row)) for row in rows])
        return f"readings {', '.join(map(str, rows[:5]))}{' and more' if len(rows) > 5 else ''} are"

    rows = np.flatnonzero(~np.isnan(times_s))
    if n_untimed := int(is_reading.sum()) - len(rows):
        notes.append(f"{name_rows(np.flatnonzero(is_reading & np.isnan(times_s)))} left out: no time")
        if n_untimed > max(3, 0.05 * len(times_s)):
            raise InputError(f"time is missing in {n_untimed} of {int(is_reading.sum())} readings, expected it in each")
    times = times_s[rows]
    if not (np.diff(times) <= 0).any():
        return rows, times
    # 1. Add the periods of a clock that wraps.
    times, n_wraps = _unwrap(times)
    if n_wraps:
        notes.append(f"the clock began anew {'once' if n_wraps == 1 else f'{n_wraps} times'}; times go on")
    # 2. Leave out single times that go back, so that the longest sequence in order remains.
    if (np.diff(times) < 0).any():
        in_order = _longest_ascent(times)
        late = np.setdiff1d(np.arange(len(times)), in_order)
        if len(late) > max(1, MAX_LATE_SHARE * len(times)):
            row = int(np.flatnonzero(np.diff(times) < 0)[0]) + 1
            where = f"line {line_number(int(rows[row]))}" if line_number else f"reading {row}"
            what = f"times go back from {times[row - 1]:.10g} to {times[row]:.10g} s at {where}"
            raise InputError(f"{what}, expected every reading later than the one before; are there several runs in it?")
        notes.append(f"{name_rows(rows[late])} left out: times go back")
        times, rows = times[in_order], rows[in_order]
    # 3. Spread equal times.
    if n_equal := int((np.diff(times) == 0).sum()):
        if n_equal == len(times) - 1:
            raise InputError(f"times are all {times[0]:g} s, expected every reading later than the one before")
        notes.append(f"{n_equal} times equal the one before; they are spread between their neighbours")
        times = _spread_equal(times)
    return rows, times


def _unwrap(times_s: Array) -> tuple[Array, int]:
    """Add the periods of a clock that wraps to times (n,), s; return these, and the number of wraps."""
    steps, offsets, n_wraps = np.diff(times_s), np.zeros(len(times_s)), 0
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for row in np.flatnonzero(steps < 0):
        for wrap in WRAPS_S:
            # A clock wraps just below its period, which spans many readings; otherwise two lines were swapped.
            if 0 < steps[row] + wrap <= 5 * usual < 0.1 * wrap and 0 <= times_s[row] < wrap:
                offsets[row + 1 :] += wrap
                n_wraps += 1
                break
    return times_s + offsets, n_wraps


def _spread_equal(times_s: Array) -> Array:
    """Spread equal times among times (n,) that never descend, s.

    The middle one of the readings of a shared time keeps it, the others are interpolated between these; at both ends
    they are extrapolated at the mean rate.
    """
    starts = np.flatnonzero(np.append(True, np.diff(times_s) > 0))
    middles, last = (starts + np.append(starts[1:], len(times_s)) - 1) / 2, len(times_s) - 1
    interval = (times_s[-1] - times_s[0]) / (middles[-1] - middles[0])
    first_s, last_s = times_s[0] - interval * middles[0], times_s[-1] + interval * (last - middles[-1])
    knots = np.concatenate([[-1e-9], middles, [last + 1e-9]])
    return np.interp(np.arange(len(times_s)), knots, np.concatenate([[first_s], times_s[starts], [last_s]]))


def _longest_ascent(values: Array) -> Indices:
    """Return the indices of the longest subsequence that never descends, by patience sorting."""
    tails: list[float] = []  # lowest last value of a subsequence, by its length
    tail_rows: list[int] = []
    before = np.full(len(values), -1)
    for row, value in enumerate(values.tolist()):
        length = bisect_right(tails, value)
        before[row] = tail_rows[length - 1] if length else -1
        tails[length : length + 1], tail_rows[length : length + 1] = [value], [row]
    chain = [tail_rows[-1]]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return np.array(chain[::-1])


def _within(columns: Mapping[str, Array], n_readings: int, notes: list[str]) -> dict[str, Array]:
    """Return the columns without the presses of a table that lie outside of the readings."""
    down, up = columns["down_command"], columns["up_command"]
    is_within = (down >= 1) & (up > down) & (down < n_readings)
    if not is_within.any():
        raise InputError("no press of --presses lies within the readings, expected times of the same clock in s")
    if not is_within.all():
        notes.append(f"{(~is_within).sum()} of {len(down)} presses lie outside of the readings, and are left out")
    return {name: values[is_within] if len(values) == len(down) else values for name, values in columns.items()}


def _correct_sign(entry: ColumnEntry, values: Array, notes: list[str]) -> Array:
    """Return depths or forces of presses; a depth of 0 becomes NaN, a force little below 0 becomes 0.

    Raises InputError if most are negative, since then the sign is inverted.
    """
    if 2 * (values < 0).sum() > (~np.isnan(values)).sum():
        factor = -1 if entry.factor is None else -entry.factor
        what = f"{entry.quantity} is below 0 in most presses, such as {np.nanmin(values):g}"
        raise InputError(f"{what}; does it point the other way ({entry.quantity}={entry.name}:{factor:g})?")
    if entry.quantity == "depth" and (values == 0).any():
        notes.append(f"{(values == 0).sum()} depths of presses are 0, and count as missing")
        return np.where(values == 0, np.nan, values)
    is_noise = (values < 0) & (values > -MAX_NOISE_SHARE * np.nanmax(values, initial=0))
    if entry.quantity == "force" and is_noise.any():
        notes.append(f"{is_noise.sum()} forces are little below 0, the least {values[is_noise].min():g} N; they are 0")
        return np.where(is_noise, 0.0, values)
    return values


def _join_positions(columns: Mapping[str, Array]) -> Array | None:
    """Return (n, 2) positions of readings or presses; None if there are none."""
    if "x" in columns:
        x, y = columns["x"], columns["y"]
        if len(x) != len(y):
            raise InputError(f"x has {len(x)} values and y {len(y)}, expected as many")
        return np.column_stack([x, y])
    if "positions" not in columns:
        return None
    positions = columns["positions"]
    if positions.ndim != 2 or 2 not in positions.shape:
        raise InputError(f"positions have shape {positions.shape}, expected (n, 2) or (2, n)")
    return positions if positions.shape[1] == 2 else positions.T


def _find_presses(
    columns: Mapping[str, Array], positions: Array | None, n_readings: int, jitter_mm: float
) -> tuple[Indices, Indices] | None:
    """Return the down and up commands (Q,) that the columns define; None if they define none."""
    if "down_command" in columns:
        down, up = (check_numbers(columns[name], np.int64, name) for name in ("down_command", "up_command"))
        if len(down) != len(up):
            raise InputError(f"down_command has {len(down)} values and up_command {len(up)}, expected as many")
        return down, up
    if "press" in columns:
        press = columns["press"]
        if len(press) != n_readings:
            raise InputError(f"press has {len(press)} values, expected {n_readings}, one a reading")
        missing = np.isnan(press)
        if (press == 0).any() and missing.sum() <= max(1, MAX_LATE_SHARE * n_readings):
            press = _hold(press)  # a cell without a number
        return _find_runs(press[:, None], _is_pressed(press), 0.0)
    if positions is None or len(positions) != n_readings:
        return None
    pressed = ~np.isnan(positions[:, 0])  # x and y are both known or both unknown
    if not pressed.any() or pressed.all():
        return None
    down, up = _find_runs(positions, pressed, jitter_mm)
    # Measured positions that never end once they have begun do not show when the pad is pressed.
    is_endless = jitter_mm > 0 and len(down) > 1 and pressed[down[0] :].all()
    return None if is_endless else (down, up)


def _bridge_gaps(positions: Array, jitter_mm: float) -> Indices:
    """Return the row (R,) of the positions (R, 2) for each reading: its own, or in a short gap the last one before it.

    A short gap has at most MAX_GAP readings, fewer than half as many as the median rest between presses, and the same
    position before and after it.
    """
    positioned = np.flatnonzero(~np.isnan(positions[:, 0]))
    before, after = positioned[:-1], positioned[1:]
    n_missing = after - before - 1
    is_known = positions[before, 0] != UNKNOWN
    is_same = is_known & (np.abs(positions[after] - positions[before]) <= jitter_mm).all(axis=1)
    rests = n_missing[~is_same & (n_missing > 0)]
    max_gap = min(MAX_GAP, (np.median(rests) - 1) // 2) if len(rests) else 0
    rows = np.arange(len(positions))
    for gap in np.flatnonzero(is_same & (n_missing > 0) & (n_missing <= max_gap)):
        rows[before[gap] : after[gap]] = before[gap]
    return rows


def _is_pressed(press: Array) -> Mask:
    """Return whether each value (R,) is positive; unpressed values must be all 0, or all missing or negative."""
    missing, zero = ~(press >= 0), press == 0
    if missing.any() and zero.any():
        raise InputError(
            f"press is missing or negative in row {int(np.argmax(missing))} and 0 in row {int(np.argmax(zero))}, "
            f"expected one of both where the pad is not pressed"
        )
    pressed = ~(missing | zero)
    if pressed.all() or not pressed.any():
        what = "0, missing or negative" if pressed.all() else "above 0"
        raise InputError(f"press is nowhere {what}; without it, presses are detected in the readings")
    return pressed


def _find_runs(values: Array, pressed: Mask, jitter: float) -> tuple[Indices, Indices]:
    """Return the down and up commands of presses: runs of pressed readings with about constant values (R, k).

    From one reading of a run to the next, values change by at most `jitter`.
    """
    steps = np.vstack([np.full((1, values.shape[1]), np.nan), np.abs(np.diff(values, axis=0))])
    down = np.flatnonzero(pressed & ~(steps <= jitter).all(axis=1))
    ends = np.append(np.flatnonzero(~pressed), len(values))
    return down, np.minimum(ends[np.searchsorted(ends, down)], np.append(down[1:], len(values)))
