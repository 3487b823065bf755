"""A headless Chromium that opens a page and says what became of it, asked in the words of the DevTools protocol."""

import base64
import io
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Flags with which it has WebGL where there is no graphics chip."""


class Chromium:
    """A browser with one page.

    Attributes:
        complaints: what the console was told at level warning or error, and exceptions.
        requests: addresses that the page has asked for.
    """

    def __init__(self, folder: Path, *flags: str) -> None:
        quiet = ("background-networking", "component-update", "sync", "quic")
        flags = (*(f"--disable-{name}" for name in quiet), "--no-first-run", "--no-sandbox", "--headless", *flags)
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
        self._out, self._in = os.fdopen(ours[1], "wb", buffering=0), theirs[0]
        self._read, self._searched = bytearray(), 0
        self._number = 0
        self._session: str | None = None
        self.complaints: list[str] = []
        self.requests: list[str] = []
        pages = self.call("Target.getTargets")["targetInfos"]
        target = next(each["targetId"] for each in pages if each["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Log", "Runtime", "Network", "Page"):
            self.call(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.terminate()
        self._process.wait()
        self._out.close()
        os.close(self._in)

    def open(self, url: str, width: int = 800, height: int = 600) -> None:
        """Open an address in a window of so many pixels, and wait until the page is there and drawn."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=url)
        self.wait_for(f"document.readyState == 'complete' && location.href == {json.dumps(url)}")
        self.wait_for_frames()

    def ask(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page, awaited if it is a promise."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, expression: str, wait_s: float = 30) -> None:
        """Wait until a JavaScript expression in the page is true."""
        end_s = time.monotonic() + wait_s
        while self.ask(expression) is not True:
            assert time.monotonic() < end_s, f"{expression} never came true"
            time.sleep(0.02)

    def wait_for_frames(self) -> None:
        """Wait until what was asked of the page can be seen."""
        self.ask("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def press(self, key: str) -> None:
        """Press and release a key, such as ArrowLeft, on what has the focus."""
        for kind in ("rawKeyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key)
        self.wait_for_frames()

    def picture(self, element: str) -> NDArray[np.int_]:
        """(height, width, 3) what is seen of the first element that a selector finds, red, green and blue to 255."""
        found = f"document.querySelector({json.dumps(element)})"
        self.ask(f"{found}.scrollIntoView({{block: 'center'}})")
        self.wait_for_frames()
        x, y, width, height = self.ask(
            f"(({{x, y, width, height}}) => [x, y, width, height].map(Math.round))({found}.getBoundingClientRect())"
        )
        seen = Image.open(io.BytesIO(base64.b64decode(self.call("Page.captureScreenshot")["data"])))
        return np.asarray(seen.convert("RGB"), dtype=int)[y : y + height, x : x + width]

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """The answer to a command of the protocol."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        self._out.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = json.loads(self._message())
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                return answer["result"]
            self._note(answer.get("method"), answer.get("params", {}))

    def _note(self, event: str | None, told: dict[str, Any]) -> None:
        if event == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        elif event == "Log.entryAdded" and told["entry"]["level"] in ("warning", "error"):
            self.complaints.append(told["entry"]["text"])
        elif event == "Runtime.consoleAPICalled" and told["type"] in ("warning", "error", "assert"):
            self.complaints.append(str(told["args"]))
        elif event == "Runtime.exceptionThrown":
            self.complaints.append(str(told["exceptionDetails"]))

    def _message(self) -> bytes:
        while (end := self._read.find(b"\0", self._searched)) < 0:
            self._searched = len(self._read)
            more = os.read(self._in, 1 << 16)
            assert more, "the browser has ended"
            self._read += more
        message = bytes(self._read[:end])
        del self._read[: end + 1]
        self._searched = 0
        return message
