"""What rigs refuse, and in which words: devices, limits, and recordings that are to be resumed."""

import errno
import importlib.util
import json
import platform
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from padforge.design import Contact, Morphology
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings
from padforge.fabricate import build
from padforge.sense.recording.press_plan import PressPlan
from padforge.sense.recording.run_directory import FORMAT, START
from padforge.sense.rig import config as rig_config
from padforge.sense.rig import devices
from padforge.sense.rig.arms.printer import Printer
from padforge.sense.rig.arms.ur5 import UR5
from padforge.sense.rig.boards import due, line_board
from padforge.sense.rig.boards.board_reader import select_inputs
from padforge.sense.rig.boards.line_board import LineAssembler, LineBoard, LineDecoder, LineHeader, LineSample
from padforge.sense.rig.by_hand import open_recorder_by_hand, plan_targets
from padforge.sense.rig.devices import ArmState, RigFault
from padforge.sense.rig.press_loop import check_plan
from padforge.sense.rig.safety import Limits, check_probe, check_start_state, check_state, check_target, check_tcp
from padforge.sense.rig.simulated_board import SimulatedBoard, simulated_board_of
from padforge.sense.rig.streams import RECORDED
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from tests.emulators.boards import format_header, format_sample
from tests.fabricate.planted import with_settings
from tests.helpers.refusals import refusal_table
from tests.sense.rig.fakes import PAD, RIG

Rows = dict[str, Callable[[], object]]
POSE = (0.0, -400.0, 60.0, 0.0, np.pi, 0.0)
X, Y, Z, *TOOL = POSE
LIMITS = Limits.from_settings(RIG)
STILL = ArmState(10.0, POSE, 0.0, 0.0, False, False, moving=False)


def rig(**settings: Any) -> RigSettings:
    return RIG.model_copy(update=settings)


def target(*position: float, tool: Any = TOOL, speed: float = 50.0, acceleration: float = 500.0) -> Callable[[], None]:
    return lambda: check_target((*position, *tool), speed, acceleration, LIMITS)


def state(limits: Limits = LIMITS, until_s: float = np.inf, **change: Any) -> Callable[[], None]:
    return lambda: check_state(replace(STILL, **change), limits, 10.0, until_s)


def test_limits_and_states_are_refused_in_these_words(golden) -> None:
    rows: Rows = {
        "no contact height": lambda: rig_config.RobotFrame.from_settings(rig(contact_mm=None)),
        "no place of the pad": lambda: rig_config.RobotFrame.from_settings(rig(pad_mm=None)),
        "no workspace": lambda: Limits.from_settings(rig(box_mm=None)),
        "a workspace from right to left": lambda: Limits.from_settings(rig(box_mm=(1, -1, -2, 2, 0, 90))),
        "no depth": lambda: Limits.from_settings(rig(max_depth_mm=0.0)),
        "no speed": lambda: Limits.from_settings(rig(travel_mm_s=0.0, press_mm_s=0.0)),
        "endless acceleration": lambda: Limits.from_settings(rig(acceleration_mm_s2=np.inf)),
        "no number of newtons": lambda: Limits.from_settings(rig(max_force_n=np.nan)),
        "no number as the surface": lambda: replace(LIMITS, contact_mm=np.nan),
        "a tool that points up": lambda: Limits.from_settings(rig(tool_rad=(0, 0, 0))),
        "no tip of the probe": lambda: check_probe(rig(tcp_mm=None)),
        "5 numbers": target(X, Y, tool=TOOL),
        "no number": target(np.nan, Y, Z),
        "no speed of a move": target(X, Y, Z, speed=0),
        "backwards": target(X, Y, Z, acceleration=-1.0),
        "left of the box": target(-100.1, Y, Z),
        "behind the box": target(X, -299.9, Z),
        "above the box": target(X, Y, 120.1),
        "below the surface": target(X, Y, 43.9),
        "too fast": target(X, Y, Z, speed=400.1),
        "too hard": target(X, Y, Z, acceleration=2000.1),
        "tilted": target(X, Y, Z, tool=(0.0, np.pi - np.radians(2.04), 0.0)),
        "no surface": lambda: check_target(POSE, 50, 500, replace(LIMITS, contact_mm=None)),
        "a press of a plan too deep": lambda: check_plan(PressPlan(np.zeros((1, 2)), np.array([6.5])), RIG),
        "turned": lambda: check_start_state(replace(STILL, pose=(X, Y, Z, -np.pi, 0.0, 0.0)), LIMITS),
        "no sensor": lambda: check_start_state(replace(STILL, force_n=None), LIMITS),
        "no tool centre point": lambda: check_tcp(None, {"tcp": [0.0, 1.23456, 150.0, 0, 0, 0]}),
        "another tool centre point": lambda: check_tcp((0.0, 0.0, 150.0), {"tcp": [0.0, 0.0, 150.11, 0, 0, 0]}),
        "emergency stop": state(emergency_stop=True, protective_stop=True),
        "protective stop": state(protective_stop=True),
        "old": state(time_s=9.49),
        "pressed too hard": state(force_n=-61.26),
        "pressed sideways": state(force_n=50.0, sideways_n=40.0),
        "sensor lost": state(force_n=None),
        "too deep": state(pose=(X, Y, 50 - 6.31, *TOOL)),
        "too long": state(until_s=9.9),
    }
    golden("rig/refusals_of_limits.txt", refusal_table(rows))


