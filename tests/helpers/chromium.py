"""A headless Chromium that opens a page and says what became of it."""

import io
import json
import shutil
import time
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Flags with which it has WebGL where there is no graphics chip."""
QUIET = ("background-networking", "component-update", "sync", "quic")


class Chromium:
    """A browser with one page; the test is skipped where none is installed.

    Attributes:
        complaints: what the console was told at level warning or error, and exceptions.
        requests: addresses that the page has asked for.
    """

    def __init__(self, profile: Path, *flags: str) -> None:
        if CHROMIUM is None:
            pytest.skip("no Chromium is installed")
        from playwright.sync_api import sync_playwright

        flags = (*(f"--disable-{name}" for name in QUIET), "--no-first-run", "--no-sandbox", *flags)
        self._playwright = sync_playwright().start()
        self._browser = self._playwright.chromium.launch_persistent_context(
            profile, executable_path=CHROMIUM, args=list(flags), device_scale_factor=1
        )
        self.page = self._browser.pages[0]
        self._session = self._browser.new_cdp_session(self.page)
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", self._hear)

    def _hear(self, said: Any) -> None:
        if said.type in ("warning", "error", "assert"):
            self.complaints.append(said.text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._browser.close()
        self._playwright.stop()

    def open(self, url: str, width: int = 800, height: int = 600) -> None:
        """Open an address in a window of so many pixels, and wait until the page is there and drawn."""
        self.page.set_viewport_size({"width": width, "height": height})
        self.page.goto(url)
        self.wait_for_frames()

    def ask(self, expression: str) -> Any:
        return self.page.evaluate(expression)

    def wait_for(self, expression: str, wait_s: float = 30) -> None:
        end_s = time.monotonic() + wait_s
        while self.ask(expression) is not True:
            assert time.monotonic() < end_s, f"{expression} never came true"
            self.page.wait_for_timeout(20)

    def wait_for_frames(self) -> None:
        """Wait until what was asked of the page can be seen."""
        self.ask("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def press(self, key: str) -> None:
        self.page.keyboard.press(key)
        self.wait_for_frames()

    def picture(self, element: str) -> NDArray[np.int_]:
        """(height, width, 3) what is seen of the first element that a selector finds, red, green and blue to 255."""
        found = f"document.querySelector({json.dumps(element)})"
        self.ask(f"{found}.scrollIntoView({{block: 'center'}})")
        self.wait_for_frames()
        x, y, width, height = self.ask(
            f"(({{x, y, width, height}}) => [x, y, width, height].map(Math.round))({found}.getBoundingClientRect())"
        )
        seen = Image.open(io.BytesIO(self.page.screenshot()))
        return np.asarray(seen.convert("RGB"), dtype=int)[y : y + height, x : x + width]

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._session.send(method, parameters)
