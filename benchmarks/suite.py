"""Benchmarks together: rounds until times are settled, their files, the summary, and the comparison with before."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from padforge.benchmarks.comparison import SLOWER, Worsening, worsenings
from padforge.benchmarks.harness import Bench, BenchListener, BenchRounds, TrialKey, measure_round
from padforge.benchmarks.table import SUMMARY_FORMAT, summary_rows, write_bench, write_csv
from padforge.design.common.files import check_writable, write_json

ROUNDS = 2, 5
"""Every trial is in the first two; the others are for those not settled."""
ENOUGH_S = 300.0
"""After so long no more rounds begin than every trial has."""
RECHECKS = 5
"""Further rounds for trials that seem slower than before."""


def run_benches(
    benches: Sequence[Bench], out: Path, report: BenchListener, before: Mapping[str, Mapping[str, Any]]
) -> tuple[dict[str, Any], list[Worsening]]:
    """Take benchmarks; write each one's files, and `bench.json` and `bench.csv` with their summary, to `out`.

    Args:
        before: benchmarks of an earlier run by name, to compare with; empty for none.

    Returns:
        The summary, as in `bench.json`, and what has become worse. A trial counts as slower only if it is so in every
        one of its rounds.

    Raises:
        InputError: `out` cannot be written, told before anything is measured.
    """
    check_writable(out)
    measured = {bench.name: BenchRounds() for bench in benches}
    documents: dict[str, dict[str, Any]] = {}

    def pace_s() -> float:
        return min(each.pace_s for each in measured.values())

    def take(bench: Bench, what: str, again: Callable[[TrialKey], bool]) -> None:
        if measure_round(bench, measured[bench.name], lambda step: report(f"{bench.name}, {what}, {step}"), again):
            measured[bench.name].pace_s = pace_s()
            documents[bench.name] = write_bench(bench, measured[bench.name], out)

    begin = time.perf_counter()
    for number in range(ROUNDS[1]):
        if number >= ROUNDS[0] and time.perf_counter() - begin > ENOUGH_S:
            break
        for bench in benches:
            settled = measured[bench.name].settled
            take(bench, f"round {number + 1}", lambda key, s=settled, n=number: n < ROUNDS[0] or not s(key))
    for number in range(RECHECKS):
        time.sleep(number if _slower(before, documents) else 0)  # what disturbs a machine may take a while
        for bench in benches:
            if slower := _slower(before, {bench.name: documents[bench.name]}):
                take(bench, "once more", slower.__contains__)
    summary = {"format": SUMMARY_FORMAT, "summary": summary_rows(list(documents.values())), "benches": documents}
    write_csv(summary["summary"], out / "bench.csv")
    write_json(out / "bench.json", summary)
    return summary, _worse(before, documents)


def _worse(before: Mapping[str, Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]) -> list[Worsening]:
    return [change for name in now if name in before for change in worsenings(before[name], now[name])]


def _slower(before: Mapping[str, Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]) -> set[TrialKey]:
    return {change.key for change in _worse(before, now) if change.what == SLOWER}