UNO = SimpleNamespace(device="/dev/ttyACM2", vid=0x2341, pid=0x0043)
NATIVE = SimpleNamespace(device="/dev/ttyACM3", vid=0x2341, pid=0x003E)
HEADER = LineHeader(1000, 10, 5.0, 3)
DAMAGED = {
    "version": (b"# padforge-line 2 rate_hz=100 bits=10 reference_v=5 channels=2\n",),
    "no rate": (b"# padforge-line 1 rate_hz=nan bits=10 reference_v=5 channels=2\n",),
    "no bits": (b"# padforge-line 1 rate_hz=100 reference_v=5 channels=2\n",),
    "half a bit": (b"# padforge-line 1 rate_hz=100 bits=9.5 reference_v=5 channels=2\n",),
    "reference": (b"# padforge-line 1 rate_hz=100 bits=10 reference_v=101 channels=2\n",),
    "channels": (b"# padforge-line 1 rate_hz=100 bits=10 reference_v=5 channels=513\n",),
    "check of a header": (b"# padforge-line 1 rate_hz=100 bits=10 reference_v=5 channels=2 check=xor\n",),
    "no check": (format_header(HEADER), b"2000,1,2,3\n"),
    "other check": (format_header(HEADER), b"2000,1,2,3*00000000\n"),
    "3 numbers": (format_header(HEADER), format_sample(2000, (1, 2), True)),
    "count": (format_header(HEADER), format_sample(2000, (1, 2, 1024), True)),
    "sign": (format_header(HEADER), format_sample(-2000, (1, 2, 3), True)),
}


def decoded(*lines: bytes) -> Callable[[], None]:
    def decode() -> None:
        decoder = LineDecoder()
        assert [item for item in decoder.decode(b"".join(lines)) if item != HEADER] == []
        assert decoder.n_errors == 1
        raise ValueError(decoder.error)

    return decode


def assembled(after_us: np.ndarray) -> Callable[[], None]:
    """Read a second of lines, and then lines of these times."""

    def assemble() -> None:
        assembler = LineAssembler(HEADER, (0, 1, 2))
        for times_us in (10**6 + np.arange(1001) * 1000, after_us):
            assembler.assemble([(1.0, [LineSample(int(time_us), (1, 2, 3)) for time_us in times_us])])

    return assemble


def described(received: bytes) -> Callable[[], None]:
    def describe() -> None:
        raise RigFault("refused", *line_board.describe_lines(received))

    return describe


