"""A web page for browsers on this machine, which shows live messages and may post to given addresses.

Messages are Server-Sent Events. Each contains everything that the page shows, so that a browser that connects late,
reconnects or is slow needs only the latest. Requests of other pages, as stated by the browser, are refused.
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
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any, Self
from urllib.parse import parse_qs, urlencode, urlsplit

from padforge.common.page import TEMPLATES, read_resource
from padforge.common.validation import InputError

HOST = "127.0.0.1"  # the loopback interface; other addresses are served only with a token
MIN_TOKEN = 16  # characters
MAX_POST_BYTES = 4096  # size limit of a post
POLL_S = 0.05  # interval at which a server checks whether to end
MIN_INTERVAL_S = 0.04  # between two messages to a browser
KEEP_ALIVE_S = 5.0  # time without a message after which an empty one is sent, to detect a closed browser
HTTP_PORT = 80  # browsers omit it from the Host header

# Takes the body of a post, and returns JSON or None; raises InputError for an invalid body.
Handler = Callable[[bytes], Mapping[str, Any] | None]


class ConnectionServer(socketserver.ThreadingTCPServer):
    """A TCP server that runs in the `with` block; connections still open at its end are closed."""

    daemon_threads = True
    request_queue_size = socket.SOMAXCONN  # a connection beyond a full queue is delayed by a second
    # On Windows the flag would let two programs share a port; elsewhere it allows a port that was used a minute ago.
    allow_reuse_address = os.name == "posix"

    def __init__(
        self, address: tuple[str, int], handler: type[socketserver.BaseRequestHandler], token: str, option: str
    ) -> None:
        """Bind the port of an address, 0 for any free one.

        Clients need the `token`, which is required if other machines can connect. `option` is the name of the command
        line option for the port, for messages.
        """
        host, port = address
        if token and not (len(token) >= MIN_TOKEN and token.isascii() and token.isprintable()):
            raise InputError(f"token has {len(token)} characters, allowed are {MIN_TOKEN} or more of plain text")
        if host not in (HOST, "localhost") and not token:
            example = f"--token {secrets.token_urlsafe(MIN_TOKEN)}"
            raise InputError(f"host is {host!r}, which other machines can reach: state a token, such as {example}")
        self.token = token
        self._lock = threading.Lock()  # of the connections: threads add and remove them
        self._connections = set[Any]()
        reasons = {errno.EADDRINUSE: "another program uses it", errno.EACCES: "this user may not use it"}
        try:
            super().__init__(address, handler)
        except (OSError, UnicodeError) as error:
            number = getattr(error, "errno", None)
            if reason := reasons.get(number):
                choice = f"choose another with {option}, or 0 for any"
                raise InputError(f"port {port} of {host}: {reason}; {choice}") from error
            if number == errno.EADDRNOTAVAIL or isinstance(error, (socket.gaierror, UnicodeError)):
                raise InputError(f"host is {host!r}, expected an address of this machine ({error})") from error
            raise

    def __enter__(self) -> Self:
        threading.Thread(target=self.serve_forever, args=(POLL_S,), name=type(self).__name__, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self.shutdown()
        self.end(timeout_s=1.0)
        self.server_close()

    def end(self, timeout_s: float) -> None:
        """Stop sending, and wait up to `timeout_s` until every client has the last message; here nothing is sent."""

    def verify_request(self, request: Any, client_address: Any) -> bool:
        with self._lock:
            self._connections.add(request)
        return True

    def close_request(self, request: Any) -> None:
        with self._lock:
            self._connections.discard(request)
        super().close_request(request)

    def server_close(self) -> None:
        super().server_close()
        with self._lock:
            for connection in self._connections:
                with suppress(OSError):  # sent data still arrive, and the thread that waits for data wakes up
                    connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error unless it is an OSError, as of a connection that its client has closed."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


def is_this_machine(host: str, port: int) -> bool:
    """Return whether the Host header of a request names this machine and the served port.

    Without this check a foreign page could connect by a host name that resolves to this machine (DNS rebinding).
    """
    name, _, number = host.partition(":")
    return name in (HOST, "localhost") and (number or str(HTTP_PORT)) == str(port)


class LocalPage(ConnectionServer):
    """A page that is served in the `with` block, with its latest message for every browser."""

    def __init__(
        self, port: int, page: str, handlers: Mapping[str, Handler], *, host: str = HOST, token: str = ""
    ) -> None:
        """Bind the port, 0 for any free one.

        The page has one <script> and one <style>, see `page_text`. Handlers of posts, by address, are called from
        several threads.
        """
        self.page, self.handlers = page.encode(), handlers
        self.policy = "default-src 'none'; connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'"
        for tag in ("script", "style"):  # only those of the page
            digest = hashlib.sha256(page.split(f"<{tag}>")[1].split(f"</{tag}>")[0].encode()).digest()
            self.policy += f"; {tag}-src 'sha256-{base64.b64encode(digest).decode()}'"
        self.policy += "; frame-ancestors 'none'"
        self._changed = threading.Condition()
        self._message, self._number, self._n_readers, self._has_ended = "", 0, 0, False
        super().__init__((host, port), _PageHandler, token, "--port")
        query = f"?{urlencode({'token': token})}" if token else ""
        self.url = f"http://{host}:{self.server_address[1]}/{query}"

    def show(self, view: Mapping[str, Any]) -> None:
        """Make `view`, a JSON object without NaN, the latest message."""
        message = json.dumps(view, allow_nan=False)
        with self._changed:
            self._message, self._number = message, self._number + 1
            self._changed.notify_all()

    def end(self, timeout_s: float) -> None:
        """Stop sending, and wait up to `timeout_s` until every browser has the latest message."""
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._n_readers == 0, timeout_s)

    def send_messages(self, send: Callable[[bytes], object]) -> None:
        """Send the latest message, at most every `MIN_INTERVAL_S`, until `end` is called."""
        with self._changed:
            self._n_readers += 1
        number = 0
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda sent=number: self._has_ended or self._number > sent, KEEP_ALIVE_S)
                    if self._has_ended and self._number == number:
                        return
                    message = f"data: {self._message}\n\n" if self._number > number else ":\n\n"
                    number = self._number
                send(message.encode())
                time.sleep(MIN_INTERVAL_S)
        finally:
            with self._changed:
                self._n_readers -= 1
                self._changed.notify_all()


def page_text(package: str, name: str, *parts: str) -> str:
    """Return a page of a package with the inserted style and script of all local pages, and further `parts`.

    Parts are files of the package; each replaces a line `/* NAME */` of the page.
    """
    text = read_resource(package, name)
    for owner, part in [(TEMPLATES, "local_page.css"), (TEMPLATES, "local_page.js"), *((package, p) for p in parts)]:
        text = text.replace(f"/* {part} */\n", read_resource(owner, part))
    return text


class _PageHandler(BaseHTTPRequestHandler):
    server: LocalPage  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout = 10  # s, for a browser that neither sends nor receives

    def do_GET(self) -> None:
        if not self._is_authorised():
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self._url.path == "/":
            page, policy = self.server.page, self.server.policy
            self._send(HTTPStatus.OK, "text/html; charset=utf-8", page, Content_Security_Policy=policy)
        elif self._url.path == "/events":
            self._send(HTTPStatus.OK, "text/event-stream")
            self.wfile.write(b"retry: 1000\n\n")  # ms after which a browser reconnects
            self.server.send_messages(self.wfile.write)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if not (self._is_authorised() and self.headers.get("Origin") == f"http://{self.headers['Host']}"):
            self.send_error(HTTPStatus.FORBIDDEN)
        elif (handler := self.server.handlers.get(self._url.path)) is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        elif not (length.isascii() and length.isdigit()):
            self.send_error(HTTPStatus.LENGTH_REQUIRED)
        elif int(length) > MAX_POST_BYTES:
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        else:
            try:
                result = handler(self.rfile.read(int(length)))
            except InputError as error:
                self._send(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(error).encode())
                return
            if result is None:
                self._send(HTTPStatus.NO_CONTENT)
            else:
                self._send(HTTPStatus.OK, "application/json", json.dumps(result, allow_nan=False).encode())

    def _is_authorised(self) -> bool:
        """Return whether a request comes from this page, with the token or, if there is none, to this machine."""
        self._url = urlsplit(self.path)
        if self.server.token:
            token = parse_qs(self._url.query).get("token", [""])[0]
            token = token or self.headers.get("Authorization", "").removeprefix("Bearer ")
            is_authorised = hmac.compare_digest(token.encode(), self.server.token.encode())
        else:
            is_authorised = is_this_machine(self.headers.get("Host", ""), self.server.server_address[1])
        return is_authorised and not self._is_foreign()

    def _is_foreign(self) -> bool:
        """Return whether another page makes the request; links to the page itself are allowed.

        Browsers send no Origin header for images and the like, but state in Sec-Fetch-Site that another page asks.
        """
        origin = f"http://{self.headers['Host']}"
        is_cross_site = self.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none")
        return (is_cross_site and self._url.path != "/") or self.headers.get("Origin", origin) != origin

    def _send(self, status: HTTPStatus, content_type: str = "", body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        headers |= {"Cache_Control": "no-store", "X_Content_Type_Options": "nosniff", "Referrer_Policy": "no-referrer"}
        headers |= {"Content_Type": content_type, "Content_Length": str(len(body) or "")}  # "" of a stream
        for name, value in headers.items():
            if value:
                self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, since the terminal shows the progress of the command."""
