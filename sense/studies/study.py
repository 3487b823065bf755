"""What every study shares: work in tasks that survive being broken off, and results as table, figure and text.

Which pads a study looks at: files of morphologies, and pads that need no file.
"""

import csv
import hashlib
import io
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from padforge.design.common.files import provenance, write_json, write_text
from padforge.design.common.parallel import Checkpoints, State, one_torch_thread, run_tasks
from padforge.design.common.settings import validate
from padforge.design.common.validation import InputError
from padforge.design.morphology import Morphology

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from padforge.sense.recording.recording import Recording


@dataclass(frozen=True)
class Task:
    """A piece of a study's work that is done in one go.

    Attributes:
        name: what is shown while it runs.
        make: its result, arrays by name; the same whatever else is done, and when.
    """

    name: str
    make: Callable[[], State]


@dataclass(frozen=True)
class Findings:
    """What a study found.

    Attributes:
        rows: of its table, all with the same keys, values as JSON has them.
        text: paragraphs that say what it shows, without markup.
        maps: further JSON that the figure needs, by name.
    """

    rows: list[dict[str, Any]]
    text: list[str]
    maps: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """A study, ready to be run.

    Attributes:
        name: stem of its files. title: of its text.
        settings: all that its results depend on, as JSON has it; a run is resumed with the same alone.
        tasks: its work. conclude: findings from the tasks' results, in their order.
        draw: the figure from the finished document.
    """

    name: str
    title: str
    settings: dict[str, Any]
    tasks: Sequence[Task]
    conclude: Callable[[list[State]], Findings]
    draw: Callable[[Mapping[str, Any]], "Figure"]


def run(
    study: Study,
    out: Path,
    *,
    jobs: int | None = None,
    executor: Executor | None = None,
    resume: bool = False,
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> dict[str, Any]:
    """Do a study's work and write NAME.json, NAME.csv, NAME.png and NAME.md.

    Results of tasks are kept in `out` until all are done.

    Args:
        out: folder. jobs: tasks at once; as many as there are cores, or as the executor has it, if None.
        executor: of the `concurrent.futures` kind, such as a cluster's; the threads of this machine if None.
        resume: whether to go on from tasks that
            an earlier run into the same folder has done; else they are thrown away.
        progress: called with (tasks done, tasks in all, the last one's name).

    Returns:
        The document: "format", "rows", "text", "settings", "provenance" and the findings' maps.

    Raises:
        InputError: tasks to go on from that belong to other settings, a folder that cannot be written, or in which the
            same study is at work.
    """
    from padforge.design.common.files import atomic_files, check_writable
    from padforge.design.common.plotting import save_figure

    check_writable(out)
    # What is kept goes by the number of a task, so the tasks and their order count as much as the settings.
    order = hashlib.sha256("\n".join(task.name for task in study.tasks).encode()).hexdigest()[:16]
    with _alone(out, study.name):
        kept = Checkpoints(out / f"{study.name}-unfinished", {study.name: study.settings | {"tasks": order}})
        findings = study.conclude(_done(study.tasks, kept, (executor, jobs), resume, progress))
        document = _document(study, findings)
        with atomic_files(out) as folder:
            save_figure(study.draw(document), folder / f"{study.name}.png")
            write_text(folder / f"{study.name}.csv", _csv(findings.rows))
            write_text(folder / f"{study.name}.md", _markdown(document, f"{study.name}.png"))
            write_json(folder / f"{study.name}.json", document)
        kept.clear()
    return document


@contextmanager
def _alone(out: Path, name: str) -> Iterator[None]:
    """Keep other runs of a study out of its folder; InputError where one is there."""
    from padforge.design.common.files import lock

    out.mkdir(parents=True, exist_ok=True)
    path, busy = out / f".{name}.lock", f"{out}: a {name} study is at work there; wait for it or choose another --out"
    if os.path.lexists(path) and (path.is_symlink() or not path.is_file()):
        raise InputError(f"{path}: is no file, expected one or nothing; remove it, or choose another --out")
    with path.open("a") as file:
        lock(file, busy)
        if not (path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat())):
            raise InputError(busy)  # who had it came to the end meanwhile, and took it away
        try:
            yield
        finally:
            with suppress(PermissionError):  # Windows, where what is open stays
                path.unlink(missing_ok=True)


def _document(study: Study, findings: Findings) -> dict[str, Any]:
    return {
        "format": f"padforge-study-{study.name}/1",
        "title": study.title,
        "text": findings.text,
        "rows": findings.rows,
        **findings.maps,
        "settings": study.settings,
        "provenance": provenance(f"padforge study {study.name}", study.settings.get("seed"), packages=("torch",)),
    }


def _done(
    tasks: Sequence[Task],
    kept: Checkpoints,
    on: tuple[Executor | None, int | None],
    resume: bool,
    progress: Callable[[int, int, str], None],
) -> list[State]:
    """The results of all tasks, by so many at once on an executor, those that are kept not made again."""
    executor, jobs = on
    states = kept.begin(resume)
    progress(len(states), len(tasks), "")
    missing = [(number, partial(_made, task.make)) for number, task in enumerate(tasks) if number not in states]
    for number, state in run_tasks(missing, executor, max_parallel=jobs):
        states[number] = state
        kept.save(number, state)
        progress(len(states), len(tasks), tasks[number].name)
    return [states[number] for number in range(len(tasks))]


