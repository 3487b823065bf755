"""The emulated firmware, in time that is told: it must fail as the real one does."""

import pytest

from sense.rig.arms.printer.marlin import numbered, place
from sense.rig.emulators.printer.firmware import START_S, Firmware

HOME = (50.0, 50.0, 50.0)


def said(firmware: Firmware, data: bytes, now: float = 0.0) -> list[str]:
    firmware.hear(data, now)
    return firmware.speak(now).decode().splitlines()


def where(firmware: Firmware, now: float, command: bytes = b"M114\n") -> tuple[float, float, float]:
    found = place(said(firmware, command, now)[0])
    assert found is not None
    return found


def test_a_line_is_executed_once_and_in_its_turn():
    firmware = Firmware(HOME)
    assert said(firmware, numbered(0, "M110 N0")) == ["ok"]
    assert said(firmware, numbered(1, "G90")) == ["ok"]
    again = ["Error:Line Number is not Last Line Number+1, Last Line: 1", "Resend: 2", "ok"]
    assert said(firmware, numbered(1, "G90")) == again
    assert said(firmware, numbered(3, "G90")) == again
    assert said(firmware, numbered(2, "G90").replace(b"9", b"8")) == [
        "Error:checksum mismatch, Last Line: 1",
        *again[1:],
    ]
    assert said(firmware, b"N2 G90\n")[0].startswith("Error:No Checksum")
    assert said(firmware, b"2 G90*35\n") == ['echo:Unknown command: "2 G90*35"', "ok"]
    assert said(firmware, numbered(2, "G90")) == ["ok"]


def test_moves_take_their_time_and_m400_waits_for_them():
    firmware = Firmware(HOME, max_mm_s=(100.0, 100.0, 10.0), max_mm_s2=(1e6, 1e6, 1e6))
    assert said(firmware, b"M204 P1000000 T1000000\nG1 Z40 F60000\n") == ["ok", "ok"]
    assert where(firmware, 0.5) == (50, 50, 40)
    assert where(firmware, START_S + 0.5, b"M114 R\n") == pytest.approx((50, 50, 45), abs=0.01)
    assert said(firmware, b"M400\n", 0.7) == []
    assert said(firmware, b"", 1.0) == []
    assert said(firmware, b"", START_S + 1.01) == ["ok"]
    assert firmware.at(START_S + 0.25) == pytest.approx((50, 50, 47.5), abs=0.01)


@pytest.mark.parametrize("emergency_parser", [True, False])
def test_m410_ends_a_move_at_once_where_it_is_heard(emergency_parser):
    firmware = Firmware(HOME, emergency_parser=emergency_parser)
    said(firmware, b"G1 Z20 F600\nM400\n")
    assert said(firmware, b"M410\n", 1.0) == (["ok", "ok"] if emergency_parser else [])
    stood = firmware.at(1.0)
    assert (firmware.at(2.0) == stood) is emergency_parser


def test_a_busy_firmware_says_so_every_two_seconds_and_catches_up():
    firmware = Firmware(HOME)
    firmware.busy(5.0)
    assert said(firmware, b"M114\n", 0.0) == []
    assert said(firmware, b"", 1.9) == []
    assert said(firmware, b"", 2.1) == ["echo:busy: processing"]
    assert said(firmware, b"", 4.2) == ["echo:busy: processing"]
    assert said(firmware, b"", 5.1)[-1] == "ok"


def test_a_restarted_firmware_takes_any_place_for_the_origin_until_it_is_homed():
    firmware = Firmware(HOME)
    said(firmware, numbered(0, "M110 N0") + numbered(1, "G90"))
    firmware.restart(1.0)
    assert said(firmware, b"", 1.0)[0] == "start"
    assert where(firmware, 1.0) == (0, 0, 0)
    assert said(firmware, numbered(2, "G90"), 1.0)[1] == "Resend: 1"
    firmware.home()
    assert where(firmware, 1.0) == HOME