def test_devices_are_refused_in_these_words(golden, monkeypatch: pytest.MonkeyPatch) -> None:
    serial = pytest.importorskip("serial")

    def port(number: int | None, text: str) -> Callable[[], None]:
        error = serial.SerialException(text) if number is None else OSError(number, text)

        def fail() -> None:
            raise devices.port_fault("/dev/ttyACM0", error)

        return fail

    def with_ports(*ports: SimpleNamespace, find: Callable[[RigSettings], str]) -> Callable[[], None]:
        def look() -> None:
            monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
            find(RigSettings())

        return look

    def where(change: Callable[[pytest.MonkeyPatch], None], call: Callable[[], object]) -> Callable[[], None]:
        def fail() -> None:
            with monkeypatch.context() as context:
                change(context)
                call()

        return fail

    broken = EntryPoints([EntryPoint("crane", "no.such.module:Crane", "padforge.arms")])
    contact = Contact()
    rows: Rows = {
        "no arm of that name": lambda: devices.load_device("padforge.arms", "crane"),
        "no board of that name": lambda: devices.load_device("padforge.boards", "abacus"),
        "an arm that cannot be loaded": where(
            lambda patch: patch.setattr(devices, "entry_points", lambda group: broken),
            lambda: devices.load_device("padforge.arms", "crane"),
        ),
        "Windows": where(lambda patch: patch.setattr(platform, "system", lambda: "Windows"), devices.check_platform),
        "no pyserial": where(lambda patch: patch.setitem(sys.modules, "serial", None), devices.host_ports),
        "no such port": port(errno.ENOENT, "No such file or directory"),
        "port in use": port(errno.EBUSY, "Device or resource busy"),
        "port locked": port(errno.EAGAIN, "Resource temporarily unavailable"),
        "no permission": port(errno.EACCES, "Permission denied"),
        "other trouble with a port": port(None, "a device attached to the system is not functioning"),
        "two boards": with_ports(UNO, NATIVE, find=line_board.find_line_port),
        "no port": with_ports(find=line_board.find_line_port),
        "no Due": with_ports(UNO, find=due.find_due_port),
        "an input that the board lacks": lambda: select_inputs((3, 16), 16),
        "board that is not connected": lambda: LineBoard("/dev/ttyACM0", 921_600, 1000.0).read(),
        "simulated board that is not connected": SimulatedBoard(PAD, RigSettings(presses=1), contact).read,
        "printer that is not connected": Printer(RIG).state,
        "arm that is not connected": UR5("192.0.2.1").state,
        "no ur-rtde": where(
            lambda patch: patch.setattr(importlib.util, "find_spec", lambda name: None), UR5("192.0.2.1").connect
        ),
        "nothing from the port": described(b""),
        "bytes of another speed": described(bytes(range(128, 228))),
        "lines of another board": described(b"2,501\r\n10000,502,501\r\n2000"),
        **{f"line, {name}": decoded(*lines) for name, lines in DAMAGED.items()},
        "times, reset": assembled(np.arange(1, 20) * 1000),
        "times, ms": assembled(2e6 + np.arange(1, 20)),
        "times, too fast": assembled(2e6 + np.arange(1, 200) * 700),
    }
    golden("rig/refusals_of_devices.txt", refusal_table(rows))


CHANGES: dict[str, Any] = {
    **{"channels": (0, 1, 3, 2), "rate_hz": 5.0, "readings_per_press": 50, "board_rate_hz": 500.0},
    **{"contact_mm": 12.0, "clearance_mm": 12.0, "travel_mm_s": 90.0, "press_mm_s": 30.0, "acceleration_mm_s2": 400.0},
    **{"depth_mm": 4.0, "depths_mm": (1.0, 2.0), "pad_mm": (1.0, 2.0), "pad_angle_deg": 5.0},
    **{"tool_rad": (0.1, 3.1, 0.0), "tcp_mm": (0.0, 0.0, 150.0), "mirrored": True},
}
"""Settings that change what a press is."""
MIDDLE_OUT = PadSettings(keep_out_mm=(((-1.0, -1.0), (1.0, -1.0), (0.0, 1.0)),))


