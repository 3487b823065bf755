"""Common parts of all studies: tasks in parallel, results as table, figure and text, pads by name."""

import csv
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from padforge.common import files
from padforge.common.command_line import text_table
from padforge.common.page import cell_text
from padforge.common.parallel import State, one_thread, run_tasks
from padforge.common.plotting import FAINT, INK, save_figure, style_axes
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import validate
from padforge.common.validation import InputError, check_int
from padforge.design.morphology import Morphology
from padforge.design.settings import PUBLISHED_PAD, Layout
from padforge.sense.arrays import Array, Indices
from padforge.sense.recording.recording import Recording
from padforge.sense.simulation.pad_model import ADC_STEPS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMED = re.compile(
    r"(?:(?P<plain>square|optimised)|(?P<kind>random|optimised|genetic)-(?P<knots>[1-9]\d?))(?:@(?P<grid>[1-9]\d{0,2}))?"
)
"""Pads without a file: straight fibres, random ones of N knots, and those of a search; their grid after an @."""


@dataclass(frozen=True)
class Sizes:
    """Numbers of training and test presses of a study, and sizes of its networks."""

    presses: int
    test: int
    hidden: int = 50  # neurons
    epochs: int = 200
    members: int = 3  # networks of an ensemble: errors of single ones vary by more than pads differ


@dataclass(frozen=True)
class Task:
    """Part of a study's work: `compute` returns arrays by name, and depends on no other task."""

    name: str
    compute: Callable[[], State]


@dataclass(frozen=True)
class StudyResult:
    """Result of a study."""

    rows: list[dict[str, Any]]  # of its table, all with the same keys; JSON values
    text: list[str]  # paragraphs without markup
    extra: dict[str, Any] = field(default_factory=dict)  # further JSON that the figure needs


@dataclass(frozen=True)
class Study:
    """A study, ready to be run."""

    name: str  # stem of its files
    title: str
    settings: dict[str, Any]  # all that its results depend on, as JSON
    tasks: Sequence[Task]
    conclude: Callable[[list[State]], StudyResult]  # takes the results of the tasks, in their order
    draw: Callable[[Mapping[str, Any]], "Figure"]  # takes the document


