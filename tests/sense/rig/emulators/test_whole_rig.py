"""The whole rig without hardware: the real ur-rtde and pyserial against emulators that share one simulated pad."""

import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from design import Contact, Morphology
from sense.recordings.press_journal import read_journal
from sense.recordings.recorder import Recorder
from sense.recordings.recording import Recording
from sense.rig.devices import RigFault
from sense.rig.emulators import whole_rig
from sense.rig.emulators.whole_rig import emulated, emulated_rig
from sense.rig.planning.press_plan import PressPlan, planned
from sense.rig.session.pad_frame import Frame
from sense.rig.session.press_loop import Session
from sense.settings import RigSettings
from tests.stress.clock import few

pytest.importorskip("rtde_control")
pytestmark = pytest.mark.usefixtures("own_address")

PAD = Morphology.straight(2)
QUICK = {
    **{"readings_per_press": 20, "clearance_mm": 5},
    **{"travel_mm_s": 500, "press_mm_s": 250, "acceleration_mm_s2": 3000},
}
RIG = emulated_rig(RigSettings.model_validate({"rate_hz": 125, "presses": 6, **QUICK}), PAD)
PLAN = planned(PAD, RIG, np.random.default_rng(0))
SHORT = PressPlan(PLAN.places_mm[:3], PLAN.depths_mm[:3])
PROGRAM = """
import sys
from sense.rig.emulators import whole_rig
whole_rig.HOST = sys.argv.pop(1)
import padforge
padforge.main()
"""


@pytest.fixture(scope="module")
def own_address(address: str) -> Iterator[None]:
    """Rigs are emulated at the address of this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole_rig, "HOST", address)
        yield


def record(
    run: Path, disturb: Callable[..., None] | None = None, plan: PressPlan = PLAN
) -> tuple[RigFault | None, float, float]:
    """Record into `run`, disturbed once after two presses; the fault, how long it took to be told, and the arm's speed
    by the emulator's truth half a second after it was told, mm/s."""
    disturbed = [float("inf")]
    with emulated(PAD, Contact(), RIG) as (arm, converter, robot, board):

        def report(done: int, of: int) -> None:
            if disturb is not None and done == 2:
                disturbed[0] = time.monotonic()
                disturb(robot, board)

        recorder = Recorder.resume(run) if run.exists() else Recorder(run, RIG.channels, {}, {})
        try:
            with recorder:
                arm.connect()
                converter.connect()
                Session(arm, converter, recorder, RIG).run(plan, report)
        except RigFault as fault:
            told = time.monotonic() - disturbed[0]
            time.sleep(0.5)
            now = time.monotonic()
            a, b = robot.pose_at([now - 0.05, now - 0.01])[:, :3]
            return fault, told, float(np.linalg.norm(b - a)) / 0.04
    return None, 0.0, 0.0


def test_every_press_comes_through_the_drivers(tmp_path):
    fault, _, _ = record(tmp_path / "run")
    assert fault is None
    recording = Recording.open(tmp_path / "run")
    assert np.array_equal(recording.presses_mm, PLAN.places_mm)
    events = [json.loads(line) for line in (tmp_path / "run" / "journal.ndjson").read_text().splitlines()]
    reached = np.array([event["at_mm"] for event in events if event["event"] == "done"])
    assert reached == pytest.approx(np.column_stack([PLAN.places_mm, PLAN.depths_mm]), abs=0.1)
    assert np.diff(recording.times_s).max() < 1.5 / recording.rate_hz
    assert events[-1]["lost"] == 0


