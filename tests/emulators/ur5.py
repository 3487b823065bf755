"""An emulated UR controller on this machine, in a thread of its own, with faults that can be injected at any moment.

Its clock catches up on cycles that the thread has slept through, so that the stream has no gap.
"""

import queue
import re
import select
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partialmethod
from typing import Any, Self

import numpy as np

from padforge.sense.rig import clock
from padforge.sense.rig.arms import rtde
from padforge.sense.rig.devices import Pose
from tests.emulators.ur5_controller import RATES_HZ, VERSIONS, Controller, PoseLog, Series

HOST = "127.0.0.1"
HOME: Pose = (-120.0, -430.0, 200.0, 0.0, 3.141592653589793, 0.0)
"""Where the emulated arm stands at first: 200 mm up, the tool pointing down."""
SCRIPT_PORT = 30003
PORTS = {"rtde": rtde.RTDE_PORT, "script": SCRIPT_PORT, "dashboard": rtde.DASHBOARD_PORT}
VERSION, CONTROLLER, OUTPUTS, INPUTS, START, DATA = b"VvOISU"  # types of RTDE frames; all numbers are big-endian
HEADER = struct.Struct(">HB")  # size of a frame, with its header, and type
TO_MM = np.array([1000.0, 1000.0, 1000.0, 1.0, 1.0, 1.0])
COMMAND_S = 5.0  # longest wait for a command to be executed
_CODES = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT64": "Q"}
_CODES |= {"VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i"}
_TYPES = (
    (r"robot_mode|safety_mode|(input|output)_int_register_\d+", "INT32"),
    (r"runtime_state|robot_status_bits|safety_status_bits|output_bit_registers\d+_to_\d+", "UINT32"),
    (r"actual_digital_(in|out)put_bits", "UINT64"),
    (r"actual_tool_accelerometer|payload_cog", "VECTOR3D"),
    (r"joint_mode", "VECTOR6INT32"),
    (r"(actual|target)_(q|qd|qdd|current|moment|TCP_\w+)|actual_current_as_torque|actual_joint_voltage", "VECTOR6D"),
    (r"joint_(control_output|temperatures)|ft_raw_wrench|payload_inertia", "VECTOR6D"),
    (r"\w+", "DOUBLE"),
)


def variable_type(name: str) -> str:
    """Return the type of a variable that a controller sends or takes, by its name, as ur-rtde decodes it."""
    return next(kind for pattern, kind in _TYPES if re.fullmatch(pattern, name))


def recipe_layout(types: list[str]) -> struct.Struct:
    return struct.Struct(">" + "".join(_CODES[kind] for kind in types))


def pack_frame(kind: int, payload: bytes) -> bytes:
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


class Connection:
    """A client's connection, with the recipes that it has negotiated."""

    def __init__(self, link: socket.socket, port: str) -> None:
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.link, self.port = link, port
        self.inputs: list[tuple[list[str], struct.Struct]] = []
        self.outputs: tuple[list[str], list[int], struct.Struct] = [], [], struct.Struct("")
        self.streaming = False
        self.text = b""  # received, but not yet complete

    def pack_state(self, state: dict[str, Any]) -> bytes:
        names, widths, layout = self.outputs
        values: list[Any] = []
        for name, width in zip(names, widths, strict=True):
            value = state.get(name, 0)
            values.extend(np.broadcast_to(value, width) if width > 1 else (value,))
        return b"\x01" + layout.pack(*values)


