"""Recordings put together from arrays, whichever way presses are told in them."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.formats.columns import FOUND, Part, assembled

TIMES = np.arange(12) / 10
VOLTS = np.arange(24.0).reshape(12, 2)
PRESSED = np.array([0, 0, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0])
PLACES = np.array([[1.0, 2], [-3, 4]])
EDGES = {"down_command": np.array([2, 7]), "up_command": np.array([5, 9])}
AT = PLACES[[0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1]]
"""Where the probe was meanwhile."""


def made(arrays: Mapping[str, np.ndarray], **factors: float) -> Recording:
    content = {"time": TIMES, "fibres": VOLTS} | dict(arrays)
    return assembled(Path("f"), [(Part(name, "?", factors.get(name)), content[name]) for name in content], {})


NUMBERED = PRESSED * np.array([5] * 6 + [3] * 6)
MISSING = np.where(PRESSED, NUMBERED, np.nan)


@pytest.mark.parametrize(
    "arrays",
    [
        EDGES | {"places": PLACES},
        EDGES | {"x": PLACES[:, 0], "y": PLACES[None, :, 1]},
        EDGES | {"places": AT.T},
        {"press": PRESSED, "places": PLACES},
        {"press": PRESSED.astype(bool)[:, None], "places": AT},
        {"press": MISSING, "places": AT},
        {"press": np.where(PRESSED, NUMBERED, -1), "places": PLACES.T.astype(np.float32)},
        {"places": np.where(PRESSED[:, None], AT, np.nan)},
        {"x": np.where(PRESSED, AT[:, 0], np.nan), "y": np.where(PRESSED, AT[:, 1], np.nan)},
    ],
)
def test_presses_are_told_in_many_ways(arrays: dict[str, np.ndarray]) -> None:
    recording = made(arrays)
    assert recording.down_command.tolist() == [2, 7]
    assert recording.up_command.tolist() == [5, 9]
    # two places for two presses may lie either way; then rows are taken
    assert recording.presses_mm.tolist() == (PLACES.T if arrays.get("places", AT).dtype == "f4" else PLACES).tolist()


def test_readings_lie_one_way_or_the_other_and_units_are_put_right() -> None:
    assert np.array_equal(made(EDGES | {"fibres": VOLTS.T}).readings, VOLTS)
    one = made(EDGES | {"fibres": VOLTS[:, 0], "time": TIMES[None]})
    assert np.array_equal(one.readings, VOLTS[:, :1])
    parts = [(Part("time", ""), TIMES), (Part("fibres", ""), VOLTS[:, 1]), (Part("fibres", "", 2.0), VOLTS.T)]
    several = assembled(Path("f"), [*parts, *((Part(name, ""), EDGES[name]) for name in EDGES)], {})
    assert np.array_equal(several.readings, np.column_stack([VOLTS[:, 1], 2 * VOLTS]))
    told = {"time": 1000 * TIMES, "fibres": (1000 * VOLTS).astype(np.int32), "places": PLACES / 10}
    edges = {"down_command": np.array([150, 601]), "up_command": np.array([500, 801])}
    recording = made(told | edges, **dict.fromkeys(("time", "fibres", "down_command", "up_command"), 1e-3), places=10)
    expected = made(EDGES | {"places": PLACES})
    for name in ("times_s", "readings", "presses_mm", "down_command", "up_command"):
        np.testing.assert_allclose(getattr(recording, name), getattr(expected, name), rtol=1e-12)
    times, down_command = 0.0751879 * np.arange(4000), np.arange(20, 3900, 40)
    told = {"time": times, "fibres": np.ones((4000, 1)), "places": np.zeros((len(down_command), 2))}
    recording = made(
        told | {"down_command": 1000 * times[down_command], "up_command": 1000 * times[down_command + 20]},
        down_command=1e-3,
        up_command=1e-3,
    )
    assert np.array_equal(
        [recording.down_command, recording.up_command], [down_command, down_command + 20]
    )  # a rounding off times of readings


def test_presses_that_nothing_tells_are_found(recording: Recording) -> None:
    at = np.full((len(recording.readings), 2), np.nan)
    for place, down_command in zip(recording.presses_mm, recording.down_command, strict=True):
        at[down_command - 10 :] = place
    at[:10] = recording.presses_mm[0]
    content = {"time": recording.times_s[:800], "fibres": recording.readings[:800]}
    for places in (recording.presses_mm[:20], at[:800]):
        found = made(content | {"places": places})
        assert np.array_equal(found.presses_mm, recording.presses_mm[:20])
        assert np.abs(found.down_command - recording.down_command[:20]).max() <= 3
        assert FOUND.items() <= found.source.items()
    with pytest.raises(InputError, match="places are 19, expected one for each of 20 presses or 800 readings"):
        made(content | {"places": recording.presses_mm[:19]})


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"time": np.ones((3, 4))}, r"time has shape \(3, 4\), expected one row or column"),
        ({"time": np.array(["a", "b"])}, "time are"),
        ({"fibres": np.ones((11, 2))}, r"fibres have shape \(11, 2\), expected \(12, C\) or \(C, 12\), as time has it"),
        ({"press": PRESSED[:11]}, "press has 11 values, expected 12, one a reading"),
        ({"press": np.where(PRESSED, 1, np.where(TIMES > 1, -1, 0))}, "press is missing or negative in row 11 and 0"),
        ({"press": 0 * PRESSED}, "press is nowhere above 0; without it, presses are found"),
        ({"press": 1 + PRESSED}, "press is nowhere 0, missing or negative"),
        ({"press": np.array([0, 0, 1, 1, 2, 2, 0, 0, 0, 0, 0, 0])}, "press 1 goes from reading 4"),
        (EDGES | {"up_command": np.array([5])}, "begun has 2 values and lifted 1"),
        (EDGES | {"down_command": np.array([2.5, 7])}, "begun are .* whole numbers"),
        (EDGES | {"places": np.ones((3, 2))}, "places are 3, expected one for each of 2 presses or 12 readings"),
        (EDGES | {"places": np.ones((2, 2, 2))}, r"places have shape \(2, 2, 2\)"),
        (EDGES | {"x": np.ones(2), "y": np.ones(3)}, "x has 2 values and y 3"),
        ({"places": np.where(np.arange(24).reshape(12, 2) == 6, 1.0, np.nan)}, "places have one of x and y in row 3"),
        ({}, "has no press"),
    ],
)
def test_arrays_that_do_not_fit_are_one_line(arrays: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(InputError, match=f"f: {message}"):
        made(arrays)
