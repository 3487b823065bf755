"""The emulated firmware, in time that is told: it must fail as the real one does."""

from padforge.sense.rig.arms.printer_link import numbered, place
from padforge.sense.virtual.printer import Firmware

HOME = (50.0, 50.0, 50.0)


def said(firmware: Firmware, data: bytes, now: float = 0.0) -> list[str]:
    firmware.hear(data, now)
    return firmware.speak(now).decode().splitlines()


def test_a_line_is_executed_once_and_in_its_turn_and_a_busy_firmware_says_so_and_catches_up():
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
    firmware.restart(1.0)
    assert said(firmware, b"", 1.0)[0] == "start"
    assert place(said(firmware, b"M114\n", 1.0)[0]) == (0, 0, 0)  # until it is homed
    assert said(firmware, numbered(3, "G90"), 1.0)[1] == "Resend: 1"
    firmware = Firmware(HOME)
    firmware.busy(5.0)
    assert said(firmware, b"M114\n", 0.0) == []
    assert said(firmware, b"", 1.9) == []
    assert said(firmware, b"", 2.1) == ["echo:busy: processing"]
    assert said(firmware, b"", 4.2) == ["echo:busy: processing"]
    assert said(firmware, b"", 5.1)[-1] == "ok"
