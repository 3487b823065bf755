"""A printer that presses, without hardware: driver, emulator, board and pad together, through faults and noise."""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from design import Morphology
from design.settings import PUBLISHED_CONTACT
from sense.recordings.press_journal import read_journal
from sense.recordings.press_plan import PressPlan, planned
from sense.recordings.recorder import Recorder
from sense.recordings.recording import Recording
from sense.rig.boards import block_reader
from sense.rig.devices.protocols import RigFault
from sense.rig.emulators import whole_rig
from sense.rig.emulators.printer.emulator import EmulatedPrinter
from sense.rig.session.pad_frame import Frame
from sense.rig.session.press_loop import Report, Session
from sense.rig.session.retreat import HEIGHT_MM
from sense.settings import RigSettings

pytest.importorskip("serial")
pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here")

PAD = Morphology.straight(2)
QUICK = {"rate_hz": 50, "readings_per_press": 30, "clearance_mm": 2.0, "depth_mm": 3.0}
FAST = {"travel_mm_s": 400, "press_mm_s": 100, "acceleration_mm_s2": 3000}
QUIET = {"noise_mv": 0.0, "drift_mv": 0.0, "creep": 0.0, "hysteresis": 0.0}
RIG = whole_rig.emulated_printer_rig(RigSettings.model_validate({"presses": 4, **QUICK, **FAST, **QUIET}), PAD)
PLAN = planned(PAD, RIG, np.random.default_rng(0))
NIMBLE = partial(EmulatedPrinter, max_mm_s=(500.0, 500.0, 100.0), max_mm_s2=(3000.0, 3000.0, 3000.0))


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A printer whose z axis is as quick as the others, and a board that need not settle."""
    monkeypatch.setattr(whole_rig, "EmulatedPrinter", NIMBLE)
    monkeypatch.setattr(block_reader, "SETTLE_S", 0.15)


class Rig:
    """An emulated rig that is kept from one recording to the next."""

    def __init__(self) -> None:
        self.kept = ExitStack()
        self.anew()

    def anew(self) -> None:
        """Another rig in the place of this one."""
        self.kept.close()
        devices = whole_rig.emulated_printer(PAD, PUBLISHED_CONTACT, RIG)
        self.arm, self.converter, self.printer, self.board = self.kept.enter_context(devices)

    def home(self) -> None:
        """What a person does after a fault: switch the printer off and on, and home it."""
        self.printer.restart()
        self.printer.home()

    def record(self, run: Path, plan: PressPlan, report: Report = lambda done, of: None, garble: float = 0.0) -> None:
        """Record into `run` or go on with it."""
        with Recorder.resume(run) if run.exists() else Recorder(run, len(PAD.knots), {}, {}) as recorder:
            self.converter.connect()
            self.arm.connect()
            self.printer.garble(garble)
            Session(self.arm, self.converter, recorder, RIG).run(plan, report)
            self.printer.garble(0)

    def disturbed(
        self, run: Path, plan: PressPlan, at: int, disturb: Callable[["Rig"], object]
    ) -> tuple[RigFault, float]:
        """Record, disturbed after `at` presses; the fault, and how long it took to be told."""
        moment = 0.0

        def report(done: int, of: int) -> None:
            nonlocal moment
            if done == at:
                moment = time.monotonic()
                disturb(self)

        with pytest.raises(RigFault) as caught:
            self.record(run, plan, report)
        return caught.value, time.monotonic() - moment

    def presses(self) -> np.ndarray:
        """(n, 3) where the tip truly turned round below the pad's surface: place on the pad and depth, mm."""
        ends = np.array([made.move.at(made.lasted_s) for made in self.printer.firmware.made]) + RIG.tcp_mm
        places, depths = Frame.of(RIG).tip(ends)
        return np.column_stack([places, depths])[depths > 0]


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig()
    with rig.kept:
        yield rig


