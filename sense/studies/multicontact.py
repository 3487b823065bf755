"""Several contacts at once: the positions of two, in any order, and the number of contacts (paper, III-D, fig. 9).

Networks learn pairs of positions, which have no order. Four kinds of targets are compared: the published ones, in the
order drawn; those ordered by x; those in the order nearest to the outputs, by a loss that is invariant to the order;
and moments, which have no order.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from padforge.common.parallel import State
from padforge.common.plotting import CURVES, INK, add_title
from padforge.design.morphology import Morphology
from padforge.design.published.networks import fit_batch, fresh_presses
from padforge.design.settings import between_fibres
from padforge.sense.arrays import Array
from padforge.sense.simulation.pad_model import ADC_STEPS
from padforge.sense.studies.press_model import PUBLISHED_PRESSES, PressModel
from padforge.sense.studies.study import (
    Sizes,
    Study,
    StudyResult,
    Task,
    classification_scores,
    classify,
    describe_pads,
    draw_confusions,
    label_axes,
    read_counts,
)

SIZES = Sizes(8192, 2000, hidden=60, epochs=100)
LABELLED = "fixed labels"
MAX_CONTACTS = 3  # at once, where they are counted
NOISE_COUNTS = 1.0
"""Noise of the readings by which contacts are counted, in counts of a 12-bit converter; positions are without it."""
BINS = 16  # groups of equally many pairs, by the distance of the two contacts
COUNTING = "number of contacts"  # method of the rows in which contacts are counted


class PairTargets(NamedTuple):
    """Targets of networks that learn pairs of contacts."""

    encode: Callable[[Array], Array]  # from pairs (Q, 2, 2) to A equally valid targets (A, Q, O)
    decode: Callable[[Array], Array]  # from the outputs of S networks (S, T, O) to pairs (T, 2, 2)


def both_orders(pairs: Array) -> Array:
    """Return both orders of pairs; shape (2, Q, 4); by x first, since a constant order is easier to learn from."""
    ordered = np.take_along_axis(pairs, pairs[:, :, :1].argsort(axis=1), axis=1)
    return np.stack([ordered, ordered[:, ::-1]]).reshape(2, -1, 4)


def moments(pairs: Array) -> Array:
    """Return the midpoint of pairs (Q, 2, 2), and xx, xy, yy of half their difference; shape (Q, 5)."""
    half = (pairs[:, 0] - pairs[:, 1]) / 2
    return np.column_stack([pairs.mean(axis=1), half[:, 0] ** 2, half[:, 0] * half[:, 1], half[:, 1] ** 2])


def pairs_from_moments(values: Array) -> Array:
    """Return the pairs (T, 2, 2) with the nearest `moments` (T, 5): on the main axis, at both sides of the midpoint."""
    squares, axes = np.linalg.eigh(values[:, [2, 3, 3, 4]].reshape(-1, 2, 2))
    half = np.sqrt(np.maximum(squares[:, 1:], 0)) * axes[:, :, 1]
    return values[:, None, :2] + np.stack([half, -half], axis=1)


def mean_of_unordered(outputs: Array) -> Array:
    """Return the mean (T, 2, 2) of pairs (S, T, 4) of several networks, each in the order of the first network's."""
    pairs = outputs.reshape(*outputs.shape[:2], 2, 2)
    reversed_pairs = pairs[:, :, ::-1]
    error, reversed_error = (np.square(each - pairs[0]).sum(axis=(2, 3)) for each in (pairs, reversed_pairs))
    return np.where((error <= reversed_error)[:, :, None, None], pairs, reversed_pairs).mean(axis=0)


def unordered_distances(predicted: Array, pressed: Array) -> Array:
    """Return the mean distance (T,) of pairs (T, 2, 2) to those pressed, in the order that makes it less."""
    distance = np.linalg.norm(predicted[:, :, None] - pressed[:, None], axis=3)
    return np.minimum(distance[:, 0, 0] + distance[:, 1, 1], distance[:, 0, 1] + distance[:, 1, 0]) / 2


def _mean(outputs: Array) -> Array:
    return outputs.mean(axis=0).reshape(-1, 2, 2)


METHODS = {
    LABELLED: PairTargets(lambda pairs: pairs.reshape(1, -1, 4), _mean),
    "sorted": PairTargets(lambda pairs: both_orders(pairs)[:1], _mean),
    "free": PairTargets(both_orders, mean_of_unordered),
    "moments": PairTargets(
        lambda pairs: moments(pairs)[None], lambda outputs: pairs_from_moments(outputs.mean(axis=0))
    ),
}


