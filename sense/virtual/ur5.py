"""An emulated UR controller on this machine, in a process of its own, with faults that can be injected at any moment.

The process is `python -m padforge.sense.virtual.ur5`; commands and answers are JSON lines on its stdin and stdout, and
the end of stdin ends it. Its clock catches up on cycles that the process has slept through, so that the stream has no
gap.
"""

import heapq
import itertools
import json
import re
import select
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partialmethod
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.files import temporary_file
from padforge.sense.rig.arms import rtde
from padforge.sense.rig.devices import Array, Pose, RigFault, start
from padforge.sense.virtual.ur5_controller import (
    RATES_HZ,
    VERSIONS,
    Controller,
    PoseLog,
    PoseLogWriter,
    Series,
    SpringySurface,
    create_pose_log,
)

HOST = "127.0.0.1"
HOME: Pose = (-120.0, -430.0, 200.0, 0.0, 3.141592653589793, 0.0)
"""Where the emulated arm stands at first: 200 mm up, the tool pointing down."""
PORTS = {"rtde": rtde.RTDE_PORT, "script": rtde.SCRIPT_PORT, "dashboard": rtde.DASHBOARD_PORT}
MAX_BACKLOG = 1 << 16  # bytes that a client may leave unread before the stream skips frames for it
TO_MM = np.array([1000.0, 1000.0, 1000.0, 1.0, 1.0, 1.0])

_LOG_PREFIX = "padforge-ur-"  # of its temporary files


class EmulatedUR5:
    """A context: the controller runs from entry to exit.

    For 127.0.0.1 ur-rtde never asks whether the arm is in remote control, for other names (127.1, say) it does.
    """

    pose_log: PoseLog  # true poses of the tip; other processes can open `PoseLog(emulator.pose_log.path)`

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
        self._settings = {"series": series, "pose_mm": pose, "surface_mm": surface_mm}
        self._settings |= {"stiffness_n_mm": stiffness_n_mm, "host": host, "tcp_mm": tcp_mm}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            path = stack.enter_context(temporary_file(Path(tempfile.gettempdir()), prefix=_LOG_PREFIX))
            create_pose_log(path)
            self._process = start("padforge.sense.virtual.ur5", json.dumps(self._settings | {"pose_log": str(path)}))
            self.pose_log = PoseLog(path)
            self._stack = stack.pop_all()
        if problem := self._read_answer():
            self.__exit__()
            raise RigFault("refused", f"no emulated arm at {problem}", "is there another one?")
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
        self._stack.close()

    def true_poses(self, times_s: ArrayLike) -> Array:
        """Return the (n, 6) true poses in mm and rad at monotonic times; see `PoseLog.poses`."""
        return self.pose_log.poses(times_s)

    def _command(self, *command: Any) -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(command).encode() + b"\n")
        self._process.stdin.flush()
        return self._read_answer()

    protective_stop = partialmethod(_command, "protective_stop")
    """Stop the arm as after a collision: the program is paused."""
    emergency_stop = partialmethod(_command, "emergency_stop")  # press the red button
    clear = partialmethod(_command, "clear")
    """Unlock the arm, power on and release the brakes, as a person does after a stop."""
    play = partialmethod(_command, "play")  # press play at the pendant: a paused program goes on
    stop_program = partialmethod(_command, "stop_program")  # press stop at the pendant: the program ends
    drop = partialmethod(_command, "drop")  # close the connections to a port; new ones are accepted
    freeze = partialmethod(_command, "set", "frozen")  # send no more states; all else goes on
    unplug = partialmethod(_command, "set", "unplugged")
    """Receive and send nothing, and close no connection: the cable is out."""
    slow = partialmethod(_command, "slow")  # delay every answer and every command by some seconds
    push = partialmethod(_command, "set", "sideways_n")  # push the tool sideways with a force in N
    remote_control = partialmethod(_command, "set", "remote")  # switch between local and remote control
    restart = partialmethod(_command, "restart")
    """Restart the controller: all connections end, and it is back after some seconds."""
    dashboard_log = partialmethod(_command, "dashboard_log")  # return every line that was sent to the dashboard

    def refuse(self, refused: bool) -> None:
        """Refuse new connections, or accept them again; open connections stay."""
        self._command("refuse" if refused else "listen")

    def _read_answer(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline() or b'"the emulator has ended"')


