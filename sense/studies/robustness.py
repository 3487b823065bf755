"""Robustness: accuracy of a pad as fibres are lost, by networks retrained for every set (paper, figures 3, 4 and 5)."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.common.parallel import State
from padforge.common.plotting import CURVES, INK
from padforge.design.contact import grid_positions, signals, signals_quantized
from padforge.design.morphology import Morphology
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.design.published.networks import FailureSet, SimulatedPresses, split_batches
from padforge.design.settings import PUBLISHED_CONTACT, Contact, between_fibres
from padforge.sense.arrays import Array
from padforge.sense.studies.study import (
    Study,
    StudyResult,
    Task,
    check_failed,
    describe_pads,
    draw_error_map,
    failed_label,
    label_axes,
)

RULES = {"published": signals_quantized, "exact": signals}
"""Signals of sampled fibres, as in the published figures, or exact."""
MIN_NETWORKS = 16
"""Minimum networks for each number of failed fibres. If there are fewer sets of these, several networks are trained for
each, since the error of a single network depends on its first weights."""
MAX_SETS = 1024  # sets of failed fibres of one size that are evaluated; if there are more, a sample is drawn
Respond = Callable[[Morphology, Array], Array]
HIDDEN = 50  # neurons of a network
TEST = 2000  # fresh presses to test on
SIDE = 33  # cells along a side of an error map


def robustness_study(
    pads: Mapping[str, Morphology],
    *,
    contact: Contact | None = None,
    rule: str = "published",
    max_failures: int = 3,
    presses: int = 1024,
    failed: Sequence[int] = (),
    seed: int = 0,
) -> Study:
    """Evaluate networks that are retrained for every set of failed fibres, as published, with error maps.

    The contact is PUBLISHED_CONTACT if None, `rule` one of RULES, and the number of training presses a square. Up to
    `max_failures` fibres fail at once, and at least one is left. If indices `failed` are given, errors are also mapped
    without all these fibres.

    Raises:
        InputError: a pad has none of the `failed` fibres, or no others.
    """
    side = math.isqrt(presses)
    contact = contact or PUBLISHED_CONTACT
    parts = [
        (label, part)
        for label, pad in pads.items()
        for level in range(min(max_failures, pad.layout.fibres - 1) + 1)
        for part in split_batches(failure_subsets(pad.layout.fibres, level, MAX_SETS))
    ]
    chosen: tuple[int, ...] = ()
    for label, pad in pads.items():
        chosen = check_failed(failed, pad.layout.fibres, label)
    parts += [(label, [chosen]) for label in pads if chosen]
    sizes = {"hidden": HIDDEN, "test": TEST, "seed": seed}
    evaluate = partial(_evaluate, respond=partial(RULES[rule], contact=contact), side=side, **sizes)
    tasks = [Task(f"{label}, {len(part[0])} failed", partial(evaluate, pads[label], part)) for label, part in parts]
    settings = {
        "pads": describe_pads(pads),
        "contact": contact.model_dump(mode="json"),
        "signals": rule,
        "max_failures": max_failures,
        "failed": list(chosen),
        "presses": presses,
        **sizes,
    }
    conclude = partial(_conclude, dict(pads), parts, settings)
    return Study("robustness", "Robustness to fibre loss", settings, tasks, conclude, _draw)


def _evaluate(
    pad: Morphology, failures: list[FailureSet], respond: Respond, side: int, hidden: int, test: int, seed: int
) -> State:
    """Compute errors with each of L sets of failed fibres, grid units: "fresh" (L,), "training" (L,), "maps" (L, Q)."""
    presses = SimulatedPresses.simulate(pad, side, test, seed, partial(respond, pad))
    positions = grid_positions(between_fibres(pad.layout), SIDE)
    responses = respond(pad, positions)
    repeats = -(-MIN_NETWORKS // math.comb(pad.layout.fibres, len(failures[0])))
    errors = [
        (
            presses.test_errors(network, failed).mean(),
            presses.position_errors(network, failed, presses.train_signals, presses.train_positions).mean(),
            presses.position_errors(network, failed, responses, positions),
        )
        for repeat in range(repeats)
        for network, failed in zip(presses.fit(failures, hidden, repeat), failures, strict=True)
    ]
    by_repeat = (np.array(part).reshape(repeats, len(failures), -1) for part in zip(*errors, strict=True))
    fresh, training, maps = (part.mean(axis=0) for part in by_repeat)
    return {"fresh": fresh[:, 0], "training": training[:, 0], "maps": maps.astype(np.float32)}


def _conclude(
    pads: Mapping[str, Morphology],
    parts: list[tuple[str, list[FailureSet]]],
    settings: Mapping[str, Any],
    states: list[State],
) -> StudyResult:
    rows, maps, by_subset = [], [], []
    for label, pad in pads.items():
        results = [(part, state) for (name, part), state in zip(parts, states, strict=True) if name == label]
        chosen = [results.pop()] if settings["failed"] else []  # the last part of a pad
        failures = [failed for part, _ in results for failed in part]
        fresh, training, errors = (
            np.concatenate([state[name] for _, state in results]) for name in ("fresh", "training", "maps")
        )
        sizes = np.array([len(failed) for failed in failures])
        mapped = []
        for level in range(sizes.max() + 1):
            means = fresh[sizes == level]
            row = {
                "pad": label,
                "n_failed": level,
                "subsets": len(means),
                "of": math.comb(pad.layout.fibres, level),
                "mean": float(means.mean()),
                "std": float(means.std()),
                "max": float(means.max()),
                "mean_mm": float(means.mean() * pad.unit_mm),
                "max_mm": float(means.max() * pad.unit_mm),
                "mean_trained_on": float(training[sizes == level].mean()),
            }
            rows.append(row)
            worst = int(np.flatnonzero(sizes == level)[means.argmax()])
            mapped.append((failures[worst], float(fresh[worst]), errors[worst]))
        mapped += [(part[0], float(state["fresh"][0]), state["maps"][0]) for part, state in chosen]
        (left, low), (right, high) = between_fibres(pad.layout)
        maps += [
            {
                "pad": label,
                "failed": list(failed),
                "mean": mean,
                "extent": [left, right, low, high],
                "errors": np.round(cells.reshape(SIDE, SIDE), 3).tolist(),
            }
            for failed, mean, cells in mapped
        ]
        by_subset += [
            {"pad": label, "failed": list(failed), "mean": float(mean)}
            for failed, mean in zip(failures, fresh, strict=True)
        ]
    return StudyResult(rows, _describe(settings, rows, maps), {"maps": maps, "by_subset": by_subset})


def _describe(settings: Mapping[str, Any], rows: list[dict[str, Any]], maps: list[dict[str, Any]]) -> list[str]:
    is_sample = any(row["subsets"] < row["of"] for row in rows)
    sample = f" ({MAX_SETS} of them, drawn at random, where there are more)" if is_sample else ""
    most = max(row["n_failed"] for row in rows)
    fibres = "fibre" if most == 1 else "fibres"
    text = [
        f"Networks of {settings['hidden']} neurons were trained on {settings['presses']} presses of a serpentine, "
        f"another one for every set of up to {most} failed {fibres}{sample}, and tested on {settings['test']} fresh "
        f"presses; errors are in grid units ({settings['signals']} signals). Where there are few sets, each was "
        f"trained several times, so that every mean is of at least {MIN_NETWORKS} networks. The last column is the "
        "paper's own measure, taken over the serpentine, most of which was trained on."
    ]
    if chosen := settings["failed"]:
        by_pad = {panel["pad"]: panel["mean"] for panel in maps}  # the last map of a pad is that without these
        text += [f"{label}: {mean:.3f} {failed_label(chosen)}." for label, mean in by_pad.items()]
    return text


def _draw(document: Mapping[str, Any]) -> Figure:
    """Draw errors by number of failed fibres, error maps without the worst sets, and how these change the map."""
    labels = list(document["settings"]["pads"])
    levels = 1 + max(row["n_failed"] for row in document["rows"])
    panels = {label: [panel for panel in document["maps"] if panel["pad"] == label] for label in labels}
    columns = max(map(len, panels.values()))
    map_rows = 1 if columns == 1 else 2  # of a pad: errors, and their change
    figure = Figure(figsize=(max(7.2, 1.9 * columns), 3.6 + 1.75 * map_rows * len(labels)), layout="constrained")
    height_ratios = [1.9] + [1.0] * map_rows * len(labels)
    grid = figure.add_gridspec(len(height_ratios), columns, height_ratios=height_ratios)
    axes = figure.add_subplot(grid[0, :])
    width = 0.8 / len(labels)
    for number, label in enumerate(labels):
        rows = [row for row in document["rows"] if row["pad"] == label]
        x = np.array([row["n_failed"] for row in rows]) + width * (number - (len(labels) - 1) / 2)
        means, stds = ([row[key] for row in rows] for key in ("mean", "std"))
        colour = CURVES[number % len(CURVES)]
        axes.bar(x, means, 0.9 * width, yerr=stds, color=colour, alpha=0.85, ecolor=INK, label=label)
        axes.scatter(x, [row["max"] for row in rows], marker="_", s=60, color=colour)
    axes.set_xticks(range(levels), [f"{level} failed" if level else "all fibres" for level in range(levels)])
    label_axes(axes, grid="y", ylabel="mean error (grid units)")
    axes.legend(frameon=False, fontsize=8)
    caption = "bar: mean over the sets; line: their standard deviation; dash: the worst set"
    axes.set_title(caption, loc="left", fontsize=8.5)
    highest = float(np.quantile([panel["errors"] for panel in document["maps"]], 0.99))
    for number, (label, (intact, *others)) in enumerate(panels.items()):
        row = 1 + map_rows * number
        for column, panel in enumerate([intact, *others]):
            axes = figure.add_subplot(grid[row, column], aspect="equal")
            title, row_label = failed_label(panel["failed"]), "" if column else label
            draw_error_map(axes, panel["errors"], title, highest, panel["extent"], row_label)
        for column, panel in enumerate(others, 1):
            axes = figure.add_subplot(grid[row + 1, column], aspect="equal")
            change, row_label = np.subtract(panel["errors"], intact["errors"]), "change" if column == 1 else ""
            image = draw_error_map(axes, change, "", highest, panel["extent"], row_label)
            image.set(cmap="RdBu_r", clim=(-highest, highest))
    return figure
