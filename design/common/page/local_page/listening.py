"""Listening for other programs: on this machine, and on others' behalf only for who knows a token."""

import errno
import os
import secrets
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, TypeVar

from padforge.design.common.errors import InputError

HOST = "127.0.0.1"
"""Only this machine is served, unless another address is asked for: then whoever asks must know a token."""
LEAST_TOKEN, MOST_TOKEN = 16, 256
"""Characters of a token."""
POLL_S = 0.05
"""A server looks so often whether it is to end."""
MOST_CONNECTIONS = 64
"""At once: far fewer than files a program may open, without which nothing could be read or written."""
ADMIT_S = 10.0
"""Who connects has so long to say what lets him in, however slowly he says it."""
END_S = 1.0
"""Longest wait for who listens to be told of the end."""


class ConnectionServer(socketserver.ThreadingTCPServer):
    """A server with a thread for each connection, of which strangers can take up neither all nor any for long."""

    daemon_threads = True
    # Elsewhere the flag lets two programs share a port; here it only lets go of one that was used a minute ago.
    allow_reuse_address = os.name == "posix"

    def __init__(self, address: tuple[str, int], handler: type[socketserver.BaseRequestHandler]) -> None:
        self._lock = threading.Lock()
        self._connections: set[socket.socket] = set()
        self._strangers: dict[socket.socket, float] = {}  # since when
        super().__init__(address, handler)

    def admit(self, request: Any) -> None:
        """Let a connection last as long as it likes: who is at its other end has said what lets him in."""
        with self._lock:
            self._strangers.pop(request, None)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether there is room for one more."""
        with self._lock:
            return len(self._connections) < MOST_CONNECTIONS

    def process_request(self, request: Any, client_address: Any) -> None:
        """Begin with a stranger."""
        with self._lock:
            self._connections.add(request)
            self._strangers[request] = time.monotonic()
        super().process_request(request, client_address)

    def close_request(self, request: Any) -> None:
        """Forget a connection."""
        with self._lock:
            self._connections.discard(request)
            self._strangers.pop(request, None)
        super().close_request(request)

    def service_actions(self) -> None:
        """Show out who has been a stranger for too long; called again and again while it serves."""
        with self._lock:
            late = [request for request, since_s in self._strangers.items() if time.monotonic() > since_s + ADMIT_S]
        _cut(late)

    def server_close(self) -> None:
        """Listen no more, and cut off all that are left."""
        super().server_close()
        with self._lock:
            left = list(self._connections)
        _cut(left)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """One who has gone away is no error of this program; any other is told as usual."""
        import sys

        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


def _cut(connections: Iterable[socket.socket]) -> None:
    """End connections, of which what was sent already still arrives; who waits for them is woken."""
    for connection in connections:
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)


Server = TypeVar("Server", bound=socketserver.BaseServer)


def refuse_open(host: str, token: str) -> None:
    """Raise InputError where other machines could listen and no token, or one that can be guessed, keeps them out."""
    if token and not (LEAST_TOKEN <= len(token) <= MOST_TOKEN and token.isascii() and token.isprintable()):
        raise InputError(
            f"token has {len(token)} characters, allowed are {LEAST_TOKEN} to {MOST_TOKEN}, those of plain text"
        )
    if host not in (HOST, "localhost") and not token:
        raise InputError(
            f"host is {host!r}, which other machines reach: whoever knows a token may listen, and nobody else; "
            f"give one, such as --token {secrets.token_urlsafe(LEAST_TOKEN)}"
        )


def listening(begin: Callable[[], Server], host: str, port: int, option: str) -> Server:
    """The server that `begin` makes.

    Raises:
        InputError: the port is taken or not for this user, or the host is no address of this machine.
    """
    try:
        return begin()
    except (OSError, UnicodeError) as error:
        number = error.errno if isinstance(error, OSError) else None
        if number in (errno.EADDRINUSE, errno.EACCES):
            reason = "another program uses it" if number == errno.EADDRINUSE else "this user may not use it"
            raise InputError(f"port {port} of {host}: {reason}; choose another with {option}, or 0 for any") from error
        if number == errno.EADDRNOTAVAIL or isinstance(error, (socket.gaierror, UnicodeError)):
            raise InputError(f"host is {host!r}, expected an address of this machine ({error})") from error
        raise
