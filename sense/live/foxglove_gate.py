"""The port that Foxglove connects to: its server takes whoever connects, so that any web page could read the pad.

Browsers let pages open WebSockets to any address, and state who asks: the origin of the page, and the host that it
named. Requests of foreign ones are refused; others are passed on to the server, whose own address no page can guess.
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

APP_ORIGIN = "https://app.foxglove.dev"  # of the app in a browser; the one on the desktop is no page of the web
MAX_HEAD = 2**14  # bytes of the request of a connection
CHUNK = 2**16  # bytes that are passed on at once, at most


class FoxgloveGate(ConnectionServer):
    """A port of this machine, within `with`, that passes connections on to a server.

    Args:
        port: 0 for any that is free.
        target: address of the server.

    Raises:
        InputError: the port cannot be used.
    """

    def __init__(self, port: int, target: tuple[str, int]) -> None:
        self.target = target
        super().__init__((HOST, port), _Visitor, "", "--foxglove")

    def end(self, timeout_s: float) -> None:
        """Do nothing: the server ends its connections itself."""


def hidden_host() -> str:
    """Draw an address of this machine that no page can guess; macOS has but one."""
    return HOST if sys.platform == "darwin" else ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))])


def is_welcome(headers: Message, port: int) -> bool:
    """Return whether a request for `port` is not that of a foreign page.

    Pages of this machine and the Foxglove app are none. "null" is the origin of pages that hide theirs.

    Args:
        headers: of the request.
        port: that was connected to.
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


class _Visitor(socketserver.StreamRequestHandler):
    server: FoxgloveGate  # pyright: ignore[reportIncompatibleVariableOverride]

    def handle(self) -> None:
        head = self._read_head()
        if not is_welcome(parse_headers(BytesIO(head.partition(b"\r\n")[2])), self.server.server_address[1]):
            self.wfile.write(b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            return
        with socket.create_connection(self.server.target) as server:
            server.sendall(head)
            back = Thread(target=_pass_on, args=(lambda: server.recv(CHUNK), self.request), daemon=True)
            back.start()
            _pass_on(lambda: self.rfile.read1(CHUNK), server)  # pyright: ignore[reportAttributeAccessIssue]
            back.join()

    def _read_head(self) -> bytes:
        """Read up to the empty line that ends the request of a WebSocket."""
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            line = self.rfile.readline(MAX_HEAD - len(head))
            if not line:
                raise ConnectionAbortedError
            head += line
        return head


def _pass_on(receive: Callable[[], bytes], to: socket.socket) -> None:
    """Pass on what comes until its end, or that of the other side, and then end both directions of the other side."""
    with suppress(OSError):
        while data := receive():
            to.sendall(data)
    with suppress(OSError):
        to.shutdown(socket.SHUT_RDWR)
