"""Sensitivity to the object: other objects than the pad was designed for, trained with or not (paper, figure 6)."""

import math
from collections.abc import Mapping
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import CURVES, INK
from padforge.design.contact import signals
from padforge.design.morphology import Morphology
from padforge.design.networks import SimulatedPresses, fit_batch
from padforge.design.settings import Contact
from padforge.sense.arrays import Array
from padforge.sense.studies.study import Study, StudyResult, Task, describe_pads, label_axes

MEMBERS = 6
"""Networks whose errors are averaged, since that of a single one depends on its first weights."""
SIDE, TEST, HIDDEN = 32, 2000, 50
RADII, SIDES = (0.6, 0.8, 1.0), (4, 30)  # sizes K, grid units, and shapes D of the object, which is a polygon


def sensitivity_study(pads: Mapping[str, Morphology], *, seed: int = 0) -> Study:
    """Compare errors for objects of several sizes and shapes, by networks trained with the same object or another."""
    objects = [Contact(radius=radius, sides=shape) for shape, radius in product(SIDES, RADII)]
    tasks = [
        Task(f"{label}, trained with K {each.radius:g}, D {each.sides}", partial(_evaluate, pad, each, objects, seed))
        for label, pad in pads.items()
        for each in objects
    ]
    settings = {
        "pads": describe_pads(pads),
        "radii": list(RADII),
        "sides": list(SIDES),
        "members": MEMBERS,
        "hidden": HIDDEN,
        "presses": SIDE**2,
        "test": TEST,
        "seed": seed,
    }
    conclude = partial(_conclude, dict(pads), objects, settings)
    return Study("sensitivity", "Sensitivity to the object that presses", settings, tasks, conclude, _draw)


def _evaluate(pad: Morphology, trained: Contact, objects: list[Contact], seed: int) -> State:
    """Compute mean errors (MEMBERS, objects), grid units, of networks trained with one object."""
    presses = SimulatedPresses.simulate(pad, SIDE, TEST, seed, lambda positions: signals(pad, positions, trained))
    rngs = np.random.default_rng([5, seed]).spawn(MEMBERS)
    networks = fit_batch(presses.train_signals, presses.train_positions, rngs, HIDDEN)
    tests = [signals(pad, presses.test_positions, contact) for contact in objects]
    errors = [
        [presses.position_errors(network, (), test, presses.test_positions).mean() for test in tests]
        for network in networks
    ]
    return {"errors": np.array(errors)}


def _conclude(
    pads: Mapping[str, Morphology], objects: list[Contact], settings: Mapping[str, Any], states: list[State]
) -> StudyResult:
    rows = []
    results = iter(states)
    for label, pad in pads.items():
        for trained in objects:
            rows += [
                {
                    "pad": label,
                    "trained_radius": trained.radius,
                    "trained_sides": trained.sides,
                    "radius": tested.radius,
                    "sides": tested.sides,
                    "mean": float(errors.mean()),
                    "std": float(errors.std()),
                    "mean_mm": float(errors.mean() * pad.unit_mm),
                }
                for tested, errors in zip(objects, next(results)["errors"].T, strict=True)
            ]
    return StudyResult(rows, _describe(settings, rows))


def _error_matrix(rows: list[dict[str, Any]], label: str) -> Array:
    """Return the mean errors of a pad by trained and tested object, each by shape, then size."""
    means = [row["mean"] for row in rows if row["pad"] == label]
    return np.reshape(means, (math.isqrt(len(means)), -1))


def _describe(settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    radii, sides = settings["radii"], settings["sides"]
    text = [
        f"Objects of {len(radii)} sizes (radius K in grid units) and {len(sides)} shapes (D sides) press every pad; "
        f"{settings['members']} networks of {settings['hidden']} neurons were trained on {settings['presses']} presses "
        f"with each object, and tested on {settings['test']} fresh presses with that one and with every other. "
        "Errors are in grid units."
    ]
    for label in settings["pads"]:
        matrix = _error_matrix(rows, label)
        trained = np.diag(matrix).reshape(len(sides), len(radii))
        small, *_, large = trained.mean(axis=0)
        shapes = trained.mean(axis=1)
        other = matrix[~np.eye(len(matrix), dtype=bool)]
        text.append(
            f"{label}: {small:.3f} with K {radii[0]:g}, {large:.3f} with K {radii[-1]:g}; "
            f"shapes differ by {100 * (shapes.max() / shapes.min() - 1):.0f} %. The mean error for an object that the "
            f"networks were not trained with is {other.mean():.3f}, at worst {other.max():.3f}, instead of "
            f"{trained.mean():.3f}."
        )
    return text


def _draw(document: Mapping[str, Any]) -> Figure:
    """Draw errors by size for every shape; and error matrices of trained by tested object."""
    rows, settings = document["rows"], document["settings"]
    labels, radii, sides = list(settings["pads"]), settings["radii"], settings["sides"]
    figure = Figure(figsize=(max(6.4, 2.6 * len(labels)), 6.4), layout="constrained")
    grid = figure.add_gridspec(2, len(labels), height_ratios=[1.0, 1.0])
    axes = figure.add_subplot(grid[0, :])
    for number, label in enumerate(labels):
        colour, trained = CURVES[number % len(CURVES)], np.diag(_error_matrix(rows, label)).reshape(len(sides), -1)
        for shape, style, errors in zip(sides, ("--", "-", ":", "-."), trained, strict=False):
            axes.plot(radii, errors, style, color=colour, marker="o", markersize=4, label=f"{label}, D {shape}")
    label_axes(axes, grid="y", xticks=radii, ylim=(0, None), ylabel="mean error (grid units)")
    axes.set_xlabel("size K of the object, trained and tested with (grid units)")
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    names = [f"{radius:g}/{shape}" for shape, radius in product(sides, radii)]
    highest = max(row["mean"] for row in rows)
    for number, label in enumerate(labels):
        axes = figure.add_subplot(grid[1, number], aspect="equal")
        matrix = _error_matrix(rows, label)
        axes.imshow(matrix, cmap="magma_r", vmin=0, vmax=highest)
        for (trained, tested), value in np.ndenumerate(matrix):
            colour = "w" if value > 0.6 * highest else INK
            axes.text(tested, trained, f"{value:.2f}", ha="center", va="center", fontsize=6, color=colour)
        axes.set_xticks(range(len(names)), names, fontsize=7, rotation=90)
        axes.set_yticks(range(len(names)), names if number == 0 else [""] * len(names), fontsize=7)
        axes.set_xlabel("tested with K/D", fontsize=8)
        axes.set_ylabel("trained with K/D" if number == 0 else "", fontsize=8)
        label_axes(axes, label)
    return figure
