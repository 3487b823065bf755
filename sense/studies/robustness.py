"""Robustness: what is left of a pad's accuracy as fibres are lost (paper, figures 3, 4 and 5)."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import CURVES, FAINT, INK, style_axes
from padforge.design.common.validation import InputError
from padforge.design.contact import grid_positions, signals, signals_quantized
from padforge.design.morphology import Morphology
from padforge.design.networks import FailureSet, SimulatedPresses, split_batches
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.design.settings import PUBLISHED_CONTACT, Contact, between_fibres
from padforge.sense.arrays import Array
from padforge.sense.studies.study import Findings, Study, Task, described

RULES = {"published": signals_quantized, "exact": signals}
"""How a pad's signals are made: by sampled fibres, as the published figures were, or exactly."""
NETWORKS = 16
"""Least networks of a level: where there are fewer sets of lost fibres, each is trained several times, for what one
network comes to is luck."""
MOST_SETS = 1024
"""Sets of lost fibres of a size that are tried at most; of more, so many are drawn."""
SIDE = 33
"""Places along a side of a map of errors."""


def robustness_study(
    pads: Mapping[str, Morphology],
    *,
    contact: Contact | None = None,
    rule: str = "published",
    max_failures: int = 3,
    hidden: int = 50,
    presses: int = 1024,
    test: int = 2000,
    seed: int = 0,
) -> Study:
    """Errors of networks trained afresh for every set of lost fibres, as published, with maps of them over the pad.

    Args:
        pads: by label. contact: PUBLISHED_CONTACT if None. rule: of RULES.
        max_failures: most fibres that fail at once. hidden: neurons of a network.
        presses: to train on, a square number. test: fresh presses. seed: of presses and networks.

    Raises:
        InputError: `presses` is no square of a number from 2.
    """
    side = math.isqrt(presses)
    if side**2 != presses or side < 2:
        raise InputError(f"presses is {presses}, allowed is a square number from 4")
    contact = contact or PUBLISHED_CONTACT
    parts = [
        (label, part)
        for label, pad in pads.items()
        for level in range(min(max_failures, pad.layout.fibres - 1) + 1)
        for part in split_batches(failure_subsets(pad.layout.fibres, level, MOST_SETS))
    ]
    tasks = [
        Task(
            f"{label}, {len(part[0])} lost", partial(_found, pads[label], contact, rule, part, hidden, side, test, seed)
        )
        for label, part in parts
    ]
    settings = {
        "pads": described(pads),
        "contact": contact.model_dump(mode="json"),
        "signals": rule,
        "max_failures": max_failures,
        "hidden": hidden,
        "presses": presses,
        "test": test,
        "seed": seed,
    }
    conclude = partial(_conclude, dict(pads), parts, settings)
    return Study("robustness", "Robustness to lost fibres", settings, tasks, conclude, _draw)


