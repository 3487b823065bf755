"""The real process, which tests of commands do without (`InThisProcess`)."""

import logging
import math
import multiprocessing
import os
import time
from typing import Any

import pytest

from padforge.common.background import PRIORITY
from padforge.common.validation import Fault
from tests.helpers.in_this_process import BackgroundProcess


def ran(work: Any, *arguments: object) -> Any:
    with BackgroundProcess(["missing_module"]) as process:
        process.submit(work, *arguments)
        return process.result()


def test_work_is_done_by_another_process_of_low_priority() -> None:
    assert ran(os.getpid) != os.getpid()
    assert ran(os.getpriority, os.PRIO_PROCESS, 0) == PRIORITY


def test_errors_and_what_is_logged_come_back(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(ValueError, match="math domain error") as caught:
        ran(math.sqrt, -1)
    assert "in _serve" in caught.value.__notes__[0]
    assert ran(logging.warning, "%s: kept", "mould.stl") is None
    assert caplog.messages == ["mould.stl: kept"]


def test_process_that_is_killed_is_a_fault() -> None:
    with pytest.raises(Fault, match="was killed, perhaps for lack of memory"):
        ran(os.abort)


def test_process_ends_with_the_body() -> None:
    begin = time.monotonic()
    with BackgroundProcess() as process:
        process.submit(time.sleep, 60)
    assert time.monotonic() - begin < 50
    assert not multiprocessing.active_children()
