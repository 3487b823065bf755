"""The printer as an arm, and its numbered lines, through a real pseudo-terminal against the emulated firmware."""

import re
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from typing import Any

import numpy as np
import pytest

from padforge.sense.rig import clock
from padforge.sense.rig.arms import printer_link
from padforge.sense.rig.arms.printer import Printer
from padforge.sense.rig.arms.printer_link import MarlinLink
from padforge.sense.rig.devices import ArmState, RigFault
from padforge.sense.settings import RigSettings
from tests.emulators import printer as firmware
from tests.emulators.printer import EmulatedPrinter
from tests.sense.rig.fakes import TERMINALS, fault_of

pytest.importorskip("serial")
pytestmark = TERMINALS

AT, BAUD = (80.0, 110.0, 60.0), 115_200
TCP = (30.0, 0.0, -20.0)
RIG = RigSettings(tcp_mm=TCP, clearance_mm=2.0, depth_mm=3.0)
QUICK: dict[str, Any] = {"max_mm_s": (500.0, 500.0, 100.0), "max_mm_s2": (3000.0, 3000.0, 3000.0)}


def driven(printer: EmulatedPrinter, **settings: Any) -> Printer:
    return Printer.from_settings(RIG.model_copy(update={"printer_port": printer.port, **settings}))


@contextmanager
def connected(at: tuple[float, float, float] = AT, **options: Any) -> Iterator[tuple[Printer, EmulatedPrinter]]:
    with EmulatedPrinter(at, **{**QUICK, **options}) as printer, closing(driven(printer)) as arm:
        arm.connect()
        yield arm, printer


def pose(x: float, y: float, z: float) -> tuple[float, ...]:
    return (x, y, z, *RIG.tool_rad)


def to_rest(arm: Printer) -> ArmState:
    while (state := arm.state()).moving:
        clock.sleep(0.004)
    return state


def test_moves_keep_to_the_limits_of_the_axes():
    with EmulatedPrinter(AT) as printer, closing(driven(printer)) as arm:
        arm.connect()
        assert (arm.state().pose, arm.state().force_n) == (pytest.approx(pose(110, 110, 40)), None)
        arm.move(pose(110, 110, 38), 200.0, 50.0)
        to_rest(arm)
        move = printer.firmware.moves[-1].move
        assert (move.speed, move.acceleration) == pytest.approx((15, 50), rel=1e-3)


def test_printer_is_told_this_in_g_code(golden, monkeypatch):
    """From connecting to closing; questions that are asked again and again are left out."""
    told: list[str] = []
    receive = firmware.Firmware.receive

    def noted(self: firmware.Firmware, data: bytes, now_s: float) -> None:
        told.extend(re.sub(r"^N\d+ |\*\d+$", "", line) for line in data.decode("ascii").splitlines() if line.strip())
        receive(self, data, now_s)

    monkeypatch.setattr(firmware.Firmware, "receive", noted)
    with EmulatedPrinter(AT) as printer, closing(driven(printer)) as arm:
        identity = dict(arm.connect()) | {"port": "<port>"}
        for end, speed_mm_s in ((pose(112.5, 105.25, 40), 150.0), (pose(112.5, 105.25, 38.125), 10.5)):
            told.append("# move")
            arm.move(end, speed_mm_s, 500.0)
            to_rest(arm)
        told.append("# stop")
        arm.move(pose(110, 110, 60), 20.0, 500.0)
        arm.stop()
    once = [line for before, line in zip(["", *told], told, strict=False) if line not in (before, "M114", "M114 R")]
    golden("rig/gcode.txt", "\n".join(once))
    golden("rig/printer.json", identity)


@pytest.mark.parametrize("realtime", [pytest.param(True, marks=pytest.mark.slow), False])
def test_move_is_straight_and_states_follow_it(realtime):
    with connected(realtime=realtime) as (arm, printer):
        arm.drain()
        start_s = clock.now()
        arm.move(pose(115, 100, 32), 20.0, 500.0)
        assert to_rest(arm).pose == pytest.approx(pose(115, 100, 32), abs=1e-9)
        assert clock.now() - start_s == pytest.approx(0.1 + 13.75 / 20 + 20 / 500, abs=0.2)
        rows = arm.drain()
        truth = printer.true_positions(rows[:, 0]) + TCP
        assert truth[-1] == pytest.approx((115, 100, 32), abs=1e-3)
        assert np.linalg.norm(rows[:, 1:4] - truth, axis=1).max() < 2.5  # 20 mm/s, and a tenth of a second
        assert np.diff(rows[:, 0]).max() < 0.4
        assert len(rows) > 10
        assert np.isnan(rows[:, 8]).all()


@pytest.mark.parametrize("emergency_parser", [pytest.param(True, marks=pytest.mark.slow), False])
def test_stop_halts_at_once_and_position_stays_known(emergency_parser):
    with connected(emergency_parser=emergency_parser) as (arm, printer):
        arm.move(pose(110, 110, 20), 20.0, 3000.0)
        clock.sleep(0.3)
        start_s = clock.now()
        arm.stop()
        assert clock.now() - start_s < 0.5
        stood = printer.true_positions(clock.now())[0] + TCP
        assert 27 < stood[2] < 39
        assert arm.state().pose[:3] == pytest.approx(stood, abs=0.01)
        assert not arm.state().moving
        arm.stop()
        arm.move(pose(110, 110, 40), 100.0, 3000.0)
        assert to_rest(arm).pose[2] == pytest.approx(40)


