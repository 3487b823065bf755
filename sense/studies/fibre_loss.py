"""The figure of a study of lost fibres.

Robustness to lost fibres: the one masked network, and the published way, another network for every set of losses.
Both are tested on the same presses, so their errors stand side by side. The published way (paper, figure 9 and
experiment) knows beforehand which fibres will be lost, and trains on the others alone: 42 networks for 6 fibres of
which up to 3 are lost.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.files import provenance
from padforge.design.common.parallel import Checkpoints, State, one_torch_thread, run_tasks
from padforge.design.common.plotting import FAINT, HORIZONTAL, INK, VERTICAL, add_caption, save_figure, style_axes
from padforge.design.common.settings import or_default
from padforge.design.common.validation import InputError, check_int, check_path, check_type, short_repr
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense import settings
from padforge.sense.arrays import MAX_FIBRES, Array, Indices
from padforge.sense.localizer.calibration import fit_recording, split_unseen
from padforge.sense.localizer.evaluation import errors_by_loss, errors_by_position
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.recording.recording import Recording

_WIDTH = 0.36


def draw_fibre_loss(document: Mapping[str, Any], path: Path) -> None:
    """Draw the error against the number of lost fibres, every way beside the others, and every set as a dot; below,
    each way's errors over the pad, with all fibres, without the worst set of each size, and without a chosen one."""
    ways = document["ways"]
    columns = len(next(iter(ways.values()))["maps"])
    figure = Figure(figsize=(max(6.4, 1.9 * columns), 4.4 + 1.9 * len(ways)), layout="constrained")
    grid = figure.add_gridspec(1 + len(ways), columns, height_ratios=[4.4] + [1.9] * len(ways))
    axes = figure.add_subplot(grid[0, :])
    style_axes(axes)
    for place, (way, colour) in enumerate(zip(ways, (VERTICAL, HORIZONTAL), strict=False)):
        sideways = _WIDTH * (place - (len(ways) - 1) / 2)
        for at, row in enumerate(ways[way]["errors"]):
            means = [each["mean_mm"] for each in ways[way]["by_subset"] if len(each["failed"]) == row["n_failed"]]
            # Spread in order of the error, so that no two dots of a level hide each other.
            spread = np.linspace(-0.3, 0.3, len(means)) * _WIDTH if len(means) > 1 else np.zeros(1)
            axes.bar(at + sideways, row["mean_mm"], 0.9 * _WIDTH, color=colour, alpha=0.35, label=None if at else way)
            axes.scatter(at + sideways + spread, sorted(means), s=9, color=colour, linewidths=0, zorder=3)
            axes.text(at + sideways, 0.03, f"{row['mean_mm']:.2f}", color=INK, fontsize=9, ha="center", va="bottom")
    axes.legend(frameon=False, loc="upper left")
    label_losses(axes, next(iter(ways.values()))["errors"], f"Lost fibres, {document['test_presses']}")
    means = [cell["mean_mm"] for way in ways.values() for each in way["maps"] for cell in each["by_position"]]
    for row, (way, found) in enumerate(ways.items()):
        panels = [figure.add_subplot(grid[1 + row, column], aspect="equal") for column in range(len(found["maps"]))]
        pictures = [_draw_map(panel, each, max(means)) for panel, each in zip(panels, found["maps"], strict=True)]
        panels[0].set_ylabel(way, fontsize=8, color=INK)
        figure.colorbar(pictures[0], ax=panels[-1], label="mm", shrink=0.9)
    save_figure(figure, path)


def label_losses(axes: Any, rows: Sequence[Mapping[str, Any]], title: str) -> None:
    """Say along and over `axes` what stands for the `rows` of errors, one a number of lost fibres, and their sets."""
    names = ["all fibres" if row["n_failed"] == 0 else f"{row['n_failed']} lost" for row in rows]
    sets = [f"{row['subsets']} set{'s' if row['subsets'] > 1 else ''}" for row in rows]
    axes.set_xticks(range(len(rows)), [f"{name}\n{count}" for name, count in zip(names, sets, strict=True)])
    axes.set_ylabel("mean error (mm)")
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.set_title(f"{title} presses never trained on\n", loc="left", color=INK, fontsize=11)
    add_caption(axes, "bar: mean over the sets of lost fibres; dot: one set")


