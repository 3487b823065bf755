"""What has become slower, less accurate or less sparing since an earlier run of the same benchmarks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from padforge.benchmarks.harness import TrialKey
from padforge.benchmarks.table import FORMAT, SUMMARY_FORMAT
from padforge.design.common.files import read_json
from padforge.design.common.validation import InputError

SLOWER, LESS_ACCURATE, LOOKS_AT_MORE = "slower", "less accurate", "looks at more"
ALARM = {SLOWER: 1.2, LESS_ACCURATE: 1.25, LOOKS_AT_MORE: 1.1}
"""Ratios beyond which a change is told of."""
LONG_S, ALARM_LONG = 0.02, 1.25
"""Work that takes longer is seldom undisturbed: it is slower from another ratio on, by the pace beside it too."""
TINY_S = 1e-3
"""Work that takes less depends on where a process happens to lie in memory: it counts as slower in company only."""
PACE_SLACK = 1.1
"""By how much the least pace of two runs on one machine may differ; quick work meets its best time more surely."""
ROUNDING = 1e-15
"""Errors below are all alike."""


@dataclass(frozen=True)
class Worsening:
    """A measurement that has become worse.

    Attributes:
        bench: its name. key: of the trial.
        what: SLOWER, LESS_ACCURATE or LOOKS_AT_MORE.
        before, now: seconds an item, error or share visited. ratio: by which it is worse, above 1; of times, as far as
            the pace of the machine does not explain it.
    """

    bench: str
    key: TrialKey
    what: str
    before: float
    now: float
    ratio: float

    def __str__(self) -> str:
        case, way, size, repetition = self.key
        trial = f"{self.bench}, {case}, {way}" + (f" {size:g}" if size else "") + (f" #{repetition}" * bool(repetition))
        return f"{trial}: {self.what}, {self.ratio:.2f}x ({self.before:.3g} before, {self.now:.3g} now)"


def read_earlier(path: Path) -> dict[str, Mapping[str, Any]]:
    """Benchmarks by name from `bench.json`, or the one in `NAME.json`.

    Raises:
        InputError: the file cannot be read or is neither.
    """
    try:
        documents = list(read_json(path, SUMMARY_FORMAT)["benches"].values())
    except InputError:
        documents = [read_json(path, FORMAT)]
    except (KeyError, AttributeError) as error:
        raise InputError(f"{path}: not as padforge bench writes it ({error!r})") from error
    try:
        for document in documents:
            worsenings(document, document)
        return {document["bench"]: document for document in documents}
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"{path}: not as padforge bench writes it ({error!r})") from error


def worsenings(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[Worsening]:
    """Changes for the worse of the package's own ways, in trials that both runs of a benchmark have, worst first."""
    earlier, pace = _rows(before), before["pace_s"] / now["pace_s"]
    changes = []
    for key, row in _rows(now).items():
        if key not in earlier or key[1] in now["plain"]:
            continue
        old = earlier[key]
        ratios = {SLOWER: (old["seconds"], row["seconds"], _slower(old, row, pace))}
        for what, column, least in ((LESS_ACCURATE, "error", ROUNDING), (LOOKS_AT_MORE, "visited", 1e-3)):
            if old[column] is not None and row[column] is not None:
                ratios[what] = (old[column], row[column], max(row[column], least) / max(old[column], least))
        for what, (then, since, ratio) in ratios.items():
            limit = ALARM_LONG if what == SLOWER and then > LONG_S else ALARM[what]
            if not ratio <= limit:  # so is NaN
                changes.append(Worsening(now["bench"], key, what, then, since, ratio))
    slower = [change.key[1] for change in changes if change.what == SLOWER]  # ways
    alone = [c for c in changes if c.what == SLOWER and c.before < TINY_S and slower.count(c.key[1]) == 1]
    return sorted((change for change in changes if change not in alone), key=lambda change: -change.ratio)


def _slower(old: Mapping[str, Any], row: Mapping[str, Any], pace: float) -> float:
    """How much slower a trial is, `pace` being how much faster the machine was before than it is now."""
    plain = row["seconds"] / old["seconds"]
    if old["seconds"] > LONG_S:
        return min(pace * plain, row["paces"] / old["paces"])
    return min(plain, PACE_SLACK * pace * plain)


def _rows(document: Mapping[str, Any]) -> dict[TrialKey, Mapping[str, Any]]:
    return {(row["case"], row["way"], row["size"], row["repetition"]): row for row in document["rows"]}


def compared(before: Mapping[str, Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]) -> int:
    """How many trials of the package's own ways both runs have."""
    return sum(
        key[1] not in now[name]["plain"]
        for name in before.keys() & now.keys()
        for key in _rows(before[name]).keys() & _rows(now[name]).keys()
    )


def comparison_lines(changes: Sequence[Worsening], trials: int) -> list[str]:
    """A comparison for people."""
    if not changes:
        return [f"{trials} trials compared: none slower, less accurate or looking at more"]
    return [f"{trials} trials compared; worse than before:", *(f"  {change}" for change in changes)]
