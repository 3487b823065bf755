"""Frames of RTDE, the data link of Universal Robots controllers, and their dashboard; big-endian, both ways."""

import re
import socket
import struct
from collections.abc import Iterator, Sequence

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
VERSION, CONTROLLER, OUTPUTS, INPUTS, START, PAUSE, DATA = b"VvOISPU"
PROTOCOL = 2
"""The only version of the protocol that is spoken here."""
RUNNING = 7
"""Robot mode of an arm that is powered on and has its brakes released."""
STOPPED, PLAYING, PAUSED = 1, 2, 4
"""Runtime states of the program."""
PROTECTIVE_BITS = 1 << 2 | 1 << 3 | 1 << 4 | 1 << 8 | 1 << 9 | 1 << 10
"""Protective and safeguard stop, recovery, violation, fault: the controller does not move the arm."""
EMERGENCY_BITS = 1 << 5 | 1 << 6 | 1 << 7

_HEADER = struct.Struct(">HB")
_CODES = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT64": "Q"}
_CODES |= {"VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i"}
_TYPES = (
    (r"robot_mode|safety_mode|(input|output)_int_register_\d+", "INT32"),
    (r"runtime_state|robot_status_bits|safety_status_bits|output_bit_registers\d+_to_\d+", "UINT32"),
    (r"actual_digital_(in|out)put_bits", "UINT64"),
    (r"actual_tool_accelerometer|payload_cog", "VECTOR3D"),
    (r"joint_mode", "VECTOR6INT32"),
    (r"actual_robot_(current|voltage)|actual_main_voltage", "DOUBLE"),
    (r"(actual|target)_(q|qd|qdd|current|moment|TCP_\w+)|actual_current_as_torque|actual_joint_voltage", "VECTOR6D"),
    (r"joint_(control_output|temperatures)|ft_raw_wrench|payload_inertia", "VECTOR6D"),
    (r"\w+", "DOUBLE"),
)


def type_of(name: str) -> str:
    """Type of a variable by its name, as ur-rtde decodes it."""
    return next(kind for pattern, kind in _TYPES if re.fullmatch(pattern, name))


def layout(types: Sequence[str]) -> struct.Struct:
    """Layout of the values of a recipe; KeyError for a type that a controller gives to a variable it does not have."""
    return struct.Struct(">" + "".join(_CODES[kind] for kind in types))


def width(kind: str) -> int:
    """How many values a variable of a type has."""
    return int(_CODES[kind][:-1] or 1)


def frame(kind: int, payload: bytes = b"") -> bytes:
    """A frame with its header."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


class Splitter:
    """Cuts a stream of bytes into frames."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Kind and payload of every frame that `data` completes; ValueError for a size no frame can have."""
        self._bytes += data
        while len(self._bytes) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._bytes)
            if size < _HEADER.size:
                raise ValueError(f"a frame of {size} bytes; expected at least {_HEADER.size}")
            if len(self._bytes) < size:
                return
            payload = bytes(self._bytes[_HEADER.size : size])
            del self._bytes[:size]
            yield kind, payload


def ask_dashboard(host: str, questions: Sequence[str], timeout_s: float) -> list[str]:
    """One line of answer to each question; OSError where the dashboard does not answer within `timeout_s` each."""
    with socket.create_connection((host, DASHBOARD_PORT), timeout_s) as link, link.makefile("rb") as lines:
        lines.readline()
        answers = []
        for question in questions:
            link.sendall(question.encode() + b"\n")
            if not (answer := lines.readline()):
                raise ConnectionError("the dashboard closed the link")
            answers.append(answer.decode(errors="replace").strip())
        return answers


def stop_program(host: str, timeout_s: float) -> bool:
    """Stop the program of the arm, and with it the arm, by the dashboard; whether none runs any more.

    A stopped program cannot go on when a person unlocks the arm, a paused one can.
    """
    try:
        return ask_dashboard(host, ["stop", "running"], timeout_s)[1].lower().endswith("false")
    except OSError:
        return False