def _draw_map(axes: Any, found: Mapping[str, Any], highest_mm: float) -> Any:
    """Draw mean errors by cell of the pad, without the fibres that its title names."""
    cells = found["by_position"]
    places = np.array([[cell["x_mm"], cell["y_mm"]] for cell in cells])
    low, high = places.min(axis=0), places.max(axis=0)
    # not every row or column need have a cell: nothing is pressed in holes
    side = np.array(
        [np.diff(np.unique(places[:, axis])).min(initial=max(high[axis] - low[axis], 1)) for axis in (0, 1)]
    )
    columns, rows = np.rint((places - low) / side).astype(int).T
    errors = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    errors[rows, columns] = [cell["mean_mm"] for cell in cells]
    (left, below), (right, above) = low - side / 2, high + side / 2
    axes.set(xticks=[], yticks=[])
    lost = "+".join(str(fibre + 1) for fibre in found["failed"])
    axes.set_title(f"without {lost}" if lost else "all fibres", fontsize=8, color=INK)
    extent = (left, right, below, above)
    return axes.imshow(errors, origin="lower", extent=extent, cmap="magma_r", vmin=0, vmax=highest_mm)


FORMAT = "padforge-fibre-loss/2"
ONE, MANY = "one network", "retrained"
"""The two ways, as the document calls them."""

Lost = tuple[int, ...]


