"""`padforge design edit` from outside: as a program with its page, drawn on in a browser."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

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


@pytest.fixture
def browser(program: Program, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with Chromium(tmp_path_factory.mktemp("profile"), "--disable-gpu") as browser:
        browser.open(program.url, 1100, 900)
        browser.wait_for("document.getElementById('link').textContent == 'ready'", PATIENCE_S)
        yield browser


@pytest.mark.slow
def test_page_follows_mouse_keys_and_fingers(program: Program, browser: Chromium, tmp_path: Path) -> None:
    begin = browser.ask(CENTRE.format(".knot .dot", 0))
    browser.page.mouse.move(*begin)
    browser.page.mouse.down()
    browser.page.mouse.move(begin[0] + 20, begin[1] - 60, steps=8)
    browser.page.mouse.up()
    browser.wait_for("document.getElementById('message').textContent.startsWith('not saved yet')")
    browser.wait_for("!busy && !queue.length")
    assert browser.ask(CENTRE.format(".knot .dot", 0)) == pytest.approx([begin[0] + 20, begin[1] - 60], abs=1)
    browser.press("Control+s")
    browser.wait_for("document.getElementById('message').textContent == 'saved to pad-edited.json'")
    checked = CliRunner().invoke(design, ["check", str(tmp_path / "pad-edited.json")], catch_exceptions=False)
    assert checked.output.splitlines() == browser.ask("document.getElementById('rules').innerText").splitlines()

    browser.press("Insert")
    browser.wait_for("view.fibres[0].knots.length == 6")
    browser.press("Delete")
    browser.wait_for("view.fibres[0].knots.length == 5")
    browser.press("PageDown")
    assert browser.ask("document.activeElement.getAttribute('aria-label')").startswith("fibre 2, knot")
    x, y = browser.ask(CENTRE.format(".knot .dot", 5))
    browser.call("Emulation.setTouchEmulationEnabled", enabled=True)
    browser.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
    for step in range(1, 6):
        touched = [{"x": x, "y": y + 4 * step}]
        browser.call("Input.dispatchTouchEvent", type="touchMove", touchPoints=touched)
        time.sleep(0.02)
    browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    browser.wait_for("!busy && !queue.length")
    assert browser.ask(CENTRE.format(".knot .dot", 5))[1] == pytest.approx(y + 20, abs=6)  # a bit may count as a tap

    browser.call("Emulation.setTouchEmulationEnabled", enabled=False)
    browser.open(program.url, 360, 740)
    browser.wait_for("view && view.unsaved", PATIENCE_S)
    assert browser.ask("document.scrollingElement.scrollWidth <= innerWidth") is True
    assert browser.complaints == []
    asked = {address for address in browser.requests if not address.startswith("data:")}
    assert asked <= {program.url + path for path in ("", "events", "edit", "save")}
    program.end()
    browser.wait_for("document.getElementById('link').textContent == 'ended in the terminal'")
