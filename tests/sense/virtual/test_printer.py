"""The emulated firmware, at times that are passed in: it must fail as the real one does."""

from padforge.sense.rig.arms.printer_link import number_line, parse_position
from padforge.sense.virtual.printer import Firmware

HOME = (50.0, 50.0, 50.0)


def answer(firmware: Firmware, data: bytes, now: float = 0.0) -> list[str]:
    firmware.receive(data, now)
    return firmware.run(now).decode().splitlines()


def test_firmware_executes_lines_once_in_order_and_reports_busy():
    firmware = Firmware(HOME)
    assert answer(firmware, number_line(0, "M110 N0")) == ["ok"]
    assert answer(firmware, number_line(1, "G90")) == ["ok"]
    again = ["Error:Line Number is not Last Line Number+1, Last Line: 1", "Resend: 2", "ok"]
    assert answer(firmware, number_line(1, "G90")) == again
    assert answer(firmware, number_line(3, "G90")) == again
    assert answer(firmware, number_line(2, "G90").replace(b"9", b"8")) == [
        "Error:checksum mismatch, Last Line: 1",
        *again[1:],
    ]
    assert answer(firmware, b"N2 G90\n")[0].startswith("Error:No Checksum")
    assert answer(firmware, b"2 G90*35\n") == ['echo:Unknown command: "2 G90*35"', "ok"]
    assert answer(firmware, number_line(2, "G90")) == ["ok"]
    firmware.restart(1.0)
    assert answer(firmware, b"", 1.0)[0] == "start"
    assert parse_position(answer(firmware, b"M114\n", 1.0)[0]) == (0, 0, 0)  # until it is homed
    assert answer(firmware, number_line(3, "G90"), 1.0)[1] == "Resend: 1"
    firmware = Firmware(HOME)
    firmware.busy(5.0)
    assert answer(firmware, b"M114\n", 0.0) == []
    assert answer(firmware, b"", 1.9) == []
    assert answer(firmware, b"", 2.1) == ["echo:busy: processing"]
    assert answer(firmware, b"", 4.2) == ["echo:busy: processing"]
    assert answer(firmware, b"", 5.1)[-1] == "ok"
