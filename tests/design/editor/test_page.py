"""`padforge design edit` from outside: as a program with its page, asked over HTTP and drawn on in a browser."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from padforge.design import Morphology
from padforge.design.cli import design
from tests.helpers.chromium import Chromium

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is a signal here")
PATIENCE_S = 120  # kernels may have to be compiled first


class Program:
    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "padforge", "design", "edit", "--port", "0", "pad.json"]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=folder)
        assert self.process.stderr is not None
        self.url = re.findall(r"http://\S+/", self.process.stderr.readline())[0]
        self.origin = self.url.rstrip("/")

    def edit(self, **edit: Any) -> None:
        connection = HTTPConnection(self.origin.removeprefix("http://"), timeout=PATIENCE_S)
        connection.request("POST", "/edit", json.dumps(edit).encode(), {"Origin": self.origin})
        assert connection.getresponse().status == 200

    def end(self) -> None:
        self.process.send_signal(signal.SIGINT)
        _, said = self.process.communicate(timeout=PATIENCE_S)
        assert (self.process.returncode, "Traceback" in said) == (130, False)


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    Morphology.random(2, 3, 7, 10.0).save(tmp_path / "pad.json")
    program = Program(tmp_path)
    try:
        yield program
    finally:
        program.process.kill()
        program.process.communicate()


CENTRE = "(r => [r.x + r.width / 2, r.y + r.height / 2])(document.querySelectorAll('{}')[{}].getBoundingClientRect())"
TEXT = "document.getElementById('{}').innerText"


@pytest.fixture
def browser(program: Program, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with Chromium(tmp_path_factory.mktemp("profile"), "--disable-gpu") as browser:
        browser.open(program.url, 1100, 900)
        browser.wait_for("document.getElementById('link').textContent == 'ready'", PATIENCE_S)
        yield browser


def drag(browser: Chromium, begin: list[float], way: tuple[float, float], steps: int = 8) -> None:
    x, y = begin
    held = {"button": "left", "buttons": 1, "clickCount": 1}
    browser.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **held)
    for step in range(1, steps + 1):
        at = {"x": x + way[0] * step / steps, "y": y + way[1] * step / steps}
        browser.call("Input.dispatchMouseEvent", type="mouseMoved", **at, **held)
        time.sleep(0.02)
    browser.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + way[0], y=y + way[1], button="left")


def control_key(browser: Chromium, key: str, modifiers: int = 2) -> None:
    for kind in ("rawKeyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers)


@pytest.mark.slow
def test_page_follows_mouse_keys_and_other_pages(program: Program, browser: Chromium, tmp_path: Path) -> None:
    colours = "[...document.querySelectorAll('#map rect')].map(each => each.getAttribute('fill-opacity')).join()"
    shown = [TEXT.format("rules"), TEXT.format("ambiguity"), colours]
    first, begin = [browser.ask(each) for each in shown], browser.ask(CENTRE.format(".knot .dot", 0))
    drag(browser, begin, (20, -60))
    browser.wait_for("document.getElementById('message').textContent.startsWith('not saved yet')")
    browser.wait_for("!busy && !queue.length")
    assert browser.ask(CENTRE.format(".knot .dot", 0)) == pytest.approx([begin[0] + 20, begin[1] - 60], abs=1)
    for each, before in zip(shown, first, strict=True):
        assert browser.ask(each) != before
    assert browser.ask("document.querySelectorAll('#violations path').length") > 0
    view = browser.ask("view")
    broken = {fibre for rule in view["rules"] for fibre in rule["fibres"]}
    classes = browser.ask("layers.fibres.map(fibre => [...fibre.group.classList])")
    assert broken
    assert {number for number, names in enumerate(classes, 1) if "broken" in names} == broken
    # the colours end at three times the ambiguity of straight fibres
    assert float(browser.ask(TEXT.format("limit"))) == pytest.approx(3 * view["straight_mm"][0], rel=0.05)
    control_key(browser, "z")
    browser.wait_for("document.getElementById('undo').disabled")
    assert browser.ask(CENTRE.format(".knot .dot", 0)) == pytest.approx(begin, abs=0.5)
    control_key(browser, "Z", modifiers=10)
    browser.wait_for("document.getElementById('redo').disabled")
    control_key(browser, "s")
    browser.wait_for("document.getElementById('message').textContent == 'saved to pad-edited.json'")
    checked = CliRunner().invoke(design, ["check", str(tmp_path / "pad-edited.json")], catch_exceptions=False)
    assert checked.output.splitlines() == browser.ask(shown[0]).splitlines()

    browser.ask("document.querySelector('.knot').focus()")
    label = "document.activeElement.getAttribute('aria-label')"
    assert browser.ask(label).startswith("fibre 1, knot 1 of 3")
    y_mm = "view.fibres[selected.fibre].knots[selected.knot][1]"
    before = browser.ask(y_mm)
    step = 0.5 if before < 14 else -0.5
    browser.press("ArrowUp" if step > 0 else "ArrowDown")
    browser.wait_for(f"Math.abs({y_mm} - {before + step}) < 1e-3")
    browser.press("Insert")
    browser.wait_for("view.fibres[0].knots.length == 6")
    browser.press("Delete")
    browser.wait_for("view.fibres[0].knots.length == 5")
    browser.press("PageDown")
    assert browser.ask(label).startswith("fibre 2, knot")
    x, y = browser.ask(CENTRE.format(".knot .dot", 5))
    browser.call("Emulation.setTouchEmulationEnabled", enabled=True)
    browser.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
    for step in range(1, 6):
        touched = [{"x": x, "y": y + 4 * step}]
        browser.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=touched)
        time.sleep(0.02)
    browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    browser.wait_for("!busy && !queue.length")
    lowered = browser.ask(CENTRE.format(".knot .dot", 5))[1] - y
    assert lowered == pytest.approx(20, abs=6)  # the first bit may count as a tap

    browser.call("Emulation.setTouchEmulationEnabled", enabled=False)
    program.edit(do="move", fibre=1, knot=1, x_mm=-12.0, y_mm=3.25)
    browser.wait_for("view.fibres[0].knots[1][1] == 3.25")
    browser.open(program.url, 360, 740)
    browser.wait_for("view && view.fibres[0].knots[1][1] == 3.25", PATIENCE_S)
    assert browser.ask("document.scrollingElement.scrollWidth <= innerWidth") is True
    assert browser.complaints == []
    asked = {address for address in browser.requests if not address.startswith("data:")}
    assert asked <= {program.url + path for path in ("", "events", "edit", "save")}
    program.end()
    browser.wait_for("document.getElementById('link').textContent == 'ended in the terminal'")
