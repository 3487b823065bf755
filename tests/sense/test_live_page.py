"""The page of `padforge sense live`: what its server says to whom, and what a browser makes of it."""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any, Self

import pytest

from design.errors import InputError
from sense.live_server import HOST, LivePage

HOSTILE = '<img src="x" onerror="document.title=1"> & [bold]'
VIEW = {
    "title": HOSTILE,
    "middle_mm": [1.0, -2.0],
    "half_mm": 20.0,
    "pressed": True,
    "ended": "",
    "fibres": [{"swing": 0.5, "state": "sound"}, {"swing": -3.0, "state": "silent"}, {"swing": None, "state": HOSTILE}],
    "presses": [
        {"press": 7 + k, "x_mm": 1.0 + k, "y_mm": -2.0, "r50_mm": 1.5, "r90_mm": 3.0, "final": k == 0} for k in (0, 1)
    ],
    "findings": [HOSTILE],
}


@pytest.fixture
def page() -> Iterator[LivePage]:
    with LivePage(0) as page:
        yield page


def get(page: LivePage, path: str, host: str | None = None) -> HTTPResponse:
    connection = HTTPConnection(HOST, port_of(page), timeout=10)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def port_of(page: LivePage) -> int:
    return int(page.url.rstrip("/").rsplit(":", 1)[1])


@contextmanager
def told(page: LivePage) -> Iterator[Iterator[dict]]:
    """The messages that a browser gets."""
    with get(page, "/events") as response:
        lines = (line.decode() for line in response)
        yield (json.loads(line[6:]) for line in lines if line.startswith("data: "))


def test_the_page_is_served_and_allows_its_own_script_alone(page: LivePage) -> None:
    response = get(page, "/")
    text = response.read().decode()
    assert response.status == 200
    assert text.startswith("<!doctype html>")
    policy = response.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    # One page, nothing from elsewhere: no address but the namespace of SVG, and no markup made from data.
    assert [part.split('"')[0] for part in text.split("http://")[1:]] == ["www.w3.org/2000/svg"]
    assert not any(word in text for word in ("https://", "innerHTML", "outerHTML", "insertAdjacentHTML", "eval("))


def test_nothing_else_is_served(page: LivePage) -> None:
    for path in ("/x", "/../pyproject.toml", "/events/"):
        assert get(page, path).status == 404
    # A page of another host, whose name was made to mean this machine, gets nothing.
    for path in ("/", "/events"):
        assert get(page, path, host="elsewhere.example").status == 403
    assert get(page, "/", host=f"localhost:{port_of(page)}").status == 200


@pytest.mark.skipif(sys.platform != "linux", reason="127.0.0.2 is another address of this machine on Linux alone")
def test_only_one_address_is_listened_at(page: LivePage) -> None:
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", port_of(page)), timeout=5)


def test_every_browser_is_told_all_whenever_it_comes(page: LivePage) -> None:
    page.show(VIEW)
    with told(page) as first, told(page) as second:
        assert next(first) == next(second) == VIEW
        page.show(VIEW | {"pressed": False})
        assert next(first) == next(second) == VIEW | {"pressed": False}
    with told(page) as again:
        assert next(again) == VIEW | {"pressed": False}


def test_a_slow_browser_is_told_the_latest_and_holds_up_nobody(page: LivePage) -> None:
    page.show({"at": 0})
    with told(page) as messages:
        assert next(messages) == {"at": 0}
        for at in range(1, 2001):
            page.show({"at": at})
        seen = [message["at"] for message in iter(lambda: next(messages), {"at": 2000})]
    assert seen == sorted(seen)
    assert len(seen) < 1000


def test_the_end_is_told() -> None:
    with LivePage(0) as page:
        page.show({"at": 0})
        browser = get(page, "/events")
        page.show({"ended": "ended"})
    assert browser.read().decode().endswith('data: {"ended": "ended"}\n\n')


def test_a_browser_that_goes_away_is_forgotten(page: LivePage, capfd: pytest.CaptureFixture[str]) -> None:
    page.show({"at": 0})
    with socket.create_connection((HOST, port_of(page))) as browser:
        browser.sendall(f"GET /events HTTP/1.0\r\nHost: {HOST}:{port_of(page)}\r\n\r\n".encode())
        assert browser.recv(10)
    with socket.create_connection((HOST, port_of(page))) as browser:
        browser.sendall(b"\x00\xff nonsense\r\n\r\n")
    with told(page) as messages:
        assert next(messages) == {"at": 0}
        page.show({"at": 1})
        assert next(messages) == {"at": 1}
    assert capfd.readouterr().err == ""


def test_what_is_no_json_is_refused(page: LivePage) -> None:
    with pytest.raises(ValueError, match="JSON"):
        page.show({"swing": float("nan")})


