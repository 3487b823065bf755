import errno
import json
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from functools import partial
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from padforge.common import page as page_elements
from padforge.common.page import PageSection
from padforge.common.server import HOST, LocalPage
from padforge.common.validation import InputError
from tests.helpers.golden import Golden
from tests.helpers.refusals import refusal_table

FORGET = r"(?<=sha256-)[^']*", '(?<=base64,)[^"]*'
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
    with LocalPage(0, PAGE, {"/double": doubled}) as page:
        yield page


def port_of(page: LocalPage) -> int:
    return int(page.url.split("/")[2].rsplit(":", 1)[1])


def posted(page: LocalPage, body: bytes | None, path: str = "/double", **headers: str | None) -> HTTPResponse:
    """What is answered; by default it is the page that was served that posts."""
    connection = HTTPConnection(HOST, port_of(page), timeout=10)
    connection.putrequest("POST", path, skip_host="Host" in headers)
    for name, value in ({"Origin": page.url.rstrip("/")} | headers).items():
        if value is not None:
            connection.putheader(name, value)
    if body is not None and "Content-Length" not in headers:
        connection.putheader("Content-Length", str(len(body)))
    connection.endheaders(body)
    return connection.getresponse()


def test_posts_return_json_and_errors_return_text(page: LocalPage) -> None:
    answer = posted(page, b"4")
    assert (answer.status, answer.headers["Content-Type"]) == (200, "application/json")
    assert json.loads(answer.read()) == {"twice": 8}
    answer = posted(page, b"nothing")
    assert (answer.status, answer.read()) == (204, b"")
    answer = posted(page, b"[")
    assert (answer.status, answer.read()) == (400, b"no <number>")
    assert answer.headers["Content-Type"].startswith("text/plain")
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


ELSEWHERE = "http://elsewhere.example"


@pytest.mark.parametrize(
    ("body", "path", "headers", "status"),
    [
        *((b"4", "/double", {"Origin": origin}, 403) for origin in (ELSEWHERE, "null", None)),
        (b"4", "/double", {"Origin": ELSEWHERE, "Host": "elsewhere.example"}, 403),
        (b"4", "/", {}, 404),
        (None, "/double", {}, 411),
        (b"1" * 4097, "/double", {}, 413),
        (b"1" * 4096, "/double", {}, 200),
    ],
)
def test_posts_of_other_origins_and_malformed_posts_are_refused(page, body, path, headers, status) -> None:
    assert posted(page, body, path, **headers).status == status


def status_of(page: LocalPage, path: str, **headers: str) -> int:
    with closing(HTTPConnection(HOST, port_of(page), timeout=10)) as browser:
        browser.request("GET", path, headers=headers)
        return browser.getresponse().status


def test_token_is_required_under_any_host_name() -> None:
    token = "known to few & all"
    with LocalPage(0, PAGE, {"/double": doubled}, host="0.0.0.0", token=token) as page:
        assert page.url.endswith("/?token=known+to+few+%26+all")
        asked = partial(status_of, page, Host="pad.example")
        assert asked("/") == asked("/events") == asked("/?token=") == asked("/?token=known+to+few") == 403
        assert asked("/?token=known+to+few+%26+all") == asked("/", Authorization=f"Bearer {token}") == 200
        assert asked("/", Authorization="Bearer another") == 403


def test_refusals_of_servers(golden: Golden, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object) -> None:
        raise OSError(errno.EACCES, "denied")

    hosts = ("0.0.0.0", ""), ("::", ""), ("", ""), ("0.0.0.0", "short"), ("192.0.2.1", "t" * 16), (".", "t" * 16)
    rows = {f"{host!r} {token!r}": partial(LocalPage, 0, PAGE, {}, host=host, token=token) for host, token in hosts}
    said = refusal_table(rows)
    monkeypatch.setattr("socket.socket.bind", forbidden)
    said += f"\n{refusal_table({'a port of others': partial(LocalPage, 80, PAGE, {})})}"
    golden("padforge/refusals_of_servers.txt", said, forget=[r"(?<=--token )\S+", r"(?<=machine \().*(?=\))"])


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/events", {"Origin": ELSEWHERE}, 403),
        ("/", {"Origin": ELSEWHERE}, 403),
        ("/events", {"Sec-Fetch-Site": "cross-site"}, 403),
        ("/events", {"Sec-Fetch-Site": "same-origin"}, 200),
        ("/", {"Sec-Fetch-Site": "none"}, 200),
        ("/", {"Sec-Fetch-Site": "cross-site"}, 200),
    ],
)
def test_page_is_reached_by_itself_and_by_links_alone(page, path, headers, status) -> None:
    """Links may be anywhere; what other pages request is refused."""
    assert status_of(page, path, **headers) == status


def test_every_reader_gets_the_latest_view(page: LocalPage) -> None:
    page.show({"at": 0})
    with ExitStack() as stack:
        readers = [stack.enter_context(closing(HTTPConnection(HOST, port_of(page), timeout=10))) for _ in range(2)]
        for reader in readers:
            reader.request("GET", "/events")
        streams = [stack.enter_context(reader.getresponse()) for reader in readers]
        page.show({"at": 1})
        for stream in streams:
            assert next(line for line in stream if line.endswith(b'{"at": 1}\n'))


def test_pages_escape_all_but_their_own_elements(tmp_path: Path, golden: Golden) -> None:
    """Each of which is here, with a cell of every kind in a table, and a row of none."""
    Image.new("RGB", (3, 2)).save(tmp_path / "a.png")
    (tmp_path / "b.svg").write_text("<svg/>")
    rows = [
        ["1e-05", "1.5 mm", "pass", "sixteen letters.", "w" * 31, "seventeen letters"],
        [-2.34567, "-", "warn", None, True, ""],
        [12, "3 %", "fail", False, "<i>", "x"],
    ]
    steps = "1. Stir **well**.\n2. Read `x.json`.\n\n| a | b |\n| --- | --- |\n| 1.5 mm | fail |"
    body = [
        *page_elements.render_markdown(f"# Title\n\n## Mix\n\n{steps}\n\nDone."),
        *page_elements.render_markdown('<img src="x"> [a](javascript:b) ![c](http://d) &lt;'),
        page_elements.table([*"abcdef"], rows, {(0, 1): 0.25, (2, 5): 1.0}),
        page_elements.table(["<u>"], []),
        page_elements.columns([page_elements.paragraph("<p>")], [page_elements.heading("&")]),
        page_elements.collapsible("<s>", [page_elements.paragraph("in it")]),
        page_elements.figures([(tmp_path / name, f"<{name}>") for name in ("a.png", "b.svg", "none.png")]),
        page_elements.figures([]),
    ]
    sections = [PageSection("A <i> b", body, [("<1>", "<2>")], "run()"), PageSection("Last", [])]
    text = page_elements.page("<b>", "&", sections)
    golden("padforge/elements.html", re.sub(r"(?s)<(style|script)>.*?</\1>", r"<\1/>", text), forget=FORGET)
    assert re.findall("<script>(.*?)</script>", text)[-1] == "run()"
