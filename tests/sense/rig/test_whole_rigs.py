"""A whole rig without hardware: real drivers of an arm and a board, whose emulators share one simulated pad."""

import json
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from padforge.common.files import UNFINISHED
from padforge.design import Morphology
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense.formats.ros_recording import import_bag
from padforge.sense.recording.press_plan import make_plan
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import Recorder, read_journal
from padforge.sense.rig import clock
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.boards.line_board import LineBoard
from padforge.sense.rig.config import RobotFrame
from padforge.sense.rig.devices import RigFault
from padforge.sense.rig.press_loop import PressLoop
from padforge.sense.settings import RigSettings
from tests.emulators import rigs
from tests.helpers.rigs import rig_toml
from tests.sense.rig.fakes import TERMINALS

pytest.importorskip("serial")
pytest.importorskip("rtde_control")
pytestmark = [TERMINALS[0], pytest.mark.usefixtures("own_address")]

PAD = Morphology.straight(2)
RIG = {"rate_hz": 125, "board_rate_hz": 1000, "readings_per_press": 20, "clearance_mm": 5, "max_force_n": "unwatched"}
RIG |= {"travel_mm_s": 500, "press_mm_s": 250, "acceleration_mm_s2": 3000}
RIG |= {"noise_mv": 0.0, "drift_mv": 0.0, "creep": 0.0, "hysteresis": 0.0}
ARM = rigs.ur5_settings(RigSettings.model_validate(RIG), PAD)


def test_readings_show_presses_when_tip_goes_down(tmp_path: Path) -> None:
    """Readings of the board and states of the controller are on one clock; each press is where it was planned."""
    plan = make_plan(PAD, ARM.model_copy(update={"presses": 4}), np.random.default_rng(0))

    def record(run: Path) -> tuple[float, np.ndarray]:
        """Return the time of the start, and the true poses since then."""
        emulated = rigs.emulate_ur5(PAD, PUBLISHED_CONTACT, ARM, "cb3")  # 125 states a second, not 500
        with emulated as (rig, robot, _), Recorder(run, len(PAD.knots), {}, {}) as recorder:
            driver = LineBoard.from_settings(rig, rig.inputs(len(PAD.knots)))
            with closing(driver), closing(UR5.from_settings(rig)) as arm:
                driver.connect()
                arm.connect()
                start_s = clock.now()
                PressLoop(arm, driver, recorder, rig).run(plan)
            return start_s, robot.pose_log.rows(start_s)

    run = tmp_path / "run"
    try:
        start_s, true_rows = record(run)
    except RigFault:  # a busy machine disturbs a recording, too
        run = tmp_path / "again"
        start_s, true_rows = record(run)
    recording = Recording.open(run)
    assert np.array_equal(recording.presses_mm, plan.positions_mm)
    events = [json.loads(line) for line in (run / "journal.ndjson").read_text().splitlines()]
    reached = np.array([event["at_mm"] for event in events if event["event"] == "done"])
    assert reached == pytest.approx(np.column_stack([plan.positions_mm, plan.depths_mm]), abs=0.1)
    assert np.diff(recording.times_s).max() < 1.5 / recording.rate_hz
    _, depths = RobotFrame.from_settings(ARM).tip(true_rows[:, 1:4])
    touched = np.flatnonzero((depths[1:] > 0) & (depths[:-1] <= 0))
    change = np.abs(recording.readings - np.median(recording.readings, axis=0)).max(axis=1) > 2e-3
    onsets = np.flatnonzero(change[1:] & ~change[:-1]) + 1
    onset_times_s = recording.times_s[onsets] + start_s
    nearest = np.abs(onset_times_s[:, None] - true_rows[touched, 0]).min(axis=1)
    assert len(onsets) == len(plan)
    assert np.ptp(nearest) < 0.03  # a reading is a mean over 8 ms, and shallow touches show late


@pytest.mark.slow
def test_killed_recording_resumes_to_complete_plan(here: Path) -> None:
    """Killed again and again; the arm stays on, pressed where the watchdog stopped it."""
    PAD.save("pad.json")
    command = [sys.executable, "-m", "padforge", "sense", "record", "--rig", "ur5", "--morphology", "pad.json"]
    command += ["--presses", "5", "--out", "run", "--mcap", "--resume"]
    journal, n_done = Path("run", "journal.ndjson"), 0

    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen(command, stderr=subprocess.DEVNULL)

    with rigs.emulate_ur5(PAD, PUBLISHED_CONTACT, ARM) as (settings, _, _):
        Path("pad.toml").write_text(rig_toml(settings, PAD.grid), encoding="utf-8")
        for wait_s in (0.05, 0.35):
            process, end = start(), time.monotonic() + 60
            while not (journal.exists() and len(read_journal(journal)) > n_done):
                assert time.monotonic() < end
                if process.poll() == 1:  # a busy machine disturbs the arm, too
                    process = start()
                time.sleep(0.002)
            time.sleep(wait_s)
            process.kill()
            process.wait()
            presses_before_kill = read_journal(journal)
            n_done = len(presses_before_kill)
        assert any(start().wait(60) == 0 for _ in range(3))  # a busy machine disturbs the arm
    recording = Recording.open(Path("run"))
    assert len(recording.presses_mm) == 5
    assert read_journal(journal).items() >= presses_before_kill.items()
    assert import_bag("run.mcap") == recording
    left = {path.name for path in here.iterdir() if not path.name.startswith(UNFINISHED)}  # those go a day later
    assert left == {"pad.json", "pad.toml", "run", "run.mcap"}
