"""What tests of design share."""

import pytest

from padforge.benchmarks import harness
from padforge.common.progress import ignore_progress


@pytest.fixture
def taken(monkeypatch):
    """Evaluations of one quick round of a benchmark, by trial."""
    monkeypatch.setattr(harness, "BUDGET_S", 0)

    def found(bench):
        rounds = harness.BenchRounds()
        harness.measure_round(bench, rounds, ignore_progress, lambda key: False)
        return rounds.results

    return found


@pytest.fixture
def one_thread():
    """Torch computes on one thread, as in a search: several that wait for a busy machine take many times as long."""
    from padforge.common.parallel import one_thread

    with one_thread():
        yield
