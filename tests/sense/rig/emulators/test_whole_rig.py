"""The whole rig without hardware: the real ur-rtde and pyserial against emulators that share one simulated pad."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from design import Morphology
from design.settings import PUBLISHED_CONTACT
from sense.recordings.press_journal import read_journal
from sense.recordings.press_plan import PressPlan, planned
from sense.recordings.recorder import Recorder
from sense.recordings.recording import Recording
from sense.rig.boards import block_reader
from sense.rig.devices.protocols import RigFault
from sense.rig.emulators.whole_rig import emulated, emulated_rig
from sense.rig.session.pad_frame import Frame
from sense.rig.session.press_loop import Report, Session
from sense.settings import RigSettings

pytest.importorskip("rtde_control")

PAD = Morphology.straight(2)
QUICK = {"rate_hz": 125, "readings_per_press": 20, "clearance_mm": 5}
FAST = {"travel_mm_s": 500, "press_mm_s": 250, "acceleration_mm_s2": 3000}
QUIET = {"noise_mv": 0.0, "drift_mv": 0.0, "creep": 0.0, "hysteresis": 0.0}
RIG = emulated_rig(RigSettings.model_validate({"presses": 6, **QUICK, **FAST, **QUIET}), PAD)
PLAN = planned(PAD, RIG, np.random.default_rng(0))
SHORT = PressPlan(PLAN.places_mm[:4], PLAN.depths_mm[:4])


class Rig:
    """An emulated rig that is kept from one recording to the next."""

    def __init__(self) -> None:
        self.kept = ExitStack()
        self.anew()

    def anew(self) -> None:
        """Another rig in the place of this one."""
        self.kept.close()
        self.arm, self.converter, self.robot, self.board = self.kept.enter_context(
            emulated(PAD, PUBLISHED_CONTACT, RIG)
        )

    def record(self, run: Path, plan: PressPlan, report: Report = lambda done, of: None) -> float:
        """Record into `run` or go on with it; when that began."""
        with Recorder.resume(run) if run.exists() else Recorder(run, 2 * PAD.grid, {}, {}) as recorder:
            self.arm.connect()
            self.converter.connect()
            began = time.monotonic()
            Session(self.arm, self.converter, recorder, RIG).run(plan, report)
        return began

    def disturbed(self, run: Path, disturb: Callable[["Rig"], object]) -> tuple[RigFault, float, float]:
        """Record into `run`, disturbed after one press; the fault, how long it took to be told, and the arm's speed
        by the emulator's truth half a second after it was told, mm/s."""
        moment = 0.0

        def report(done: int, of: int) -> None:
            nonlocal moment
            moment = time.monotonic()
            disturb(self)

        with pytest.raises(RigFault) as caught:
            self.record(run, PLAN, report)
        told = time.monotonic() - moment
        time.sleep(0.5)
        now = time.monotonic()
        a, b = self.robot.pose_at([now - 0.05, now - 0.01])[:, :3]
        return caught.value, told, float(np.linalg.norm(b - a)) / 0.04


@pytest.fixture(scope="module")
def rig(own_address: None) -> Iterator[Rig]:
    rig = Rig()
    with rig.kept:
        yield rig


@pytest.fixture
def soon_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where times need not be exact, connecting need not take long."""
    monkeypatch.setattr(block_reader, "SETTLE_S", 0.15)


class Made(NamedTuple):
    """A recording, when it began, and what the arm has really done since."""

    run: Path
    began: float
    truth: NDArray[np.float64]


@pytest.fixture(scope="module")
def made(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The short plan, undisturbed."""
    run = tmp_path_factory.mktemp("made") / "run"
    began = rig.record(run, SHORT)
    truth = rig.robot.truth.rows()
    return Made(run, began, truth[truth[:, 0] > began])


