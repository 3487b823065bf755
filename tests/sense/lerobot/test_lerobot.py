"""LeRobot itself opens exported datasets, and records a pad beside an arm."""

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import pytest

from padforge.sense import Localization, Recording
from padforge.sense.formats.lerobot import export_lerobot
from tests.helpers.presses import changed

HERE = Path(__file__).parent
PLUGIN = HERE.parents[2] / "plugins" / "lerobot_robot_padforge"
Run = Callable[..., str]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def lerobot(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run modules with LeRobot, which is installed once for each list of requirements; return their output."""
    requirements, cache = HERE / "requirements.txt", pytestconfig.cache.mkdir("lerobot")  # type: ignore[union-attr]
    texts = (path.read_bytes() for path in [requirements, *sorted(PLUGIN.glob("*.*"))])
    packages = cache / hashlib.sha256(b"".join(texts)).hexdigest()[:12]
    with filelock.FileLock(cache / "lock"):
        if not packages.exists():
            part = tmp_path_factory.mktemp("packages", numbered=True)
            options = ["--disable-pip-version-check", "--no-compile", "--no-deps", "--target", str(part)]
            pip = [sys.executable, "-m", "pip", "install", "-q", *options, "-r", str(requirements), str(PLUGIN)]
            done = subprocess.run(pip, capture_output=True, text=True, check=False)
            if done.returncode:
                # on the machines of CI it must not be missing unnoticed
                (pytest.fail if "CI" in os.environ else pytest.skip)(f"LeRobot cannot be installed: {done.stderr}")
            part.rename(packages)
    home = tmp_path_factory.mktemp("home")
    path = os.pathsep.join(map(str, (HERE, packages)))
    environment = {**os.environ, "PYTHONPATH": path, "HF_HOME": str(home), "HF_HUB_OFFLINE": "1"}

    def run(*words: object) -> str:
        command = [sys.executable, str(HERE / "run.py"), *map(str, words)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        return done.stderr

    return run


def test_lerobot_records_a_pad_and_opens_exported_sets(lerobot: Run, brief: Recording, model: Path, tmp_path) -> None:
    recording, touches = annotated(brief)
    export_lerobot(recording, tmp_path / "exported", touches)
    names = "exported", "recorded"
    said = lerobot(  # all in one process: its imports take longest
        "lerobot.scripts.lerobot_record",
        "--teleop.discover_packages_path=virtual_arm",  # the arm of the tests; the pad is found by its name
        *("--robot.type=padforge", f"--robot.model={model}", "--robot.robot={type: virtual_arm, start: -3}"),
        *("--teleop.type=virtual_leader", f"--dataset.root={tmp_path / 'recorded'}"),
        *("--dataset.repo_id=padforge/test", "--dataset.num_episodes=2"),
        *("--dataset.single_task=Touch.", "--dataset.fps=20", "--dataset.episode_time_s=2"),
        *("--dataset.reset_time_s=0", "--dataset.push_to_hub=false", "--play_sounds=false"),
        *("+", "read_dataset", *(tmp_path / name for name in names)),
    )
    exported, recorded = (json.loads((tmp_path / f"{name}.json").read_text()) for name in names)
    for read in (exported, recorded):
        read["frames"] = {name: np.array(values) for name, values in read["frames"].items()}
    check_exported(exported, recording, touches)
    assert len(recorded["episodes"]) == 2, said
    check_recorded(recorded)


def annotated(brief: Recording) -> tuple[Recording, Localization]:
    """A recording with readings that are missing, and touches mirrored about the middle."""
    presses = len(brief.presses_mm)
    forces, r90 = np.linspace(1, 5, presses), np.linspace(0.5, 2, presses)
    touches = Localization(-brief.presses_mm, np.ones((presses, 2)), r90, r90)
    return replace(changed(brief, "readings", np.s_[50:60, 1], np.nan), forces_n=forces), touches


def check_exported(read: dict[str, Any], recording: Recording, touches: Localization) -> None:
    frames, state, presses = read["frames"], recording.readings.astype(np.float32), len(recording.presses_mm)
    ends = np.append((recording.up_command[:-1] + recording.down_command[1:]) // 2, len(state))
    assert read["episodes"] == np.column_stack([np.append(0, ends[:-1]), ends]).tolist()
    assert (read["fps"], read["robot_type"], set(read["tasks"])) == (13, "padforge", {"Press the pad."})
    np.testing.assert_array_equal(frames["observation.state"], state)
    episodes = np.repeat(np.arange(presses), np.diff(ends, prepend=0))
    np.testing.assert_array_equal(frames["episode_index"], episodes)
    index = np.arange(len(state))
    np.testing.assert_allclose(frames["timestamp"] * 13, index - np.append(0, ends[:-1])[episodes], atol=1e-3)
    is_over = index >= recording.up_command[episodes]
    touch = np.column_stack([-recording.presses_mm[episodes], touches.r90_mm[episodes], np.ones(len(index))])
    np.testing.assert_allclose(frames["observation.touch"], np.where(is_over[:, None], touch, 0), rtol=1e-6)
    statistics = read["stats"]["observation.state"]
    np.testing.assert_allclose(statistics["mean"], np.nanmean(state, axis=0), rtol=1e-5)
    np.testing.assert_allclose(statistics["max"], np.nanmax(state, axis=0), rtol=1e-6)


def check_recorded(read: dict[str, Any]) -> None:
    names, fibres = read["features"]["observation.state"], [f"pad.fibre_{fibre}_v" for fibre in range(4)]
    touch = [f"pad.{name}" for name in ("pressed", "valid", "x_mm", "y_mm", "r90_mm", "unlike")]
    assert names == ["elbow.pos", "wrist.pos", *fibres, *touch]
    state = dict(zip(names, read["frames"]["observation.state"].T, strict=True))
    action = read["frames"]["action"]
    np.testing.assert_array_equal(action[:, 0], -action[:, 1])
    np.testing.assert_array_equal(np.diff(action[:, 0]), 1)
    assert state["elbow.pos"][0] == -3
    np.testing.assert_array_equal(state["elbow.pos"][1:], action[:-1, 0])  # the actions reached the arm
    volts = np.column_stack([state[name] for name in fibres])
    assert (volts > 0.5).all()
    assert (volts < 3).all()
    assert (volts.std(axis=0) > 0).all()
    assert set(state["pad.pressed"]) == {0.0, 1.0}
    assert state["pad.valid"][-1] == 1
    assert (state["pad.r90_mm"][state["pad.valid"] == 1] > 0).all()
    assert not (state["pad.x_mm"][state["pad.valid"] == 0]).any()