def run(
    study: Study,
    out: Path,
    *,
    jobs: int | None = None,
    executor: Executor | None = None,
    on_progress: OnProgress = ignore_progress,
) -> dict[str, Any]:
    """Run a study, write NAME.json, NAME.csv, NAME.png and NAME.md into the folder `out`, and return the document.

    Tasks run in `executor`, such as a cluster's, or else in threads; `jobs` at once, by default as many as there are
    workers. `on_progress` is called with (tasks done, total, name of the last one).

    Raises:
        InputError: the folder cannot be written.
    """
    files.check_writable(out)
    result = study.conclude(compute_states(study.tasks, on_progress, jobs=jobs, executor=executor))
    document = {
        "format": f"padforge-study-{study.name}/1",
        "title": study.title,
        "text": result.text,
        "rows": result.rows,
        **result.extra,
        "settings": study.settings,
        "provenance": files.provenance(f"padforge study {study.name}", study.settings.get("seed"), packages=("torch",)),
    }
    with files.atomic_files(out) as folder:
        save_figure(study.draw(document), folder / f"{study.name}.png")
        files.write_text(folder / f"{study.name}.md", _markdown(document, f"{study.name}.png"))
        with (folder / f"{study.name}.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(result.rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(result.rows)
        files.write_json(folder / f"{study.name}.json", document)
    return document


def compute_states(
    tasks: Sequence[Task], on_progress: OnProgress, *, jobs: int | None = None, executor: Executor | None = None
) -> list[State]:
    """Return the results of tasks, in their order, computed in parallel."""
    states = dict[int, State]()
    on_progress(0, len(tasks), "")
    work = [(number, partial(_compute, task)) for number, task in enumerate(tasks)]
    for number, state in run_tasks(work, executor, max_parallel=jobs):
        states[number] = state
        on_progress(len(states), len(tasks), tasks[number].name)
    return [states[number] for number in range(len(tasks))]


def _compute(task: Task) -> State:
    with one_thread():
        return task.compute()


def study_lines(document: Mapping[str, Any]) -> list[str]:
    """Format a study as a table and paragraphs."""
    return [*text_table(_table_cells(document["rows"]), text_columns=()), "", *document["text"]]


def _table_cells(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Format rows as text, the first one their keys."""
    return [list(rows[0]), *(list(map(cell_text, row.values())) for row in rows)]


def _markdown(document: Mapping[str, Any], figure: str) -> str:
    def line(row: list[str]) -> str:
        return f"| {' | '.join(row)} |"

    head, *body = map(line, _table_cells(document["rows"]))
    rule = f"|{' --- |' * len(document['rows'][0])}"
    parts = [f"# {document['title']}", *document["text"], f"![{document['title']}]({figure})"]
    return "\n\n".join([*parts, "\n".join([head, rule, *body])]) + "\n"


def load_pads(names: Sequence[str], seed: int, layout: Layout = PUBLISHED_PAD.layout) -> dict[str, Morphology]:
    """Load or make pads, by the labels of tables and figures; raises InputError for unknown names and a label twice.

    A name is a file, `square`, `random-N`, `optimised`, `optimised-N` or `genetic-N` (`square@8`: with a grid of 8).
    Pads without a file have the layout, or another grid with its pitch.
    """
    return _label([(name, *_load_pad(name, seed, layout)) for name in names])


def load_recordings(names: Sequence[str]) -> dict[str, Recording]:
    """Load recordings by label; raises InputError as `open_recording`, and for a label twice."""
    from padforge.sense.formats.import_export import open_recording

    paths = [Path(name) for name in names]
    labels = [path.resolve().parent.name if path.name == "recording" else path.stem for path in paths]
    return _label([(name, label, open_recording(name)) for name, label in zip(names, labels, strict=True)])


def _label(parts: Sequence[tuple[str, str, Any]]) -> dict[str, Any]:
    """Return objects by label, from tuples of the user's name, label and object."""
    labelled: dict[str, Any] = {}
    for name, label, part in parts:
        # Matplotlib typesets mathematics between $, and leaves labels that begin with _ out of legends.
        label = label.replace("$", "").lstrip("_ ") or "pad"
        if label in labelled:
            raise InputError(f"{name}: another one is called {label}, expected each label once")
        labelled[label] = part
    return labelled


def _load_pad(name: str, seed: int, layout: Layout) -> tuple[str, Morphology]:
    path = Path(name)
    if path.exists():
        is_default_name = path.name == "morphology.json" and path.parent.name
        return path.parent.name if is_default_name else path.stem, Morphology.load(path)
    named = NAMED.fullmatch(name)
    if named is None:
        raise InputError(
            f"{name}: no such file, and none of square, optimised, random-N, optimised-N, genetic-N (N from 1 to 99 "
            "knots; 64 where they are searched for)"
        )
    kind, knots = named["plain"] or named["kind"], named["knots"]
    if named["grid"]:
        layout = Layout.create(int(named["grid"]), layout.pitch_mm)
    if kind == "square":
        return name, Morphology.straight(layout)
    if kind == "random":
        return name, Morphology.random(layout, int(knots), seed)
    from padforge.design.optimize.search import search
    from padforge.design.settings import PUBLISHED_CONTACT, PUBLISHED_SEARCH, SearchSettings

    # under the published contact: by descent from a single start, or genetic as published
    pad = PUBLISHED_PAD.for_layout(layout)
    method = "genetic" if kind == "genetic" else "descent"
    overrides = {"starts": 1, "seed": seed, "method": method} | ({"knots": int(knots)} if knots else {})
    settings = validate(SearchSettings, PUBLISHED_SEARCH.model_dump() | overrides, f"{method} search")
    return name, search(pad, PUBLISHED_CONTACT, settings).morphology


def describe_pads(pads: Mapping[str, Morphology]) -> dict[str, Any]:
    """Describe each pad for the settings of a study."""
    return {
        label: {
            **({"grid": pad.grid} if pad.layout.is_square else {"fibres": list(pad.layout.counts)}),
            "pitch_mm": pad.pitch_mm,
            "knots_sha256": hashlib.sha256(pad.knots.tobytes()).hexdigest(),
        }
        for label, pad in pads.items()
    }


def read_counts(signals: Array, training: int, noise_counts: float, rng: np.random.Generator) -> Array:
    """Read signals (Q, C) with a noisy 12-bit converter, in whole counts; a fibre without signal reads noise.

    Full scale is the largest magnitude of a fibre's signal in the first `training` presses. Readings begin at 0 unless
    there are negative signals.
    """
    full_scale, lowest = np.abs(signals[:training]).max(axis=0), -ADC_STEPS * int(signals.min() < 0)
    share = np.divide(signals, full_scale, out=np.zeros(signals.shape), where=full_scale > 0)
    return np.clip(np.rint(ADC_STEPS * share + rng.normal(0, noise_counts, signals.shape)), lowest, ADC_STEPS)


def fit_and_predict(inputs: Array, targets: Array, rng: np.random.Generator, sizes: Sizes) -> Array:
    """Fit networks to the training presses of inputs (Q, D) and targets (Q, O); return their mean for the others."""
    from padforge.design.published.networks import fit_batch

    n = sizes.presses
    networks = fit_batch(inputs[:n], targets[:n], rng.spawn(sizes.members), sizes.hidden, sizes.epochs)
    return np.mean([network(inputs[n:]) for network in networks], axis=0)


def classify(inputs: Array, classes: Indices, n_classes: int, rng: np.random.Generator, sizes: Sizes) -> State:
    """Count how often test presses of each class, by row, are classified as each, by column."""
    predicted = fit_and_predict(inputs, np.eye(n_classes)[classes], rng, sizes).argmax(axis=1)
    counts = np.bincount(classes[sizes.presses :] * n_classes + predicted, minlength=n_classes**2)
    return {"confusions": counts.reshape(n_classes, n_classes)}


def classification_scores(confusions: Array) -> dict[str, float]:
    """Return the share of correct classifications, and that of always guessing the most frequent class, per cent."""
    total = confusions.sum()
    return {
        "accuracy_percent": float(100 * np.trace(confusions) / total),
        "majority_percent": float(100 * confusions.sum(axis=1).max() / total),
    }


def check_failed(failed: Sequence[int], fibres: int, source: str) -> tuple[int, ...]:
    """Return ascending indices of failed fibres; InputError if the source has no such fibres, or no others."""
    indices = {check_int(f"index of a failed fibre of {source}", index, 0, fibres - 1) for index in failed}
    if len(indices) == fibres:
        raise InputError(f"failed are all {fibres} fibres of {source}, at least one must be left")
    return tuple(sorted(indices))


def failed_label(failed: Sequence[int]) -> str:
    """Return the title of a result without some fibres."""
    return f"without {'+'.join(str(fibre + 1) for fibre in failed)}" if failed else "all fibres"


def label_axes(axes: Any, title: str = "", grid: Literal["", "x", "y"] = "", **labels: Any) -> None:
    """Set limits and labels as `axes.set`, a title, and grid lines across one axis."""
    axes.set(**labels)
    if title:
        axes.set_title(title, loc="left", color=INK, fontsize=10)
    if grid:
        axes.grid(axis=grid, color=FAINT, linewidth=0.6)
    style_axes(axes)


def draw_confusions(axes: Any, counts: Sequence[Sequence[int]], title: str, xlabel: str, ylabel: str) -> None:
    """Draw a confusion matrix, true classes by row and predicted ones by column, in per cent of each row."""
    percent = 100 * np.array(counts) / np.maximum(np.sum(counts, axis=1, keepdims=True), 1)
    axes.imshow(percent, cmap="Blues", vmin=0, vmax=100)
    for (i, j), value in np.ndenumerate(percent):
        axes.text(j, i, f"{value:.0f}", ha="center", va="center", color="white" if value > 60 else INK, fontsize=9)
    axes.tick_params(length=0, labelcolor=INK)
    axes.spines[:].set_visible(False)
    axes.set_title(title, loc="left", color=INK, fontsize=10)
    axes.set_xlabel(xlabel, color=INK)
    axes.set_ylabel(ylabel, color=INK)


def draw_error_map(
    axes: Any, errors: Any, title: str, highest: float, extent: Sequence[float] | None = None, row_label: str = ""
) -> Any:
    """Draw errors by cell of the pad, y upwards, and return the image; the first map of a row has a label and scale."""
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, fontsize=8, color=INK)
    image = axes.imshow(errors, origin="lower", extent=extent, cmap="magma_r", vmin=0, vmax=highest)
    if row_label:
        axes.set_ylabel(row_label, fontsize=8, color=INK)
        axes.figure.colorbar(image, ax=axes, location="left", shrink=0.8).ax.tick_params(labelsize=7)
    return image
