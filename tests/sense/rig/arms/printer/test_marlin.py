"""Lines of Marlin, as its sources print them and as hosts write them."""

import pytest

from sense.rig.arms.printer import marlin

M115 = [
    "FIRMWARE_NAME:Marlin 2.1.2 (Nov 22 2023 12:00:00) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin"
    " PROTOCOL_VERSION:1.0 MACHINE_TYPE:Ender-3 Pro EXTRUDER_COUNT:1 UUID:cede2a2f-41a2-4748-9b12-c55c62f367ff",
    "Cap:SERIAL_XON_XOFF:0",
    "Cap:EEPROM:1",
    "Cap:EMERGENCY_PARSER:1",
    "Cap:AUTOREPORT_POS:0",
]
M503 = [
    "echo:; Maximum feedrates (units/s):",
    "echo:  M203 X500.00 Y400.00 Z5.00 E25.00",
    "echo:; Maximum Acceleration (units/s2):",
    "echo:  M201 X500.00 Y500.00 Z100.00 E5000.00",
    "echo:; Acceleration (units/s2) (P<print-accel> R<retract-accel> T<travel-accel>):",
    "echo:  M204 P500.00 R1000.00 T500.00",
]


def test_a_numbered_line_has_the_exclusive_or_of_its_bytes():
    assert marlin.numbered(0, "M110 N0") == b"N0 M110 N0*125\n"
    assert marlin.numbered(3, "T0") == b"N3 T0*57\n"  # the example of the RepRap wiki


def test_a_move_is_in_millimetres_a_minute():
    assert marlin.move((1.0, 2.5, -0.125), 10.0) == "G1 X1.000 Y2.500 Z-0.125 F600.0"


@pytest.mark.parametrize(
    ("line", "number"),
    [("Resend: 42", 42), ("Resend:7", 7), ("rs N12", 12), ("Resend: ", None), ("ok", None), ("Resend: 4x", None)],
)
def test_the_line_that_is_asked_for_again(line, number):
    assert marlin.resend(line) == number


@pytest.mark.parametrize(
    ("line", "place"),
    [
        ("X:10.00 Y:-0.50 Z:3.20 E:0.00 Count X:800 Y:-40 Z:1280", (10.0, -0.5, 3.2)),
        ("X:1.00 Y:2.00 Z:3.00", (1.0, 2.0, 3.0)),
        ("X:1.00 Y:2.00 Z:3.0o E:0.00", None),
        ("X:1.00 Y:2.00", None),
        ("T:20.1 /0.0 B:20.0 /0.0", None),
    ],
)
def test_a_place_is_read_whole_or_not_at_all(line, place):
    assert marlin.place(line) == place


def test_what_a_printer_says_of_itself():
    found = marlin.Firmware.of(M115)
    assert found.name == "Marlin 2.1.2 (Nov 22 2023 12:00:00)"
    assert found.machine == "Ender-3 Pro"
    assert found.capabilities == {"EEPROM", "EMERGENCY_PARSER"}
    assert marlin.Firmware.of(["echo: hello"]) == marlin.Firmware()


def test_limits_of_axes():
    assert marlin.limits(M503, "M203") == (500.0, 400.0, 5.0)
    assert marlin.limits(M503, "M201") == (500.0, 500.0, 100.0)
    assert marlin.limits(M503[2:], "M203") is None
    assert marlin.limits(["M203 X0.00 Y1.00 Z1.00"], "M203") is None


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("Error:Printer halted. kill() called!", True),
        ("Error:Thermal Runaway, system stopped! Heater_ID: bed", True),
        ("Error:checksum mismatch, Last Line: 41", False),
        ("echo:Printer halted", False),
    ],
)
def test_some_errors_are_the_end(line, expected):
    assert marlin.halts(line) is expected
