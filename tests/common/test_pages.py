import json
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from functools import partial
from http.client import HTTPConnection, HTTPResponse
from typing import Any

import pytest

from padforge.common.page import PageSection, render_markdown, table
from padforge.common.page import page as whole_page
from padforge.common.server import HOST, LocalPage
from padforge.common.validation import InputError

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
    for host, token in (("0.0.0.0", ""), ("::", ""), ("", ""), ("0.0.0.0", "short")):
        with pytest.raises(InputError, match="token"):
            LocalPage(0, PAGE, {}, host=host, token=token)


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


def test_markdown_renders_elements_and_escapes_html():
    rows = "| a | b |\n| --- | --- |\n| 1.5 mm | fail |"
    steps = "1. Stir **well**.\n2. Read `x.json`."
    head, rows, steps, end = render_markdown(f"# Title\n\n## Mix\n\n{rows}\n\n{steps}\n\nDone.")
    assert head == "<h3>Mix</h3>"
    assert rows == table(["a", "b"], [["1.5 mm", "fail"]])
    assert '<td class="number">1.5 mm</td><td class="fail">fail</td>' in rows
    assert re.sub(r"\s", "", steps) == ("<ol><li>Stir<strong>well</strong>.</li><li>Read<code>x.json</code>.</li></ol>")
    assert end.strip() == "<p>Done.</p>"
    (piece,) = render_markdown('<img src="x"> [a](javascript:b) ![c](http://d) &lt;')
    assert piece.strip() == "<p>&lt;img src=&quot;x&quot;&gt; [a](javascript:b) ![c](http://d) &amp;lt;</p>"
    text = whole_page("<b>", "&", [PageSection("A <i> b", [table(["<u>"], [["<s>"]])], [("<1>", "<2>")])])
    assert not re.search("<[ius12]>", text)
    assert "<title>&lt;b&gt;</title>" in text
    assert '<a href="#a-i-b">A &lt;i&gt; b</a>' in text
    assert '<h2 id="a-i-b">A &lt;i&gt; b</h2>' in text
    assert '<div class="tile"><b>&lt;1&gt;</b> &lt;2&gt;</div>' in text
