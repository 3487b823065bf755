"""Whole rigs without hardware: real drivers, and emulators that share one simulated pad, through faults and noise."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from padforge.common.files import UNFINISHED
from padforge.common.progress import OnProgress, ignore_progress
from padforge.design import Morphology
from padforge.design.settings import PUBLISHED_CONTACT
from padforge.sense.formats.ros_recording import import_bag
from padforge.sense.recording.press_plan import PressPlan, make_plan
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import Recorder, read_journal
from padforge.sense.rig import clock
from padforge.sense.rig.arms.printer import Printer
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.boards import board_reader
from padforge.sense.rig.boards.line_board import LineBoard
from padforge.sense.rig.config import RobotFrame
from padforge.sense.rig.devices import Arm, RigFault
from padforge.sense.rig.press_loop import PressLoop
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.pad_model import LivePad
from tests.emulators import rigs
from tests.emulators.printer import EmulatedPrinter
from tests.helpers.rigs import rig_toml

pytest.importorskip("serial")
pytestmark = [
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here"),
    pytest.mark.usefixtures("own_address"),
]

PAD = Morphology.straight(2)
QUIET = {"noise_mv": 0.0, "drift_mv": 0.0, "creep": 0.0, "hysteresis": 0.0}
FAST_AXES = {"max_mm_s": (500.0, 500.0, 100.0), "max_mm_s2": (3000.0, 3000.0, 3000.0)}
"""A printer whose z axis is as fast as the others."""
QUICK = {"rate_hz": 125, "board_rate_hz": 500, "readings_per_press": 20, "clearance_mm": 5}
QUICK |= {"travel_mm_s": 500, "press_mm_s": 250, "acceleration_mm_s2": 3000}
SLOWER = {"rate_hz": 50, "readings_per_press": 30, "clearance_mm": 2.0, "depth_mm": 3.0, "press_mm_s": 100}
ARM = rigs.ur5_settings(RigSettings.model_validate(QUICK | QUIET | {"max_force_n": "unwatched"}), PAD)
PRINTER = rigs.printer_settings(RigSettings.model_validate(QUICK | SLOWER | QUIET), PAD)


emulate_arm = partial(rigs.emulate_ur5, series="cb3")  # 125 states a second, not 500, for a busy machine
ATTEMPTS = 3  # to record, since a busy machine disturbs a recording, too
T = TypeVar("T")


def attempted(record: Callable[[int], T]) -> T:
    """Return the result of the first attempt, by its number, that no fault ends, or of the last one."""
    for attempt in range(ATTEMPTS - 1):
        with suppress(RigFault):
            return record(attempt)
    return record(ATTEMPTS - 1)


class Rig:
    """An emulated rig that lives through several recordings; `robot` is the emulated arm or printer."""

    def __init__(
        self, settings: RigSettings, emulate: Callable[..., Any], make_arm: Callable[[RigSettings], Any]
    ) -> None:
        self.settings, self.stack = settings, ExitStack()
        emulated = emulate(PAD, PUBLISHED_CONTACT, settings)
        named, self.robot, self.board = self.stack.enter_context(emulated)
        inputs = named.inputs(len(PAD.knots))
        self.board_driver = self.stack.enter_context(closing(LineBoard.from_settings(named, inputs)))
        self.arm: Arm = self.stack.enter_context(closing(make_arm(named)))

    def plan(self, presses: int) -> PressPlan:
        return make_plan(PAD, self.settings.model_copy(update={"presses": presses}), np.random.default_rng(0))

    def record(self, run: Path, plan: PressPlan, report: OnProgress = ignore_progress) -> float:
        """Record into `run`, or resume it; return the time of the start."""
        with Recorder.resume(run) if run.exists() else Recorder(run, len(PAD.knots), {}, {}) as recorder:
            self.board_driver.connect()
            self.arm.connect()
            start_s = clock.now()
            report(0, len(plan), "")
            PressLoop(self.arm, self.board_driver, recorder, self.settings).run(plan, report)
        return start_s

    def disturbed(self, run: Path, plan: PressPlan, disturb: Callable[["Rig"], object]) -> str:
        """Record, disturbed after one more press; return the cause of the fault, which is one line."""
        n_disturbed = 1 + (len(read_journal(run / "journal.ndjson")) if run.exists() else 0)

        def report(done: int, of: int, what: str) -> None:
            if done == n_disturbed:
                disturb(self)

        with pytest.raises(RigFault) as caught:
            self.record(run, plan, report)
        assert "\n" not in str(caught.value)
        return caught.value.cause

    def is_at_rest(self) -> bool:
        """Return whether the arm truly rests half a second from now, and the printer for the next nine seconds."""
        clock.sleep(0.5)
        now = clock.now()
        if isinstance(self.robot, EmulatedPrinter):
            return bool(np.ptp(self.robot.true_positions([now, now + 9]), axis=0).max() == 0)
        return bool(np.ptp(self.robot.true_poses([now - 0.05, now - 0.01])[:, :3], axis=0).max() < 0.04)

    def home(self) -> None:
        """Switch a printer off and on and home it, as a person does after a fault."""
        self.robot.restart()
        self.robot.home()


@pytest.fixture(autouse=True, scope="module")
def quick() -> Iterator[None]:
    """Make printers fast, and boards settle soon: their times are exact in one test only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "EmulatedPrinter", partial(EmulatedPrinter, **FAST_AXES))
        patch.setattr(board_reader, "SETTLE_S", 0.15)
        yield


