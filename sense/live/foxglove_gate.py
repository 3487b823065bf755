"""A gate to Foxglove's server. The server accepts every connection, so that any web page could read the pad.

Browsers let pages open WebSockets to any address, and state the origin of the page and the host of the request. The
gate refuses requests of foreign pages, and forwards others to the server, whose address a page cannot guess.
"""

import secrets
import socket
import socketserver
import sys
from collections.abc import Callable
from contextlib import suppress
from email.message import Message
from http.client import parse_headers
from io import BytesIO
from threading import Thread
from urllib.parse import urlsplit

from padforge.common.server import HOST, ConnectionServer, is_this_machine

APP_ORIGIN = "https://app.foxglove.dev"  # origin of the app in a browser; the desktop app has no web origin
CHUNK = 2**16  # maximum number of bytes forwarded at once


class FoxgloveGate(ConnectionServer):
    """A port of this machine, 0 for any free one, that forwards connections to a server in the `with` block."""

    def __init__(self, port: int, target: tuple[str, int]) -> None:
        self.target = target
        super().__init__((HOST, port), _GateHandler, "", "--foxglove")


def hidden_host() -> str:
    """Return a random loopback address, which a page cannot guess; macOS has only one."""
    return HOST if sys.platform == "darwin" else ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


def is_welcome(headers: Message, port: int) -> bool:
    """Return whether a request is to this machine, and from a program, a page of this machine, or the Foxglove app.

    A program sends no origin, or one of a scheme other than http and https. The origin "null", by which a browser hides
    that of a page, is refused.
    """
    origin = headers["Origin"]
    if not is_this_machine(headers["Host"] or "", port):
        return False
    if origin is None or origin == APP_ORIGIN:
        return True
    try:
        url = urlsplit(origin)
    except ValueError:
        return False
    return url.hostname in (HOST, "localhost") if url.scheme in ("http", "https") else bool(url.scheme)


class _GateHandler(socketserver.StreamRequestHandler):
    server: FoxgloveGate  # pyright: ignore[reportIncompatibleVariableOverride]

    def handle(self) -> None:
        head = self._read_head()
        if not is_welcome(parse_headers(BytesIO(head.partition(b"\r\n")[2])), self.server.server_address[1]):
            self.wfile.write(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            return
        with socket.create_connection(self.server.target) as server:
            server.sendall(head)
            replies = Thread(target=_forward, args=(lambda: server.recv(CHUNK), self.request), daemon=True)
            replies.start()
            _forward(lambda: self.rfile.read1(CHUNK), server)  # pyright: ignore[reportAttributeAccessIssue]
            replies.join()

    def _read_head(self) -> bytes:
        """Read the request of a WebSocket up to the empty line at its end."""
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            line = self.rfile.readline(2**14 - len(head))  # requests are short
            if not line:
                raise ConnectionAbortedError
            head += line
        return head


def _forward(receive: Callable[[], bytes], target: socket.socket) -> None:
    """Forward data until either side closes, then shut the target down."""
    with suppress(OSError):
        while data := receive():
            target.sendall(data)
    with suppress(OSError):
        target.shutdown(socket.SHUT_RDWR)
