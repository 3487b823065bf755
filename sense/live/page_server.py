"""The page of a pad that is pressed: it shows what happens as it happens, and may say a few words itself."""

import contextlib
import queue
from collections.abc import Collection

from padforge.design.common.server import HOST, LocalPage, page_text
from padforge.design.common.validation import InputError

_MOST_WORDS = 16
"""That wait to be taken: a button may be hit again and again."""


class LivePage(LocalPage):
    """The page, served from `with` to its end."""

    def __init__(
        self, port: int, page: str = "live.html", words: Collection[str] = (), *, host: str = HOST, token: str = ""
    ) -> None:
        """Take `port`, or any that is free if 0.

        Args:
            page: file among `pages`. words: what the page may say, see `said`. host, token: see `LocalPage`.

        Raises:
            InputError: as `LocalPage`.
        """
        self._words, self._said = frozenset(words), queue.Queue[str](_MOST_WORDS)
        text = page_text("padforge.sense.live", f"pages/{page}", "pages/common.css", "pages/common.js")
        super().__init__(port, text, {"/say": self._hear}, host=host, token=token)

    def said(self) -> list[str]:
        """The words that the page has said since the last call, oldest first."""
        return [self._said.get_nowait() for _ in range(self._said.qsize())]

    def _hear(self, body: bytes) -> None:
        word = body.decode("ascii", "replace")
        if word not in self._words:
            raise InputError("no word that was agreed on")
        with contextlib.suppress(queue.Full):
            self._said.put_nowait(word)
