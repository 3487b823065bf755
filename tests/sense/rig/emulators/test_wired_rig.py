"""Whole emulated rigs wired in any order, one whose board speaks in lines, and one whose recorder is killed."""

import random
import socket
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import padforge
from design import Morphology
from design.common.errors import InputError
from design.settings import PUBLISHED_CONTACT
from sense.recordings.press_journal import read_journal
from sense.recordings.press_plan import planned
from sense.recordings.recorder import Recorder
from sense.recordings.recording import Recording
from sense.recordings.simulation.pad_model import LivePad
from sense.rig.arms.ur5.rtde_frames import RTDE_PORT
from sense.rig.boards import block_reader
from sense.rig.devices.protocols import RigFault
from sense.rig.emulators.line_board import EmulatedLineBoard
from sense.rig.emulators.whole_rig import emulated, emulated_rig
from sense.rig.operation import look_over, record
from sense.rig.planning.setup import Setup
from sense.rig.session.press_loop import Session
from sense.settings import RigSettings

pytest.importorskip("rtde_control")
pytestmark = pytest.mark.usefixtures("own_address")

STEP_V = 3.3 / 4095
FAST = {"clearance_mm": 5, "travel_mm_s": 500, "press_mm_s": 250, "acceleration_mm_s2": 3000}


