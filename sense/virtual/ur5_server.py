"""Process of the UR emulator: its sockets, its clock, and the faults its parent switches on.

`python -m padforge.sense.virtual.ur5_server`; orders and answers are JSON lines on stdin and stdout, and the end
of stdin ends it. The clock catches up on cycles the process has slept through, so that the stream has no gap."""

import heapq
import itertools
import json
import re
import select
import socket
import struct
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from padforge.sense.rig.arms import rtde as frames
from padforge.sense.virtual.ur5_controller import RATES_HZ, VERSIONS, Controller, Series, SpringySurface, TruthWriter

PORTS = {"rtde": frames.RTDE_PORT, "script": frames.SCRIPT_PORT, "dashboard": frames.DASHBOARD_PORT}
MAX_BACKLOG = 1 << 16
"""Bytes a client may leave unread before the stream skips frames for it."""
TO_MM = np.array([1000.0, 1000.0, 1000.0, 1.0, 1.0, 1.0])


class Client:
    """A connection, with what it has negotiated."""

    def __init__(self, link: socket.socket, port: str) -> None:
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.link, self.port = link, port
        self.inputs: list[tuple[list[str], struct.Struct]] = []
        self.outputs: tuple[list[str], list[int], struct.Struct] = [], [], struct.Struct("")
        self.streaming = False
        self.splitter = frames.Splitter()
        self.text = b""
        self.backlog = b""

    def send(self, data: bytes) -> None:
        """Send what the socket takes and keep the rest for the next call."""
        self.backlog += data
        with suppress(BlockingIOError):
            self.backlog = self.backlog[self.link.send(self.backlog) :]


