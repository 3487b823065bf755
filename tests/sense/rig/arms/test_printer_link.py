"""Lines of Marlin, as its sources print them and as hosts write them."""

import pytest

from padforge.sense.rig.arms import printer_link as link
from padforge.sense.rig.arms.printer_link import PrinterInfo

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


def test_lines_follow_marlin_and_answers_are_parsed():
    """A numbered line ends in the exclusive or of its bytes, a move is in mm/min."""
    assert link.number_line(0, "M110 N0") == b"N0 M110 N0*125\n"
    assert link.number_line(3, "T0") == b"N3 T0*57\n"  # the example of the RepRap wiki
    assert link.format_move((1.0, 2.5, -0.125), 10.0) == "G1 X1.000 Y2.500 Z-0.125 F600.0"
    info = PrinterInfo.parse(M115)
    assert info.firmware == "Marlin 2.1.2 (Nov 22 2023 12:00:00)"
    assert info.machine == "Ender-3 Pro"
    assert info.capabilities == {"EEPROM", "EMERGENCY_PARSER"}
    assert PrinterInfo.parse(["echo: hello"]) == PrinterInfo()
    assert link.parse_axis_limits(M503, "M203") == (500.0, 400.0, 5.0)
    assert link.parse_axis_limits(M503, "M201") == (500.0, 500.0, 100.0)
    assert link.parse_axis_limits(M503[2:], "M203") is None
    assert link.parse_axis_limits(["M203 X0.00 Y1.00 Z1.00"], "M203") is None


@pytest.mark.parametrize(
    ("read", "line", "expected"),
    [
        *((link.parse_resend, line, number) for line, number in (("Resend: 42", 42), ("Resend:7", 7), ("rs N12", 12))),
        *((link.parse_resend, line, None) for line in ("Resend: ", "ok", "Resend: 4x")),
        (link.parse_position, "X:10.00 Y:-0.50 Z:3.20 E:0.00 Count X:800 Y:-40 Z:1280", (10.0, -0.5, 3.2)),
        (link.parse_position, "X:1.00 Y:2.00 Z:3.00", (1.0, 2.0, 3.0)),
        *(
            (link.parse_position, line, None)
            for line in ("X:1.00 Y:2.00 Z:3.0o E:0.00", "X:1.00 Y:2.00", "T:20.1 /0.0")
        ),
        (link.is_halt, "Error:Printer halted. kill() called!", True),
        (link.is_halt, "Error:Thermal Runaway, system stopped! Heater_ID: bed", True),
        *((link.is_halt, line, False) for line in ("Error:checksum mismatch, Last Line: 41", "echo:Printer halted")),
    ],
)
def test_parse_line(read, line, expected):
    assert read(line) == expected
