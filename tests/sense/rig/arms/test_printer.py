"""The printer as an arm, and its numbered lines, through a real pseudo-terminal against the emulated firmware."""

import os
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest

from padforge.sense.rig.arms import printer_link as marlin
from padforge.sense.rig.arms.printer import Printer
from padforge.sense.rig.arms.printer_link import MarlinLink
from padforge.sense.rig.boards.line_framing import LineHeader
from padforge.sense.rig.devices import ArmState, RigFault
from padforge.sense.settings import RigSettings
from padforge.sense.virtual import printer as firmware
from padforge.sense.virtual.boards import EmulatedLineBoard
from padforge.sense.virtual.printer import EmulatedPrinter
from tests.sense.rig.fakes import fault_of

pytest.importorskip("serial")
pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here")

AT, BAUD = (80.0, 110.0, 60.0), 115_200
TCP = (30.0, 0.0, -20.0)
RIG = RigSettings(tcp_mm=TCP, clearance_mm=2.0, depth_mm=3.0)
QUICK: dict[str, Any] = {"max_mm_s": (500.0, 500.0, 100.0), "max_mm_s2": (3000.0, 3000.0, 3000.0)}


def driven(printer: EmulatedPrinter, **settings: Any) -> Printer:
    return Printer.of(RIG.model_copy(update={"printer_port": printer.port, **settings}))


@contextmanager
def connected(at: tuple[float, float, float] = AT, **options: Any) -> Iterator[tuple[Printer, EmulatedPrinter]]:
    with EmulatedPrinter(at, **{**QUICK, **options}) as printer, closing(driven(printer)) as arm:
        arm.connect()
        yield arm, printer


def pose(x: float, y: float, z: float) -> tuple[float, ...]:
    return (x, y, z, *RIG.tool_rad)


def to_rest(arm: Printer) -> ArmState:
    while (state := arm.state()).moving:
        time.sleep(0.004)
    return state


def test_a_printer_says_who_it_is_where_its_tip_is_and_how_fast_its_axes_are():
    with EmulatedPrinter(AT) as printer, closing(driven(printer)) as arm:
        told = arm.connect()
        assert told["firmware"].startswith("Marlin")
        assert told["max_mm_s"] == [500.0, 500.0, 15.0]
        state = arm.state()
        assert state.pose == pytest.approx(pose(110, 110, 40))
        assert (state.moving, state.force_n) == (False, None)
        arm.move(pose(110, 110, 38), 200.0, 50.0)
        to_rest(arm)
        made = printer.firmware.made[-1].move
        assert (made.speed, made.acceleration) == pytest.approx((15, 50), rel=1e-3)


@pytest.mark.parametrize("realtime", [pytest.param(True, marks=pytest.mark.slow), False])
def test_the_tip_goes_straight_and_its_place_is_known_all_the_way(realtime):
    with connected(realtime=realtime) as (arm, printer):
        arm.drain()
        down_command = time.monotonic()
        arm.move(pose(115, 100, 32), 20.0, 500.0)
        assert to_rest(arm).pose == pytest.approx(pose(115, 100, 32), abs=1e-9)
        assert time.monotonic() - down_command == pytest.approx(0.1 + 13.75 / 20 + 20 / 500, abs=0.2)
        rows = arm.drain()
        truth = printer.nozzle_at(rows[:, 0]) + TCP
        assert truth[-1] == pytest.approx((115, 100, 32), abs=1e-3)
        assert np.linalg.norm(rows[:, 1:4] - truth, axis=1).max() < 2.5  # 20 mm/s, and a tenth of a second
        assert np.diff(rows[:, 0]).max() < 0.4
        assert len(rows) > 10
        assert np.isnan(rows[:, 8]).all()


@pytest.mark.parametrize("emergency_parser", [pytest.param(True, marks=pytest.mark.slow), False])
def test_a_stop_is_one_at_once_and_the_place_is_known_after_it(emergency_parser):
    with connected(emergency_parser=emergency_parser) as (arm, printer):
        arm.move(pose(110, 110, 20), 20.0, 3000.0)
        time.sleep(0.3)
        down_command = time.monotonic()
        arm.stop()
        assert time.monotonic() - down_command < 0.5
        stood = printer.nozzle_at(time.monotonic())[0] + TCP
        assert 27 < stood[2] < 39
        assert arm.state().pose[:3] == pytest.approx(stood, abs=0.01)
        assert not arm.state().moving
        arm.stop()
        arm.move(pose(110, 110, 40), 100.0, 3000.0)
        assert to_rest(arm).pose[2] == pytest.approx(40)


@pytest.mark.parametrize(
    ("disturb", "cause", "match", "under_way"),
    [
        (EmulatedPrinter.halt, "emergency_stop", "has halted .*kill", True),
        (EmulatedPrinter.restart, "lost", "has restarted, so that its place is unknown", False),
        (EmulatedPrinter.unplug, "lost", "the printer is gone", False),
        (lambda printer: printer.busy(10), "stale", "it may be busy", True),
    ],
    ids=["halt", "restart", "unplug", "busy"],
)
def test_faults_are_told_within_two_seconds(disturb, cause, match, under_way):
    with connected() as (arm, printer):
        if under_way:
            arm.move(pose(110, 110, 20), 10.0, 3000.0)
        disturb(printer)
        assert fault_of(arm.state, cause, match) < 2