def fit_pairs(
    method: PairTargets, inputs: Array, pairs: Array, rng: np.random.Generator, sizes: Sizes
) -> Callable[[Array], Array]:
    """Fit networks to signals (Q, D) of pairs (Q, 2, 2); the result predicts pairs (T, 2, 2) from signals (T, D)."""
    targets, rngs = method.encode(pairs), rng.spawn(sizes.members)
    networks = fit_batch(inputs, targets[0], rngs, sizes.hidden, sizes.epochs, alternatives=targets[1:])
    return lambda features: method.decode(np.stack([network(features) for network in networks]))


def multicontact_study(
    pads: Mapping[str, Morphology], *, press_model: PressModel = PUBLISHED_PRESSES, sizes: Sizes = SIZES, seed: int = 0
) -> Study:
    """Localize two contacts at once by each of METHODS, and count up to MAX_CONTACTS contacts.

    Responses to contacts add, and contacts are drawn uniformly and independently.
    """
    work = {name: partial(_localize_pairs, method) for name, method in METHODS.items()} | {COUNTING: _count_contacts}
    tasks = [
        Task(f"{label}, {name}", partial(compute, pad=pad, press_model=press_model, sizes=sizes, seed=seed))
        for label, pad in pads.items()
        for name, compute in work.items()
    ]
    settings = {
        "pads": describe_pads(pads),
        **press_model.to_dict(),
        "max_contacts": MAX_CONTACTS,
        "noise_counts": NOISE_COUNTS,
        "seed": seed,
        **asdict(sizes),
    }
    conclude = partial(_conclude, dict(pads), settings, press_model.describe())
    return Study("multicontact", "Several contacts at once", settings, tasks, conclude, _draw)


def _localize_pairs(method: PairTargets, pad: Morphology, press_model: PressModel, sizes: Sizes, seed: int) -> State:
    """Return the test pairs "pressed" and "predicted"; shape (T, 2, 2), grid units."""
    rng, n = np.random.default_rng([5, seed]), sizes.presses
    pairs = _draw_contacts(pad, n + sizes.test, 2, rng)
    inputs = press_model.respond(pad, pairs, np.random.default_rng([5, seed, 0]))
    predict = fit_pairs(method, inputs[:n], pairs[:n], rng, sizes)
    return {"pressed": pairs[n:], "predicted": predict(inputs[n:])}


def _count_contacts(pad: Morphology, press_model: PressModel, sizes: Sizes, seed: int) -> State:
    """Return the confusions (MAX_CONTACTS + 1, MAX_CONTACTS + 1) of the number of contacts on the test presses."""
    rng, count = np.random.default_rng([6, seed]), sizes.presses + sizes.test
    positions = _draw_contacts(pad, count, MAX_CONTACTS, rng)
    number = rng.integers(MAX_CONTACTS + 1, size=count)
    present = np.arange(MAX_CONTACTS) < number[:, None]
    summed = press_model.respond(pad, positions, np.random.default_rng([6, seed, 0]), present)
    return classify(read_counts(summed, sizes.presses, NOISE_COUNTS, rng), number, MAX_CONTACTS + 1, rng, sizes)


def _draw_contacts(pad: Morphology, count: int, contacts: int, rng: np.random.Generator) -> Array:
    """Draw positions (count, contacts, 2)."""
    positions = fresh_presses(between_fibres(pad.layout), count * contacts, int(rng.integers(2**32)))
    return positions.reshape(count, contacts, 2)


def _conclude(
    pads: Mapping[str, Morphology], settings: Mapping[str, Any], responses: str, states: list[State]
) -> StudyResult:
    rows, curves, confusions = [], [], []
    results = iter(states)
    for label, pad in pads.items():
        pairs = {method: next(results) for method in METHODS}
        labelled = unordered_distances(**pairs[LABELLED]).mean()
        for method, state in pairs.items():
            errors = unordered_distances(**state)
            half = np.linalg.norm(state["pressed"][:, 0] - state["pressed"][:, 1], axis=1) / 2
            as_labelled = np.linalg.norm(state["predicted"] - state["pressed"], axis=2).mean()
            curve = _errors_by_distance(errors * pad.unit_mm, 2 * half * pad.unit_mm)
            row = {
                "pad": label,
                "method": method,
                "error_grid": float(errors.mean()),
                "error_mm": float(errors.mean() * pad.unit_mm),
                "of_fixed_labels": float(errors.mean() / labelled),
                "error_by_labels_mm": float(as_labelled * pad.unit_mm) if method == LABELLED else None,
                "midpoint_error_mm": float(half.mean() * pad.unit_mm),
                "resolution_mm": _resolution_mm(curve),
                "accuracy_percent": None,
                "majority_percent": None,
            }
            rows.append(row)
            curves.append({"pad": label, "method": method, **curve})
        counts = next(results)["confusions"]
        rows.append(dict.fromkeys(rows[-1]) | {"pad": label, "method": COUNTING} | classification_scores(counts))
        confusions.append({"pad": label, "counts": counts.tolist()})
    return StudyResult(rows, [_describe(settings, responses)], {"curves": curves, "confusions": confusions})