def _found(
    pad: Morphology, contact: Contact, rule: str, losses: list[FailureSet], hidden: int, side: int, test: int, seed: int
) -> State:
    """Mean errors (L,) with each of some losses, grid units: on "fresh" presses, and on "own", those trained on among
    them; and (L, SIDE^2) errors over the pad, "maps"."""

    def answer(places: Array) -> Array:
        return RULES[rule](pad, places, contact)

    trial = SimulatedPresses.simulate(pad, side, test, seed, answer)
    places = grid_positions(between_fibres(pad.layout), SIDE)
    over = answer(places)
    repeats = -(-NETWORKS // math.comb(pad.layout.fibres, len(losses[0])))
    found = [
        (
            trial.test_errors(network, loss).mean(),
            trial.position_errors(network, loss, trial.train_signals, trial.train_positions).mean(),
            trial.position_errors(network, loss, over, places),
        )
        for repeat in range(repeats)
        for network, loss in zip(trial.fit(losses, hidden, repeat), losses, strict=True)
    ]
    fresh, own, maps = (np.array(part) for part in zip(*found, strict=True))
    by_loss = (repeats, len(losses), -1)
    maps = maps.reshape(by_loss).mean(axis=0).astype(np.float32)
    return {
        "fresh": fresh.reshape(by_loss[:2]).mean(axis=0),
        "own": own.reshape(by_loss[:2]).mean(axis=0),
        "maps": maps,
    }


def _conclude(
    pads: Mapping[str, Morphology],
    parts: list[tuple[str, list[FailureSet]]],
    settings: Mapping[str, Any],
    states: list[State],
) -> Findings:
    rows, maps, by_subset = [], [], []
    for label, pad in pads.items():
        own = [(part, state) for (name, part), state in zip(parts, states, strict=True) if name == label]
        losses = [loss for part, _ in own for loss in part]
        fresh, seen, over = (np.concatenate([state[name] for _, state in own]) for name in ("fresh", "own", "maps"))
        sizes = np.array([len(loss) for loss in losses])
        for level in range(sizes.max() + 1):
            means = fresh[sizes == level]
            rows.append(
                {
                    "pad": label,
                    "n_failed": level,
                    "subsets": len(means),
                    "of": math.comb(pad.layout.fibres, level),
                    "mean": float(means.mean()),
                    "std": float(means.std()),
                    "max": float(means.max()),
                    "mean_mm": float(means.mean() * pad.unit_mm),
                    "max_mm": float(means.max() * pad.unit_mm),
                    "mean_trained_on": float(seen[sizes == level].mean()),
                }
            )
            # The worst set of each level, and where it is worst.
            worst = int(np.flatnonzero(sizes == level)[means.argmax()])
            shown = np.round(over[worst].reshape(SIDE, SIDE), 3)
            (left, low), (right, high) = between_fibres(pad.layout)
            told = {"pad": label, "failed": list(losses[worst]), "extent": [left, right, low, high]}
            maps.append(told | {"errors": shown.tolist()})
        by_subset += [
            {"pad": label, "failed": list(loss), "mean": float(mean)} for loss, mean in zip(losses, fresh, strict=True)
        ]
    return Findings(rows, _told(settings, rows), {"maps": maps, "by_subset": by_subset})


def _told(settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    drawn = (
        f" ({MOST_SETS} of them, drawn at random, where there are more)"
        if any(row["subsets"] < row["of"] for row in rows)
        else ""
    )
    text = [
        f"Networks of {settings['hidden']} neurons learnt from {settings['presses']} presses of a serpentine, another "
        f"one for every set of up to {max(row['n_failed'] for row in rows)} lost fibres{drawn}, and were tested on "
        f"{settings['test']} fresh "
        f"presses; errors are in grid units ({settings['signals']} signals). Sets of which there are few were trained "
        f"several times, so that at least {NETWORKS} networks stand behind each mean. The last column is the paper's "
        "own measure, taken over the serpentine, most of which was trained on."
    ]
    least, most = (
        {row["pad"]: row for row in rows if row["n_failed"] == level}
        for level in (0, max(row["n_failed"] for row in rows))
    )
    for label, row in least.items():
        said = f"{label}: {row['mean']:.3f} with all fibres ({row['mean_mm']:.2f} mm)"
        if label in most and most[label]["n_failed"] > 0:
            worst = most[label]
            said += (
                f", {worst['mean']:.3f} with {worst['n_failed']} lost ({worst['mean'] / row['mean']:.1f} times as much), "
                f"{worst['max']:.3f} with the worst {worst['n_failed']}"
            )
        text.append(f"{said}.")
    if len(most) > 1:
        order = sorted(most, key=lambda label: most[label]["mean"])
        worse = most[order[-1]]["mean"] / most[order[0]]["mean"]
        text.append(
            f"With {most[order[0]]['n_failed']} lost {order[0]} is the most accurate and {order[-1]} the least, "
            f"{worse:.1f} times as far off."
        )
    return text


def _draw(document: Mapping[str, Any]) -> Figure:
    """Errors by number of lost fibres, and maps of them before a loss and after the worst ones."""
    labels = list(document["settings"]["pads"])
    levels = 1 + max(row["n_failed"] for row in document["rows"])
    figure = Figure(figsize=(max(7.2, 1.9 * levels), 3.6 + 1.75 * len(labels)), layout="constrained")
    grid = figure.add_gridspec(1 + len(labels), levels, height_ratios=[1.9] + [1.0] * len(labels))
    axes = figure.add_subplot(grid[0, :])
    wide = 0.8 / len(labels)
    for place, label in enumerate(labels):
        rows = [row for row in document["rows"] if row["pad"] == label]
        at = np.array([row["n_failed"] for row in rows]) + wide * (place - (len(labels) - 1) / 2)
        means, stds = ([row[key] for row in rows] for key in ("mean", "std"))
        colour = CURVES[place % len(CURVES)]
        axes.bar(at, means, 0.9 * wide, yerr=stds, color=colour, alpha=0.85, ecolor=INK, label=label)
        axes.scatter(at, [row["max"] for row in rows], marker="_", s=60, color=colour)
    axes.set_xticks(range(levels), [f"{level} lost" if level else "all fibres" for level in range(levels)])
    axes.set_ylabel("mean error (grid units)")
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.legend(frameon=False, fontsize=8)
    axes.set_title("bar: mean over the sets; line: their spread; dash: the worst set", loc="left", fontsize=8.5)
    style_axes(axes)
    highest = float(np.quantile([each["errors"] for each in document["maps"]], 0.99))
    for place, label in enumerate(labels):
        for column, each in enumerate(each for each in document["maps"] if each["pad"] == label):
            axes = figure.add_subplot(grid[1 + place, column], aspect="equal")
            picture = axes.imshow(
                each["errors"], origin="lower", extent=each["extent"], cmap="magma_r", vmin=0, vmax=highest
            )
            axes.set(xticks=[], yticks=[])
            lost = "+".join(str(fibre + 1) for fibre in each["failed"])
            axes.set_title(f"without {lost}" if lost else "all fibres", fontsize=8, color=INK)
            if column == 0:
                axes.set_ylabel(label, fontsize=8, color=INK)
                figure.colorbar(picture, ax=axes, location="left", shrink=0.8).ax.tick_params(labelsize=7)
    return figure