def test_presses_show_in_the_readings_when_the_tip_goes_down(tmp_path):
    """One clock: where the tip is, by the controller's states, and what the fibres give, by the board's samples."""
    quiet = RIG.model_copy(update={"noise_mv": 0.0, "drift_mv": 0.0, "creep": 0.0, "hysteresis": 0.0})
    with emulated(PAD, Contact(), quiet) as (arm, converter, robot, _):
        with Recorder(tmp_path / "run", RIG.channels, {}, {}) as recorder:
            arm.connect()
            converter.connect()
            began = time.monotonic()
            Session(arm, converter, recorder, quiet).run(PLAN)
        recording = Recording.open(tmp_path / "run")
        truth = robot.truth.rows()
    _, depths = Frame.of(quiet).tip(truth[:, 1:4])
    touched = np.flatnonzero((depths[1:] > 0) & (depths[:-1] <= 0))
    change = np.abs(recording.readings - np.median(recording.readings, axis=0)).max(axis=1) > 2e-3
    onsets = np.flatnonzero(change[1:] & ~change[:-1]) + 1
    told = recording.times_s[onsets] + began
    nearest = np.abs(told[:, None] - truth[touched, 0]).min(axis=1)
    assert len(onsets) == len(PLAN)
    assert np.ptp(nearest) < 0.03  # a reading is a mean over 8 ms, and shallow touches show late


@pytest.mark.parametrize(
    ("disturb", "cause"),
    [
        (lambda robot, board: robot.protective_stop(), "protective_stop"),
        (lambda robot, board: robot.emergency_stop(), "emergency_stop"),
        (lambda robot, board: robot.drop("rtde"), "lost"),
        (lambda robot, board: robot.freeze(True), "stale"),
        (lambda robot, board: robot.restart(1.0), "lost"),
        (lambda robot, board: board.unplug(), "lost"),
        (lambda robot, board: board.stall(), "stale"),
    ],
    ids=["protective", "emergency", "drop", "freeze", "restart", "unplug", "stall"],
)
def test_a_fault_in_mid_run_stops_the_arm_and_loses_nothing(tmp_path, disturb, cause):
    fault, told, speed = record(tmp_path / "run", disturb, SHORT)
    assert fault is not None
    assert fault.cause == cause
    assert "\n" not in str(fault)
    assert told < 5
    assert speed < 1
    assert set(read_journal(tmp_path / "run" / "journal.ndjson")) >= {0, 1}
    assert record(tmp_path / "run", plan=SHORT)[0] is None
    assert np.array_equal(Recording.open(tmp_path / "run").presses_mm, SHORT.places_mm)


def test_damaged_bytes_cost_samples_but_never_give_wrong_ones(tmp_path):
    fault, _, _ = record(tmp_path / "run", lambda robot, board: board.garble(1e-3))
    assert fault is None
    recording = Recording.open(tmp_path / "run")
    assert len(recording.presses_mm) == len(PLAN)
    rest = np.median(recording.readings, axis=0)
    assert np.abs(recording.readings - rest).max() < 0.6


def test_a_killed_recorder_resumes_to_the_whole_plan(tmp_path, address):
    """Killed while a press is under way: once a day, three times under stress."""
    settings = "[pad]\ngrid = 2\n[rig]\nrate_hz = 125.0\n" + "".join(
        f"{key} = {value}\n" for key, value in QUICK.items()
    )
    (tmp_path / "pad.toml").write_text(settings, encoding="utf-8")
    root = Path(__file__).parents[4]
    command = [sys.executable, "-c", PROGRAM, address, "sense", "record", "--through-drivers", "--presses", "8"]
    command += ["--out", "run", "--resume"]
    environment = os.environ | {"PYTHONPATH": str(root)}
    journal = tmp_path / "run" / "journal.ndjson"
    kept: set[int] = set()
    rng = random.Random(0)
    for _ in range(min(few(1).max_examples, 3)):
        process = subprocess.Popen(command, cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL)
        end = time.monotonic() + 60
        while not (journal.exists() and len(read_journal(journal)) >= min(len(kept) + 2, 8)):
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.02)
        time.sleep(rng.uniform(0, 0.3))
        process.kill()
        process.wait()
        assert set(read_journal(journal)) >= kept
        kept = set(read_journal(journal))
        assert len(kept) >= 2
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert len(Recording.open(tmp_path / "run").presses_mm) == 8
    assert "nothing to resume" not in done.stderr
