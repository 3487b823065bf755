"""Robustness to fibre loss on a recording: one localizer for all failures, and networks retrained for every set.

Both methods are tested on the same presses. The published one (paper, figure 9 and experiment) knows beforehand which
fibres will fail, and trains on the others alone: 42 networks for 6 fibres of which up to 3 fail.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.common.command_line import text_table
from padforge.common.files import provenance
from padforge.common.parallel import State
from padforge.common.plotting import FAINT, HORIZONTAL, INK, VERTICAL, add_caption, save_figure, style_axes
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import or_default
from padforge.common.validation import InputError
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense import settings
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer.calibration import fit_recording, split_unseen
from padforge.sense.localizer.evaluation import Evaluation, errors_by_loss, errors_by_position
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.recording.recording import Recording
from padforge.sense.studies.study import Task, check_failed, compute_states, draw_error_map, failed_label

FORMAT = "padforge-fibre-loss/1"
ONE, RETRAINED = "one network", "retrained"  # the two methods, as the document calls them
BAR_WIDTH = 0.36

Failed = tuple[int, ...]


@dataclass(frozen=True)
class MethodErrors:
    """Errors of one method.

    Attributes:
        errors: rows of `evaluation.error_row`, one a number of failed fibres.
        by_subset: mean error of each set of failed fibres.
        maps: errors by position without the worst set of each size and, at the end, without the chosen fibres.
    """

    errors: list[dict[str, Any]]
    by_subset: list[dict[str, Any]]
    maps: list[dict[str, Any]]


@dataclass(frozen=True)
class FibreLoss:
    """Errors of one or both methods for every set of failed fibres.

    Attributes:
        split: how the test presses were held back.
        training_presses: their number.
        test_presses: their number, the same for both methods.
        methods: errors by name of the method, `ONE` or `RETRAINED`.
        provenance: of the study.
    """

    split: str
    training_presses: int
    test_presses: int
    methods: dict[str, MethodErrors]
    provenance: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the document of `fibre_loss.json`."""
        return {"format": FORMAT} | asdict(self)


def fibre_loss_study(
    recording: Recording,
    localizer: LocalizerModel | None = None,
    *,
    retrain: bool = False,
    options: settings.LocalizerSettings | None = None,
    max_failures: int = 3,
    failed: Sequence[int] = (),
    on_progress: OnProgress = ignore_progress,
) -> FibreLoss:
    """Evaluate every set of failed fibres, by one localizer, by networks retrained for each set, or by both.

    Args:
        recording: with presses of known position. The test presses are those that `localizer` held out if it was
            trained on this recording, else the share that `options` hold out.
        localizer: the one network; None for retraining alone.
        retrain: whether networks are retrained for every set.
        options: split, share and seed; the defaults if None.
        max_failures: most fibres that fail at once; at least one is left.
        failed: indices of any number of fibres; errors are also mapped without all of them.
        on_progress: called with (networks done, total, "").

    Raises:
        InputError: neither method, no such fibres or none left, too few presses, a recording used in a recalibration or
            that does not suit the localizer, or a localizer without fibre dropout.
    """
    if localizer is None and not retrain:
        raise InputError("neither a localizer nor retraining is given, expected one of them or both")
    options = or_default("options", options, settings.LocalizerSettings)
    fibres = recording.fibres
    most = min(max_failures, fibres - 1)
    chosen = check_failed(failed, fibres, "the recording")
    training, test = split_unseen(recording, localizer, options)
    levels = range(most + 1)
    positions_mm = recording.presses_mm[test]
    evaluate = partial(_evaluate, fibres, levels, chosen, positions_mm)
    methods = {}
    if localizer is not None:
        methods[ONE] = evaluate(partial(localizer.predict_features, localizer.scaled_features(recording)[test]))
    if retrain:
        subsets = [subset for level in levels for subset in failure_subsets(fibres, level)]
        subsets += [chosen] if chosen and chosen not in subsets else []
        published = options.model_copy(update={"method": "published"})
        tasks = [Task("", partial(train_without, subset, recording, training, test, published)) for subset in subsets]
        states: list[Any] = compute_states(tasks, on_progress)
        predictions = {subset: Localization(**state) for subset, state in zip(subsets, states, strict=True)}
        methods[RETRAINED] = evaluate(predictions.__getitem__)
    origin = provenance("padforge sense fibre-loss", options.seed, packages=["torch"] * retrain)
    origin["inputs"] = {"recording": recording.digest, "localizer": dict(localizer.provenance) if localizer else {}}
    split = options.split if localizer is None else localizer.split
    return FibreLoss(split, len(training), len(test), methods, origin)


def _evaluate(
    fibres: int, levels: range, chosen: Failed, positions_mm: Array, predict: Callable[[Failed], Localization]
) -> MethodErrors:
    """Return errors by number and by set of failed fibres, and maps without the worst and the chosen sets."""
    rows, by_subset = errors_by_loss(fibres, levels, predict, positions_mm)
    worst = [
        max((row for row in by_subset if len(row["failed"]) == level), key=lambda row: row["mean_mm"])["failed"]
        for level in levels
    ]
    maps = [
        {"failed": list(failed), "by_position": errors_by_position(predict(tuple(failed)).positions_mm, positions_mm)}
        for failed in (*worst, *([chosen] if chosen else []))
    ]
    return MethodErrors(rows, by_subset, maps)


