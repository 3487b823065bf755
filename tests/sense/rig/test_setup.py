"""A recording that is gone on with keeps its plan, and is refused where anything that makes a press has changed."""

import json
import re
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings
from padforge.sense.recording.press_plan import make_plan
from padforge.sense.recording.run_directory import START
from padforge.sense.rig.config import RigConfig, kept_plan, plan_of, recorder_of
from padforge.sense.settings import RigSettings

PAD = Morphology.straight(2)
RIG = RigSettings(presses=5, channels=(0, 1, 2, 3))
ARM = {"model": "UR5", "serial": "2018", "controller": "5.12.2", "tcp": [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]}
BOARD = {"name": "padforge-due", "serial": "ab12", "firmware": "1.0.0", "port": "/dev/ttyACM0"}
DEVICES: dict[str, dict[str, Any]] = {"arm": ARM, "board": BOARD}


def setup(out: Path, pad: Morphology = PAD) -> RigConfig:
    return RigConfig(pad, PUBLISHED_CONTACT, RIG, out, "test")


def resumed(out: Path, pad: Morphology = PAD, **settings: Any) -> list:
    """The plan that is gone on with under other settings."""
    return plan_of(setup(out, pad), RIG.model_copy(update=settings), resume=True).to_rows()


@pytest.fixture(scope="module")
def down_command(tmp_path_factory) -> Path:
    """A recording of no press so far, which nobody may change."""
    out = tmp_path_factory.mktemp("down_command")
    with recorder_of(setup(out), RIG, make_plan(PAD, RIG, np.random.default_rng(0)), out, False, DEVICES):
        pass
    return out


def test_a_plan_is_of_a_kind_or_from_a_file_and_is_kept_where_another_is_asked_for_later(down_command, tmp_path):
    assert resumed(down_command, seed=9, presses=3) == resumed(down_command)
    other = replace(setup(down_command), rig=RIG.model_copy(update={"seed": 9, "presses": 30}))
    assert kept_plan(other).endswith("the plan it was begun with, [rig] presses = 5, seed = 0")
    assert kept_plan(setup(down_command)) == kept_plan(replace(other, out=tmp_path / "new")) == ""
    # `--plan` and `[rig] plan` say the same
    (tmp_path / "places.csv").write_text("x_mm,y_mm\n1,2\n-3.5,4\n", encoding="utf-8")
    named = RigSettings(plan=str(tmp_path / "places.csv"), depth_mm=3.0)
    assert named.plan_file == tmp_path / "places.csv"
    assert plan_of(setup(tmp_path / "run"), named, resume=False).to_rows() == [[1, 2, 3], [-3.5, 4, 3]]
    grid = RigSettings(plan="grid", presses=4)
    assert grid.plan_file is None
    assert len(plan_of(setup(tmp_path / "run"), grid, resume=False)) == 4
    with pytest.raises(InputError, match=r"\[rig\] plan: got 'grids', expected uniform, .* or a \.csv file"):
        RigSettings(plan="grids")


def test_a_recording_of_a_rectangle_is_resumed_but_for_holes_that_were_made_since(tmp_path):
    pad = Morphology.random((1, 3), 2, 0, (8.0, 15.0))
    plan = make_plan(pad, RIG, np.random.default_rng(0))
    with recorder_of(setup(tmp_path, pad), RIG, plan, tmp_path, False, DEVICES):
        pass
    assert resumed(tmp_path, pad) == plan.to_rows()
    with pytest.raises(InputError, match="another pad"):
        resumed(tmp_path, Morphology.straight((1, 3), (8.0, 15.0)))
    x, y = plan.positions_mm[1].tolist()
    hole = ((x - 1, y - 1), (x + 1, y - 1), (x, y + 1))
    with pytest.raises(InputError, match=r"press 2, at .* lies in a keep-out"):
        plan_of(replace(setup(tmp_path, pad), size=PadSettings(keep_out_mm=(hole,))), RIG, resume=True)


CHANGES: dict[str, Any] = {
    **{"channels": [0, 1, 3, 2], "rate_hz": 5.0, "readings_per_press": 50, "board_rate_hz": 500.0},
    **{"contact_mm": 12.0, "clearance_mm": 12.0, "travel_mm_s": 90.0, "press_mm_s": 30.0, "acceleration_mm_s2": 400.0},
    **{"depth_mm": 4.0, "depths_mm": [1.0, 2.0], "pad_mm": [1.0, 2.0], "pad_angle_deg": 5.0},
    **{"tool_rad": [0.1, 3.1, 0.0], "tcp_mm": [0.0, 0.0, 150.0], "mirrored": True},
}
"""Settings that change what a press is."""


@pytest.mark.parametrize(("key", "value"), CHANGES.items())
def test_other_settings_are_refused(down_command, key, value):
    with pytest.raises(InputError, match=re.escape(f"[rig] {key}: got {value}, the recording")):
        plan_of(setup(down_command), RigSettings(**RIG.model_dump() | {key: value}), resume=True)


def test_another_pad_is_refused_and_other_limits_addresses_and_sides_that_nobody_named_are_not(down_command, tmp_path):
    limits = {"max_force_n": 30.0, "max_depth_mm": 5.5, "box_mm": (0, 1, 0, 1, 0, 1)}
    resumed(down_command, **limits, host="arm", port="COM3")
    with pytest.raises(InputError, match="another pad"):
        resumed(down_command, Morphology.random(2, 3, 1))
    with pytest.raises(InputError, match="another pad"):  # rather than that its fibres are on other inputs
        resumed(down_command, Morphology.straight(3), channels=())
    document = json.loads((down_command / START).read_text())
    assert document["source"]["rig"].pop("mirrored") is False
    (tmp_path / START).write_text(json.dumps(document))
    for side in (None, False):
        resumed(tmp_path, mirrored=side)
    with pytest.raises(InputError, match=r"mirrored: got True, .* was begun with False"):
        resumed(tmp_path, mirrored=True)


@pytest.mark.parametrize(
    ("device", "key", "value", "goes_on"),
    [
        ("arm", "controller", "5.13.0", True),
        ("board", "port", "/dev/ttyACM1", True),
        ("arm", "serial", "2019", False),
        ("arm", "model", "UR3", False),
        ("arm", "tcp", [0.0, 0.0, 149.0, 0.0, 0.0, 0.0], False),
        ("board", "name", "another", False),
        ("board", "serial", "cd34", False),
        ("board", "firmware", "1.1.0", False),
    ],
)
def test_start_json_keeps_what_devices_said_and_another_arm_tool_or_board_is_refused(
    down_command, tmp_path, device, key, value, goes_on
):
    assert json.loads((down_command / START).read_text())["source"]["devices"] == DEVICES
    out = Path(shutil.copytree(down_command, tmp_path / "run"))
    devices = DEVICES | {device: DEVICES[device] | {key: value}}
    plan = plan_of(setup(out), RIG, resume=True)
    refusal = pytest.raises(InputError, match=re.escape(f"{device}: {key} is {value}, the recording in"))
    with nullcontext() if goes_on else refusal, recorder_of(setup(out), RIG, plan, out, True, devices):
        pass


@pytest.mark.parametrize("source", ["[]", "5", '{"plan": 5}', "{}"])
def test_a_recording_without_a_plan_cannot_be_resumed(tmp_path, source):
    text = f'{{"format": "padforge-recording/2", "fibres": 4, "source": {source}}}'
    (tmp_path / "start.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="has no plan"):
        resumed(tmp_path)