class Connection:
    """A client's connection, with the recipes that it has negotiated."""

    def __init__(self, link: socket.socket, port: str) -> None:
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.link, self.port = link, port
        self.inputs: list[tuple[list[str], struct.Struct]] = []
        self.outputs: tuple[list[str], list[int], struct.Struct] = [], [], struct.Struct("")
        self.streaming = False
        self.splitter = rtde.FrameSplitter()
        self.text = b""
        self.backlog = b""

    def send(self, data: bytes) -> None:
        """Send what the socket accepts and keep the remainder for the next call."""
        self.backlog += data
        with suppress(BlockingIOError):
            self.backlog = self.backlog[self.link.send(self.backlog) :]

    def pack_state(self, state: dict[str, Any]) -> bytes:
        """Return the values of the output recipe."""
        names, widths, layout = self.outputs
        values: list[Any] = []
        for name, width in zip(names, widths, strict=True):
            value = state.get(name, 0)
            values.extend(np.broadcast_to(value, width) if width > 1 else (value,))
        return b"\x01" + layout.pack(*values)


class ControllerServer:
    """The sockets of one controller."""

    def __init__(self, controller: Controller, pose_log: PoseLogWriter, host: str) -> None:
        self.controller, self.pose_log, self.host = controller, pose_log, host
        self.connections: list[Connection] = []
        self.listeners: dict[str, socket.socket] = {}
        self.frozen = self.unplugged = False
        self.delay_s = 0.0
        self._delayed: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self._restart_s: float | None = None

    def listen(self) -> None:
        """Open the ports; OSError if one is in use."""
        for name, port in PORTS.items():
            self.listeners[name] = socket.create_server((self.host, port))

    def refuse(self) -> None:
        """Close the ports; open connections stay."""
        for listener in self.listeners.values():
            listener.close()
        self.listeners.clear()

    def drop(self, port: str) -> None:
        """Close the connections to one of the ports."""
        for connection in [connection for connection in self.connections if connection.port == port]:
            self._close(connection)

    def slow(self, seconds: float) -> None:
        """Delay answers and commands from now on; what waits is done now, so that nothing overtakes it."""
        while self._delayed:
            heapq.heappop(self._delayed)[2]()
        self.delay_s = seconds

    def restart(self, seconds: float) -> None:
        """Close all connections and ports; they come back after some seconds with a restarted controller."""
        self.refuse()
        for port in PORTS:
            self.drop(port)
        self._delayed.clear()
        self.controller.stop_program()
        self._restart_s = time.monotonic() + seconds

    def serve(self) -> None:
        """Run until stdin ends."""
        period = 1 / RATES_HZ[self.controller.series]
        cycle = time.monotonic()
        while True:
            timeout = max(0.0, cycle - time.monotonic())
            if not self._poll(timeout):
                return
            while self._delayed and self._delayed[0][0] <= time.monotonic():
                heapq.heappop(self._delayed)[2]()
            while cycle <= time.monotonic():
                self._run_cycle(cycle)
                cycle += period

    def _run_cycle(self, now: float) -> None:
        if self._restart_s is not None and now >= self._restart_s:
            self._restart_s = None
            self.controller.restart(now)
            self.listen()
        self.controller.tick(now)
        pose, surface = self.controller.motion.pose, self.controller.surface
        self.pose_log.append(now, pose * TO_MM, surface.force(pose) if surface else 0.0)
        if self.frozen or self.unplugged:
            return
        state = self.controller.state()
        for connection in [connection for connection in self.connections if connection.streaming]:
            if len(connection.backlog) < MAX_BACKLOG:
                self._send(connection, rtde.pack_frame(rtde.DATA, connection.pack_state(state)))

    def _poll(self, timeout: float) -> bool:
        """Wait for sockets and the parent; return False once the parent has gone."""
        listeners = {} if self.unplugged else {listener: name for name, listener in self.listeners.items()}
        links = {} if self.unplugged else {connection.link: connection for connection in self.connections}
        ready, _, _ = select.select([sys.stdin, *listeners, *links], [], [], timeout)
        for source in ready:
            if source in listeners:
                with suppress(OSError):
                    self._accept(source.accept()[0], listeners[source])
            elif source in links and links[source] in self.connections:
                self._receive(links[source])
        return sys.stdin not in ready or self._execute_command()

    def _accept(self, link: socket.socket, port: str) -> None:
        connection = Connection(link, port)
        self.connections.append(connection)
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
            for kind, payload in connection.splitter.split(data):
                self._process_frame(connection, kind, payload)
        elif connection.port == "script":
            connection.text += data
            if re.search(rb"(?m)^end\s*\Z", connection.text):
                connection.text = b""
                self._do(self.controller.upload)
        else:
            *lines, connection.text = (connection.text + data).split(b"\n")
            for line in lines:
                self._answer(connection, self.controller.answer_dashboard(line.decode().strip()).encode() + b"\n")

    def _process_frame(self, connection: Connection, kind: int, payload: bytes) -> None:
        if kind == rtde.DATA:
            names, layout = connection.inputs[payload[0] - 1]
            values = dict(zip(names, layout.unpack(payload[1:]), strict=True))
            self._do(lambda: self.controller.write(values, time.monotonic()))
            return
        answer = b"\x01"
        if kind == rtde.CONTROLLER:
            answer = struct.pack(">4I", *VERSIONS[self.controller.series])
        elif kind in (rtde.OUTPUTS, rtde.INPUTS):
            # A rate of eight bytes precedes the names of outputs, and ur-rtde leaves a comma after the last name.
            names = payload[8 * (kind == rtde.OUTPUTS) :].decode().strip(",").split(",")
            types = [rtde.variable_type(name) for name in names]
            if kind == rtde.OUTPUTS:
                connection.outputs = names, [rtde.n_values(name) for name in types], rtde.recipe_layout(types)
            else:
                connection.inputs.append((names, rtde.recipe_layout(types)))
                answer = bytes([len(connection.inputs)])
            answer += ",".join(types).encode()
        elif kind != rtde.VERSION:
            connection.streaming = kind == rtde.START
        self._answer(connection, rtde.pack_frame(kind, answer))

    def _do(self, action: Callable[[], None]) -> None:
        """Run an action now, or later if answers are slow."""
        if self.delay_s:
            heapq.heappush(self._delayed, (time.monotonic() + self.delay_s, next(self._numbers), action))
        else:
            action()

    def _answer(self, connection: Connection, data: bytes) -> None:
        self._do(lambda: self._send(connection, data))

    def _send(self, connection: Connection, data: bytes) -> None:
        if connection in self.connections:
            try:
                connection.send(data)
            except OSError:
                self._close(connection)

    def _close(self, connection: Connection) -> None:
        self.connections.remove(connection)
        connection.link.close()

    def _execute_command(self) -> bool:
        """Execute a command of the parent; return False if there is no parent."""
        line = sys.stdin.readline()
        if not line:
            return False
        command, *arguments = json.loads(line)
        if command == "set":
            name, value = arguments
            setattr(self.controller if hasattr(self.controller, name) else self, name, value)
            _print(None)
        elif command == "dashboard_log":
            _print(self.controller.dashboard_log)
        else:
            server_commands = ("listen", "refuse", "drop", "restart", "slow")
            _print(getattr(self if command in server_commands else self.controller, command)(*arguments))
        return True


def _print(value: Any) -> None:
    print(json.dumps(value), flush=True)


def main(
    series: Series,
    pose_mm: list[float],
    surface_mm: float | None,
    stiffness_n_mm: float,
    host: str,
    tcp_mm: tuple[float, float, float],
    pose_log: str,
) -> None:
    """Open the ports and serve; the first line on stdout is null, or why that fails."""
    surface = None if surface_mm is None else SpringySurface(surface_mm / 1e3, stiffness_n_mm * 1e3)
    x, y, z = (value / 1e3 for value in tcp_mm)
    controller = Controller(series, np.array(pose_mm) / TO_MM, surface, time.monotonic(), (x, y, z))
    server = ControllerServer(controller, PoseLogWriter(Path(pose_log)), host)
    try:
        server.listen()
    except OSError as error:
        _print(f"{host}: {error.strerror}")
        return
    _print(None)
    server.serve()


if __name__ == "__main__":
    main(**json.loads(sys.argv[1]))
