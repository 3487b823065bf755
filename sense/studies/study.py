"""What every study shares: work in tasks that survive being broken off, and results as table, figure and text."""

import csv
import hashlib
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from padforge.design.common.files import provenance, write_json, write_text
from padforge.design.common.parallel import Checkpoints, State, one_torch_thread, run_tasks
from padforge.design.common.validation import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