def _made(make: Callable[[], State]) -> State:
    """A task's result, wherever it is made."""
    with one_torch_thread():
        return make()


def table_cells(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Rows as text, the first one their keys; numbers with four digits."""
    return [list(rows[0]), *([_cell(value) for value in row.values()] for row in rows)]


def study_lines(document: Mapping[str, Any]) -> list[str]:
    """A study as a table for people, and what it shows."""
    cells = table_cells(document["rows"])
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    told = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in cells]
    return [*told, "", *document["text"]]


def _cell(value: object) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _markdown(document: Mapping[str, Any], figure: str) -> str:
    def line(row: list[str]) -> str:
        return f"| {' | '.join(cell.replace('|', chr(92) + '|').replace('<', '&lt;') for cell in row)} |"

    head, *body = map(line, table_cells(document["rows"]))
    rule = f"|{' --- |' * len(document['rows'][0])}"
    parts = [f"# {document['title']}", *document["text"], f"![{document['title']}]({figure})"]
    return "\n\n".join([*parts, "\n".join([head, rule, *body])]) + "\n"


NAMED = re.compile(r"(square|(optimised)|(random|optimised|genetic)-([1-9]\d?))(?:@([1-9]\d{0,2}))?")
"""Straight fibres, random ones of N knots, and what a search finds: by gradients, or as published; their grid after an
@."""
GRID = 4


def load_pads(names: Sequence[str], seed: int) -> dict[str, Morphology]:
    """Pads by the label that tables and figures give them, in order.

    Args:
        names: files, `square`, `random-N`, `optimised`, `optimised-N` or `genetic-N` (`square@8`: with a grid of 8).
        seed: of all but the first two.

    Raises:
        InputError: no such file or name, a file that is no morphology, or a name given twice.
    """
    return _labelled([(name, *_load(name, seed)) for name in names])


def load_recordings(names: Sequence[str]) -> "dict[str, Recording]":
    """Recordings by label, as `open_recording` reads them; raises InputError as it does, and for a label met twice."""
    from padforge.sense.formats.import_export import open_recording

    def label(path: Path) -> str:
        return path.resolve().parent.name if path.name == "recording" else path.stem

    return _labelled([(name, label(Path(name)), open_recording(name)) for name in names])


def _labelled(parts: list[tuple[str, str, Any]]) -> dict[str, Any]:
    """Things by label, from what the user called them, their labels and themselves."""
    found: dict[str, Any] = {}
    for name, label, thing in parts:
        # Names of files may hold what no page or table can; matplotlib typesets what is between $ as mathematics, and
        # leaves labels with a _ in front out of its legends; a spreadsheet works out what begins with = + - or @.
        printable = label.encode("utf-8", "backslashreplace").decode().replace("$", "")
        label = " ".join(printable.split()).lstrip("_=+-@ ") or "pad"
        if label in found:
            raise InputError(f"{name}: one called {label} is there already, expected each once")
        found[label] = thing
    return found


def _load(name: str, seed: int) -> tuple[str, Morphology]:
    named = NAMED.fullmatch(name)
    if named and not Path(name).exists():
        grid, method, knots = int(named[5] or GRID), named[2] or named[3], int(named[4]) if named[4] else None
        if method is None:
            return name, Morphology.straight(grid)
        if method == "random":
            return name, Morphology.random(grid, knots or 0, seed)
        return name, _found(grid, "genetic" if method == "genetic" else "descent", knots, seed)
    if not Path(name).exists():
        raise InputError(
            f"{name}: no such file, and none of square, optimised, random-N, optimised-N, genetic-N (N from 1 to 99 "
            "knots; 64 where they are searched for)"
        )
    path = Path(name)
    label = path.parent.name if path.name == "morphology.json" and path.parent.name else path.stem
    return label, Morphology.load(path)


def _found(grid: int, method: Literal["descent", "genetic"], knots: int | None, seed: int) -> Morphology:
    """What a search finds for the published contact: by gradients from a single start, under the default rules; or as
    published, where rules count for nothing. So many knots, or the default."""
    from padforge.design.optimize.search import search
    from padforge.design.settings import PUBLISHED_CONTACT, PUBLISHED_PAD, PUBLISHED_SEARCH, SearchSettings

    pad = PUBLISHED_PAD.model_copy(update={"grid": grid})
    asked = {"starts": 1, "seed": seed, "method": method} | ({} if knots is None else {"knots": knots})
    settings = validate(SearchSettings, PUBLISHED_SEARCH.model_dump() | asked, f"{method} search")
    return search(pad, PUBLISHED_CONTACT, settings).morphology


def described(pads: Mapping[str, Morphology]) -> dict[str, Any]:
    """What the settings say of each pad."""
    return {
        label: {
            **({"grid": pad.grid} if pad.layout.is_square else {"fibres": list(pad.layout.counts)}),
            "pitch_mm": pad.pitch_mm,
            "knots_sha256": hashlib.sha256(pad.knots.tobytes()).hexdigest(),
        }
        for label, pad in pads.items()
    }
