"""Recordings of the published study, and others that lie in MATLAB files."""

from pathlib import Path

import numpy as np

from padforge.design.common.mat_files import load_mat
from padforge.design.common.validation import InputError
from padforge.sense.recordings.processing.limits import Array
from padforge.sense.recordings.recording import Recording

from padforge.sense.recordings.formats.assembly import assembled
from padforge.sense.recordings.formats.mapping import chosen, file_and_mapping, parse_mapping

READINGS_PER_PRESS = 40
"""Length of the published cycle of a press, readings."""
DOWN_AT = 20
"""Reading of the published cycle at which the probe is sent down; it is sent up at the end of the cycle."""
NOTE = "note"
"""What the source of a recording says that was left out of it."""


def import_mat(path: str | Path, mapping: str = "") -> Recording:
    """Read a recording from a MATLAB file: as published, or as a mapping of its variables tells (see `mapping`).

    Published are `voltage` (R, C) volts, `pos` (2, Q) mm, `tim` (1, R) s, 40 readings a press. `pos` may lie the other
    way, (Q, 2); without it, or where it is NaN, the places of the presses are unknown. The last press may be cut off:
    its readings are kept, as those of the press before need them, but it is no press. More readings may follow.

    Raises:
        InputError: the file is torn, of another kind, or its variables do not fit together.
    """
    path, mapping = file_and_mapping(path, mapping)
    return _mapped(path, mapping) if mapping else _published(path)


def _published(path: Path) -> Recording:
    content = load_mat(path, ("voltage", "tim"))
    voltage, tim = (_numbers(content[name], f"{path}: {name}") for name in ("voltage", "tim"))
    if voltage.ndim != 2 or len(voltage) < READINGS_PER_PRESS:
        raise InputError(f"{path}: voltage has shape {voltage.shape}, expected at least {READINGS_PER_PRESS} rows")
    whole = len(voltage) // READINGS_PER_PRESS
    if "pos" in content:
        pos = _numbers(content["pos"], f"{path}: pos")
        if pos.ndim != 2 or 2 not in pos.shape or 0 in pos.shape:
            raise InputError(f"{path}: pos has shape {pos.shape}, expected (2, presses)")
        places = pos.T if pos.shape[0] == 2 else pos
    else:
        places = np.full((whole, 2), np.nan)
    if len(places) > whole + 1:
        raise InputError(
            f"{path}: voltage has shape {voltage.shape}, expected {READINGS_PER_PRESS} rows for each of the "
            f"{len(places)} presses of pos, {READINGS_PER_PRESS * len(places)} in all; only the last may be cut off"
        )
    source = {"kind": "published", "file": path.name} | _note(len(places), len(voltage))
    places = places[:whole]
    begun = READINGS_PER_PRESS * np.arange(len(places)) + DOWN_AT
    try:
        return Recording(voltage, tim.ravel(), places, begun, begun - DOWN_AT + READINGS_PER_PRESS, source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _note(presses: int, readings: int) -> dict[str, str]:
    """What the source says where presses and readings do not end together."""
    rest = readings - READINGS_PER_PRESS * presses
    if rest > 0:
        return {NOTE: f"the last {rest} readings belong to no press"}
    if rest < 0:
        there = READINGS_PER_PRESS + rest
        return {NOTE: f"the last of {presses} presses is left out, with {there} of {READINGS_PER_PRESS} readings"}
    return {}


def _mapped(path: Path, mapping: str) -> Recording:
    parts = parse_mapping(mapping)
    content = load_mat(path, ())
    names = [name for name in content if not name.startswith("__")]
    try:
        found = [(part, names[at]) for part, places in chosen(parts, names) for at in places]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    arrays = [(part, _numbers(content[name], f"{path}: {name}")) for part, name in found]
    return assembled(path, arrays, {"kind": "mat", "file": path.name, "mapping": mapping})


def _numbers(values: object, what: str) -> Array:
    if not isinstance(values, np.ndarray):
        told = values if isinstance(values, str) else "a structure"
        raise InputError(f"{what} is {told}, expected a full matrix of real numbers")
    return values.astype(np.float64)