RIGS = {
    "arm at 1000 Hz": (ARM.model_copy(update={"board_rate_hz": 1000.0}), emulate_arm, UR5.from_settings),
    "arm": (ARM.model_copy(update={"channels": (3, 1, 0, 2)}), emulate_arm, UR5.from_settings),
    "printer": (PRINTER, rigs.emulate_printer, Printer.from_settings),
}


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """Open one of `RIGS`."""
    if request.param != "printer":
        pytest.importorskip("rtde_control")
    rig = Rig(*RIGS[request.param])
    with rig.stack:
        yield rig


def assert_complete(run: Path, plan: PressPlan, atol_mm: float = 0.1) -> None:
    """Check that all presses are recorded, where and as deep as planned, and that fibres responded to each."""
    recording = Recording.open(run)
    assert np.array_equal(recording.presses_mm, plan.positions_mm)
    events = [json.loads(line) for line in (run / "journal.ndjson").read_text().splitlines()]
    reached = np.array([event["at_mm"] for event in events if event["event"] == "done"])
    assert reached == pytest.approx(np.column_stack([plan.positions_mm, plan.depths_mm]), abs=atol_mm)
    spans = list(zip(recording.down_command, recording.up_command, strict=True))
    rest = [recording.readings[max(b - 4, 0) : b - 1].mean(axis=0) for b, _ in spans]
    felt = [np.abs(recording.readings[b:u] - rest[press]).max() for press, (b, u) in enumerate(spans)]
    assert min(felt) > 0.01


