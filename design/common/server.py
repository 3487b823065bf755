"""A page for browsers on this machine, that is told of what happens as it happens, and may be answered itself.

Every message (a Server-Sent Event) is the whole of what the page shows. So a browser that comes late, comes back or
cannot keep up needs nothing but the latest. The other way the page posts to addresses that were agreed on before; only
its own script can: browsers tell who asks, and another page is not listened to.
"""

import base64
import errno
import hashlib
import hmac
import json
import os
import secrets
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any, Self, TypeVar
from urllib.parse import parse_qs, urlencode, urlsplit

from padforge.design.common.page import read_resource
from padforge.design.common.validation import InputError

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


def check_exposure(host: str, token: str) -> None:
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


def bind_server(begin: Callable[[], Server], host: str, port: int, option: str) -> Server:
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


HTTP_PORT = 80
"""Which browsers leave out of the name that they ask for."""
LEAST_PAUSE_S = 0.04
"""Between two messages to a browser: faster than eyes."""
ALIVE_S = 5.0
"""After so long without a message a browser is sent an empty one, which fails if it is gone."""
RETRY_MS = 1000
"""After so long a browser that has lost its connection tries again."""

_SWALLOWED = 2**20
"""Bytes of what is too long that are read, so that its sender hears why."""
TEMPLATES = "padforge.design.common.templates"
_SHARED = ("local_page.css", "local_page.js")

Handler = Callable[[bytes], Mapping[str, Any] | None]
"""Takes what the page posts to an address; answers with JSON, or nothing. What it cannot use is an InputError."""


class LocalPage:
    """The page, served from `with` to its end.

    Attributes:
        url: of the page.
    """

    def __init__(
        self,
        port: int,
        page: str,
        heard: Mapping[str, Handler] | None = None,
        longest: int = 4096,
        *,
        host: str = HOST,
        token: str = "",
    ) -> None:
        """Take `port`, or any that is free if 0.

        Args:
            page: HTML with one <script> and one <style>, as `page_text` gives it.
            heard: what takes what the page posts, by address; called from several threads at once.
            longest: most bytes that are taken at once.
            host: address to listen on.
            token: what must be known to be answered, as `check_exposure` has it; "" for none.

        Raises:
            InputError: the port is taken, or not for this user, or others could listen without a token.
        """
        check_exposure(host, token)
        self._server = bind_server(
            lambda: _Server((host, port), token, page, heard or {}, longest), host, port, "--port"
        )
        known = f"?{urlencode({'token': token})}" if token else ""
        self.url = f"http://{host}:{self._server.server_address[1]}/{known}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(POLL_S,), name="server of the page", daemon=True
        )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.news.end(END_S)
        self._server.server_close()

    def show(self, view: Mapping[str, Any]) -> None:
        """Show `view`, JSON, from now on.

        Raises:
            ValueError: it holds what JSON does not, such as NaN.
        """
        self._server.news.tell(json.dumps(view, allow_nan=False))


def page_text(package: str, name: str, *parts: str) -> str:
    """The text of a page that a package ships, with what all local pages share and with `parts` of its own.

    A part stands in the page as a line `/* its name */` or, where it has several, once for each.
    """
    text = read_resource(package, name)
    for owner, part in (
        *((TEMPLATES, shared) for shared in _SHARED),
        *((package, part) for part in parts),
    ):
        text = text.replace(f"/* {part} */\n", read_resource(owner, part))
    return text


