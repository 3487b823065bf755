"""Fixtures shared by all tests."""

import os
import signal
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

from tests.helpers.effort import EVERY_DAY

# a worker a core leaves nothing for the threads that numpy would take besides; to be said before it is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # as padforge has it, also where tests load onnxruntime first

# a shell has what runs behind it ignore Ctrl-C, and programs that tests start would inherit that: they never ended
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.load_profile(EVERY_DAY)

coverage = sys.modules.get("coverage")
if coverage is not None and coverage.Coverage.current() is not None:
    # kernels run compiled: the lines that a run compiles count as covered, so none may come from the usual cache
    from numba.core import config

    fresh = tempfile.TemporaryDirectory(prefix="padforge-coverage-")
    config.JIT_COVERAGE, config.CACHE_DIR = 1, fresh.name  # pyright: ignore[reportAttributeAccessIssue]

RIG = Path(__file__).parent / "sense" / "rig"
PUBLISHED = Path(__file__).resolve().parents[2] / "shared" / "data" / "published"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One worker more than cores: rigs wait for clocks most of their time."""
    return 1 + (len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Rigs first: they wait for clocks and need few compiled kernels, which another process compiles meanwhile."""
    items.sort(key=lambda item: RIG not in item.path.parents or item.path.parent.name == "planning")


@pytest.fixture(scope="session")
def published() -> Path:
    """Folder of the published study's files; tests that need it skip where it is absent."""
    if not PUBLISHED.is_dir():
        pytest.skip("the published data are not here")
    return PUBLISHED
