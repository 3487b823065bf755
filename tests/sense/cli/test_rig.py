"""`record` and `doctor`."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from padforge.benchmarks.twin import printed_pad
from padforge.common.files import sha256
from padforge.design import Contact, Morphology
from padforge.sense import Recording
from padforge.sense.formats.ros_recording import import_bag
from padforge.sense.live import outputs
from padforge.sense.rig import operation
from padforge.sense.rig.devices import RigFault
from padforge.sense.settings import RigSettings
from tests.emulators.finger import Finger
from tests.emulators.rigs import emulate_printer, printer_settings
from tests.helpers.rigs import rig_toml
from tests.sense.cli.conftest import Run
from tests.sense.rig.fakes import PAD, RIG, TERMINALS, FakeArm, FakeBoard, FingerBoard, Time


def test_record_writes_beside_its_pad_and_presses_as_deep_as_the_contact(padforge_sense) -> None:
    assert padforge_sense("record", "--presses", "4")[0] == 0
    assert Recording.open("out/pad/recording").source["rig"]["presses"] == 4
    Morphology.random(2, 3, 1).save(Path("mine/morphology.json"))
    code, out, _ = padforge_sense("record", "--presses", "4", "--seed", "7", "--morphology", "mine/morphology.json")
    assert code == 0
    assert out.endswith(" -> mine/recording\n")
    assert Recording.open("mine/recording").source["rig"]["seed"] == 7
    # as deep as the contact, and it is said if the pad is designed for another depth
    Path("soft.toml").write_text("[contact]\ndepth_mm = 2\n[rig]\npresses = 4\n")
    assert padforge_sense("record", "--spec", "soft.toml", "--out", "soft")[::2] == (0, "")
    assert set(Recording.open("soft").depths_mm) == {2.0}
    origin = {"settings": {"contact": Contact(depth_mm=2.0).model_dump(mode="json")}}
    Morphology.from_layout(PAD.knots, PAD.layout, origin).save("pad/morphology.json")
    code, _, err = padforge_sense("record", "--presses", "4", "--morphology", "pad/morphology.json")
    assert (code, err) == (0, "[rig] presses 5 mm deep, the pad is designed for presses of 2 mm\n")


def test_record_writes_an_mcap_file_as_export_does(padforge_sense, monkeypatch: pytest.MonkeyPatch) -> None:
    code, out, err = padforge_sense("record", "--presses", "4", "--mcap", "--out", "rec")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "rec -> rec.mcap"
    assert import_bag("rec.mcap") == Recording.open("rec")
    Path("same").mkdir()
    assert padforge_sense("export", "rec", "same/rec.mcap")[0] == 0
    assert Path("same/rec.mcap").read_bytes() == Path("rec.mcap").read_bytes()
    monkeypatch.setattr(f"{import_bag.__module__}._typestore", partial(import_module, "rosbags.missing"))
    code, _, err = padforge_sense("record", "--presses", "4", "--mcap", "--out", "other")
    assert (code, err) == (2, "padforge: other.mcap: MCAP needs rosbags: pip install 'padforge[formats]'\n")
    assert not Path("other").exists()


def test_record_simulates_a_twin(padforge_sense) -> None:
    twin = printed_pad(Morphology.random(2, 3, 5), np.random.default_rng(3))
    twin.save("twin.json")
    assert padforge_sense("record", "--twin", "twin.json", "--presses", "4", "--out", "measured")[0] == 0
    measured = Recording.open("measured")
    assert measured.fibres == len(twin.channels)
    assert measured.source["kind"] == "simulated"
    assert measured.source["contact"] == twin.contact().model_dump(mode="json")
    made_by = json.loads(Path("measured/start.json").read_text())["provenance"]
    assert made_by["inputs"]["twin.json"] == sha256(Path("twin.json"))
    for name, pad in (("planned", twin.morphology), ("other", Morphology.straight(3))):
        pad.save(f"{name}.json")
        words = ("record", "--twin", "twin.json", "--morphology", f"{name}.json", "--presses", "4", "--out", name)
        assert padforge_sense(*words)[0] == 0
    assert not np.array_equal(Recording.open("planned").readings, measured.readings)
    assert Recording.open("other").fibres == 6


@TERMINALS[0]
@TERMINALS[1]
def test_record_with_a_printer(padforge_sense) -> None:
    fast = {"rate_hz": 50, "readings_per_press": 30, "clearance_mm": 1, "depth_mm": 1, "travel_mm_s": 400}
    pad = Morphology.straight(2)
    pad.save("morphology.json")
    rig = printer_settings(RigSettings.model_validate(fast), pad)
    with emulate_printer(pad, Contact(), rig) as (settings, _, _):
        Path("pad.toml").write_text(rig_toml(settings, pad.grid))
        words = ("record", "--rig", "printer", "--presses", "2", "--morphology", "morphology.json")
        code, out, err = padforge_sense(*words)
    assert (code, out[:14]) == (0, "2 presses over"), err
    assert Recording.open("recording").source["rig"]["tcp_mm"] == [30.0, 0.0, -20.0]


class Bench:
    """A fake arm and board in virtual time, in place of the devices that commands open; and what was said.

    Args:
        command: runs `padforge sense`.
        patch: that ends with the test.
    """

    def __init__(self, command: Run, patch: pytest.MonkeyPatch) -> None:
        self._command, self._patch, self.transcript = command, patch, list[str]()
        self.renew()

    def renew(self) -> None:
        self.time = Time()
        self.arm = FakeArm(self.time)
        self.board = FakeBoard(self.arm)
        self.arm.move = self._miss(self.arm.move)
        self._patch.setattr(operation, "make_board", lambda rig, inputs: self.board)
        self._patch.setattr(operation, "load_device", lambda group, name: lambda rig: self.arm)
        self._patch.setattr(operation, "host_ports", lambda: PORTS)

    @staticmethod
    def _miss(move: Callable[..., None]) -> Callable[..., None]:
        """The arm stands a little beside where it was sent."""
        return lambda pose, *speeds: move((pose[0] + 0.01234, pose[1] - 0.05678, pose[2] + 0.03456, *pose[3:]), *speeds)

    def __call__(self, *words: str, title: str) -> None:
        """Run a command, and add what it prints to the transcript."""
        with self.time.of_all():
            code, out, err = self._command(*words)
        said = [out.rstrip()] * bool(out) + [f"stderr: {line}" for line in err.splitlines()]
        self.transcript += [f"# {title}", f"$ padforge sense {' '.join(words)}", *said, f"exit {code}", ""]


PORTS = [
    SimpleNamespace(device="/dev/ttyACM0", description="padforge-due", vid=0x2341),
    SimpleNamespace(device="/dev/ttyS0", description="built in", vid=None),
]
IDENTITY = {"model": "UR5", "serial": "2018", "tcp": [0.0, 0.0, 150.0, 0.0, 0.0, 0.0]}


@pytest.fixture
def bench(padforge_sense: Run, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """It stands in the folder of pad.json and rig.toml."""
    PAD.save("pad.json")
    rig = RIG.model_copy(update={"tcp_mm": (0.0, 0.0, 150.0), "presses": 3, "plan": "serpentine", "max_force_n": 60.0})
    Path("rig.toml").write_text(rig_toml(rig, PAD.grid))
    bench = Bench(padforge_sense, monkeypatch)
    monkeypatch.setattr(FakeArm, "connect", lambda arm: dict(IDENTITY))
    return bench


RECORD = ("record", "--rig", "ur5", "--spec", "rig.toml", "--morphology", "pad.json", "--out", "run")


def test_record_says_and_keeps_what_an_arm_did(bench: Bench, golden) -> None:
    """Over the pad without touching it, until the link is lost, and resumed by other settings; and then read back."""
    bench(*RECORD, "--dry-run", title="above the pad")
    assert not Path("run").exists()
    bench.renew()
    bench.arm.hook = lambda arm: setattr(arm, "lost", arm.time() > 101.4)
    bench(*RECORD, title="the link is lost in the third press")
    bench.renew()
    bench(*RECORD, title="again")
    assert bench.arm.moves == []

    def press_back(arm: FakeArm) -> None:
        """A spring that shakes, so that its mean is above its median."""
        arm.force_n = -3.0 * max(50.0 - arm.pose[2], 0.0) * (1 + (7 * arm.time() % 1) ** 6)
        bench.board.lose = 35 if 100.3 < arm.time() < 100.35 else 0

    bench.arm.hook = press_back
    bench(*RECORD, "--resume", "--presses", "5", "--seed", "4", title="resumed by another plan, which does not count")
    golden("rig/record.txt", "\n".join(bench.transcript))
    golden("rig/start.json", Path("run/start.json").read_text(), forget=[r'(?<="versions": )\{[^}]*\}'])
    golden("rig/journal.ndjson", Path("run/journal.ndjson").read_text())


def test_record_refuses_a_tip_that_is_not_the_controllers_before_anything_moves(bench: Bench, golden) -> None:
    """The controller has it 150 mm from the flange; an unwatched force is announced."""
    for tcp_mm, max_force_n in ((None, 60.0), ((0.0, 0.0, 0.0), 60.0), ((0.0, 0.05, 150.0), None)):
        bench.renew()
        rig = RIG.model_copy(update={"tcp_mm": tcp_mm, "max_force_n": max_force_n, "presses": 1})
        Path("rig.toml").write_text(rig_toml(rig, PAD.grid))
        bench(*RECORD, "--resume", title=f"tcp_mm {tcp_mm}, max_force_n {max_force_n}")
        assert bool(bench.arm.moves) is (max_force_n is None)
        assert Path("run").exists() is (max_force_n is None)
    golden("rig/record_tcp.txt", "\n".join(bench.transcript))


DOCTOR = ("doctor", "--rig", "ur5", "--spec", "rig.toml", "--morphology", "pad.json")


def test_doctor_says_how_a_rig_is(bench: Bench, golden) -> None:
    states_s = np.cumsum([99.0, *[0.008] * 60, 0.03, *[0.008] * 60])
    states = np.column_stack([states_s, np.zeros((len(states_s), 9))])
    bench.arm.drain = lambda: states
    bench(*DOCTOR, title="all is well")
    bench.renew()
    bench(*DOCTOR[:1], *DOCTOR[3:], title="the board alone")
    bench.renew()
    read = bench.board.volts

    def worn(positions_mm: np.ndarray, depths_mm: np.ndarray) -> np.ndarray:
        volts = read(positions_mm, depths_mm)
        volts[:, 0], volts[:, 1], volts[:, 2] = 0.0, 3.3, 1.5
        volts[:, 3] += 0.05 * np.random.default_rng(len(volts)).standard_normal(len(volts))
        return volts

    bench.board.volts = worn
    bench.board.lose = 7
    said = bench.board.connect() | {"rate_hz": 1020.0, "inputs": [14, 3, 0, 1], "warning": "its lines have no check"}
    bench.board.connect = lambda: said
    states_s[60:] += 0.4
    bench.arm.drain, bench.arm.protective_stop, bench.arm.force_n = lambda: states + 0.0, True, None
    states[:, 0] = states_s
    state = bench.arm.state
    bench.arm.state = lambda: replace(state(), time_s=bench.arm.time() - 0.14)
    bench(*DOCTOR, title="little is well")
    bench.renew()
    bench.arm.emergency_stop, bench.arm.force_n = True, 3.26
    rig = RIG.model_copy(update={"tcp_mm": (0.0, 0.0, 149.0), "max_force_n": None})
    Path("rig.toml").write_text(rig_toml(rig, PAD.grid))
    bench(*DOCTOR, "--json", title="another tip, and nobody watches the force")
    bench.renew()
    bench.board.lost = bench.arm.lost = True
    bench(*DOCTOR, title="both are gone")
    assert bench.arm.moves == []
    golden("rig/doctor.txt", "\n".join(bench.transcript))


def test_record_by_hand(padforge_sense, monkeypatch: pytest.MonkeyPatch) -> None:
    pad, rig, time = PAD, RigSettings(presses=2, readings_per_press=10, board_rate_hz=40.0), Time(least_s=0.025)
    pad.save("morphology.json")
    Path("pad.toml").write_text(rig_toml(rig, pad.grid))
    finger = Finger(pad, Contact(), rig, rig.board_rate_hz)
    board = FingerBoard(finger, time, {"name": "virtual", "channels": len(pad.knots), "rate_hz": rig.board_rate_hz})
    monkeypatch.setattr(operation, "make_board", lambda rig, inputs: board)

    shown, troubles = list[Mapping[str, Any]](), list[RigFault]()

    class WatchedPage(outputs.LivePage):
        def show(self, view: Mapping[str, Any]) -> None:
            super().show(view)
            shown.append(view)
            finger.look(view)
            assert time() < 1000, "the recording comes to no end"
            if troubles:
                raise troubles.pop()

        def read_commands(self) -> list[str]:
            return [*super().read_commands(), *finger.commands()]

    monkeypatch.setattr(outputs, "LivePage", WatchedPage)
    by_hand = ("record", "--rig", "hand", "--out", "rec")
    with time.of_all():
        code, out, err = padforge_sense(*by_hand)
    assert code == 0, err
    assert "http://127.0.0.1:" in err
    recording = Recording.open("rec")
    assert recording.has_position.sum() == 2
    assert recording.source["kind"] == "hand"
    *messages, last = out.splitlines()
    assert sum(line.startswith("counted: x ") for line in messages) == 2
    assert last.startswith(f"{len(recording.presses_mm)} presses")
    assert shown[-1]["ended"] == "ended"
    troubles.append(RigFault("lost", "the board is gone", "see why"))
    with time.of_all():
        assert padforge_sense(*by_hand[:-1], "again")[0] == 1
    assert shown[-1]["ended"] == "the board is gone; see why"


def test_doctor_examines_each_device_without_the_other(padforge_sense, golden, monkeypatch) -> None:
    monkeypatch.setattr(operation, "host_ports", list)
    said = []
    for ports in ('port = "no-such-port"\nprinter_port = "neither"', 'port = "it"\nprinter_port = "it"'):
        places = "pad_mm = [0, 0]\ncontact_mm = 9\nbox_mm = [-9, 9, -9, 9, 0, 99]"
        Path("rig.toml").write_text(f"[rig]\n{ports}\n{places}\n")
        code, out, err = padforge_sense("doctor", "--rig", "printer", "--spec", "rig.toml")
        assert (code, err) == (1, "")
        said.append(out)
    golden("rig/doctor_printer.txt", "\n".join(said))