def test_every_press_comes_through_the_drivers(made: Made) -> None:
    recording = Recording.open(made.run)
    assert np.array_equal(recording.presses_mm, SHORT.places_mm)
    events = [json.loads(line) for line in (made.run / "journal.ndjson").read_text().splitlines()]
    reached = np.array([event["at_mm"] for event in events if event["event"] == "done"])
    assert reached == pytest.approx(np.column_stack([SHORT.places_mm, SHORT.depths_mm]), abs=0.1)
    assert np.diff(recording.times_s).max() < 1.5 / recording.rate_hz
    assert events[-1]["lost"] == 0


def test_presses_show_in_the_readings_when_the_tip_goes_down(made: Made) -> None:
    """One clock: where the tip is, by the controller's states, and what the fibres give, by the board's samples."""
    recording, truth = Recording.open(made.run), made.truth
    _, depths = Frame.of(RIG).tip(truth[:, 1:4])
    touched = np.flatnonzero((depths[1:] > 0) & (depths[:-1] <= 0))
    change = np.abs(recording.readings - np.median(recording.readings, axis=0)).max(axis=1) > 2e-3
    onsets = np.flatnonzero(change[1:] & ~change[:-1]) + 1
    told = recording.times_s[onsets] + made.began
    nearest = np.abs(told[:, None] - truth[touched, 0]).min(axis=1)
    assert len(onsets) == len(SHORT)
    assert np.ptp(nearest) < 0.03  # a reading is a mean over 8 ms, and shallow touches show late


@pytest.mark.usefixtures("soon_settled")
def test_damaged_bytes_cost_samples_but_never_give_wrong_ones(rig: Rig, tmp_path: Path) -> None:
    rig.record(tmp_path / "run", SHORT, lambda done, of: rig.board.garble(1e-3))
    rig.board.garble(0)
    assert rig.converter.statistics()["damaged"] > 3
    recording = Recording.open(tmp_path / "run")
    assert len(recording.presses_mm) == len(SHORT)
    rest = np.median(recording.readings, axis=0)
    assert np.abs(recording.readings - rest).max() < 0.6


class Fault(NamedTuple):
    """How a rig is disturbed, what a person then reads, and what helps."""

    disturb: Callable[[Rig], object]
    cause: str
    cure: Callable[[Rig], object]


FAULTS = {
    "protective": Fault(lambda rig: rig.robot.protective_stop(), "protective_stop", lambda rig: rig.robot.clear()),
    "emergency": Fault(lambda rig: rig.robot.emergency_stop(), "emergency_stop", lambda rig: rig.robot.clear()),
    "drop": Fault(lambda rig: rig.robot.drop("rtde"), "lost", lambda rig: None),
    "freeze": Fault(lambda rig: rig.robot.freeze(True), "stale", lambda rig: rig.robot.freeze(False)),
    "restart": Fault(lambda rig: rig.robot.restart(0.4), "lost", lambda rig: time.sleep(0.3)),
    "stall": Fault(lambda rig: rig.board.stall(), "stale", lambda rig: rig.board.stall(False)),
    "unplug": Fault(lambda rig: rig.board.unplug(), "lost", Rig.anew),
}


@pytest.mark.usefixtures("soon_settled")
@pytest.mark.parametrize(
    "names",
    [
        ("protective", "drop", "freeze", "stall", "unplug"),
        pytest.param(("emergency", "restart"), marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_faults_in_mid_run_stop_the_arm_and_lose_nothing(rig: Rig, tmp_path: Path, names: tuple[str, ...]) -> None:
    """One after the other in one recording, which is resumed after each."""
    run = tmp_path / "run"
    for presses, name in enumerate(names, start=1):
        disturb, cause, cure = FAULTS[name]
        fault, told, speed = rig.disturbed(run, disturb)
        assert fault.cause == cause, name
        assert "\n" not in str(fault)
        assert told < 5, name
        assert speed < 1, name
        assert set(read_journal(run / "journal.ndjson")) >= set(range(presses)), name
        cure(rig)
    rig.record(run, PLAN)
    assert np.array_equal(Recording.open(run).presses_mm, PLAN.places_mm)
