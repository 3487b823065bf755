"""Serial ports of this host, with pyserial's ways to fail told apart for a person."""

import errno
from typing import Any

from padforge.sense.rig.devices.protocols import RigFault


def host_ports() -> list[Any]:
    """All serial ports of this host, as pyserial lists them: `device`, `vid`, `pid`, `serial_number`, `description`.

    Raises:
        RigFault: "refused" without pyserial.
    """
    _pyserial()
    from serial.tools.list_ports import comports

    return list(comports())


def open_port(port: str, baud: int, timeout_s: float) -> Any:
    """Open `port` for this process alone, as a `serial.Serial` whose reads wait for at most `timeout_s`.

    Raises:
        RigFault: "refused" where that cannot be, and why.
    """
    serial = _pyserial()
    try:
        return serial.Serial(port, baud, timeout=timeout_s, write_timeout=1, exclusive=True)
    except Exception as error:  # pyserial lets termios.error through, which is no OSError
        raise refusal(port, error) from error


def refusal(port: str, error: Exception) -> RigFault:
    """What pyserial's `error` on opening `port` means and what to do about it."""
    number, text = getattr(error, "errno", None), str(error)  # Windows has the kind in the text only
    if number == errno.ENOENT or "FileNotFoundError" in text:
        advice = "check the cable; `padforge sense doctor` lists the ports there are"
        return RigFault("refused", f"{port}: there is no such port", advice)
    if number in (errno.EAGAIN, errno.EBUSY) or "PermissionError" in text:
        advice = "close it; it may be the serial monitor of the Arduino IDE"
        return RigFault("refused", f"{port}: another program uses it", advice)
    if number in (errno.EACCES, errno.EPERM):
        advice = "join the group that owns it (`sudo usermod -aG dialout $USER`) and log in again"
        return RigFault("refused", f"{port}: no permission to open it", advice)
    return RigFault("refused", f"{port}: cannot be opened ({error})", "check that it is the right port")


def _pyserial() -> Any:
    try:
        import serial
    except ModuleNotFoundError as error:
        raise RigFault("refused", "pyserial is not installed", "pip install 'padforge[rig]'") from error
    return serial
