"""Lines of Marlin, as its sources print them and as hosts write them, and straight moves within limits of axes."""

import math

import pytest

from padforge.sense.rig.arms import printer_link as marlin
from padforge.sense.rig.arms.printer_link import StraightMove

M115 = [
    "FIRMWARE_NAME:Marlin 2.1.2 (Nov 22 2023 12:00:00) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin"
    " PROTOCOL_VERSION:1.0 MACHINE_TYPE:Ender-3 Pro EXTRUDER_COUNT:1 UUID:cede2a2f-41a2-4748-9b12-c55c62f367ff",
    *("Cap:SERIAL_XON_XOFF:0", "Cap:EEPROM:1", "Cap:EMERGENCY_PARSER:1", "Cap:AUTOREPORT_POS:0"),
]
M503 = [
    "echo:; Maximum feedrates (units/s):",
    "echo:  M203 X500.00 Y400.00 Z5.00 E25.00",
    "echo:; Maximum Acceleration (units/s2):",
    "echo:  M201 X500.00 Y500.00 Z100.00 E5000.00",
    "echo:; Acceleration (units/s2) (P<print-accel> R<retract-accel> T<travel-accel>):",
    "echo:  M204 P500.00 R1000.00 T500.00",
]


def test_lines_are_written_as_marlin_reads_them_and_what_a_printer_says_of_itself_is_read():
    """A numbered line ends in the exclusive or of its bytes, a move is in mm/min."""
    assert marlin.numbered(0, "M110 N0") == b"N0 M110 N0*125\n"
    assert marlin.numbered(3, "T0") == b"N3 T0*57\n"  # the example of the RepRap wiki
    assert marlin.move((1.0, 2.5, -0.125), 10.0) == "G1 X1.000 Y2.500 Z-0.125 F600.0"
    found = marlin.PrinterDialect.of(M115)
    assert found.name == "Marlin 2.1.2 (Nov 22 2023 12:00:00)"
    assert found.machine == "Ender-3 Pro"
    assert found.capabilities == {"EEPROM", "EMERGENCY_PARSER"}
    assert marlin.PrinterDialect.of(["echo: hello"]) == marlin.PrinterDialect()
    assert marlin.limits(M503, "M203") == (500.0, 400.0, 5.0)
    assert marlin.limits(M503, "M201") == (500.0, 500.0, 100.0)
    assert marlin.limits(M503[2:], "M203") is None
    assert marlin.limits(["M203 X0.00 Y1.00 Z1.00"], "M203") is None


@pytest.mark.parametrize(
    ("read", "line", "expected"),
    [
        *((marlin.resend, line, number) for line, number in (("Resend: 42", 42), ("Resend:7", 7), ("rs N12", 12))),
        *((marlin.resend, line, None) for line in ("Resend: ", "ok", "Resend: 4x")),
        (marlin.place, "X:10.00 Y:-0.50 Z:3.20 E:0.00 Count X:800 Y:-40 Z:1280", (10.0, -0.5, 3.2)),
        (marlin.place, "X:1.00 Y:2.00 Z:3.00", (1.0, 2.0, 3.0)),
        *((marlin.place, line, None) for line in ("X:1.00 Y:2.00 Z:3.0o E:0.00", "X:1.00 Y:2.00", "T:20.1 /0.0")),
        (marlin.halts, "Error:Printer halted. kill() called!", True),
        (marlin.halts, "Error:Thermal Runaway, system stopped! Heater_ID: bed", True),
        *((marlin.halts, line, False) for line in ("Error:checksum mismatch, Last Line: 41", "echo:Printer halted")),
    ],
)
def test_a_line_is_read_whole_or_not_at_all(read, line, expected):
    assert read(line) == expected


LONG_WAY = StraightMove((0.0, 0.0, 0.0), (30.0, 40.0, 0.0), 10.0, 20.0)


def test_moves_have_a_trapezoid_of_speed_and_no_axis_exceeds_its_limits():
    assert LONG_WAY.duration_s == pytest.approx(50 / 10 + 10 / 20)
    assert LONG_WAY.at(-1.0) == LONG_WAY.start
    assert LONG_WAY.at(0.5) == pytest.approx((1.5, 2.0, 0.0))  # 2.5 mm while it gains speed
    assert LONG_WAY.at(2.5) == pytest.approx((13.5, 18.0, 0.0))
    assert LONG_WAY.at(LONG_WAY.duration_s - 0.5) == pytest.approx((28.5, 38.0, 0.0))
    assert LONG_WAY.at(99.0) == LONG_WAY.end
    short = StraightMove((0.0, 0.0, 5.0), (0.0, 0.0, 4.0), 100.0, 100.0)
    assert short.duration_s == pytest.approx(0.2)
    assert short.at(0.1) == pytest.approx((0.0, 0.0, 4.5))
    nowhere = StraightMove((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 10.0, 10.0)
    assert nowhere.duration_s == 0
    assert nowhere.within((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)).at(0.0) == nowhere.end
    move = LONG_WAY.within((3.0, 100.0, 1.0), (100.0, 4.0, 1.0))  # z does not move, and limits nothing
    assert move.speed * 0.6 == pytest.approx(3.0)
    assert move.acceleration * 0.8 == pytest.approx(4.0)
    assert LONG_WAY.within((100.0, 100.0, 1.0), (100.0, 100.0, 1.0)) == LONG_WAY


@pytest.mark.parametrize(
    ("place", "expected"), [((15.0, 20.0, 2.0), 2.0), ((33.0, 44.0, 0.0), 5.0), ((-4.0, 3.0, 0.0), 5.0)]
)
def test_distance_is_to_the_way_between_its_ends(place, expected):
    assert LONG_WAY.distance_mm(place) == pytest.approx(expected)
    assert math.isfinite(StraightMove(place, place, 1.0, 1.0).distance_mm((0.0, 0.0, 0.0)))
