"""The two tiers, how tests are shared out among workers, and fixtures for all.

`pytest -n auto` runs what answers at once; tests marked `slow` wait for `pytest -n auto -m slow`.
"""

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hypothesis
import pytest

import padforge

# a worker a core leaves nothing for the threads that numpy and torch would take besides; said before they are imported
for library in ("OMP", "OPENBLAS"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # as padforge has it, also where tests load onnxruntime first

# The padforge that is installed is tested, a wheel or a checkout, also by programs that tests start here: the checkout
# comes last, for the tests themselves and for the benches, of which a wheel has none.
ROOT = Path(__file__).resolve().parents[1]
os.environ["PYTHONSAFEPATH"] = "1"
if str(ROOT) not in sys.path:
    sys.path.append(str(ROOT))
if str(ROOT) not in padforge.__path__:
    padforge.__path__.append(str(ROOT))

# a shell has what runs behind it ignore Ctrl-C, and programs that tests start would inherit that: they never ended
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

hypothesis.settings.register_profile("padforge", deadline=None, derandomize=True, max_examples=40)
hypothesis.settings.load_profile("padforge")

from padforge.common import background, compilation, plotting  # noqa: E402
from tests.helpers import kernels  # noqa: E402
from tests.helpers.golden import Golden  # noqa: E402
from tests.helpers.in_this_process import InThisProcess  # noqa: E402
from tests.helpers.once import Once  # noqa: E402

background.BackgroundProcess = InThisProcess  # before other modules take the name from there
compilation.NOTICE_AFTER_S = 3600.0  # so that compilation adds no line to the output of commands
plotting.DPI = 40  # pixels take most of the time of a picture, and no test looks at them
PUBLISHED = ROOT.parent / "shared" / "data" / "published"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--renew", action="store_true", help="keep outputs in tests/golden as they are now")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One worker for each core that may be used, of two threads too: each imports all, which takes ten seconds."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def pytest_cmdline_main(config: pytest.Config) -> None:
    """Kernels are compiled by one process, not by each worker again."""
    if config.getoption("numprocesses", None) and not config.option.collectonly and kernels.missing():
        kernels.compile_all()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """The tests of a file go to one worker, which makes what they share; in tests/docs those of a page of the docs."""
    from xdist.scheduler import LoadScopeScheduling

    class FileScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file, _, test = nodeid.partition("::")
            return test.partition("[")[2] or file if file.startswith("tests/docs") else file

    return FileScheduling(config, log) if config.option.dist == "load" else None


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    return Once(tmp_path_factory.getbasetemp())


@pytest.fixture
def golden(request: pytest.FixtureRequest, tmp_path: Path) -> Golden:
    return Golden(tmp_path, renew=bool(request.config.getoption("--renew")))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the test, in which it works."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """All figures that the test has drawn, in the order in which they were begun."""
    from matplotlib.figure import Figure

    drawn, begin = [], Figure.__init__

    def remember(figure: Figure, *args: Any, **options: Any) -> None:
        begin(figure, *args, **options)
        drawn.append(figure)

    monkeypatch.setattr(Figure, "__init__", remember)
    return drawn


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], dict[Any, Any]]:
    """Evaluations of one quick round of a benchmark, by trial."""
    from padforge.benchmarks import harness
    from padforge.common.progress import ignore_progress

    def evaluate(bench: harness.Bench) -> dict[Any, Any]:
        rounds = harness.BenchRounds()
        harness.measure_round(bench, rounds, ignore_progress, lambda key: False)
        return rounds.results

    monkeypatch.setattr(harness, "BUDGET_S", 0)
    return evaluate


@pytest.fixture(scope="session")
def published() -> Path:
    """Folder of the published study's files; tests that need it skip where it is absent."""
    if not PUBLISHED.is_dir():
        pytest.skip("the published data are not here")
    return PUBLISHED