def test_recordings_are_not_resumed_in_these_words(golden, tmp_path: Path) -> None:
    run, hand, broken = (tmp_path / name for name in ("run", "hand", "broken"))
    options = RIG.model_copy(update={"channels": (0, 1, 2, 3)})
    arm = {"model": "UR5", "serial": "2018", "tcp": [0.0] * 6}
    identities = {"arm": arm, "board": {"name": "due", "serial": "7", "firmware": "1.0.0"}}
    config = rig_config.RigConfig(PAD, PUBLISHED_CONTACT, options, run, "test")
    with rig_config.open_recorder(config, [[0.0, 0.0, 4.0]], run, False, identities):
        pass
    recorder, _, _ = open_recorder_by_hand(replace(config, out=hand), {"name": "due"}, resume=False)
    with recorder:
        pass
    broken.mkdir()
    (broken / START).write_text(json.dumps({"format": FORMAT, "fibres": 4, "source": {"kind": "arrays"}}))

    def resumed(out: Path = run, pad: Morphology = PAD, **settings: Any) -> Callable[[], object]:
        other = replace(config, out=out, pad=pad, rig=options.model_copy(update=settings))
        return lambda: rig_config.load_or_make_plan(other, resume=True)

    def opened(device: str, **changed: Any) -> Callable[[], object]:
        other = identities | {device: identities[device] | changed}
        return lambda: rig_config.open_recorder(config, [[0.0, 0.0, 4.0]], run, True, other)

    kept_out, folder = replace(config, pad_settings=MIDDLE_OUT), tmp_path / "pad"
    folder.mkdir()
    build(PAD, folder, [], with_settings({"holder": True}))
    frames = {"none": None, "far": json.loads((folder / "fabrication.json").read_text())["frame"] | {"walls_mm": 1e9}}
    for name, frame in frames.items():
        (tmp_path / name).mkdir()
        document = json.loads((folder / "fabrication.json").read_text()) | {"frame": frame}
        (tmp_path / name / "fabrication.json").write_text(json.dumps(document))
    printer = RigSettings(tcp_mm=(30.0, -5.0, -20.0), max_force_n=None)
    simulated = simulate(Morphology.straight(2), RigSettings(presses=1)).source

    def model_of(name: str, source: object) -> Callable[[], object]:
        (tmp_path / name / RECORDED).mkdir(parents=True)
        (tmp_path / name / RECORDED / START).write_text(json.dumps({"format": FORMAT, "source": source}))
        return lambda: simulated_board_of(tmp_path / name)

    rows: Rows = {
        "no plan": resumed(broken),
        "by hand": resumed(hand),
        "another pad": resumed(pad=Morphology.random(2, 3, 1)),
        **{f"another {key}": resumed(**{key: value}) for key, value in CHANGES.items()},
        "another arm": opened("arm", serial="2019"),
        "another tool": opened("arm", tcp=[0.0, 0.0, 149.0, 0.0, 0.0, 0.0]),
        "another board": opened("board", serial="8"),
        "other firmware": opened("board", firmware="1.0.1"),
        "a keep-out where it presses": lambda: rig_config.load_or_make_plan(kept_out, resume=True),
        "an adaptive plan by hand": lambda: plan_targets(replace(config, rig=rig(plan="adaptive"))),
        "a pad that never was in a holder": lambda: rig_config.locate_on_bed(printer, tmp_path / "none"),
        "no mould": lambda: rig_config.locate_on_bed(printer, tmp_path),
        "a damaged frame": lambda: rig_config.locate_on_bed(printer, tmp_path / "far"),
        "no recording of the model": lambda: simulated_board_of(tmp_path / "model"),
        "a model of a real pad": model_of("real", {"kind": "rig"}),
        "a model of a twin": model_of("twin", {**simulated, "twin": {"presses": 1500}}),
        "a model of no pad": model_of("nothing", {**simulated, "morphology": {}}),
    }
    golden("rig/refusals_to_resume.txt", refusal_table(rows))
    assert rig_config.plan_notice(replace(config, rig=rig(seed=9, presses=30))) == (
        f"{run}: keeps the plan that it was begun with, [rig] presses = 6, seed = 0"
    )
    assert rig_config.plan_notice(config) == ""
