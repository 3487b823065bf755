"""What a recording by hand is kept in, and when it may be gone on with."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from design import Contact, Morphology
from design.common.errors import InputError
from sense.live.by_hand.run_directory import opened
from sense.live.by_hand.session import record_by_hand
from sense.rig.devices.protocols import RigFault
from sense.rig.planning.setup import Setup
from sense.settings import RigSettings

BOARD = {"name": "board", "channels": 4, "rate_hz": 1000.0}


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    """A recording whose first two presses are made, and one at an unknown place."""
    setup = Setup(Morphology.straight(2), Contact(), RigSettings(presses=5), tmp_path / "run", "test", [])
    recorder, targets, left = opened(setup, BOARD, resume=False)
    assert left is targets
    with recorder:
        recorder.append(np.arange(20.0), np.ones((20, 4)))
        for press, place in enumerate((targets[0], (np.nan, np.nan), targets[1])):
            recorder.begin(place, 2 + 5 * press)
            recorder.finish(5 + 5 * press)
    return setup


def test_it_says_what_there_is_to_know(setup: Setup) -> None:
    source = json.loads((setup.out / "start.json").read_text())["source"]
    assert source["kind"] == "hand"
    assert source["devices"]["board"] == BOARD
    assert source["plan"]["columns"] == ["x_mm", "y_mm"]
    assert len(source["plan"]["presses"]) == 5


def test_only_what_is_missing_is_asked_for(setup: Setup) -> None:
    recorder, targets, left = opened(setup, BOARD, resume=True)
    with recorder:
        np.testing.assert_array_equal(left, targets[2:])
        assert recorder.readings == 20


def spoilt(setup: Setup, change: Callable[[dict], None]) -> Setup:
    path = setup.out / "start.json"
    document = json.loads(path.read_text())
    change(document["source"])
    path.write_text(json.dumps(document))
    return setup


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda source: source.update(kind="rig"), "holds a recording of kind 'rig', not 'hand'"),
        (lambda source: source.update(morphology={}), "was begun with another pad"),
        (lambda source: source.update(plan=None), "has no plan"),
        (lambda source: source.update(plan={"presses": [[1, 2, 3]]}), "its plan has shape"),
        (lambda source: source.update(plan={"presses": [["a", 1]]}), "places of the plan"),
    ],
)
def test_another_recording_is_not_gone_on_with(setup: Setup, change: Callable[[dict], None], said: str) -> None:
    with pytest.raises(InputError, match=said):
        opened(spoilt(setup, change), BOARD, resume=True)


def test_other_settings_are_refused(setup: Setup) -> None:
    other = replace(setup, rig=setup.rig.model_copy(update={"rate_hz": 20.0}))
    with pytest.raises(InputError, match=r"\[rig\] rate_hz: got 20.0, the recording in .* was begun with 13.3"):
        opened(other, BOARD, resume=True)


def test_a_recording_killed_while_it_was_being_born_is_not_in_the_way(tmp_path: Path) -> None:
    board = Mock(connect=Mock(side_effect=RigFault("lost", "the board is gone")))
    setup = Setup(Morphology.straight(2), Contact(), RigSettings(), tmp_path / "run", "test", [])
    setup.out.mkdir()
    (setup.out / "journal.ndjson").touch()
    with pytest.raises(RigFault, match="the board is gone"):
        record_by_hand(setup, board, lambda view: None)
    (setup.out / "notes.txt").touch()
    with pytest.raises(InputError, match="never written over"):
        record_by_hand(setup, board, lambda view: None)
