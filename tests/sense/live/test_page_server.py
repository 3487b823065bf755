"""The pages of a pad that is pressed: who is served what, and what a browser makes of it."""

import json
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPResponse

import pytest

from padforge.common import server as page_server
from padforge.common.server import HOST
from padforge.sense.live.outputs import LivePage
from tests.helpers.chromium import Chromium

HOSTILE = '<img src="x" onerror="document.title=1"> & [bold]'
VIEW = {
    "title": HOSTILE,
    "centre_mm": [1.0, -2.0],
    "half_mm": [20.0, 20.0],
    "pressed": True,
    "ended": "",
    "fibres": [
        {"swing": 0.5, "state": "sound"},
        {"swing": -3.0, "state": "no_response"},
        {"swing": None, "state": HOSTILE},
    ],
    "presses": [
        {"press": 7 + k, "x_mm": 1.0 + k, "y_mm": -2.0, "r50_mm": 1.5, "r90_mm": 3.0, "final": k == 0}
        | {"measures_text": "", "moment_text": "0.30 s after the touch"}
        for k in (0, 1)
    ],
    "track": [[1.0, -12.0], [1.0, -7.0]],
    "faults": [HOSTILE],
}


@pytest.fixture
def page() -> Iterator[LivePage]:
    with LivePage(0) as page:
        yield page


@pytest.fixture
def hand_page() -> Iterator[LivePage]:
    with LivePage(0, "hand.html", ("back", "skip")) as page:
        yield page


def get(page: LivePage, path: str, host: str | None = None) -> HTTPResponse:
    connection = HTTPConnection(HOST, port_of(page), timeout=10)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def port_of(page: LivePage) -> int:
    return int(page.url.rstrip("/").rsplit(":", 1)[1])


@contextmanager
def events_of(page: LivePage) -> Iterator[Iterator[dict]]:
    """The views that a browser gets."""
    with get(page, "/events") as response:
        lines = (line.decode() for line in response)
        yield (json.loads(line[6:]) for line in lines if line.startswith("data: "))


@pytest.mark.parametrize("name", ["live.html", "hand.html"])
def test_page_allows_only_its_own_script(name: str) -> None:
    with LivePage(0, name) as page:
        response = get(page, "/")
        text = response.read().decode()
    assert response.status == 200
    assert text.startswith("<!doctype html>")
    policy = response.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert not any(word in policy + text for word in ("unsafe", "common.", "local_page."))
    # One page, nothing from elsewhere: no address but the namespace of SVG, and no markup made from data.
    assert [part.split('"')[0] for part in text.split("http://")[1:]] == ["www.w3.org/2000/svg"]
    assert not any(word in text for word in ("https://", "innerHTML", "outerHTML", "insertAdjacentHTML", "eval("))


def test_server_refuses_other_paths_and_other_host_names(page, monkeypatch) -> None:
    for path in ("/x", "/../pyproject.toml", "/events/"):
        assert get(page, path).status == 404
    # A page of another host, whose name was made to mean this machine, gets nothing.
    for path in ("/", "/events"):
        assert get(page, path, host="elsewhere.example").status == 403
    assert get(page, "/", host=f"localhost:{port_of(page)}").status == 200
    assert get(page, "/", host="localhost").status == 403
    monkeypatch.setattr(page_server, "HTTP_PORT", port_of(page))  # which browsers leave out
    assert [get(page, "/", name).status for name in ("localhost", HOST, "elsewhere")] == [200, 200, 403]
    if sys.platform == "linux":  # where 127.0.0.2 is another address of this machine
        with pytest.raises(OSError, match="refused"):
            socket.create_connection(("127.0.0.2", port_of(page)), timeout=5)


def test_slow_browser_skips_views_and_delays_nobody(page: LivePage) -> None:
    page.show({"at": 0})
    with events_of(page) as messages:
        assert next(messages) == {"at": 0}
        for at in range(1, 2001):
            page.show({"at": at})
        numbers = [message["at"] for message in iter(lambda: next(messages), {"at": 2000})]
    assert numbers == sorted(numbers)
    assert len(numbers) < 1000
    with LivePage(0) as other:
        other.show({"at": 0})
        browser = get(other, "/events")
        other.show({"ended": "ended"})
    assert browser.read().decode().endswith('data: {"ended": "ended"}\n\n')  # the last view is not skipped


def test_server_survives_browsers_that_go_away(page: LivePage, capfd: pytest.CaptureFixture[str]) -> None:
    page.show({"at": 0})
    with socket.create_connection((HOST, port_of(page))) as browser:
        browser.sendall(f"GET /events HTTP/1.0\r\nHost: {HOST}:{port_of(page)}\r\n\r\n".encode())
        assert browser.recv(10)
    with socket.create_connection((HOST, port_of(page))) as browser:
        browser.sendall(b"\x00\xff nonsense\r\n\r\n")
    with events_of(page) as messages:
        assert next(messages) == {"at": 0}
        page.show({"at": 1})
        assert next(messages) == {"at": 1}
    assert capfd.readouterr().err == ""


def post(page: LivePage, body: bytes, **headers: str) -> int:
    """Post a command as the page that was served does by default; return the status."""
    connection = HTTPConnection(HOST, port_of(page), timeout=10)
    connection.request("POST", "/command", body, {"Origin": page.url.rstrip("/")} | headers)
    return connection.getresponse().status


