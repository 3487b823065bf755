"""The page of `padforge sense live`: what its server says to whom, and what a browser makes of it."""

import json
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path

import pytest

from padforge.design.common import server as local_page
from padforge.design.common.server import HOST
from padforge.sense.live.outputs import LivePage
from tests.helpers.chromium import CHROMIUM, Chromium

HOSTILE = '<img src="x" onerror="document.title=1"> & [bold]'
VIEW = {
    "title": HOSTILE,
    "origin_mm": [1.0, -2.0],
    "half_mm": [20.0, 20.0],
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


@pytest.mark.parametrize("name", ["live.html", "hand.html"])
def test_the_page_is_served_and_allows_its_own_script_alone(name: str) -> None:
    with LivePage(0, name) as page:
        response = get(page, "/")
        text = response.read().decode()
    assert "common." not in text
    assert "local_page." not in text
    assert response.status == 200
    assert text.startswith("<!doctype html>")
    policy = response.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    # One page, nothing from elsewhere: no address but the namespace of SVG, and no markup made from data.
    assert [part.split('"')[0] for part in text.split("http://")[1:]] == ["www.w3.org/2000/svg"]
    assert not any(word in text for word in ("https://", "innerHTML", "outerHTML", "insertAdjacentHTML", "eval("))


def test_nothing_else_is_served_and_only_to_who_asks_this_machine_by_its_name(page, monkeypatch) -> None:
    for path in ("/x", "/../pyproject.toml", "/events/"):
        assert get(page, path).status == 404
    # A page of another host, whose name was made to mean this machine, gets nothing.
    for path in ("/", "/events"):
        assert get(page, path, host="elsewhere.example").status == 403
    assert get(page, "/", host=f"localhost:{port_of(page)}").status == 200
    assert get(page, "/", host="localhost").status == 403
    monkeypatch.setattr(local_page, "HTTP_PORT", port_of(page))  # which browsers leave out
    assert [get(page, "/", name).status for name in ("localhost", HOST, "elsewhere")] == [200, 200, 403]
    if sys.platform == "linux":  # where 127.0.0.2 is another address of this machine
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.2", port_of(page)), timeout=5)


def test_every_browser_is_told_all_whenever_it_comes(page: LivePage) -> None:
    page.show(VIEW)
    with pytest.raises(ValueError, match="JSON"):
        page.show({"swing": float("nan")})
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


@pytest.fixture
def asking() -> Iterator[LivePage]:
    with LivePage(0, "hand.html", ("back", "skip")) as page:
        yield page


def said(page: LivePage, body: bytes, **headers: str) -> int:
    """The status of what a page says; by default it is the one that was served."""
    connection = HTTPConnection(HOST, port_of(page), timeout=10)
    connection.request("POST", "/say", body, {"Origin": page.url.rstrip("/")} | headers)
    return connection.getresponse().status


def test_only_what_its_own_page_says_is_heard(page: LivePage, asking: LivePage) -> None:
    assert [said(asking, word) for word in (b"skip", b"back", b"skip")] == [204, 204, 204]
    assert asking.said() == ["skip", "back", "skip"]
    for word in (b"", b"quit", b"skip\n", b"\xff" * 4, b"back" * 1000):
        assert said(asking, word) == 400
    port = port_of(asking)
    for origin in ("http://elsewhere.example", "null", f"https://{HOST}:{port}", f"http://{HOST}:{port + 1}"):
        assert said(asking, b"skip", Origin=origin) == 403
    assert said(page, b"skip") == 400  # it says nothing
    assert asking.said() == page.said() == []
    for _ in range(20):
        assert said(asking, b"skip", Host=f"localhost:{port}", Origin=f"http://localhost:{port}") == 204
    assert len(asking.said()) == 16  # they do not pile up


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Chromium]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    with Chromium(tmp_path, "--disable-gpu") as browser:
        yield browser


def box_of(browser: Chromium, part: str) -> list[float]:
    """Centre x and y and width of what a selector finds."""
    box = "({x, y, width, height}) => [x + width / 2, y + height / 2, width]"
    return browser.ask(f"({box})(document.querySelector('{part}').getBBox())")