class Server:
    """The sockets of one controller."""

    def __init__(self, controller: Controller, truth: TruthWriter, host: str) -> None:
        self.controller, self.truth, self.host = controller, truth, host
        self.clients: list[Client] = []
        self.listeners: dict[str, socket.socket] = {}
        self.frozen = self.unplugged = False
        self.slow_s = 0.0
        self._later: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._returns: float | None = None

    def listen(self) -> None:
        """Open the ports; OSError where one is taken."""
        for name, port in PORTS.items():
            self.listeners[name] = socket.create_server((self.host, port))

    def refuse(self) -> None:
        """Close the ports; links that are open stay."""
        for listener in self.listeners.values():
            listener.close()
        self.listeners.clear()

    def drop(self, port: str) -> None:
        """Close the links to one of the ports."""
        for client in [client for client in self.clients if client.port == port]:
            self._close(client)

    def slow(self, seconds: float) -> None:
        """From now on answer and obey so much later; what waits is done now, lest it be overtaken."""
        while self._later:
            heapq.heappop(self._later)[2]()
        self.slow_s = seconds

    def restart(self, seconds: float) -> None:
        """All links and ports go; they come back after some seconds with a controller that has forgotten all."""
        self.refuse()
        for port in PORTS:
            self.drop(port)
        self._later.clear()
        self.controller.stop_program()
        self._returns = time.monotonic() + seconds

    def serve(self) -> None:
        """Run until stdin ends."""
        period = 1 / RATES_HZ[self.controller.series]
        cycle = time.monotonic()
        while True:
            timeout = max(0.0, cycle - time.monotonic())
            if not self._poll(timeout):
                return
            while self._later and self._later[0][0] <= time.monotonic():
                heapq.heappop(self._later)[2]()
            while cycle <= time.monotonic():
                self._cycle(cycle)
                cycle += period

    def _cycle(self, now: float) -> None:
        if self._returns is not None and now >= self._returns:
            self._returns = None
            self.controller.restart(now)
            self.listen()
        self.controller.tick(now)
        pose, surface = self.controller.motion.pose, self.controller.surface
        self.truth.append(now, pose * TO_MM, surface.force(pose) if surface else 0.0)
        if self.frozen or self.unplugged:
            return
        state = self.controller.state()
        for client in [client for client in self.clients if client.streaming]:
            if len(client.backlog) < MAX_BACKLOG:
                self._send(client, frames.frame(frames.DATA, _pack(client, state)))

    def _poll(self, timeout: float) -> bool:
        """Wait for sockets and the parent; False once the parent has gone."""
        listeners = {} if self.unplugged else {listener: name for name, listener in self.listeners.items()}
        clients = {} if self.unplugged else {client.link: client for client in self.clients}
        ready, _, _ = select.select([sys.stdin, *listeners, *clients], [], [], timeout)
        for source in ready:
            if source in listeners:
                with suppress(OSError):
                    self._accept(source.accept()[0], listeners[source])
            elif source in clients and clients[source] in self.clients:
                self._receive(clients[source])
        return sys.stdin not in ready or self._obey()

    def _accept(self, link: socket.socket, port: str) -> None:
        client = Client(link, port)
        self.clients.append(client)
        if port == "dashboard":
            self._answer(client, b"Connected: Universal Robots Dashboard Server\n")

    def _receive(self, client: Client) -> None:
        try:
            data = client.link.recv(65536)
        except OSError:
            data = b""
        if not data:
            self._close(client)
        elif client.port == "rtde":
            for kind, payload in client.splitter.feed(data):
                self._rtde(client, kind, payload)
        elif client.port == "script":
            client.text += data
            if re.search(rb"(?m)^end\s*\Z", client.text):
                client.text = b""
                self._do(self.controller.upload)
        else:
            *lines, client.text = (client.text + data).split(b"\n")
            for line in lines:
                self._answer(client, self.controller.dashboard(line.decode().strip()).encode() + b"\n")

    def _rtde(self, client: Client, kind: int, payload: bytes) -> None:
        if kind == frames.DATA:
            names, values = client.inputs[payload[0] - 1]
            written = dict(zip(names, values.unpack(payload[1:]), strict=True))
            self._do(lambda: self.controller.write(written, time.monotonic()))
            return
        if kind == frames.VERSION:
            answer = b"\x01"
        elif kind == frames.CONTROLLER:
            answer = struct.pack(">4I", *VERSIONS[self.controller.series])
        elif kind == frames.OUTPUTS:
            answer = self._outputs(client, payload)
        elif kind == frames.INPUTS:
            names = _names(payload)
            types = [frames.type_of(name) for name in names]
            client.inputs.append((names, frames.layout(types)))
            answer = bytes([len(client.inputs)]) + ",".join(types).encode()
        else:
            client.streaming = kind == frames.START
            answer = b"\x01"
        self._answer(client, frames.frame(kind, answer))

    def _outputs(self, client: Client, payload: bytes) -> bytes:
        names = _names(payload[8:])
        types = [frames.type_of(name) for name in names]
        client.outputs = names, [frames.width(kind) for kind in types], frames.layout(types)
        return b"\x01" + ",".join(types).encode()

    def _do(self, action: Callable[[], None]) -> None:
        """Do something now, or later where answers are slow."""
        if self.slow_s:
            heapq.heappush(self._later, (time.monotonic() + self.slow_s, next(self._order), action))
        else:
            action()

    def _answer(self, client: Client, data: bytes) -> None:
        self._do(lambda: self._send(client, data))

    def _send(self, client: Client, data: bytes) -> None:
        if client in self.clients:
            try:
                client.send(data)
            except OSError:
                self._close(client)

    def _close(self, client: Client) -> None:
        self.clients.remove(client)
        client.link.close()

    def _obey(self) -> bool:
        """Carry out an order of the parent; False where there is no parent."""
        line = sys.stdin.readline()
        if not line:
            return False
        order, *arguments = json.loads(line)
        _say(self._order_of(order)(*arguments))
        return True

    def _order_of(self, name: str) -> Callable[..., Any]:
        orders = {
            "listen": self.listen,
            "refuse": self.refuse,
            "drop": self.drop,
            "restart": self.restart,
            "slow": self.slow,
            "asked": lambda: self.controller.asked,
            "set": lambda key, value: setattr(self.controller if hasattr(self.controller, key) else self, key, value),
        }
        return orders.get(name) or getattr(self.controller, name)


def _names(payload: bytes) -> list[str]:
    """Names of variables, after the last of which ur-rtde leaves a comma."""
    return payload.decode().strip(",").split(",")


def _pack(client: Client, state: dict[str, Any]) -> bytes:
    names, widths, values = client.outputs
    flat: list[Any] = []
    for name, width in zip(names, widths, strict=True):
        value = state.get(name, 0)
        flat.extend(np.broadcast_to(value, width) if width > 1 else (value,))
    return b"\x01" + values.pack(*flat)


def _say(what: Any) -> None:
    print(json.dumps(what), flush=True)


def main(
    series: Series,
    pose_mm: list[float],
    surface_mm: float | None,
    stiffness_n_mm: float,
    host: str,
    tcp_mm: tuple[float, float, float],
    truth: str,
) -> None:
    """Open the ports and serve; the first line on stdout is null, or why it cannot be."""
    surface = None if surface_mm is None else SpringySurface(surface_mm / 1e3, stiffness_n_mm * 1e3)
    x, y, z = (value / 1e3 for value in tcp_mm)
    controller = Controller(series, np.array(pose_mm) / TO_MM, surface, time.monotonic(), (x, y, z))
    server = Server(controller, TruthWriter(Path(truth)), host)
    try:
        server.listen()
    except OSError as error:
        _say(f"{host}: {error.strerror}")
        return
    _say(None)
    server.serve()


if __name__ == "__main__":
    main(**json.loads(sys.argv[1]))
