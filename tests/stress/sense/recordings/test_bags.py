"""Bags of ROS 2, damaged: a recording, or refused in one line."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sense import export_bag, import_bag
from tests.helpers.effort import few
from tests.sense.recordings.formats.ros.foreign import array, write_bag
from tests.stress.damage import damages
from tests.stress.sense.cases import made, right_or_refused

pytest.importorskip("rosbags")

KINDS = ("pad.mcap", "foreign.mcap", "foreign.db3")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder: Path = tmp_path_factory.mktemp("bags")
    export_bag(made(3, presses=12), folder / KINDS[0])
    found = {KINDS[0]: (folder / KINDS[0]).read_bytes()}
    for plugin in ("mcap", "sqlite3"):
        said = [("/skin", 0.1 * at, array("Float64MultiArray", np.array([1.0, 2.0, at % 8 / 8]))) for at in range(60)]
        bag = write_bag(folder / plugin, said, plugin)
        found[f"foreign{bag.suffix}"] = bag.read_bytes()
    return found


@few(60)
@given(name=st.sampled_from(KINDS), damage=damages())
def test_a_damaged_bag_is_a_recording_or_one_line(
    bags: dict[str, bytes],
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    damage: Callable[[bytes], bytes],
) -> None:
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(damage(bags[name]))
    found = right_or_refused(lambda: import_bag(path, "" if name == KINDS[0] else "fibres=/skin"))
    assert found is None or found.lifted[-1] <= len(found.readings)