@pytest.mark.slow
def test_a_browser_shows_the_pad(page: LivePage, browser: Chromium) -> None:
    page.show(VIEW)
    browser.open(page.url)
    browser.wait_for("document.querySelectorAll('.fibre').length == 3")
    shown = browser.ask("document.body.innerText")
    assert "2.0, -2.0 mm" in shown
    assert "press 8: within 1.5 mm at 50 %, 3.0 mm at 90 %, to be refined" in shown
    assert shown.count(HOSTILE) == 3
    assert ("fibre 1" in shown, "fibre 3" in shown, "fibre 0" in shown) == (True, True, False)
    assert browser.ask("document.images.length") == 0
    count = "document.querySelectorAll('{}').length"
    assert [browser.ask(count.format(f"#pad .{name}")) for name in ("trail", "r50", "r90", "early")] == [1, 1, 1, 1]
    # The pad is 40 mm wide and as wide on the page as its edge; y goes up.
    edge, latest, before = (box_of(browser, f"#pad .{part}") for part in ("edge", "r90", "trail"))
    assert latest[2] / edge[2] == pytest.approx(2 * 3.0 / 40)
    assert (latest[0] - before[0]) / edge[2] == pytest.approx(1 / 40)
    assert latest[1] == pytest.approx(edge[1])
    bars = browser.ask(
        "[...document.querySelectorAll('.bar rect:not(.back)')].map(bar => bar.getBBox()).map(b => [b.x, b.width])"
    )
    assert bars == [[0, 0.5], [-1, 1], [0, 0]]
    bad = browser.ask("[...document.querySelectorAll('.fibre')].map(row => row.classList.contains('bad'))")
    assert bad == [False, True, True]


HAND = VIEW | {"paths": [[[-20, 0], [0, 1], [20, 0]]], "commands": [{"key": "s", "command": "skip", "text": HOSTILE}]}
HAND |= {"prompt": "press x 1, y -2 mm", "message": HOSTILE, "phase": "press", "progress": 0.5, "done": 2, "total": 8}
HAND |= {"target": [1.0, -2.0], "rejected": None}


@pytest.mark.slow
def test_a_browser_shows_where_to_press_on_the_pad_as_it_lies_and_says_what_is_said(
    asking: LivePage, browser: Chromium
) -> None:
    asking.show(HAND)
    browser.open(asking.url)
    browser.wait_for("document.getElementById('prompt').textContent == 'press x 1, y -2 mm'")
    assert "2 of 8 presses" in browser.ask("document.body.innerText")
    assert browser.ask("document.querySelectorAll('.path').length") == 1
    browser.ask("document.querySelector('button').click()")
    browser.press("s")
    browser.wait_for("document.getElementById('bar').value == .25")
    deadline = time.monotonic() + 10
    heard: list[str] = []
    while len(heard) < 2 and time.monotonic() < deadline:
        heard += asking.said()
        time.sleep(0.02)
    assert heard == ["skip", "skip"]
    for mirrored in (False, True):
        asking.show(HAND | {"target": [11.0, -2.0], "mirrored": mirrored})
        browser.open(asking.url)
        browser.wait_for("document.querySelector('.press .ring') != null")
        ring, edge = box_of(browser, ".press .ring"), box_of(browser, "#pad .edge")
        assert (ring[0] - edge[0]) / edge[2] == pytest.approx(-0.25 if mirrored else 0.25)
        assert ring[1] == pytest.approx(edge[1])
        ticks = "[...document.querySelectorAll('#pad text[y=\"466\"][text-anchor=middle]')]"
        names, places = (browser.ask(f"{ticks}.map(t => +{what})") for what in ("t.textContent", "t.getAttribute('x')"))
        assert names == sorted(names)
        assert places == sorted(places, reverse=mirrored)


@pytest.mark.slow
def test_a_browser_comes_back_to_a_page_that_was_away(browser: Chromium) -> None:
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
