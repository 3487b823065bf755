"""A page for browsers on this machine, that is told of what happens as it happens, and may say a few words itself.

Every message (a Server-Sent Event) is the whole of what the page shows. So a browser that comes late, comes back or
cannot keep up needs nothing but the latest. The other way a page says single words that were agreed on before; which of
them, only its own script can: browsers tell who asks, and another page is not listened to.
"""

import base64
import contextlib
import errno
import hashlib
import json
import os
import queue
import socketserver
import threading
import time
from collections.abc import Collection, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, Self

from design.common.errors import InputError

HOST = "127.0.0.1"
HTTP_PORT = 80
"""Which browsers leave out of the name that they ask for."""
"""Only this machine is served: readings are nobody else's business, and nobody is asked for a password."""
LEAST_PAUSE_S = 0.04
"""Between two messages to a browser: faster than eyes."""
ALIVE_S = 5.0
"""After so long without a message a browser is sent an empty one, which fails if it is gone."""
END_S = 1.0
"""Longest wait for the browsers to be told of the end."""
POLL_S = 0.05
"""The server looks so often whether it is to end."""
RETRY_MS = 1000
"""After so long a browser that has lost its connection tries again."""

_PAGES = Path(__file__).with_name("pages")
_SHARED = ("common.css", "common.js")
_MOST_WORDS = 16
"""That wait to be taken: a button may be hit again and again."""


class LivePage:
    """The page, served from `with` to its end.

    Attributes:
        url: of the page.
    """

    def __init__(self, port: int, page: str = "live.html", words: Collection[str] = ()) -> None:
        """Take `port`, or any that is free if 0.

        Args:
            page: file among `pages`. words: what the page may say, see `said`.

        Raises:
            InputError: the port is taken, or not for this user.
        """
        self._server = _listening(port, page, words)
        self.url = f"http://{HOST}:{self._server.server_address[1]}/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(POLL_S,), name="server of the live page", daemon=True
        )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._server.news.end(END_S)

    def show(self, view: Mapping[str, Any]) -> None:
        """Show `view`, JSON, from now on.

        Raises:
            ValueError: it holds what JSON does not, such as NaN.
        """
        self._server.news.tell(json.dumps(view, allow_nan=False))

    def said(self) -> list[str]:
        """The words that pages have said since the last call, oldest first."""
        return [self._server.said.get_nowait() for _ in range(self._server.said.qsize())]


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


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    # Elsewhere the flag lets two programs share a port; here it only lets go of one that was used a minute ago.
    allow_reuse_address = os.name == "posix"

    def __init__(self, port: int, page: str, words: Collection[str]) -> None:
        self.news = News()
        self.words, self.said = frozenset(words), queue.Queue[str](_MOST_WORDS)
        text = _whole(page)
        self.page, self.policy = text.encode(), _policy(text)
        super().__init__((HOST, port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that has gone away is no error of this program; any other is told as usual."""
        import sys

        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


def _listening(port: int, page: str, words: Collection[str]) -> _Server:
    try:
        return _Server(port, page, words)
    except OSError as error:
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise
        reason = "another program uses it" if error.errno == errno.EADDRINUSE else "this user may not use it"
        raise InputError(f"port {port} of {HOST}: {reason}; choose another with --port, or 0 for any") from error


class _Handler(BaseHTTPRequestHandler):
    server: _Server  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout = 10  # of a browser that neither asks nor takes what it is sent

    def do_GET(self) -> None:
        if not self._asked_here():
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._send_page()
        elif self.path == "/events":
            self._send_news()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        if not (self._asked_here() and self.headers.get("Origin") == f"http://{self.headers['Host']}"):
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path != "/say":
            self.send_error(HTTPStatus.NOT_FOUND)
        elif (word := self._word()) not in self.server.words:
            self.send_error(HTTPStatus.BAD_REQUEST)
        else:
            with contextlib.suppress(queue.Full):
                self.server.said.put_nowait(word)
            self.send_response(HTTPStatus.NO_CONTENT)
            self.end_headers()

    def _word(self) -> str:
        length = self.headers.get("Content-Length", "")
        most = max(map(len, self.server.words), default=0)
        fits = length.isascii() and length.isdigit() and len(length) < 4 and int(length) <= most
        return self.rfile.read(int(length)).decode("ascii", "replace") if fits else ""

    def _asked_here(self) -> bool:
        """Whether this machine was asked by its own name: no page from elsewhere gets at it by renaming it."""
        port = self.server.server_address[1]
        left_out = (HOST, "localhost") if port == HTTP_PORT else ()
        return self.headers.get("Host") in (f"{HOST}:{port}", f"localhost:{port}", *left_out)

    def _send_page(self) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(self.server.page)))
        self.send_header("Content-Security-Policy", self.server.policy)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(self.server.page)

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
        """Nothing: the terminal shows the pad."""


def _whole(page: str) -> str:
    """The text of a page with what it shares with others."""
    text = (_PAGES / page).read_text(encoding="utf-8")
    for name in _SHARED:
        text = text.replace(f"/* {name} */\n", (_PAGES / name).read_text(encoding="utf-8"))
    return text


def _policy(page: str) -> str:
    """The content security policy under which only the page's own script and style count, and only we are asked."""
    hashes = {tag: _hash(page.split(f"<{tag}>")[1].split(f"</{tag}>")[0]) for tag in ("script", "style")}
    return (
        f"default-src 'none'; connect-src 'self'; img-src data:; script-src {hashes['script']}; "
        f"style-src {hashes['style']}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
