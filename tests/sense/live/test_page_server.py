"""The pages of a pad that is pressed: who is served what, and what a browser makes of it."""

import json
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPResponse
from typing import Any

import pytest

from padforge.common import server as page_server
from padforge.common.server import HOST
from padforge.sense.live.outputs import LivePage
from tests.helpers.chromium import Chromium
from tests.helpers.golden import Golden
from tests.helpers.page_script import shown

HOSTILE = '<img src="x" onerror="document.title=1"> & [bold]'
VIEW: dict[str, Any] = {
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


def shown_press(number: int, **changes: Any) -> dict[str, Any]:
    at = {"press": number, "x_mm": 4.0 * number - 30.0, "y_mm": 3.0 * number - 29.5}
    return VIEW["presses"][0] | at | {"measures_text": ", 2.0 ± 0.3 mm deep"} | changes


FREE = VIEW | {"pressed": False, "track": [], "faults": [], "half_mm": [20.0, 10.0]}
FREE |= {"fibres": [{"swing": -0.25, "state": "unmonitored"}, {"swing": 0.0, "state": ""}]}
SEVERAL = shown_press(9, final=False, unlike=True, text="press 9: several fingers")
LIVE = [
    ("a finger that has moved", "view", VIEW),
    ("it is lifted off", "view", FREE | {"presses": [shown_press(number) for number in (6, 7, 8)]}),
    ("two fingers, and one place is unknown", "view", FREE | {"presses": [shown_press(8, final=False), SEVERAL]}),
    ("before any press on a pad with its tracks up", "view", FREE | {"presses": [], "mirrored": True}),
    ("the connection is lost", "lost", None),
    ("the end", "view", FREE | {"presses": [], "mirrored": True, "ended": "the board is gone"}),
    ("there is no server any more", "lost", None),
]
HAND = VIEW | {"paths": [[[-20, 0], [0, 1], [20, 0]]], "commands": [{"key": "s", "command": "skip", "text": HOSTILE}]}
HAND |= {"prompt": "press x 1, y -2 mm", "message": HOSTILE, "phase": "press", "progress": 0.5, "done": 2, "total": 8}
HAND |= {"target": [1.0, -2.0], "rejected": None, "presses": [{"x_mm": 3.0 * n, "y_mm": 1.0} for n in (1, 2, 3)]}
LIFT = HAND | {"phase": "lift", "prompt": "lift", "progress": 0.75}
BY_HAND = [
    ("asked to press", "view", HAND),
    ("asked to lift, but sounds need a key", "view", LIFT),
    ("a button", "buttons 0 click", None),
    *((f"{key} {held}", "keydown", {"key": key} | held) for key in "sx" for held in ({}, {"repeat": True})),
    ("with Ctrl", "keydown", {"key": "s", "ctrlKey": True}),
    ("held", "view", HAND | {"phase": "hold", "mirrored": True}),
    ("asked to lift", "view", LIFT),
    ("it does not count", "view", HAND | {"phase": "wait", "rejected": [5.0, 6.0], "message": "not counted"}),
    ("the end", "view", HAND | {"phase": "done", "target": None, "done": 8, "ended": "ended"}),
]


@pytest.mark.parametrize(("name", "actions"), [("live", LIVE), ("hand", BY_HAND)])
def test_pages_show_this_of_views(golden: Golden, name: str, actions: list[tuple[str, str, Any]]) -> None:
    """All parts, and what is sent and heard; a part that is as before is left out."""
    with LivePage(0, f"{name}.html") as page:
        golden(f"live/page_{name}.txt", shown(get(page, "/").read().decode(), actions))


@pytest.mark.slow
def test_browser_shows_pages_as_text_and_sends_commands(page: LivePage, hand_page: LivePage, browser: Chromium) -> None:
    page.show(VIEW)
    browser.open(page.url)
    browser.wait_for("document.querySelectorAll('.fibre').length == 3")
    assert browser.ask("document.body.innerText").count(HOSTILE) == 3
    assert browser.ask("document.images.length") == 0
    hand_page.show(HAND)
    browser.open(hand_page.url)
    browser.wait_for("document.getElementById('bar').value == .25")
    browser.ask("document.querySelector('button').click()")
    browser.press("s")
    deadline, commands = time.monotonic() + 10, list[str]()
    while len(commands) < 2 and time.monotonic() < deadline:
        commands += hand_page.read_commands()
        time.sleep(0.02)
    assert commands == ["skip", "skip"]
