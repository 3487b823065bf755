"""Mappings of columns, and recordings assembled from arrays."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.formats.assembly import ForeignArrays, assemble_recording
from padforge.sense.formats.columns import ColumnEntry, match_columns, parse_columns
from padforge.sense.recording.recording import PRESSES_DETECTED


def test_match_columns_orders_fibres_by_their_numbers() -> None:
    def order(*names: str, mapping: str = "time=t,fibres=*") -> list[str]:
        return [entry.name for entry, _ in match_columns(parse_columns(mapping), ["t", *names])[1:]]

    assert order("fibre_0_v", "fibre_10_v", "fibre_1_v") == ["fibre_0_v", "fibre_1_v", "fibre_10_v"]
    assert order("c02", "c10", "c1") == ["c1", "c02", "c10"]
    assert order("left", "back", "2nd") == ["left", "back", "2nd"]  # a table has an order of its own
    assert order("c2", "c1", mapping="time=t,fibres=c2,fibres=c1") == ["c2", "c1"]  # as stated


TIMES = np.arange(12) / 10
VOLTS = np.arange(24.0).reshape(12, 2)
PRESSED = np.array([0, 0, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0])
POSITIONS = np.array([[1.0, 2], [-3, 4]])
COMMANDS = {"down_command": np.array([2, 7]), "up_command": np.array([5, 9])}
PROBE = POSITIONS[[0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1]]
"""Position of the probe at each reading."""
NUMBERED = PRESSED * np.array([5] * 6 + [3] * 6)


def assembled(arrays: Mapping[str, np.ndarray], **factors: float) -> Recording:
    content = {"time": TIMES, "fibres": VOLTS} | dict(arrays)
    entries = [(ColumnEntry(name, "?", factors.get(name)), content[name]) for name in content]
    return assemble_recording(ForeignArrays(Path("f"), entries, {}))


@pytest.mark.parametrize(
    "arrays",
    [
        COMMANDS | {"positions": POSITIONS},
        COMMANDS | {"x": POSITIONS[:, 0], "y": POSITIONS[None, :, 1]},
        {"press": PRESSED.astype(bool)[:, None], "positions": PROBE},
        {"press": np.where(PRESSED, NUMBERED, np.nan), "positions": PROBE},
        {"press": np.where(PRESSED, NUMBERED, -1), "positions": POSITIONS.T.astype(np.float32)},
        {"positions": np.where(PRESSED[:, None], PROBE, np.nan)},
    ],
)
def test_assemble_recording_finds_presses_in_any_form(arrays: dict[str, np.ndarray]) -> None:
    recording = assembled(arrays)
    assert recording.down_command.tolist() == [2, 7]
    assert recording.up_command.tolist() == [5, 9]
    # Two positions of two presses may be (2, n) or (n, 2): rows are presses.
    expected = POSITIONS.T if arrays.get("positions", PROBE).dtype == "f4" else POSITIONS
    assert recording.presses_mm.tolist() == expected.tolist()


def test_assemble_recording_detects_presses_in_the_readings(recording: Recording) -> None:
    probe = np.full((len(recording.readings), 2), np.nan)
    for position, down in zip(recording.presses_mm, recording.down_command, strict=True):
        probe[down - 10 :] = position
    probe[:10] = recording.presses_mm[0]
    content = {"time": recording.times_s[:800], "fibres": recording.readings[:800]}
    for positions in (recording.presses_mm[:20], probe[:800]):
        detected = assembled(content | {"positions": positions})
        assert np.array_equal(detected.presses_mm, recording.presses_mm[:20])
        assert np.abs(detected.down_command - recording.down_command[:20]).max() <= 3
        assert PRESSES_DETECTED.items() <= detected.source.items()
    with pytest.raises(InputError, match="positions are 19, expected one for each of 20 presses or 800 readings"):
        assembled(content | {"positions": recording.presses_mm[:19]})


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"fibres": np.ones((11, 2))}, r"fibres have shape \(11, 2\), expected \(12, C\) or \(C, 12\), 12 as in time"),
        ({"press": np.where(PRESSED, 1, np.where(TIMES > 1, -1, 0))}, "press is missing or negative in row 11 and 0"),
        ({"press": 1 + PRESSED}, "press is nowhere 0, missing or negative"),
        (COMMANDS | {"positions": np.ones((3, 2))}, "positions are 3, expected one for each of 2 presses or 12"),
        ({}, "has no press"),
    ],
)
def test_assemble_recording_refuses_arrays_that_do_not_fit(arrays: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(InputError, match=f"f: {message}"):
        assembled(arrays)


def test_assemble_recording_bridges_gaps_of_positions(recording: Recording) -> None:
    """A motion capture loses 5 % of the positions for one reading."""
    positions = np.full((len(recording.times_s), 2), np.nan)
    depths = np.full(len(positions), np.nan)
    for position, down, up in zip(recording.presses_mm, recording.down_command, recording.up_command, strict=True):
        positions[down:up], depths[down:up] = position, 3.0
    lost = np.random.default_rng(0).random(len(positions)) < 0.05
    lost[[*recording.down_command, *(recording.up_command - 1)]] = False
    content = {"time": recording.times_s, "fibres": recording.readings}
    gappy = {"positions": np.where(lost[:, None], np.nan, positions), "depth": np.where(lost, np.nan, depths)}
    bridged = assembled(content | gappy)
    assert np.array_equal(bridged.down_command, recording.down_command)
    assert np.array_equal(bridged.up_command, recording.up_command)
    assert np.array_equal(bridged.presses_mm, recording.presses_mm)
    assert (bridged.depths_mm == 3).all()
    n_lost = int((lost & ~np.isnan(positions[:, 0])).sum())
    assert bridged.source["note"].startswith(f"{n_lost} readings within presses lack a position; gaps of up to 3")


@pytest.mark.parametrize(("gap", "rest", "presses"), [(2, 6, 2), (3, 6, 3), (4, 12, 3)])
def test_assemble_recording_keeps_rests_between_presses(gap: int, rest: int, presses: int) -> None:
    """Two presses on one spot are two if the pad rests as long between others."""
    x = np.array([*[np.nan] * 5, *[1.0] * 5, *[np.nan] * gap, *[1.0] * 5, *[np.nan] * rest, *[2.0] * 5, np.nan])
    content = {"time": np.arange(len(x)) / 10, "fibres": np.ones((len(x), 1)), "x": x, "y": x}
    assert len(assembled(content).down_command) == presses
