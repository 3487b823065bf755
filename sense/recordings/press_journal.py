"""Reading `journal.ndjson`: which presses of a run directory are done, where, how deep and with which force."""

import json
from collections.abc import Mapping
from pathlib import Path
from reprlib import repr as shortened
from typing import Any, NamedTuple

from padforge.design.common.files import read_bytes
from padforge.design.common.validation import InputError
from padforge.sense.recordings.processing.limits import MAX_INDEX, MAX_MM, MAX_N

from padforge.sense.recordings.block_file import open_in_place


class Press(NamedTuple):
    """A press that is done; see `Recording`, whose arrays hold one entry of each. NaN where something is not known."""

    x_mm: float
    y_mm: float
    begun: int
    lifted: int
    depth_mm: float
    reached_mm: float
    force_n: float


def read_journal(path: Path) -> dict[int, Press]:
    """Every press that is done, by its number.

    Numbers ascend. A press that was aborted and begun again counts as it was begun last.

    Raises:
        InputError: the file is missing, or a line other than a torn last one is no entry.
    """
    try:
        text = read_bytes(path).decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: no journal ({error})") from error
    begun: dict[int, tuple[float, float, int, float]] = {}
    done: dict[int, tuple[int, float, float]] = {}
    for number, line in enumerate(text.split("\n")[:-1], start=1):  # what follows the last newline is a torn line
        try:
            event = json.loads(line)
            if not isinstance(event, dict):
                raise ValueError(f"{shortened(event)}, expected an object")
            press, reading = _whole(event, "press"), _whole(event, "reading")
            if event.get("event") == "begun":
                place = (_number(event, "x_mm", MAX_MM), _number(event, "y_mm", MAX_MM))
                begun[press] = (*place, reading, _number(event, "depth_mm", MAX_MM, None))
                done.pop(press, None)
            elif event.get("event") == "done" and press in begun:
                done[press] = (reading, _reached(event), _number(event, "force_n", MAX_N, None))
            elif event.get("event") == "aborted" and press in begun:
                del begun[press]
                done.pop(press, None)
            else:
                raise ValueError(f"event {shortened(event.get('event'))} of press {press}")
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}: line {number} is no journal entry ({error})") from error
    presses = ((press, *begun[press], *done[press]) for press in sorted(done))
    return {
        press: Press(x, y, first, lifted, depth, reached, force)
        for press, x, y, first, depth, lifted, reached, force in presses
    }


def cut_torn_line(path: Path) -> None:
    """Take away what follows the last whole line of a journal."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with open_in_place(path) as file:
            file.truncate(whole)


def _whole(event: Mapping[str, Any], key: str) -> int:
    value = event.get(key)
    if type(value) is not int or not 0 <= value <= MAX_INDEX:
        raise ValueError(f"{key} is {shortened(value)}, expected a whole number from 0 to {MAX_INDEX}")
    return value


def _reached(event: Mapping[str, Any]) -> float:
    """The last of `at_mm`, where the tip was on the pad: x, y and depth."""
    at = event.get("at_mm", [None] * 3)
    if not isinstance(at, list) or len(at) != 3:
        raise ValueError(f"at_mm is {shortened(at)}, expected x, y and depth")
    return _number({"at_mm": at[2]}, "at_mm", MAX_MM)


def _number(event: Mapping[str, Any], key: str, limit: float, missing: object = "missing") -> float:
    value = event.get(key, missing)
    if value is None:
        return float("nan")
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= limit:
        raise ValueError(f"{key} is {shortened(value)}, expected a number from {-limit:g} to {limit:g}, or null")
    return float(value)
