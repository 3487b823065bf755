"""Lines over a real pseudo-terminal: each is executed once and in its turn, whatever noise there is."""

import os
import time
from contextlib import closing

import numpy as np
import pytest

from sense.rig.arms.printer import marlin
from sense.rig.arms.printer.link import MarlinLink
from sense.rig.boards.line.framing import Header
from sense.rig.devices.protocols import RigFault
from sense.rig.emulators.line_board import EmulatedLineBoard
from sense.rig.emulators.printer.emulator import EmulatedPrinter

pytest.importorskip("serial")
pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="there are no pseudo-terminals here")

AT = (50.0, 50.0, 50.0)


def test_every_line_is_executed_once_whatever_noise_there_is():
    ends = [(50 + number / 50, 50.0, 50.0) for number in range(1, 101)]
    with EmulatedPrinter(AT, seed=3) as printer, closing(MarlinLink(printer.port, 115_200)) as link:
        link.begin(2.0)
        printer.garble(3e-3)
        for end in ends:
            link.ask(marlin.move(end, 500.0))
        printer.garble(0)
        link.ask("M400")
        assert np.array([made.move.end for made in printer.firmware.made[1:]]) == pytest.approx(np.array(ends))


def test_an_answer_comes_with_its_lines():
    with EmulatedPrinter(AT) as printer, closing(MarlinLink(printer.port, 115_200)) as link:
        link.begin(2.0)
        answer = link.ask("M114")
        assert [marlin.place(line) for line in answer] == [AT]
        assert link.ask("M999") == []  # unknown to the firmware, and then no line of noise


def test_silence_is_told():
    with EmulatedPrinter(AT) as printer, closing(MarlinLink(printer.port, 115_200)) as link:
        printer.busy(60)
        with pytest.raises(RigFault, match="no printer answers") as fault:
            link.begin(0.2)
        assert fault.value.cause == "refused"
        printer.busy(0)
        link.begin(2.0)
        printer.busy(60)
        with pytest.raises(RigFault, match=r"not answered for 0\.3 s; it may be busy") as fault:
            link.ask("M114", 0.3)
        assert fault.value.cause == "stale"


def test_what_never_falls_silent_is_no_printer():
    """As where the port is that of the board that reads the fibres."""
    with EmulatedLineBoard(lambda times_s: np.zeros((len(times_s), 4)), Header(1000, 12, 3.3, 4)) as board:
        begun = time.monotonic()
        with closing(MarlinLink(board.port, 115_200)) as link, pytest.raises(RigFault, match="no printer answers"):
            link.begin(0.5)
        assert time.monotonic() < begun + 5


def test_a_board_that_restarts_as_its_port_is_opened_does_so_once():
    with EmulatedPrinter(AT, restarts=True) as printer:
        with closing(MarlinLink(printer.port, 115_200)) as link, pytest.raises(RigFault, match="restarted") as fault:
            link.begin(2.0)
        assert fault.value.cause == "refused"
        with closing(MarlinLink(printer.port, 115_200)) as link:
            link.begin(2.0)