def test_commands_are_accepted_from_the_page_only(page: LivePage, hand_page: LivePage) -> None:
    assert [post(hand_page, word) for word in (b"skip", b"back", b"skip")] == [204, 204, 204]
    assert hand_page.read_commands() == ["skip", "back", "skip"]
    for word in (b"", b"quit", b"skip\n", b"\xff" * 4, b"back" * 1000):
        assert post(hand_page, word) == 400
    port = port_of(hand_page)
    assert post(hand_page, b"skip", Origin=f"http://{HOST}:{port + 1}") == 403
    assert post(page, b"skip") == 400  # it has no commands
    assert hand_page.read_commands() == page.read_commands() == []
    assert post(hand_page, b"skip", Host=f"localhost:{port}", Origin=f"http://localhost:{port}") == 204
    assert hand_page.read_commands() == ["skip"]


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with Chromium(tmp_path_factory.mktemp("profile"), "--disable-gpu") as browser:
        yield browser


def box_of(browser: Chromium, part: str) -> list[float]:
    """Centre x and y and width of what a selector finds."""
    box = "({x, y, width, height}) => [x + width / 2, y + height / 2, width]"
    return browser.ask(f"({box})(document.querySelector('{part}').getBBox())")


@pytest.mark.slow
def test_browser_shows_the_pad(page: LivePage, browser: Chromium) -> None:
    page.show(VIEW)
    browser.open(page.url)
    browser.wait_for("document.querySelectorAll('.fibre').length == 3")
    text = browser.ask("document.body.innerText")
    assert "2.0, -2.0 mm" in text
    assert "press 8: within 1.5 mm at 50 %, 3.0 mm at 90 %, 0.30 s after the touch" in text
    assert text.count(HOSTILE) == 3
    assert ("fibre 1" in text, "fibre 3" in text, "fibre 0" in text) == (True, True, False)
    assert browser.ask("document.images.length") == 0
    count = "document.querySelectorAll('{}').length"
    assert [browser.ask(count.format(f"#pad .{name}")) for name in ("trail", "r50", "r90", "early")] == [1, 1, 1, 1]
    # The pad is 40 mm wide and as wide on the page as its edge; y goes up.
    points = browser.ask("document.querySelector('#pad .track').getAttribute('points')").split()
    assert len(points) == 3  # the track, and where the finger is now
    x, y = (float(part) for part in points[-1].split(","))
    assert [x, y] == browser.ask("['cx', 'cy'].map(name => +document.querySelector('.position').getAttribute(name))")
    edge, half, latest, before = (box_of(browser, f"#pad .{part}") for part in ("edge", "r50", "r90", "trail"))
    assert [circle[2] / edge[2] for circle in (half, latest)] == pytest.approx([2 * 1.5 / 40, 2 * 3.0 / 40])
    assert (latest[0] - before[0]) / edge[2] == pytest.approx(1 / 40)
    assert latest[1] == pytest.approx(edge[1])
    bars = browser.ask(
        "[...document.querySelectorAll('.bar rect:not(.back)')].map(bar => bar.getBBox()).map(b => [b.x, b.width])"
    )
    assert bars == [[0, 0.5], [-1, 1], [0, 0]]
    bad = browser.ask("[...document.querySelectorAll('.fibre')].map(row => row.classList.contains('bad'))")
    assert bad == [False, True, True]
    # no place is shown for what no single press explains
    several = VIEW["presses"][-1] | {"unlike": True, "text": "press 8: several fingers"}
    page.show(VIEW | {"presses": [*VIEW["presses"][:-1], several]})
    browser.wait_for("document.getElementById('position').textContent == 'several fingers?'")
    assert browser.ask("document.getElementById('radii').textContent") == "press 8: several fingers"
    assert [browser.ask(count.format(f"#pad .{name}")) for name in ("trail", "r50", "r90", "position")] == [1, 0, 0, 0]


HAND = VIEW | {"paths": [[[-20, 0], [0, 1], [20, 0]]], "commands": [{"key": "s", "command": "skip", "text": HOSTILE}]}
HAND |= {"prompt": "press x 1, y -2 mm", "message": HOSTILE, "phase": "press", "progress": 0.5, "done": 2, "total": 8}
HAND |= {"target": [1.0, -2.0], "rejected": None}


@pytest.mark.slow
def test_browser_shows_where_to_press_and_sends_commands(hand_page: LivePage, browser: Chromium) -> None:
    hand_page.show(HAND)
    browser.open(hand_page.url)
    browser.wait_for("document.getElementById('prompt').textContent == 'press x 1, y -2 mm'")
    assert "2 of 8 presses" in browser.ask("document.body.innerText")
    assert browser.ask("document.querySelectorAll('.path').length") == 1
    browser.ask("document.querySelector('button').click()")
    browser.press("s")
    browser.wait_for("document.getElementById('bar').value == .25")
    deadline = time.monotonic() + 10
    commands: list[str] = []
    while len(commands) < 2 and time.monotonic() < deadline:
        commands += hand_page.read_commands()
        time.sleep(0.02)
    assert commands == ["skip", "skip"]
    for mirrored in (False, True):
        hand_page.show(HAND | {"target": [11.0, -2.0], "mirrored": mirrored})
        browser.open(hand_page.url)
        browser.wait_for("document.querySelector('.press .ring') != null")
        ring, edge = box_of(browser, ".press .ring"), box_of(browser, "#pad .edge")
        assert (ring[0] - edge[0]) / edge[2] == pytest.approx(-0.25 if mirrored else 0.25)
        assert ring[1] == pytest.approx(edge[1])
        ticks = "[...document.querySelectorAll('#pad text[y=\"466\"][text-anchor=middle]')]"
        names, places = (browser.ask(f"{ticks}.map(t => +{what})") for what in ("t.textContent", "t.getAttribute('x')"))
        assert names == sorted(names)
        assert places == sorted(places, reverse=mirrored)


@pytest.mark.slow
def test_browser_reconnects_to_a_page(browser: Chromium) -> None:
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