def push_aside(printer: EmulatedPrinter) -> None:
    real = printer.firmware.position
    printer.firmware.position = lambda time_s: (real(time_s)[0] + 3, *real(time_s)[1:])


@pytest.mark.parametrize(
    ("disturb", "cause", "match", "under_way"),
    [
        (EmulatedPrinter.halt, "emergency_stop", "has halted .*kill", True),
        (EmulatedPrinter.restart, "lost", "has restarted, so that its position is unknown", False),
        (EmulatedPrinter.unplug, "lost", "the printer is gone", False),
        (lambda printer: printer.busy(10), "stale", "it may be busy", True),
        (push_aside, "lost", r"is at 83\.00, 110\.00, .* mm, but was sent to 80\.00, 110\.00, 40\.00 mm", True),
    ],
    ids=["halt", "restart", "unplug", "busy", "aside"],
)
def test_state_raises_within_two_seconds_of_fault(disturb, cause, match, under_way):
    with connected() as (arm, printer):
        if under_way:
            arm.move(pose(110, 110, 20), 10.0, 3000.0)
        disturb(printer)
        assert fault_of(arm.state, cause, match) < 2


def test_unconfirmed_stop_halts_printer_and_clipped_move_raises():
    with connected() as (arm, printer):
        arm.move(pose(110, 110, 10), 10.0, 3000.0)
        clock.sleep(0.3)
        printer.busy(10)
        start_s = clock.now()
        with pytest.raises(RigFault, match="did not confirm the stop, and was told to halt"):
            arm.stop()
        with pytest.raises(RigFault, match="told to halt; see that it stands"):  # also for the next caller
            arm.state()
        clock.sleep(0.05)
        assert printer.firmware.halted
        assert printer.true_positions(start_s + 0.6)[0] == pytest.approx(printer.true_positions(start_s + 5)[0])
    with connected() as (arm, printer):
        beyond = r"is about to go to 220\.00, .* but was sent to 230\.00"
        fault_of(lambda: arm.move(pose(260, 110, 40), 50.0, 3000.0), "lost", beyond)
        assert printer.true_positions(clock.now() + 9)[0] == pytest.approx(AT, abs=0.5)
        fault_of(arm.state, "lost")


@pytest.mark.parametrize("asked_s", [0.1, pytest.param(0.0, marks=pytest.mark.slow)])
def test_move_that_was_given_up_is_never_made(asked_s: float):
    """The thread waits for a position as it is told to move, or for the new acceleration."""
    with connected() as (arm, printer):
        printer.busy(0.95)
        clock.sleep(asked_s)
        fault_of(lambda: arm.move(pose(110, 110, 38), 50.0, 3000.0), "deadline", "did not answer within")
        with suppress(RigFault):  # halted, as the stop is not confirmed in time
            arm.stop()
        clock.sleep(0.3)
        assert printer.true_positions(clock.now() + 9)[0] == pytest.approx(AT)


@pytest.mark.parametrize(
    ("position", "max_z_mm_s", "settings", "match"),
    [
        ((0.0, 0.0, 0.0), 100.0, {}, "has not been homed"),
        (AT, 3.0, {}, r"way down of 5 mm takes 1\.7 s, allowed is less than 1\.5 s"),
        # 13.3 readings a second of a board of 18 samples are 18
        (AT, 4.0, {"board_rate_hz": 18.0}, r"takes 1\.3 s, allowed is less than 1\.1 s"),
        # the deepest press counts
        (AT, 3.0, {"clearance_mm": 1.0, "depths_mm": (1.0, 4.0)}, r"way down of 5 mm takes 1\.7 s"),
    ],
)
def test_connect_refuses_unusable_printer(position, max_z_mm_s, settings, match):
    limits: dict[str, Any] = QUICK | {"max_mm_s": (500.0, 500.0, max_z_mm_s)}
    with EmulatedPrinter(position, **limits) as printer, closing(driven(printer, **settings)) as arm:
        assert fault_of(arm.connect, "refused", match) < 5
        fault_of(arm.state, "lost", "connect first")
        assert len(printer.firmware.moves) == 1


def test_connect_refuses_other_firmware(monkeypatch):
    monkeypatch.setattr(firmware, "IDENTITY", "FIRMWARE_NAME:RepRapFirmware FIRMWARE_VERSION:3.4")
    with EmulatedPrinter(AT) as printer, closing(driven(printer)) as arm:
        fault_of(arm.connect, "refused", "'RepRapFirmware', allowed is Marlin")
        monkeypatch.setattr(firmware, "IDENTITY", "FIRMWARE_NAME:Marlin 1.1.9 (Github) PROTOCOL_VERSION:1.0")
        fault_of(arm.connect, "refused", "only once it stands; allowed is Marlin 2")


