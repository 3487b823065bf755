"""Pages of this machine that post: who is heard, and what becomes of what cannot be used."""

import json
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from http.client import HTTPConnection, HTTPResponse
from typing import Any

import pytest

from design.common.errors import InputError
from design.common.page.local_page import listening
from design.common.page.local_page.listening import HOST
from design.common.page.local_page.local_page import LocalPage

PAGE = "<!doctype html><title>x</title><style>p { margin: 0 }</style><script>1</script>"


def doubled(body: bytes) -> Mapping[str, Any] | None:
    if body == b"nothing":
        return None
    try:
        return {"twice": 2 * json.loads(body)}
    except ValueError as error:
        raise InputError("no <number>") from error


@pytest.fixture
def page() -> Iterator[LocalPage]:
    with LocalPage(0, PAGE, {"/double": doubled}, 100) as page:
        yield page


def posted(page: LocalPage, body: bytes | None, path: str = "/double", **headers: str) -> HTTPResponse:
    """What is answered; by default it is the page that was served that posts."""
    connection = HTTPConnection(HOST, int(page.url.rstrip("/").rsplit(":", 1)[1]), timeout=10)
    connection.putrequest("POST", path, skip_host="Host" in headers)
    for name, value in ({"Origin": page.url.rstrip("/")} | headers).items():
        connection.putheader(name, value)
    if body is not None and "Content-Length" not in headers:
        connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(body)
    return connection.getresponse()


def test_what_is_posted_is_answered(page: LocalPage) -> None:
    answer = posted(page, b"4")
    assert (answer.status, answer.headers["Content-Type"], json.loads(answer.read())) == (
        200,
        "application/json",
        {"twice": 8},
    )
    assert (posted(page, b"nothing").status, posted(page, b"nothing").read()) == (204, b"")


def test_what_cannot_be_used_is_told_as_text(page: LocalPage) -> None:
    answer = posted(page, b"[")
    assert (answer.status, answer.read()) == (400, b"no <number>")
    assert answer.headers["Content-Type"].startswith("text/plain")
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


def test_only_the_page_itself_is_heard_and_only_where_it_was_agreed(page: LocalPage) -> None:
    for origin in ("http://elsewhere.example", "null", ""):
        assert posted(page, b"4", Origin=origin).status == 403
    assert posted(page, b"4", Host="elsewhere.example", Origin="http://elsewhere.example").status == 403
    assert posted(page, b"4", "/").status == 404


def test_a_length_is_asked_for_and_kept(page: LocalPage) -> None:
    assert posted(page, None).status == 411
    for length in ("-1", "x", "1e3", "1" * 20):
        assert posted(page, None, **{"Content-Length": length}).status == 411
    assert posted(page, b"1" * 101).status == 413
    assert posted(page, b"1" * 3_000_00).status == 413
    assert posted(page, b"1").status == 200


def test_with_a_token_only_those_who_know_it_are_answered_by_whatever_name_they_ask() -> None:
    token = "known to few & all"
    with LocalPage(0, PAGE, {"/double": doubled}, 100, host="0.0.0.0", token=token) as page:
        assert page.url.endswith("/?token=known+to+few+%26+all")
        port = int(page.url.split("/")[2].rsplit(":", 1)[1])

        def asked(path: str, **headers: str) -> int:
            connection = HTTPConnection(HOST, port, timeout=10)
            connection.request("GET", path, headers={"Host": "pad.example"} | headers)
            return connection.getresponse().status

        assert asked("/") == asked("/events") == asked("/?token=") == asked("/?token=known+to+few") == 403
        assert asked("/?token=known+to+few+%26+all") == asked("/", Authorization=f"Bearer {token}") == 200
        assert asked("/", Authorization="Bearer another") == 403


def port_of(page: LocalPage) -> int:
    return int(page.url.split("/")[2].rsplit(":", 1)[1])


def test_an_address_that_is_none_is_refused_in_silence(page: LocalPage, capfd: pytest.CaptureFixture[str]) -> None:
    """Whoever asks for it knows no token yet, and would fill the terminal."""
    for asked in (b"GET http://[ HTTP/1.0", b"POST http://[x]y/double HTTP/1.0"):
        with socket.create_connection((HOST, port_of(page)), timeout=10) as stranger:
            stranger.sendall(asked + b"\r\n\r\n")
            assert stranger.recv(100).split()[1] == b"400"
    assert posted(page, b"1").status == 200
    assert capfd.readouterr().err == ""


def test_half_of_what_was_posted_is_not_heard(page: LocalPage) -> None:
    asked = f"POST /double HTTP/1.0\r\nHost: {HOST}:{port_of(page)}\r\nOrigin: http://{HOST}:{port_of(page)}\r\n"
    with socket.create_connection((HOST, port_of(page)), timeout=10) as browser:
        browser.sendall(f"{asked}Content-Length: 2\r\n\r\n4".encode())
        browser.shutdown(socket.SHUT_WR)
        assert browser.recv(100).split()[1] == b"400"


def test_strangers_do_not_take_up_all_connections_for_long(page: LocalPage, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are shown out however slowly they go on to ask; who was let in is not."""
    monkeypatch.setattr(listening, "ADMIT_S", 1.0)
    monkeypatch.setattr(listening, "MOST_CONNECTIONS", 8)
    page.show({"at": 0})
    with ExitStack() as stack:
        browser = HTTPConnection(HOST, port_of(page), timeout=10)
        browser.request("GET", "/events")
        events = stack.enter_context(browser.getresponse())
        strangers = [socket.create_connection((HOST, port_of(page)), timeout=10) for _ in range(20)]
        for stranger in strangers:
            stack.enter_context(stranger)
        end = time.monotonic() + 20
        while strangers:
            assert time.monotonic() < end
            for stranger in list(strangers):
                try:
                    stranger.sendall(b"G")
                except OSError:
                    strangers.remove(stranger)
            time.sleep(0.1)
        assert posted(page, b"1").status == 200
        page.show({"at": 1})
        told = (line for line in events if line.startswith(b"data: "))
        assert [json.loads(next(told)[6:])["at"] for _ in range(2)] == [0, 1]


def test_other_machines_are_let_in_only_with_a_token() -> None:
    for host, token in (("0.0.0.0", ""), ("::", ""), ("", ""), ("0.0.0.0", "short")):
        with pytest.raises(InputError, match="token"):
            LocalPage(0, PAGE, host=host, token=token)