def test_a_stop_that_is_not_confirmed_halts_the_printer_and_a_place_beyond_its_reach_is_told_before():
    with connected() as (arm, printer):
        arm.move(pose(110, 110, 10), 10.0, 3000.0)
        time.sleep(0.3)
        printer.busy(10)
        down_command = time.monotonic()
        with pytest.raises(RigFault, match="did not confirm the stop, and was told to halt"):
            arm.stop()
        with pytest.raises(RigFault, match="told to halt; see that it stands"):  # whoever looks next is told why
            arm.state()
        time.sleep(0.05)
        assert printer.firmware.halted
        assert printer.nozzle_at(down_command + 0.6)[0] == pytest.approx(printer.nozzle_at(down_command + 5)[0])
    with connected() as (arm, printer):
        with pytest.raises(RigFault, match=r"is about to go to 220\.00, .* but was sent to 230\.00") as fault:
            arm.move(pose(260, 110, 40), 50.0, 3000.0)
        assert fault.value.cause == "lost"
        assert printer.nozzle_at(time.monotonic() + 9)[0] == pytest.approx(AT, abs=0.5)
        fault_of(arm.state, "lost")


@pytest.mark.parametrize(
    ("options", "settings", "match"),
    [
        ({}, {"printer_port": None}, "printer_port is unknown"),
        ({}, {"tcp_mm": None}, "tcp_mm is unknown"),
        ({"at": (0.0, 0.0, 0.0)}, {}, "has not been homed"),
        ({"max_mm_s": (500.0, 500.0, 3.0)}, {}, r"way down of 5 mm takes 1\.7 s, allowed is less than 1\.5 s"),
        ({}, {"depths_mm": (1.0, 9.0), "press_mm_s": 2.0}, "way down of 11 mm"),
    ],
)
def test_a_printer_that_cannot_be_used_is_refused(options, settings, match):
    with EmulatedPrinter(**{"at": AT, **QUICK, **options}) as printer, closing(driven(printer, **settings)) as arm:
        assert fault_of(arm.connect, "refused", match) < 5
        fault_of(arm.state, "lost", "connect first")
        assert len(printer.firmware.made) == 1


def test_other_firmware_is_refused(monkeypatch):
    monkeypatch.setattr(firmware, "IDENTITY", "FIRMWARE_NAME:RepRapFirmware FIRMWARE_VERSION:3.4")
    with EmulatedPrinter(AT) as printer, closing(driven(printer)) as arm:
        fault_of(arm.connect, "refused", "'RepRapFirmware', allowed is Marlin")
        monkeypatch.setattr(firmware, "IDENTITY", "FIRMWARE_NAME:Marlin 1.1.9 (Github) PROTOCOL_VERSION:1.0")
        fault_of(arm.connect, "refused", "only once it stands; allowed is Marlin 2")


def test_orders_that_are_none_and_a_second_program_are_refused_and_break_nothing():
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


def test_every_line_is_executed_once_and_in_its_turn_whatever_noise_there_is():
    ends = np.column_stack([50 + np.arange(1, 31) / 50, np.full((30, 2), 50.0)])
    with EmulatedPrinter((50.0, 50.0, 50.0), seed=3) as printer, closing(MarlinLink(printer.port, BAUD)) as link:
        link.begin(2.0)
        answer = link.ask("M114")
        assert [marlin.place(line) for line in answer] == [(50, 50, 50)]
        assert link.ask("M999") == []  # unknown to the firmware, and then no line of noise
        printer.garble(5e-3)
        for x, y, z in ends.tolist():
            link.ask(marlin.move((x, y, z), 500.0))
        printer.garble(0)
        link.ask("M400")
        assert np.array([made.move.end for made in printer.firmware.made[1:]]) == pytest.approx(ends)


def test_what_is_silent_is_no_printer_and_a_board_that_restarts_as_its_port_is_opened_does_so_once():
    with EmulatedPrinter(AT) as printer, closing(MarlinLink(printer.port, BAUD)) as link:
        printer.busy(60)
        fault_of(lambda: link.begin(0.2), "refused", "no printer answers; check .* printer_baud")
        printer.busy(0)
        link.begin(2.0)
        printer.busy(60)
        fault_of(lambda: link.ask("M114", 0.3), "stale", r"not answered for 0\.3 s; it may be busy")
    with EmulatedPrinter(AT, restarts=True) as printer:
        with closing(MarlinLink(printer.port, BAUD)) as link:
            fault_of(lambda: link.begin(2.0), "refused", "restarted")
        with closing(MarlinLink(printer.port, BAUD)) as link:
            link.begin(2.0)


@pytest.mark.slow
def test_what_never_falls_silent_is_no_printer():
    """As where the port is that of the board that reads the fibres."""
    board = EmulatedLineBoard(lambda times_s: np.zeros((len(times_s), 4)), LineHeader(1000, 12, 3.3, 4))
    with board, closing(MarlinLink(board.port, BAUD)) as link:
        assert fault_of(lambda: link.begin(0.5), "refused", "no printer answers") < 5