class EmulatedUR5:
    """A context: the controller runs from entry to exit.

    For 127.0.0.1 ur-rtde never asks whether the arm is in remote control, for other names (127.1, say) it does.
    """

    def __init__(
        self,
        series: Series = "cb3",
        pose: Pose = HOME,
        surface_mm: float | None = None,
        stiffness_n_mm: float = 2.0,
        host: str = HOST,
        tcp_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Describe a controller: "cb3" at 125 Hz or "e" at 500 Hz, over a springy plane at `surface_mm`."""
        surface_m = -np.inf if surface_mm is None else surface_mm / 1e3
        x, y, z = (value / 1e3 for value in tcp_mm)
        pose_m = np.array(pose) / TO_MM
        self._controller = Controller(series, pose_m, surface_m, stiffness_n_mm * 1e3, clock.now(), (x, y, z))
        self.pose_log = PoseLog()
        self.true_poses = self.pose_log.poses
        self.dashboard_log = self._controller.dashboard_log  # every line that was sent to the dashboard
        self.host = host
        self._connections: list[Connection] = []
        self._listeners: dict[str, socket.socket] = {}
        self._frozen = self._unplugged = False
        self._delay_s = 0.0
        self._delayed: deque[tuple[float, Callable[[], None]]] = deque()
        self._restart_s: float | None = None
        self._commands: queue.SimpleQueue[tuple[str, tuple[Any, ...], Future[None]]] = queue.SimpleQueue()
        self._ending = False
        self._thread = threading.Thread(target=self._serve, name=f"emulated arm at {host}", daemon=True)

    def __enter__(self) -> Self:
        self._listen()
        self._run_cycle(clock.now())  # so that there is a pose from the start on
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending = True
        self._thread.join()
        self._close_all()

    def _command(self, name: str, *arguments: Any) -> None:
        """Call a method between two cycles, and wait for its end."""
        done: Future[None] = Future()
        self._commands.put((name, arguments, done))
        done.result(COMMAND_S)

    protective_stop = partialmethod(_command, "protective_stop")  # as after a collision: the program is paused
    emergency_stop = partialmethod(_command, "emergency_stop")  # press the red button
    clear = partialmethod(_command, "clear")  # what a person does after a stop: unlock, power on, release the brakes
    play = partialmethod(_command, "play")  # press play at the pendant: a paused program goes on
    stop_program = partialmethod(_command, "stop_program")  # press stop at the pendant: the program ends
    refuse = partialmethod(_command, "_refuse")  # refuse new connections, or accept them again; open ones stay
    drop = partialmethod(_command, "_drop")  # close the connections to a port; new ones are accepted
    slow = partialmethod(_command, "_slow")  # delay every answer and every command by some seconds
    restart = partialmethod(_command, "_restart")  # all connections end, and it is back after some seconds

    def freeze(self, frozen: bool) -> None:
        """Send no more states, or go on; all else goes on."""
        self._frozen = frozen

    def unplug(self, unplugged: bool) -> None:
        """Receive and send nothing, and close no connection: the cable is out."""
        self._unplugged = unplugged

    def break_force_sensor(self, broken: bool) -> None:
        self._controller.has_force = not broken

    def push(self, sideways_n: float) -> None:
        self._controller.sideways_n = sideways_n

    def remote_control(self, remote: bool) -> None:
        self._controller.remote = remote

    def _listen(self) -> None:
        for name, port in PORTS.items():
            self._listeners[name] = socket.create_server((self.host, port))

    def _refuse(self, refused: bool) -> None:
        for listener in self._listeners.values():
            listener.close()
        self._listeners.clear()
        if not refused:
            self._listen()

    def _drop(self, port: str) -> None:
        for connection in [connection for connection in self._connections if connection.port == port]:
            self._close(connection)

    def _close_all(self) -> None:
        self._refuse(True)
        for port in PORTS:
            self._drop(port)

    def _slow(self, seconds: float) -> None:
        """Delay answers and commands from now on; what waits is done now, so that nothing overtakes it."""
        while self._delayed:
            self._delayed.popleft()[1]()
        self._delay_s = seconds

    def _restart(self, seconds: float) -> None:
        self._close_all()
        self._delayed.clear()
        self._controller.stop_program()
        self._restart_s = clock.now() + seconds

    def _serve(self) -> None:
        period = 1 / RATES_HZ[self._controller.series]
        cycle = clock.now()
        while not self._ending:
            self._poll(max(0.0, cycle - clock.now()))
            while not self._commands.empty():
                name, arguments, done = self._commands.get()
                done.set_result(getattr(self if name.startswith("_") else self._controller, name)(*arguments))
            while self._delayed and self._delayed[0][0] <= clock.now():
                self._delayed.popleft()[1]()
            due_s = clock.now()  # and no later: where cycles take longer than they last, it must still read its sockets
            while cycle <= due_s:
                self._run_cycle(cycle)
                cycle += period

    def _run_cycle(self, now: float) -> None:
        if self._restart_s is not None and now >= self._restart_s:
            self._restart_s = None
            self._controller.restart(now)
            self._listen()
        self._controller.tick(now)
        self.pose_log.append(now, self._controller.motion.pose * TO_MM, self._controller.surface_force())
        if self._frozen or self._unplugged:
            return
        state = self._controller.state()
        for connection in [connection for connection in self._connections if connection.streaming]:
            self._send(connection, pack_frame(DATA, connection.pack_state(state)))

    def _poll(self, timeout: float) -> None:
        if self._unplugged:
            clock.sleep(timeout)
            return
        listeners = {listener: name for name, listener in self._listeners.items()}
        links = {connection.link: connection for connection in self._connections}
        for source in select.select([*listeners, *links], [], [], timeout)[0]:
            if source in listeners:
                with suppress(OSError):
                    self._accept(source.accept()[0], listeners[source])
            elif links[source] in self._connections:
                self._receive(links[source])

    def _accept(self, link: socket.socket, port: str) -> None:
        connection = Connection(link, port)
        self._connections.append(connection)
        if port == "dashboard":
            self._answer(connection, b"Connected: Universal Robots Dashboard Server\n")

    def _receive(self, connection: Connection) -> None:
        try:
            data = connection.link.recv(65536)
        except OSError:
            data = b""
        if not data:
            self._close(connection)
        elif connection.port == "rtde":
            connection.text += data
            while len(connection.text) >= (size := int.from_bytes(connection.text[:2].ljust(2, b"\xff"))):
                frame, connection.text = connection.text[:size], connection.text[size:]
                self._process_frame(connection, frame[2], frame[3:])
        elif connection.port == "script":
            connection.text += data
            if re.search(rb"(?m)^end\s*\Z", connection.text):
                text, connection.text = connection.text.decode(), b""
                self._do(lambda: self._controller.upload(text))
        else:
            *lines, connection.text = (connection.text + data).split(b"\n")
            for line in lines:
                self._answer(connection, self._controller.answer_dashboard(line.decode().strip()).encode() + b"\n")

    def _process_frame(self, connection: Connection, kind: int, payload: bytes) -> None:
        if kind == DATA:
            if not 0 < payload[0] <= len(connection.inputs):
                return  # a client that reconnects, as ur-rtde does, sends the recipes of its last link first
            names, layout = connection.inputs[payload[0] - 1]
            values = dict(zip(names, layout.unpack(payload[1:]), strict=True))
            self._do(lambda: self._controller.write(values, clock.now()))
            return
        answer = b"\x01"
        if kind == CONTROLLER:
            answer = struct.pack(">4I", *VERSIONS[self._controller.series])
        elif kind in (OUTPUTS, INPUTS):
            # A rate of eight bytes precedes the names of outputs, and ur-rtde leaves a comma after the last name.
            names = payload[8 * (kind == OUTPUTS) :].decode().strip(",").split(",")
            types = [variable_type(name) for name in names]
            if kind == OUTPUTS:
                connection.outputs = names, [int(_CODES[name][:-1] or 1) for name in types], recipe_layout(types)
            elif "IN_USE" not in (types := [self._claim(connection, name) for name in names]):
                connection.inputs.append((names, recipe_layout(types)))
                answer = bytes([len(connection.inputs)])
            answer += ",".join(types).encode()
        elif kind != VERSION:
            connection.streaming = kind == START
        self._answer(connection, pack_frame(kind, answer))

    def _claim(self, connection: Connection, name: str) -> str:
        """Return the type of an input, or "IN_USE" if another client writes it."""
        others = [other for other in self._connections if other is not connection]
        in_use = any(name in names for other in others for names, _ in other.inputs)
        return "IN_USE" if in_use else variable_type(name)

    def _do(self, action: Callable[[], None]) -> None:
        """Run an action now, or later if answers are slow."""
        if self._delay_s:
            self._delayed.append((clock.now() + self._delay_s, action))
        else:
            action()

    def _answer(self, connection: Connection, data: bytes) -> None:
        self._do(lambda: self._send(connection, data))

    def _send(self, connection: Connection, data: bytes) -> None:
        """Send bytes, or close the connection to a client that has left too many unread."""
        if connection in self._connections:
            try:
                connection.link.sendall(data)
            except OSError:
                self._close(connection)

    def _close(self, connection: Connection) -> None:
        self._connections.remove(connection)
        connection.link.close()