@pytest.mark.parametrize("rig", ["arm at 1000 Hz"], indirect=True)
def test_readings_show_presses_when_tip_goes_down(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Readings of the board and states of the controller are on one clock."""
    monkeypatch.setattr(board_reader, "SETTLE_S", 0.5)
    plan = rig.plan(4)
    run, start_s = attempted(lambda n: (run := tmp_path / str(n), rig.record(run, plan)))
    assert_complete(run, plan)
    recording, true_rows = Recording.open(run), rig.robot.pose_log.rows()
    assert np.diff(recording.times_s).max() < 1.5 / recording.rate_hz
    true_rows = true_rows[true_rows[:, 0] > start_s]
    _, depths = RobotFrame.from_settings(ARM).tip(true_rows[:, 1:4])
    touched = np.flatnonzero((depths[1:] > 0) & (depths[:-1] <= 0))
    change = np.abs(recording.readings - np.median(recording.readings, axis=0)).max(axis=1) > 2e-3
    onsets = np.flatnonzero(change[1:] & ~change[:-1]) + 1
    onset_times_s = recording.times_s[onsets] + start_s
    nearest = np.abs(onset_times_s[:, None] - true_rows[touched, 0]).min(axis=1)
    assert len(onsets) == len(plan)
    assert np.ptp(nearest) < 0.03  # a reading is a mean over 8 ms, and shallow touches show late


@pytest.mark.usefixtures("steady")
@pytest.mark.parametrize("rig", ["printer"], indirect=True)
def test_printer_presses_as_planned_despite_noise(rig: Rig, tmp_path: Path) -> None:
    plan = rig.plan(2)
    rig.record(tmp_path / "run", plan, lambda done, of, what: rig.robot.garble(1e-3))
    rig.robot.garble(0)
    assert_complete(tmp_path / "run", plan, 0.06)
    moves = rig.robot.firmware.moves
    turned = np.array([move.move.position(move.duration_s) for move in moves]) + PRINTER.tcp_mm
    places, depths = RobotFrame.from_settings(PRINTER).tip(turned)
    presses = np.column_stack([plan.positions_mm, plan.depths_mm])
    assert np.column_stack([places, depths])[depths > 0] == pytest.approx(presses, abs=0.06)


FAULTS: dict[str, tuple[Callable[[Rig], object], str, Callable[[Rig], object]]] = {
    "arm protective stop": (lambda rig: rig.robot.protective_stop(), "protective_stop", lambda rig: rig.robot.clear()),
    "arm drops": (lambda rig: rig.robot.drop("rtde"), "lost", lambda rig: None),
    "arm freezes": (lambda rig: rig.robot.freeze(True), "stale", lambda rig: rig.robot.freeze(False)),
    "board of the arm stalls": (lambda rig: rig.board.stall(), "stale", lambda rig: rig.board.stall(False)),
    "arm emergency stop": (lambda rig: rig.robot.emergency_stop(), "emergency_stop", lambda rig: rig.robot.clear()),
    "arm restarts": (lambda rig: rig.robot.restart(0.4), "lost", lambda rig: clock.sleep(0.3)),
    "board of the arm resets": (lambda rig: rig.board.reset(), "data", lambda rig: None),
    "board of the arm changes": (
        *(lambda rig: rig.board.send_columns(15), "data"),
        lambda rig: rig.board.send_columns(16),
    ),
    "printer halts": (lambda rig: rig.robot.halt(), "emergency_stop", Rig.home),
    "printer is busy": (lambda rig: rig.robot.busy(10), "stale", Rig.home),
    "printer restarts": (lambda rig: rig.robot.restart(), "lost", Rig.home),
}
"""How a rig is disturbed, the cause of the fault that is raised, and the remedy."""


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["arm", "printer"], indirect=True)
def test_recording_survives_faults_and_arm_stops(rig: Rig, tmp_path: Path) -> None:
    """One after the other in one recording, which is resumed after each, in the end with a garbled board."""
    run, plan = tmp_path / "run", rig.plan(12)
    faults = [fault for name, fault in FAULTS.items() if ("printer" in name) == (rig.settings is PRINTER)]
    for press, (disturb, cause, cure) in enumerate(faults, start=1):
        for _ in range(ATTEMPTS):
            raised = rig.disturbed(run, plan, disturb)
            at_rest = rig.is_at_rest()
            cure(rig)
            if raised == cause:
                break
        assert (raised, at_rest) == (cause, True)
        assert set(read_journal(run / "journal.ndjson")) >= set(range(press))
    attempted(lambda n: rig.record(run, plan, lambda done, of, what: rig.board.garble(2e-3)))
    assert_complete(run, plan)
    readings = Recording.open(run).readings
    assert np.abs(readings - np.median(readings, axis=0)).max() < 0.6  # a wrong reading would be an outlier


def test_readings_are_in_order_of_fibres() -> None:
    """As many as the board has inputs, in another order."""
    grid = 8
    pad = Morphology.straight(grid)
    channels = np.random.default_rng(1).permutation(2 * grid).tolist()
    rig = rigs.ur5_settings(RigSettings.model_validate({"channels": channels, **QUIET}), pad)
    emulated = rigs.emulate_ur5(pad, PUBLISHED_CONTACT, rig)
    with emulated as (settings, _, _), closing(LineBoard.from_settings(settings, channels)) as board_driver:
        said = board_driver.connect()
        assert said["inputs"] == list(rig.channels)
        volts = np.median(board_driver.read().volts, axis=0)
    still = LivePad(pad, PUBLISHED_CONTACT, rig, rig.board_rate_hz, np.random.default_rng(rig.seed))
    rests_v = still.volts(np.zeros((1, 2)), np.full(1, -10.0))[0]
    assert volts == pytest.approx(rests_v, abs=3.3 / 4095)
    assert np.unique(volts).size > grid


@pytest.mark.slow
def test_killed_recording_resumes_to_complete_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed again and again; the arm stays on, pressed where the watchdog stopped it."""
    pytest.importorskip("rtde_control")
    monkeypatch.chdir(tmp_path)
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
        assert any(start().wait(60) == 0 for _ in range(ATTEMPTS))
    recording = Recording.open(Path("run"))
    assert len(recording.presses_mm) == 5
    assert read_journal(journal).items() >= presses_before_kill.items()
    assert import_bag("run.mcap") == recording
    left = {path.name for path in tmp_path.iterdir() if not path.name.startswith(UNFINISHED)}  # those go a day later
    assert left == {"pad.json", "pad.toml", "run", "run.mcap"}