def fibre_loss_study(
    recording: Recording,
    localizer: LocalizerModel | None = None,
    *,
    retrain: bool = False,
    options: settings.LocalizerSettings | None = None,
    max_failures: int = 3,
    failed: Sequence[int] = (),
    keep_in: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Errors for every set of lost fibres, of one network, of networks retrained for each set, or of both.

    Args:
        recording: with presses of known place. Those that `localizer` held back are the test if it learnt from this
            recording, else the share of them that `options` hold back.
        localizer: the one network; None for the second way alone. retrain: whether the second way is wanted.
        options: split, share and seed; the defaults if None.
        max_failures: fibres that fail at once, at most; no more than leave one.
        failed: fibres, by index, without which errors are mapped too, however many they are; none where empty.
        keep_in: folder for the networks that are done, from which a run that was broken off goes on;
            `Checkpoints.clear` removes them once the document is kept.
        progress: called with (networks done, networks in all).

    Returns:
        A document with "ways": for each, "errors" and "by_subset" as `evaluate` gives them, and "maps", errors by place
        without the worst set of each size and, at the end, without `failed`; and "test_presses".

    Raises:
        InputError: neither way wanted, no such fibres or none left, too few presses, a recording seen in a
            recalibration or that does not suit the localizer, a localizer that knows no lost fibres, or networks in
            `keep_in` of other settings.
    """
    check_type("retrain", retrain, bool)
    if localizer is None and not retrain:
        raise InputError("neither a localizer nor retraining is given, expected one of them or both")
    check_type("recording", recording, Recording)
    if localizer is not None:
        check_type("localizer", localizer, LocalizerModel)
    keep_in = None if keep_in is None else check_path("keep_in", keep_in)
    options, max_failures = (
        or_default("options", options, settings.LocalizerSettings),
        check_int("max_failures", max_failures, 0, MAX_FIBRES),
    )
    chosen = _chosen(failed, recording.fibres)
    training, test = split_unseen(recording, localizer, options)
    levels = range(min(max_failures, recording.fibres - 1) + 1)
    positions_mm = recording.presses_mm[test]
    ways: dict[str, Any] = {}
    if localizer is not None:
        locate = partial(localizer.predict_features, localizer.scaled_features(recording)[test])
        ways[ONE] = _way(recording.fibres, levels, chosen, locate, positions_mm)
    if retrain:
        found = _retrained(recording, training, test, options, levels, chosen, keep_in, progress)
        ways[MANY] = _way(recording.fibres, levels, chosen, found.__getitem__, positions_mm)
    made_by = provenance("padforge sense fibre-loss", options.seed, packages=("torch",))
    made_by["inputs"] = {"recording": recording.digest, "localizer": dict(localizer.provenance) if localizer else {}}
    return {
        "format": FORMAT,
        "split": options.split if localizer is None else localizer.split,
        "training_presses": len(training),
        "test_presses": len(test),
        "ways": ways,
        "provenance": made_by,
    }


def _chosen(failed: Sequence[int], fibres: int) -> list[Lost]:
    """The set of fibres that is mapped beside the worst ones, if there is one."""
    numbers = check_type("failed", failed, Sequence)
    subset = tuple(sorted({check_int("failed fibre", fibre, 0, fibres - 1) for fibre in numbers}))
    if len(subset) == fibres:
        raise InputError(f"failed are all {fibres} fibres, at least one must be left")
    return [subset] if subset else []


def _way(
    fibres: int, levels: range, chosen: Sequence[Lost], locate: Callable[[Lost], Localization], positions_mm: Array
) -> dict[str, Any]:
    rows, by_subset = errors_by_loss(fibres, levels, locate, positions_mm)
    worst = [
        max((each for each in by_subset if len(each["failed"]) == level), key=lambda each: each["mean_mm"])["failed"]
        for level in levels
    ]
    maps = [
        {"failed": list(lost), "by_position": errors_by_position(locate(tuple(lost)).positions_mm, positions_mm)}
        for lost in (*worst, *chosen)
    ]
    return {"errors": rows, "by_subset": by_subset, "maps": maps}


def _retrained(
    recording: Recording,
    training: Indices,
    test: Indices,
    options: settings.LocalizerSettings,
    levels: range,
    chosen: Sequence[Lost],
    keep_in: Path | None,
    progress: Callable[[int, int], None],
) -> dict[Lost, Localization]:
    """What the network of each set of lost fibres finds for the test presses; finished ones are not made again."""
    subsets = [subset for level in levels for subset in failure_subsets(recording.fibres, level)]
    subsets += [subset for subset in chosen if subset not in subsets]
    about = {"recording": recording.digest, "test": test.tolist(), "seed": options.seed, "split": options.split}
    kept = Checkpoints(keep_in, {"fibre-loss": about}) if keep_in else None
    states = kept.begin(resume=True) if kept else {}
    found = {lost: _found_of(states[_number(lost)], len(test)) for lost in subsets if _number(lost) in states}
    progress(len(found), len(subsets))
    options = options.model_copy(update={"method": "published", "features": "published"})
    missing = [lost for lost in subsets if lost not in found]
    trainings = ((lost, partial(train_without, lost, recording, training, test, options)) for lost in missing)
    with one_torch_thread():
        for lost, result in run_tasks(trainings):
            found[lost] = result
            if kept:
                kept.save(_number(lost), {key: value for key, value in vars(result).items() if key != "measures"})
            progress(len(found), len(subsets))
    return found


def train_without(
    lost: Lost, recording: Recording, training: Indices, test: Indices, options: settings.LocalizerSettings
) -> Localization:
    """Train on the other fibres alone, and find the test presses; the same whatever else is trained, and when."""
    rest = np.setdiff1d(np.arange(recording.fibres), lost)
    fewer = replace(recording, readings=recording.readings[:, rest])
    localizer = fit_recording(fewer, training, options, np.random.default_rng([options.seed, _number(lost)]))
    return localizer.predict_features(localizer.scaled_features(fewer)[test])


def _number(lost: Lost) -> int:
    """A number that stands for a set of fibres: the sum of 2^fibre."""
    return sum(1 << fibre for fibre in lost)


def _found_of(state: State, presses: int) -> Localization:
    """What a network that was done found for so many presses; InputError where its file holds something else."""
    shapes = {"positions_mm": (presses, 2), "std_mm": (presses, 2), "r50_mm": (presses,), "r90_mm": (presses,)}
    arrays = {name: (array.shape, array.dtype.kind) for name, array in state.items()}
    if arrays != {name: (shape, "f") for name, shape in shapes.items()}:
        raise InputError(f"unfinished networks hold {short_repr(arrays)}, expected {shapes}; remove them to start anew")
    if not all(np.isfinite(array).all() for array in state.values()):
        raise InputError("unfinished networks hold NaN or infinity, expected finite numbers; remove them to start anew")
    return Localization(state["positions_mm"], state["std_mm"], state["r50_mm"], state["r90_mm"])


def fibre_loss_lines(document: dict[str, Any]) -> list[str]:
    """The errors of both ways as a table for people."""
    head = f"error in mm on {document['test_presses']} presses (split: {document['split']})"
    out = [head, f"{'':14s}lost  sets   mean    std    max"]
    for way, errors in document["ways"].items():
        out += [
            f"{way:<14s}{row['n_failed']:4d} {row['subsets']:5d} {row['mean_mm']:6.2f} {row['std_mm']:6.2f} "
            f"{row['max_mm']:6.2f}"
            for row in errors["errors"]
        ]
    return out