def test_printer_refuses_impossible_moves_a_second_program_and_moves_of_an_unknown_tip():
    with connected() as (arm, printer), closing(driven(printer)) as second:
        for order, match in (
            ((110, 110, 40, 0.0, 3.0, 0.0), "a printer cannot turn it"),
            (pose(float("nan"), 110, 40), "finite numbers"),
        ):
            with pytest.raises(RigFault, match=match):
                arm.move(order, 10.0, 100.0)
        arm.move(pose(110, 110, 39.5), 10.0, 1000.0)
        with pytest.raises(RigFault, match="under way"):
            arm.move(pose(110, 110, 40), 10.0, 100.0)
        fault_of(second.connect, "refused", "another program uses it")
        assert to_rest(arm).pose[2] == pytest.approx(39.5)
        arm.close()
        arm.close()
        second.connect()
    with EmulatedPrinter(position=AT, **QUICK) as printer, closing(driven(printer, tcp_mm=None)) as arm:
        arm.connect()
        fault_of(lambda: arm.move(pose(110, 110, 38), 50.0, 3000.0), "refused", "tcp_mm is unknown")


def test_execute_runs_every_line_once_in_order_despite_noise():
    ends = np.column_stack([50 + np.arange(1, 31) / 50, np.full((30, 2), 50.0)])
    with EmulatedPrinter((50.0, 50.0, 50.0), seed=3) as printer, closing(MarlinLink(printer.port, BAUD)) as link:
        link.handshake(2.0)
        answer = link.execute("M114")
        assert [printer_link.parse_position(line) for line in answer] == [(50, 50, 50)]
        assert link.execute("M999") == []  # unknown to the firmware, and then no line of noise
        printer.garble(5e-3)
        for x, y, z in ends.tolist():
            link.execute(printer_link.format_move((x, y, z), 500.0))
        printer.garble(0)
        link.execute("M400")
        assert np.array([move.move.end for move in printer.firmware.moves[1:]]) == pytest.approx(ends)


def test_handshake_refuses_silent_and_restarting_printer():
    with EmulatedPrinter(AT) as printer, closing(MarlinLink(printer.port, BAUD)) as link:
        printer.busy(60)
        fault_of(lambda: link.handshake(0.2), "refused", "no printer answers; check .* printer_baud")
        printer.busy(0)
        link.handshake(2.0)
        printer.busy(60)
        fault_of(lambda: link.execute("M114", 0.3), "stale", r"not answered for 0\.3 s; it may be busy")
    with EmulatedPrinter(AT, restarts=True) as printer:
        with closing(MarlinLink(printer.port, BAUD)) as link:
            fault_of(lambda: link.handshake(2.0), "refused", "restarted")
        with closing(MarlinLink(printer.port, BAUD)) as link:
            link.handshake(2.0)


M115 = ["FIRMWARE_NAME:Marlin 2.1.2 (Nov 22 2023 12:00:00) SOURCE_CODE_URL:github.com MACHINE_TYPE:Ender-3 Pro UUID:0"]
M503 = ["echo:  M203 X500.00 Y400.00 Z5.00 E25.00", "echo:  M201 X500.00 Y500.00 Z100.00 E5000.00"]


def test_lines_follow_marlin_and_answers_are_parsed():
    """A numbered line ends in the exclusive or of its bytes, a move is in mm/min."""
    assert printer_link.number_line(0, "M110 N0") == b"N0 M110 N0*125\n"
    assert printer_link.number_line(3, "T0") == b"N3 T0*57\n"  # the example of the RepRap wiki
    assert printer_link.format_move((1.0, 2.5, -0.125), 10.0) == "G1 X1.000 Y2.500 Z-0.125 F600.0"
    assert printer_link.parse_identity(M115, "FIRMWARE_NAME") == "Marlin 2.1.2 (Nov 22 2023 12:00:00)"
    assert printer_link.parse_identity(M115, "MACHINE_TYPE") == "Ender-3 Pro"
    assert printer_link.parse_identity(["echo: hello"], "FIRMWARE_NAME") == ""
    assert printer_link.parse_axis_limits(M503, "M203") == (500.0, 400.0, 5.0)
    assert printer_link.parse_axis_limits(M503, "M201") == (500.0, 500.0, 100.0)
    assert [printer_link.parse_resend(line) for line in ("Resend: 42", "rs N12", "Resend: 4x")] == [42, 12, None]
    assert printer_link.parse_position("X:10.00 Y:-0.50 Z:3.20 E:0.00 Count X:800 Y:-40 Z:1280") == (10.0, -0.5, 3.2)
    assert printer_link.parse_position("X:1.00 Y:2.00 Z:3.0o E:0.00") is None
    assert printer_link.is_halt("Error:Thermal Runaway, system stopped! Heater_ID: bed")
    assert not printer_link.is_halt("Error:checksum mismatch, Last Line: 41")
    assert printer_link.parse_axis_limits(M503[1:], "M203") is None
    assert printer_link.parse_axis_limits(["M203 X0.00 Y1.00 Z1.00"], "M203") is None