def _errors_by_distance(errors_mm: Array, distances_mm: Array) -> dict[str, list[float]]:
    """Return mean errors and mean distances of pairs (T,), in BINS by distance."""
    bins = np.array_split(np.argsort(distances_mm), min(BINS, len(distances_mm)))
    return {
        "distance_mm": [float(distances_mm[members].mean()) for members in bins],
        "error_mm": [float(errors_mm[members].mean()) for members in bins],
    }


def _resolution_mm(curve: Mapping[str, list[float]]) -> float | None:
    """Return the distance from which on the mean error is less than a quarter of it; None if it never is."""
    farthest_first = zip(reversed(curve["distance_mm"]), reversed(curve["error_mm"]), strict=True)
    resolved = list(takewhile(lambda pair: pair[1] < pair[0] / 4, farthest_first))
    return resolved[-1][0] if resolved else None


def _describe(settings: Mapping[str, Any], responses: str) -> str:
    return (
        f"Two contacts press at once, each anywhere between the outermost fibres, and their strains add. {responses} "
        f"Networks of {settings['hidden']} neurons, of which the mean of {settings['members']} is taken, were trained "
        f"on {settings['presses']} pairs in at most {settings['epochs']} steps and tested on {settings['test']} "
        "others. An error is the mean distance of both contacts, in the order of the two that makes it less. Fixed "
        "labels are the published method: contacts are learnt in the order they were drawn in. Sorted: by x. Free: in "
        "the order that the network comes nearest to. Moments: the midpoint and the products of half the difference. "
        "The midpoint error is that of predicting their midpoint for both, the resolution the distance from which on "
        f"the error is less than a quarter of it. Of up to {settings['max_contacts']} contacts, the number is read "
        f"with noise of {settings['noise_counts']:g} of {ADC_STEPS} counts; the majority is the share of the most "
        "frequent one."
    )


def _draw(document: Mapping[str, Any]) -> Figure:
    """Draw errors by method and pad; and for every pad errors by distance, and confusions of the number."""
    labels = list(document["settings"]["pads"])
    figure = Figure(figsize=(max(8.0, 1.2 + 2.9 * len(labels)), 9.6), layout="constrained")
    grid = figure.add_gridspec(3, len(labels), height_ratios=[1, 1, 1.1])
    colours = dict(zip(METHODS, CURVES, strict=False))
    _draw_bars(figure.add_subplot(grid[0, :]), document["rows"], labels, colours)
    highest = max(max(curve["error_mm"]) for curve in document["curves"])
    for column, label in enumerate(labels):
        axes = figure.add_subplot(grid[1, column])
        curves = [curve for curve in document["curves"] if curve["pad"] == label]
        for curve in curves:
            colour = colours[curve["method"]]
            axes.plot(curve["distance_mm"], curve["error_mm"], color=colour, marker="o", markersize=2.5)
        ends = np.array([0, curves[0]["distance_mm"][-1]])
        axes.plot(ends, ends / 2, "--", color=INK, linewidth=0.8, label="midpoint for both")
        axes.plot(ends, ends / 4, ":", color=INK, linewidth=0.8, label="a quarter of the distance")
        axes.set_ylim(0, 1.05 * highest)
        ylabel = "" if column else "mean error (mm)"
        label_axes(axes, label, xlabel="distance of the two contacts (mm)", ylabel=ylabel)
        axes.legend(frameon=False, fontsize=8, loc="upper left")
        axes, counts = figure.add_subplot(grid[2, column]), document["confusions"][column]["counts"]
        title = f"number: {100 * np.trace(counts) / np.sum(counts):.0f} % correct"
        draw_confusions(axes, counts, title, "contacts predicted", "" if column else "contacts pressed")
        axes.set(xticks=range(len(counts)), yticks=range(len(counts)))
    test, most = document["settings"]["test"], document["settings"]["max_contacts"]
    add_title(figure, f"{test} presses never trained on: positions of two contacts, number of up to {most}")
    return figure


def _draw_bars(axes: Any, rows: list[dict[str, Any]], labels: list[str], colours: Mapping[str, str]) -> None:
    width = 0.8 / len(colours)
    for number, (method, colour) in enumerate(colours.items()):
        errors = [row["error_mm"] for row in rows if row["method"] == method]
        x = np.arange(len(labels)) + (number - (len(colours) - 1) / 2) * width
        bars = axes.bar(x, errors, 0.92 * width, color=colour, label=method)
        axes.bar_label(bars, fmt="%.1f", fontsize=8, color=INK, padding=1)
    axes.set_xticks(range(len(labels)), labels)
    axes.legend(frameon=False, fontsize=8, ncols=len(colours), loc="lower left", bbox_to_anchor=(0, 1))
    label_axes(axes, ylabel="mean error, two contacts (mm)")