def assert_whole(run: Path, plan: PressPlan) -> None:
    """All presses are there, where and as deep as planned, and the fibres felt each."""
    recording = Recording.open(run)
    assert np.array_equal(recording.presses_mm, plan.places_mm)
    events = [json.loads(line) for line in (run / "journal.ndjson").read_text().splitlines()]
    reached = np.array([event["at_mm"] for event in events if event["event"] == "done"])
    assert reached == pytest.approx(np.column_stack([plan.places_mm, plan.depths_mm]), abs=0.06)
    spans = list(zip(recording.begun, recording.lifted, strict=True))
    rest = [recording.readings[b - 4 : b - 1].mean(axis=0) for b, _ in spans]
    felt = [np.abs(recording.readings[b:u] - rest[press]).max() for press, (b, u) in enumerate(spans)]
    assert min(felt) > 0.01


def test_presses_are_made_where_they_are_planned_whatever_noise_there_is(rig: Rig, tmp_path: Path) -> None:
    rig.record(tmp_path / "run", PLAN, garble=1e-3)
    assert_whole(tmp_path / "run", PLAN)
    assert rig.presses() == pytest.approx(np.column_stack([PLAN.places_mm, PLAN.depths_mm]), abs=0.06)


class Fault(NamedTuple):
    """How the printer is disturbed, what a person then reads, and what helps."""

    disturb: Callable[[Rig], object]
    cause: str
    cure: Callable[[Rig], object]


FAULTS = {
    "halt": Fault(lambda rig: rig.printer.halt(), "emergency_stop", Rig.home),
    "busy": Fault(lambda rig: rig.printer.busy(10), "stale", Rig.home),
    "restart": Fault(lambda rig: rig.printer.restart(), "lost", Rig.home),
    "unplug": Fault(lambda rig: rig.printer.unplug(), "lost", Rig.anew),
}


@pytest.mark.parametrize(
    "names", [("busy", "unplug"), pytest.param(("halt", "restart"), marks=pytest.mark.slow)], ids=" ".join
)
def test_faults_in_mid_run_are_told_and_lose_nothing(rig: Rig, tmp_path: Path, names: tuple[str, ...]) -> None:
    """One after the other in one recording, which is resumed after each."""
    run = tmp_path / "run"
    for presses, name in enumerate(names, start=1):
        disturb, cause, cure = FAULTS[name]
        fault, told = rig.disturbed(run, PLAN, presses, disturb)
        assert fault.cause == cause, name
        assert "\n" not in str(fault)
        assert told < 2, name
        now = time.monotonic()
        assert np.ptp(rig.printer.nozzle_at([now, now + 9]), axis=0).max() == 0, name
        assert set(read_journal(run / "journal.ndjson")) >= set(range(presses)), name
        cure(rig)
    rig.record(run, PLAN)
    assert_whole(run, PLAN)


def test_a_fault_of_the_board_stops_and_lifts_the_probe(rig: Rig, tmp_path: Path) -> None:
    fault, _ = rig.disturbed(tmp_path / "run", PLAN, 1, lambda rig: rig.board.unplug())
    assert fault.cause == "lost"
    tip = rig.printer.nozzle_at(time.monotonic())[0] + RIG.tcp_mm
    assert tip[2] == pytest.approx((RIG.contact_mm or 0) + HEIGHT_MM, abs=0.05)


@pytest.mark.slow
def test_five_hundred_presses(rig: Rig, tmp_path: Path) -> None:
    run, plan = tmp_path / "run", planned(PAD, RIG.model_copy(update={"presses": 500}), np.random.default_rng(0))
    for presses, (name, (disturb, cause, cure)) in enumerate(FAULTS.items(), start=1):
        fault, told = rig.disturbed(run, plan, 100 * presses, disturb)
        assert (fault.cause, told < 2) == (cause, True), name
        cure(rig)
    rig.record(run, plan)
    assert_whole(run, plan)