def train_without(
    failed: Failed, recording: Recording, training: Indices, test: Indices, options: settings.LocalizerSettings
) -> State:
    """Train on the other fibres alone, and predict the test presses; independent of all other trainings."""
    remaining = np.setdiff1d(np.arange(recording.fibres), failed)
    partial_recording = replace(recording, readings=recording.readings[:, remaining])
    rng = np.random.default_rng([options.seed, sum(1 << fibre for fibre in failed)])
    localizer = fit_recording(partial_recording, training, options, rng)
    prediction = localizer.predict_features(localizer.scaled_features(partial_recording)[test])
    return {key: value for key, value in vars(prediction).items() if key != "measures"}


def fibre_loss_lines(result: FibreLoss) -> list[str]:
    """Format the errors of both methods as a table."""
    keys = ("mean_mm", "std_mm", "max_mm")
    cells = [
        [name, str(row["n_failed"]), str(row["subsets"]), *(f"{row[key]:.2f}" for key in keys)]
        for name, method in result.methods.items()
        for row in method.errors
    ]
    head = f"error in mm on {result.test_presses} presses (split: {result.split})"
    return [head, *text_table([["", "failed", "sets", "mean", "std", "max"], *cells])]


def draw_fibre_loss(result: FibreLoss, path: Path) -> None:
    """Draw errors by number of failed fibres; below, maps of each method's errors."""
    methods = result.methods
    columns = len(next(iter(methods.values())).maps)
    figure = Figure(figsize=(max(6.4, 1.9 * columns), 4.4 + 1.9 * len(methods)), layout="constrained")
    grid = figure.add_gridspec(1 + len(methods), columns, height_ratios=[4.4] + [1.9] * len(methods))
    axes = figure.add_subplot(grid[0, :])
    draw_errors_by_loss(axes, methods, f"Fibre loss, {result.test_presses}")
    axes.legend(frameon=False, loc="upper left")
    panels = [panel for method in methods.values() for panel in method.maps]
    highest = max(cell["mean_mm"] for panel in panels for cell in panel["by_position"])
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        axes = figure.add_subplot(grid[1 + row, column], aspect="equal")
        errors, extent = _error_grid(panel["by_position"])
        label = "" if column else f"{list(methods)[row]}, mm"
        draw_error_map(axes, errors, failed_label(panel["failed"]), highest, extent, label)
    save_figure(figure, path)


def draw_errors_by_loss(axes: Any, methods: Mapping[str, Evaluation | MethodErrors], title: str) -> None:
    """Draw the errors of one or two methods by number of failed fibres, every set of them as a dot."""
    style_axes(axes)
    levels = next(iter(methods.values())).errors
    for number, ((name, method), colour) in enumerate(zip(methods.items(), (VERTICAL, HORIZONTAL), strict=False)):
        for level, row in enumerate(method.errors):
            x = level + BAR_WIDTH * (number - (len(methods) - 1) / 2)
            means = sorted(each["mean_mm"] for each in method.by_subset if len(each["failed"]) == row["n_failed"])
            # side by side, so that no dot hides another
            offsets = 0.3 * BAR_WIDTH * np.linspace(-1, 1, len(means)) if len(means) > 1 else np.zeros(1)
            axes.bar(x, row["mean_mm"], 0.9 * BAR_WIDTH, color=colour, alpha=0.35, label=None if level else name)
            axes.scatter(x + offsets, means, s=9, color=colour, linewidths=0, zorder=3)
            axes.text(x, 0.03, f"{row['mean_mm']:.2f}", color=INK, fontsize=9, ha="center", va="bottom")
    names = [f"{row['n_failed']} failed" if row["n_failed"] else "all fibres" for row in levels]
    sets = [f"{row['subsets']} set{'s' if row['subsets'] > 1 else ''}" for row in levels]
    axes.set_xticks(range(len(levels)), [f"{name}\n{count}" for name, count in zip(names, sets, strict=True)])
    axes.set_ylabel("mean error (mm)")
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.set_title(f"{title} presses never trained on\n", loc="left", color=INK, fontsize=11)
    add_caption(axes, "bar: mean over the sets of failed fibres; dot: one set")


def _error_grid(cells: Sequence[Mapping[str, float]]) -> tuple[Array, tuple[float, float, float, float]]:
    """Return mean errors by row and column, NaN where nothing is pressed, and their extent, mm."""
    middles = np.array([[cell["x_mm"], cell["y_mm"]] for cell in cells])
    low, high = middles.min(axis=0), middles.max(axis=0)
    # the smallest step between rows or columns, some of which may lack a cell: nothing is pressed in holes
    side = np.array(
        [np.diff(np.unique(middles[:, axis])).min(initial=max(high[axis] - low[axis], 1)) for axis in (0, 1)]
    )
    columns, rows = np.rint((middles - low) / side).astype(int).T
    errors = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    errors[rows, columns] = [cell["mean_mm"] for cell in cells]
    (left, below), (right, above) = (low - side / 2).tolist(), (high + side / 2).tolist()
    return errors, (left, right, below, above)
