"""Reading `journal.ndjson`: which presses of a run directory are done, and where."""

import json
from collections.abc import Mapping
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

from design.common.errors import InputError
from design.common.files import read_bytes
from sense.recordings.processing.limits import MAX_INDEX, MAX_MM


def read_journal(path: Path) -> dict[int, tuple[float, float, int, int]]:
    """Place (x, y in mm, NaN where not known) and readings (begun, lifted) of every press that is done, by its number.

    Numbers ascend. A press that was aborted and begun again counts as it was begun last.

    Raises:
        InputError: the file is missing, or a line other than a torn last one is no entry.
    """
    try:
        text = read_bytes(path).decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: no journal ({error})") from error
    begun: dict[int, tuple[float, float, int]] = {}
    done: dict[int, int] = {}
    for number, line in enumerate(text.split("\n")[:-1], start=1):  # what follows the last newline is a torn line
        try:
            event = json.loads(line)
            if not isinstance(event, dict):
                raise ValueError(f"{shortened(event)}, expected an object")
            press, reading = _whole(event, "press"), _whole(event, "reading")
            if event.get("event") == "begun":
                begun[press] = (_place(event, "x_mm"), _place(event, "y_mm"), reading)
                done.pop(press, None)
            elif event.get("event") == "done" and press in begun:
                done[press] = reading
            elif event.get("event") == "aborted" and press in begun:
                del begun[press]
                done.pop(press, None)
            else:
                raise ValueError(f"event {shortened(event.get('event'))} of press {press}")
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: line {number} is no journal entry ({error})") from error
    return {press: (*begun[press], done[press]) for press in sorted(done)}


def cut_torn_line(path: Path) -> None:
    """Take away what follows the last whole line of a journal."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with path.open("r+b") as file:
            file.truncate(whole)


def _whole(event: Mapping[str, Any], key: str) -> int:
    value = event.get(key)
    if type(value) is not int or not 0 <= value <= MAX_INDEX:
        raise ValueError(f"{key} is {shortened(value)}, expected a whole number from 0 to {MAX_INDEX}")
    return value


def _place(event: Mapping[str, Any], key: str) -> float:
    value = event.get(key, "missing")
    if value is None:
        return float("nan")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_MM:
        raise ValueError(f"{key} is {shortened(value)}, expected a number from {-MAX_MM:g} to {MAX_MM:g}, or null")
    return float(value)
