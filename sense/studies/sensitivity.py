"""Sensitivity: other objects than the pad was meant for, known beforehand or met unawares (paper, figure 6)."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import CURVES, FAINT, INK, style_axes
from padforge.design.contact import signals
from padforge.design.morphology import Morphology
from padforge.design.networks import SimulatedPresses, fit_batch
from padforge.design.settings import Contact
from padforge.sense.studies.study import Findings, Study, Task, described

MEMBERS = 6
"""Networks whose errors are averaged, for what one network comes to is luck."""
SIDE, TEST, HIDDEN = 32, 2000, 50


def sensitivity_study(
    pads: Mapping[str, Morphology],
    *,
    radii: Sequence[float] = (0.6, 0.8, 1.0),
    sides: Sequence[int] = (4, 30),
    seed: int = 0,
) -> Study:
    """Errors for objects of several sizes and shapes, of networks trained with the same object or with another.

    Args:
        pads: by label. radii: sizes K of the object, grid units. sides: its shapes D. seed: of presses and networks.

    Raises:
        InputError: a radius or number of sides that a contact cannot have.
    """
    objects = [Contact(radius=radius, sides=shape) for shape, radius in product(sides, radii)]
    tasks = [
        Task(f"{label}, trained with {_name(own)}", partial(_found, pad, own, objects, seed))
        for label, pad in pads.items()
        for own in objects
    ]
    settings = {
        "pads": described(pads),
        "radii": list(radii),
        "sides": list(sides),
        "members": MEMBERS,
        "hidden": HIDDEN,
        "presses": SIDE**2,
        "test": TEST,
        "seed": seed,
    }
    conclude = partial(_conclude, dict(pads), objects, settings)
    return Study("sensitivity", "Sensitivity to the object that presses", settings, tasks, conclude, _draw)


def _name(contact: Contact) -> str:
    return f"K {contact.radius:g}, D {contact.sides}"


def _found(pad: Morphology, own: Contact, objects: list[Contact], seed: int) -> State:
    """Mean errors (MEMBERS, objects) of networks trained with the object `own`, grid units."""
    trial = SimulatedPresses.simulate(pad, SIDE, TEST, seed, lambda places: signals(pad, places, own))
    rngs = np.random.default_rng([5, seed]).spawn(MEMBERS)
    networks = fit_batch(trial.train_signals, trial.train_positions, rngs, HIDDEN)
    met = [signals(pad, trial.test_positions, contact) for contact in objects]
    return {
        "errors": np.array(
            [
                [trial.position_errors(network, (), given, trial.test_positions).mean() for given in met]
                for network in networks
            ]
        )
    }


def _conclude(
    pads: Mapping[str, Morphology], objects: list[Contact], settings: Mapping[str, Any], states: list[State]
) -> Findings:
    rows = []
    results = iter(states)
    for label, pad in pads.items():
        for own in objects:
            errors = next(results)["errors"]
            rows += [
                {
                    "pad": label,
                    "trained_radius": own.radius,
                    "trained_sides": own.sides,
                    "radius": met.radius,
                    "sides": met.sides,
                    "mean": float(each.mean()),
                    "std": float(each.std()),
                    "mean_mm": float(each.mean() * pad.unit_mm),
                }
                for met, each in zip(objects, errors.T, strict=True)
            ]
    return Findings(rows, _told(settings, rows))


def _matched(rows: list[dict[str, Any]], pad: str, radius: float, sides: int) -> float:
    """Mean error on an object that the networks were trained with."""
    wanted = {"pad": pad, "trained_radius": radius, "trained_sides": sides, "radius": radius, "sides": sides}
    return next(row["mean"] for row in rows if wanted.items() <= row.items())


def _told(settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    radii, sides = settings["radii"], settings["sides"]
    text = [
        f"Objects of {len(radii)} sizes (radius K in grid units) and {len(sides)} shapes (D sides) press every pad; "
        f"{settings['members']} networks of {settings['hidden']} neurons learnt from {settings['presses']} presses "
        f"with each object, and were tested on {settings['test']} fresh presses with that one and with every other. "
        "Errors are in grid units."
    ]
    for label in settings["pads"]:
        small, large = (np.mean([_matched(rows, label, radius, d) for d in sides]) for radius in (radii[0], radii[-1]))
        shapes = [np.mean([_matched(rows, label, radius, d) for radius in radii]) for d in sides]
        own = [row["mean"] for row in rows if row["pad"] == label and _trained(row)]
        met = [row["mean"] for row in rows if row["pad"] == label and not _trained(row)]
        text.append(
            f"{label}: {small:.3f} with K {radii[0]:g}, {large:.3f} with K {radii[-1]:g}; "
            f"shapes differ by {100 * (max(shapes) / min(shapes) - 1):.0f} %. An object the networks were not "
            f"trained with is located {np.mean(met):.3f} off on average, at worst {max(met):.3f}, instead of "
            f"{np.mean(own):.3f}."
        )
    return text


def _trained(row: Mapping[str, Any]) -> bool:
    return (row["trained_radius"], row["trained_sides"]) == (row["radius"], row["sides"])


def _draw(document: Mapping[str, Any]) -> Figure:
    """Errors by size of the object for every shape, and errors on objects that were not trained with."""
    rows, settings = document["rows"], document["settings"]
    labels, radii, sides = list(settings["pads"]), settings["radii"], settings["sides"]
    figure = Figure(figsize=(max(6.4, 2.6 * len(labels)), 6.4), layout="constrained")
    grid = figure.add_gridspec(2, len(labels), height_ratios=[1.0, 1.0])
    axes = figure.add_subplot(grid[0, :])
    for number, label in enumerate(labels):
        for shape, style in zip(sides, ("--", "-", ":", "-."), strict=False):
            errors = [_matched(rows, label, radius, shape) for radius in radii]
            colour = CURVES[number % len(CURVES)]
            axes.plot(radii, errors, style, color=colour, marker="o", markersize=4, label=f"{label}, D {shape}")
    axes.set(
        xticks=radii,
        ylim=(0, None),
        xlabel="size K of the object, trained and pressed with (grid units)",
        ylabel="mean error (grid units)",
    )
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    style_axes(axes)
    names = [f"{radius:g}/{shape}" for shape, radius in product(sides, radii)]
    for number, label in enumerate(labels):
        axes = figure.add_subplot(grid[1, number], aspect="equal")
        errors = np.array([row["mean"] for row in rows if row["pad"] == label]).reshape(len(names), len(names))
        axes.imshow(errors, cmap="magma_r", vmin=0, vmax=max(row["mean"] for row in rows))
        for (trained, met), value in np.ndenumerate(errors):
            dark = value > 0.6 * max(row["mean"] for row in rows)
            axes.text(met, trained, f"{value:.2f}", ha="center", va="center", fontsize=6, color="w" if dark else INK)
        axes.set_xticks(range(len(names)), names, fontsize=7, rotation=90)
        axes.set_yticks(range(len(names)), names if number == 0 else [""] * len(names), fontsize=7)
        axes.set_xlabel("pressed with K/D", fontsize=8)
        axes.set_ylabel("trained with K/D" if number == 0 else "", fontsize=8)
        axes.set_title(label, loc="left", fontsize=9, color=INK)
        style_axes(axes)
    return figure