def test_a_port_that_is_taken_is_one_clear_line(page: LivePage) -> None:
    port = port_of(page)
    with pytest.raises(InputError, match=rf"^port {port} of 127.0.0.1: another program uses it; .*--port"):
        LivePage(port)


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Browser:
    """A headless Chromium, asked over pipes in the words of the DevTools protocol."""

    def __init__(self, folder: Path) -> None:
        quiet = ("background-networking", "component-update", "sync", "quic", "gpu")
        flags = [*(f"--disable-{name}" for name in quiet), "--no-first-run", "--no-sandbox", "--headless"]
        command = [str(CHROMIUM), *flags, f"--user-data-dir={folder}", "--remote-debugging-pipe", "about:blank"]
        ours, theirs = os.pipe(), os.pipe()
        # It listens at 3 and answers at 4.
        script = "import os, sys; r, w, *c = sys.argv[1:]; os.dup2(int(r), 3); os.dup2(int(w), 4); os.execv(c[0], c)"
        ends = (ours[0], theirs[1])
        self._process = subprocess.Popen(
            [sys.executable, "-c", script, *map(str, ends), *command], pass_fds=ends, stderr=subprocess.DEVNULL
        )
        os.close(ours[0])
        os.close(theirs[1])
        self._out, self._in = os.fdopen(ours[1], "wb", buffering=0), os.fdopen(theirs[0], "rb")
        self._number = 0
        self._session: str | None = None
        pages = self._call("Target.getTargets")["targetInfos"]
        target = next(each["targetId"] for each in pages if each["type"] == "page")
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.terminate()
        self._process.wait()
        self._out.close()
        self._in.close()

    def open(self, url: str) -> None:
        self._call("Page.navigate", url=url)

    def ask(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page."""
        return self._call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression: str, wait_s: float = 30) -> None:
        end_s = time.monotonic() + wait_s
        while self.ask(expression) is not True:
            assert time.monotonic() < end_s, f"{expression} never came true"
            time.sleep(0.05)

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        self._out.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = json.loads(self._message())
            if answer.get("id") == self._number:
                return answer["result"]

    def _message(self) -> bytes:
        message = bytearray()
        while (byte := self._in.read(1)) != b"\0":
            assert byte, "the browser has ended"
            message += byte
        return bytes(message)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    with Browser(tmp_path) as browser:
        yield browser


def test_a_browser_shows_the_pad(page: LivePage, browser: Browser) -> None:
    page.show(VIEW)
    browser.open(page.url)
    browser.wait_for("document.querySelectorAll('.fibre').length == 3")
    shown = browser.ask("document.body.innerText")
    assert "2.0, -2.0 mm" in shown
    assert "press 8: within 1.5 mm at 50 %, 3.0 mm at 90 %, to be refined" in shown
    assert shown.count(HOSTILE) == 3
    assert browser.ask("document.images.length") == 0
    count = "document.querySelectorAll('{}').length"
    assert [browser.ask(count.format(f"#pad .{name}")) for name in ("trail", "r50", "r90", "early")] == [1, 1, 1, 1]
    # The pad is 40 mm wide and as wide on the page as its edge; y goes up.
    edge, latest, before = (
        browser.ask(f"(({{x, y, width, height}}) => [x, y, width, height])(document.querySelector('{part}').getBBox())")
        for part in ("#pad .edge", "#pad .r90", "#pad .trail")
    )
    assert latest[2] / edge[2] == pytest.approx(2 * 3.0 / 40)
    assert (latest[0] + latest[2] / 2 - before[0] - before[2] / 2) / edge[2] == pytest.approx(1 / 40)
    assert latest[1] + latest[3] / 2 == pytest.approx(edge[1] + edge[3] / 2)
    bars = browser.ask(
        "[...document.querySelectorAll('.bar rect:not(.back)')].map(bar => bar.getBBox()).map(b => [b.x, b.width])"
    )
    assert bars == [[0, 0.5], [-1, 1], [0, 0]]
    assert browser.ask("[...document.querySelectorAll('.fibre')].map(row => row.classList.contains('bad'))") == [
        False,
        True,
        True,
    ]


def test_a_browser_comes_back_to_a_page_that_was_away(browser: Browser) -> None:
    with LivePage(0) as page:
        port = port_of(page)
        page.show(VIEW | {"title": "before"})
        browser.open(page.url)
        browser.wait_for("document.getElementById('title').textContent == 'before'")
    browser.wait_for("document.getElementById('link').textContent.includes('trying again')")
    with LivePage(port) as page:
        page.show(VIEW | {"title": "after"})
        browser.wait_for("document.getElementById('title').textContent == 'after'")
        assert browser.ask("document.getElementById('link').textContent") == "pressed"
