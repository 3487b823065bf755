"""What messages round off of a recording, in one message beside them: stamps are whole ns, places m instead of mm."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError, check_float
from padforge.sense.recordings.processing.limits import MAX_S, Array
from padforge.sense.recordings.recording import Recording

from padforge.sense.recordings.formats.ros.topics import UNITS

FORMAT = "padforge-ros/1"
_WHOLE = ("begun", "lifted")
_NUMBERS = ("times_s", "presses_mm", "depths_mm", "reached_mm", "forces_n")
MOST_BYTES, MOST_PARTS = 2**26, 2**21
"""Most that the text may have, and most brackets, braces and quotes in it: Python makes much of little text."""


def written(recording: Recording, epoch_s: float, topics: Mapping[str, object]) -> str:
    """The text for a recording whose stamps count from `epoch_s`, and what is said of the `topics` of its bag.

    Raises:
        InputError: the text is too long to be read back.
    """
    arrays = {name: getattr(recording, name) for name in (*_NUMBERS, *_WHOLE)}
    document = {
        "format": FORMAT,
        "topics": {topic: UNITS[topic] for topic in topics},
        "digest": recording.digest,
        "epoch_s": epoch_s,
        "source": dict(recording.source),
        **{name: _listed(values) for name, values in arrays.items()},
    }
    text = json.dumps(document, allow_nan=False)
    if not _fits(text.encode()):
        raise InputError(
            f"recording is too long for a bag: {len(text)} characters of times, presses and source, "
            f"allowed are {MOST_BYTES}, with {MOST_PARTS} brackets and quotes"
        )
    return text


def _fits(text: bytes) -> bool:
    return len(text) <= MOST_BYTES and sum(map(text.count, (b"[", b"{", b'"'))) <= MOST_PARTS


def _listed(values: Any) -> list[Any]:
    """Numbers for JSON, which has no NaN: None."""
    missing = np.isnan(values)
    return np.where(missing, np.array(None), values).tolist() if missing.any() else values.tolist()


def read(text: bytes, readings: Array) -> tuple[Recording, float, str] | None:
    """The recording of a text, with its (R, C) readings from the messages, its epoch and the digest it had.

    None where the text is of another kind, or does not go with the readings.
    """
    if not _fits(text):
        return None
    try:
        document = json.loads(text)
        if document["format"] != FORMAT:
            return None
        arrays: dict[str, Any] = {name: np.array(document[name], np.float64) for name in (*_NUMBERS, *_WHOLE)}
        recording = Recording(readings=readings, **arrays, source=document["source"])
        epoch_s = check_float("epoch_s", document["epoch_s"], -MAX_S, MAX_S)
        return recording, epoch_s, str(document["digest"])
    except (InputError, KeyError, TypeError, ValueError, OverflowError, RecursionError):
        return None