@pytest.fixture(autouse=True)
def soon_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where times need not be exact, connecting need not take long."""
    monkeypatch.setattr(block_reader, "SETTLE_S", 0.15)


def rig_of(board: str, pad: Morphology, **more: object) -> RigSettings:
    """Wired at random, to all inputs of the board if it has no more than there are fibres."""
    channels = np.random.default_rng(1).permutation(len(pad.knots)).tolist()
    rig = {"board": board, "channels": channels, "presses": 4, "drift_mv": 0.0, **FAST, **more}
    return emulated_rig(RigSettings.model_validate(rig), pad)


@pytest.mark.parametrize(("board", "grid"), [("due", 6), ("line", 8)])
def test_readings_are_of_the_fibres_in_the_order_of_the_pad(board: str, grid: int) -> None:
    """As many as the board has inputs, and not in its order."""
    pad = Morphology.straight(grid)
    rig = rig_of(board, pad, noise_mv=0.0)
    with emulated(pad, PUBLISHED_CONTACT, rig) as (_, converter, _, _):
        said = converter.connect()
        assert said["inputs"] == list(rig.channels)
        volts = np.median(converter.read().volts, axis=0)
    still = LivePad(pad, PUBLISHED_CONTACT, rig, rig.converter_rate_hz, np.random.default_rng(rig.seed))
    rests_v = still.volts(np.zeros((1, 2)), np.full(1, -10.0))[0]
    assert volts == pytest.approx(rests_v, abs=STEP_V)
    assert np.unique(volts).size > grid


@pytest.mark.parametrize(
    ("board", "grid", "said"),
    [("due", 7, "fibre 13 is on input 12, an Arduino Due has 0 to 11"), ("crane", 2, "emulated are due and line")],
)
def test_a_board_with_too_few_inputs_and_one_that_is_not_emulated_are_refused(board: str, grid: int, said: str) -> None:
    pad = Morphology.straight(grid)
    rig = emulated_rig(RigSettings(board=board), pad)
    with pytest.raises((InputError, RigFault), match=said), emulated(pad, PUBLISHED_CONTACT, rig):
        pass


PAD = Morphology.straight(8)
RIG = rig_of("line", PAD, rate_hz=1000.0, readings_per_press=300)
PLAN = planned(PAD, RIG, np.random.default_rng(0))


class LineRig:
    """A rig with a line board that keeps all it has sampled: a reading is one sample, which its noise makes unlike any.

    Attributes:
        sent: counts of all samples, fibre by fibre, each with the times at which these were taken.
    """

    def __init__(self) -> None:
        self.kept = ExitStack()
        self.sent: dict[tuple[int, ...], list[float]] = defaultdict(list)
        self.anew()

    def anew(self) -> None:
        """Another rig in the place of this one."""
        self.kept.close()
        self.arm, self.converter, _, board = self.kept.enter_context(emulated(PAD, PUBLISHED_CONTACT, RIG))
        assert isinstance(board, EmulatedLineBoard)
        self.board, source = board, board._source

        def noted(times_s: np.ndarray) -> np.ndarray:
            volts = source(times_s)
            counts = np.rint(volts[:, RIG.channels] / STEP_V).astype(int)
            for row, taken_s in zip(counts.tolist(), times_s.tolist(), strict=True):
                self.sent[tuple(row)].append(taken_s)
            return volts

        self.board._source = noted

    def record(self, run: Path, report: Callable[[int, int], None]) -> None:
        """Record into `run` or go on with it."""
        with Recorder.resume(run) if run.exists() else Recorder(run, 2 * PAD.grid, {}, {}) as recorder:
            self.arm.connect()
            self.converter.connect()
            Session(self.arm, self.converter, recorder, RIG).run(PLAN, report)


@pytest.fixture
def rig() -> Iterator[LineRig]:
    rig = LineRig()
    with rig.kept:
        yield rig


def cured(rig: LineRig) -> None:
    rig.board.garble(0)
    rig.board.stall(False)
    rig.board.send_columns(2 * PAD.grid)


FAULTS: dict[str, tuple[str, Callable[[LineRig], object], Callable[[LineRig], object]]] = {
    "reset": ("data", lambda rig: rig.board.reset(), cured),
    "other columns": ("data", lambda rig: rig.board.send_columns(15), cured),
    "stall": ("stale", lambda rig: rig.board.stall(), cured),
    "unplug": ("lost", lambda rig: rig.board.unplug(), LineRig.anew),
}
"""How a board fails: what is told, how it is made to, and what helps."""


@pytest.mark.slow
@pytest.mark.parametrize("names", [("reset", "unplug"), ("other columns", "stall")], ids=" ".join)
def test_a_line_board_that_fails_among_damaged_lines_loses_no_press_and_gives_no_wrong_reading(
    rig: LineRig, tmp_path: Path, names: tuple[str, ...]
) -> None:
    """One fault after the other in one recording, with a byte in a thousand damaged, resumed after each."""
    run = tmp_path / "run"
    for presses, name in enumerate(names, start=1):
        cause, disturb, cure = FAULTS[name]
        moment = np.inf

        def report(done: int, of: int, presses: int = presses, disturb: Callable = disturb) -> None:
            nonlocal moment
            rig.board.garble(1e-3)
            if done == presses:
                moment = time.monotonic()
                disturb(rig)

        with pytest.raises(RigFault) as caught:
            rig.record(run, report)
        assert caught.value.cause == cause, name
        assert time.monotonic() - moment < 2.5, name
        cure(rig)
    dropped = rig.board.dropped
    rig.record(run, lambda done, of: rig.board.garble(1e-3))
    statistics = rig.converter.statistics()
    lost = statistics["missing"] - (rig.board.dropped - dropped)
    assert statistics["damaged"] > 20
    assert lost == pytest.approx(statistics["damaged"], rel=0.1, abs=10)  # the end of a line may cost two, or be two
    recording = Recording.open(run)
    assert np.array_equal(recording.presses_mm, PLAN.places_mm)
    counts = np.rint(recording.readings / STEP_V).astype(int)
    assert recording.readings == pytest.approx(counts * STEP_V, abs=1e-6)
    taken_s = [-np.inf]
    for row in map(tuple, counts.tolist()):
        taken_s.append(next(at_s for at_s in rig.sent[row] if at_s > taken_s[-1]))  # or it was never sent, or before
    apart_s = np.abs(np.diff(recording.times_s) - np.diff(taken_s[1:]))
    assert np.sort(apart_s)[-len(names) - 1] < 0.02  # but from where it was broken off to where it was resumed


QUICK = {"rate_hz": 125, "readings_per_press": 20}
IN_ORDER = RigSettings.model_validate({"board": "line", "presses": 1, **QUICK, **FAST})


def test_sixteen_fibres_are_recorded_and_their_wiring_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    setup = Setup(PAD, PUBLISHED_CONTACT, IN_ORDER, tmp_path / "run", "test")
    recording = record("simulated", setup)
    assert recording is not None
    assert recording.fibres == 16
    assert recording.source["rig"]["channels"] == list(range(16))
    turned = IN_ORDER.model_copy(update={"channels": tuple(range(16))[::-1]})
    with pytest.raises(InputError, match=r"\[rig\] channels: got \[15, 14, .* was begun with \[0, 1, "):
        record("simulated", replace(setup, rig=turned), resume=True)
    with pytest.raises(InputError, match=r"was begun with another pad|\[rig\] channels"):
        record("simulated", replace(setup, pad=Morphology.straight(6)), resume=True)


def test_a_rig_is_looked_over_at_the_inputs_of_its_fibres(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sense.rig.diagnostics.LOOK_S", 0.3)
    setup = Setup(Morphology.straight(1), PUBLISHED_CONTACT, IN_ORDER, tmp_path, "test")
    found = {each.name: each for each in look_over("simulated", setup, (14, 3))}
    assert found["channel 1"].found.startswith("input 14 rests at")
    assert found["channel 2"].found.startswith("input 3 rests at")
    assert "channel 3" not in found
    assert found["board"].found.startswith("name emulated, serial 0, channels 2, inputs [14, 3]")


SETTINGS = """[pad]
grid = 2
[rig]
rate_hz = 125.0
readings_per_press = 20
clearance_mm = 5
travel_mm_s = 500
press_mm_s = 250
acceleration_mm_s2 = 3000
"""
PROGRAM = """
import sys
from sense.rig.emulators import whole_rig
whole_rig.HOST = sys.argv.pop(1)
import padforge
padforge.main()
"""


def await_the_end_of_its_arm(address: str) -> None:
    """The emulated arm ends as soon as it finds that its program has."""
    end = time.monotonic() + 10
    while time.monotonic() < end:
        try:
            socket.create_connection((address, RTDE_PORT), 1.0).close()
        except ConnectionRefusedError:
            return
        except ConnectionResetError:  # it ends at this moment
            pass
        time.sleep(0.01)


@pytest.mark.slow
def test_a_recorder_killed_while_a_press_is_under_way_resumes_to_the_whole_plan(
    tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[4]))
    Path("pad.toml").write_text(SETTINGS, encoding="utf-8")
    words = ["sense", "record", "--through-drivers", "--presses", "7", "--out", "run", "--resume"]
    journal, kept, rng = Path("run", "journal.ndjson"), set(), random.Random(0)
    for _ in range(2):
        process = subprocess.Popen([sys.executable, "-c", PROGRAM, address, *words], stderr=subprocess.DEVNULL)
        end = time.monotonic() + 60
        while not (journal.exists() and len(read_journal(journal)) >= len(kept) + 2):
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.02)
        time.sleep(rng.uniform(0, 0.3))
        process.kill()
        process.wait()
        assert set(read_journal(journal)) >= kept
        kept = set(read_journal(journal))
        await_the_end_of_its_arm(address)
    monkeypatch.setattr(sys, "argv", ["padforge", *words])
    with pytest.raises(SystemExit) as done:
        padforge.main()
    assert not done.value.code
    assert len(Recording.open(Path("run")).presses_mm) == 7