class News:
    """The latest message, which any number of readers wait for."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._message = ""
        self._number = 0
        self._readers = 0
        self._ended = False

    def tell(self, message: str) -> None:
        """This is the latest from now on."""
        with self._changed:
            self._message, self._number = message, self._number + 1
            self._changed.notify_all()

    def end(self, wait_s: float) -> None:
        """There will be no more; waits until every reader has seen the last, for `wait_s` at most."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._readers == 0, wait_s)

    def __enter__(self) -> Self:
        with self._changed:
            self._readers += 1
        return self

    def __exit__(self, *error: object) -> None:
        with self._changed:
            self._readers -= 1
            self._changed.notify_all()

    def after(self, number: int, wait_s: float) -> tuple[int, str] | None:
        """The latest message and its number, once that is greater than `number`; None once all has been told.

        After `wait_s` without one: `number` again, and an empty message.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._number > number, wait_s)
            if self._number > number:
                return self._number, self._message
            return None if self._ended else (number, "")


class _Server(ConnectionServer):
    def __init__(
        self, address: tuple[str, int], token: str, page: str, heard: Mapping[str, Handler], longest: int
    ) -> None:
        self.news = News()
        self.token, self.heard, self.longest = token, heard, longest
        self.page, self.policy = page.encode(), _policy(page)
        super().__init__(address, _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Server  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout = 10  # of a browser that neither asks nor takes what it is sent

    def parse_request(self) -> bool:
        """Also refuses an address that is none."""
        if not super().parse_request():
            return False
        try:
            self._asked = urlsplit(self.path)
        except ValueError:
            self.send_error(HTTPStatus.BAD_REQUEST)
            return False
        return True

    def do_GET(self) -> None:
        path = self._asked.path
        if not self._may_ask():
            self.send_error(HTTPStatus.FORBIDDEN)
        elif path == "/":
            page, policy = self.server.page, self.server.policy
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", page, Content_Security_Policy=policy)
        elif path == "/events":
            self._send_news()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        if not (self._may_ask() and self.headers.get("Origin") == f"http://{self.headers['Host']}"):
            self.send_error(HTTPStatus.FORBIDDEN)
        elif (hear := self.server.heard.get(self._asked.path)) is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        elif (length := self._length()) is None:
            self.send_error(HTTPStatus.LENGTH_REQUIRED)
        elif length > self.server.longest:
            self.rfile.read(min(length, _SWALLOWED))  # who is still sending does not listen
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        elif len(body := self.rfile.read(length)) < length:
            self.send_error(HTTPStatus.BAD_REQUEST)  # a half of what was meant is something else
        else:
            self._answer(hear, body)

    def _answer(self, hear: Handler, body: bytes) -> None:
        try:
            answer = hear(body)
        except InputError as error:
            self._send(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(error).encode())
        else:
            if answer is None:
                self._send(HTTPStatus.NO_CONTENT)
            else:
                text = json.dumps(answer, allow_nan=False)
                self._send(HTTPStatus.OK, "application/json", text.encode())

    def _length(self) -> int | None:
        length = self.headers.get("Content-Length", "")
        return int(length) if length.isascii() and length.isdigit() and len(length) < 10 else None

    def _may_ask(self) -> bool:
        """Whether the token is known, where there is one; else whether this machine was asked by its own name: no page
        from elsewhere gets at it by renaming it."""
        if self.server.token:
            said = parse_qs(self._asked.query).get("token", [""])[0]
            said = said or self.headers.get("Authorization", "").removeprefix("Bearer ")
            may = hmac.compare_digest(said.encode(), self.server.token.encode())
        else:
            port = self.server.server_address[1]
            left_out = (HOST, "localhost") if port == HTTP_PORT else ()
            may = self.headers.get("Host") in (f"{HOST}:{port}", f"localhost:{port}", *left_out)
        if may:
            self.server.admit(self.request)
        return may

    def _send(self, status: HTTPStatus, kind: str = "", body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        if kind:
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.end_headers()
        self.wfile.write(body)

    def _send_news(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(f"retry: {RETRY_MS}\n\n".encode())
        number = 0
        with self.server.news as news:
            while (told := news.after(number, ALIVE_S)) is not None:
                number, message = told
                self.wfile.write(f"data: {message}\n\n".encode() if message else b":\n\n")
                time.sleep(LEAST_PAUSE_S)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal has better to show."""


def _policy(page: str) -> str:
    """The content security policy under which only the page's own script and style count, and only we are asked."""
    hashes = {tag: _hash(page.split(f"<{tag}>")[1].split(f"</{tag}>")[0]) for tag in ("script", "style")}
    return (
        f"default-src 'none'; connect-src 'self'; img-src data:; script-src {hashes['script']}; "
        f"style-src {hashes['style']}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
