"""Pairs of contacts: ways to learn where two are, when neither is the first of them.

Several contacts at once: where two are, whichever is named first, and how many there are (paper, III-D, fig. 9).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import CURVES, INK, add_title, draw_confusions, style_axes
from padforge.design.contact import signals
from padforge.design.morphology import Morphology
from padforge.design.networks import fresh_presses
from padforge.design.settings import PUBLISHED_CONTACT, between_fibres
from padforge.sense.arrays import Array
from padforge.sense.studies.indentation import COUNTS, readings
from padforge.sense.studies.study import Findings, Study, Task, described

LABELLED = "fixed labels"


@dataclass(frozen=True)
class Way:
    """How networks are taught pairs of contacts.

    Attributes:
        targets: from places (Q, 2, 2) of two contacts each, (A, Q, O) that are equally right.
        pairs: places (T, 2, 2) from what S networks give, (S, T, O).
    """

    targets: Callable[[Array], Array]
    pairs: Callable[[Array], Array]


def by_x(places: Array) -> Array:
    """Pairs (Q, 2, 2) with the contact of lower x first."""
    return np.take_along_axis(places, places[:, :, :1].argsort(axis=1), axis=1)


def both_orders(places: Array) -> Array:
    """(2, Q, 4): ordered by x, since networks learn better from an order that lasts than from one at random, and
    the other way round."""
    return np.stack([_flat(by_x(places)), _flat(by_x(places)[:, ::-1])])


def moments(places: Array) -> Array:
    """(Q, 5) of pairs (Q, 2, 2), the same in either order: their midpoint, and xx, xy, yy of half their difference."""
    half = (places[:, 0] - places[:, 1]) / 2
    return np.column_stack([places.mean(axis=1), half[:, 0] ** 2, half[:, 0] * half[:, 1], half[:, 1] ** 2])


def pairs_of_moments(found: Array) -> Array:
    """(T, 2, 2) pairs whose `moments` (T, 5) are the nearest: along the main axis, at either side of the midpoint."""
    squares, axes = np.linalg.eigh(found[:, [2, 3, 3, 4]].reshape(-1, 2, 2))
    half = np.sqrt(np.maximum(squares[:, 1:], 0)) * axes[:, :, 1]
    return found[:, None, :2] + np.stack([half, -half], axis=1)


def mean_of_unordered(found: Array) -> Array:
    """(T, 2, 2) mean of pairs that networks name in an order of their own, (S, T, 4): each turned as the first is."""
    named = found.reshape(*found.shape[:2], 2, 2)
    off, off_turned = (np.square(pairs - named[0]).sum(axis=(2, 3)) for pairs in (named, named[:, :, ::-1]))
    return np.where((off <= off_turned)[:, :, None, None], named, named[:, :, ::-1]).mean(axis=0)


def unordered_distances(found: Array, pressed: Array) -> Array:
    """(T,) mean distance of two contacts found to those pressed, both (T, 2, 2), in the order that makes it less."""
    off = np.linalg.norm(found[:, :, None] - pressed[:, None], axis=3)
    return np.minimum(off[:, 0, 0] + off[:, 1, 1], off[:, 0, 1] + off[:, 1, 0]) / 2


def _flat(places: Array) -> Array:
    return places.reshape(-1, 4)


def _mean(found: Array) -> Array:
    return found.mean(axis=0).reshape(-1, 2, 2)


WAYS = {
    LABELLED: Way(lambda places: _flat(places)[None], _mean),
    "sorted": Way(lambda places: _flat(by_x(places))[None], _mean),
    "free": Way(both_orders, mean_of_unordered),
    "moments": Way(lambda places: moments(places)[None], lambda found: pairs_of_moments(found.mean(axis=0))),
}
"""As published, in the order drawn; by x; with a loss that does not care for the order; by what has no order."""


def learnt(
    way: Way, given: Array, places: Array, rng: np.random.Generator, members: int, hidden: int, epochs: int
) -> Callable[[Array], Array]:
    """What finds pairs (T, 2, 2) from signals (T, D), having learnt from signals (Q, D) of pairs (Q, 2, 2)."""
    from padforge.design.networks import fit_batch

    targets = way.targets(places)
    networks = fit_batch(given, targets[0], rng.spawn(members), hidden, epochs, alternatives=targets[1:])
    return lambda signalled: way.pairs(np.stack([network(signalled) for network in networks]))


MEMBERS = 3
EPOCHS = 100
MOST = 3
"""Contacts at once, when they are counted."""
NOISE_COUNTS = 1.0
"""Noise of the readings by which contacts are counted, in counts of a 12-bit converter; places are found without."""
BINS = 16
"""Groups of as many pairs each, by how far apart the two contacts are."""
COUNTED = "number of contacts"
"""What stands for the way in tables and tasks that are not of pairs."""


def multicontact_study(
    pads: Mapping[str, Morphology],
    *,
    presses: int = 8192,
    test: int = 2000,
    hidden: int = 60,
    members: int = MEMBERS,
    epochs: int = EPOCHS,
    seed: int = 0,
) -> Study:
    """Places of two contacts at once by every one of WAYS, and the number of up to MOST contacts.

    Signals of contacts add, and contacts are drawn uniformly, independently of each other.

    Args:
        pads: by label. presses, test: how many are learnt from and tested on.
        hidden, epochs: of a network. members: networks whose mean is taken. seed: of presses, noise and networks.
    """
    numbers = (presses, test, members, hidden, epochs, seed)
    tasks = [
        Task(f"{label}, {name}", partial(work, *numbers))
        for label, pad in pads.items()
        for name, work in [
            *((name, partial(_located, pad, way)) for name, way in WAYS.items()),
            (COUNTED, partial(_counted, pad)),
        ]
    ]
    settings = {
        "pads": described(pads),
        "most": MOST,
        "noise_counts": NOISE_COUNTS,
        "presses": presses,
        "test": test,
        "members": members,
        "hidden": hidden,
        "epochs": epochs,
        "seed": seed,
    }
    conclude = partial(_conclude, dict(pads), settings)
    return Study("multicontact", "Several contacts at once", settings, tasks, conclude, _draw)


def _located(
    pad: Morphology, way: Way, presses: int, test: int, members: int, hidden: int, epochs: int, seed: int
) -> State:
    """The test pairs as they were made, "pressed", and as networks find them, "found": (T, 2, 2), grid units."""
    rng = np.random.default_rng([5, seed])
    places = _drawn(pad, presses + test, 2, rng)
    given = signals(pad, places, PUBLISHED_CONTACT)
    find = learnt(way, given[:presses], places[:presses], rng, members, hidden, epochs)
    return {"pressed": places[presses:], "found": find(given[presses:])}


def _counted(pad: Morphology, presses: int, test: int, members: int, hidden: int, epochs: int, seed: int) -> State:
    """Confusions (MOST+1, MOST+1) on the test presses: how often i contacts, by row, were taken for j."""
    from padforge.design.networks import fit_batch

    rng = np.random.default_rng([6, seed])
    places = _drawn(pad, presses + test, MOST, rng)
    number = rng.integers(MOST + 1, size=presses + test)
    alone = signals(pad, places.reshape(-1, 2), PUBLISHED_CONTACT).reshape(*places.shape[:2], -1)
    signalled = (alone * (np.arange(MOST) < number[:, None])[:, :, None]).sum(axis=1)
    read = readings(signalled, signalled[:presses].max(axis=0), NOISE_COUNTS, rng)
    networks = fit_batch(read[:presses], np.eye(MOST + 1)[number[:presses]], rng.spawn(members), hidden, epochs)
    found = np.mean([network(read[presses:]) for network in networks], axis=0).argmax(axis=1)
    confusions = np.zeros((MOST + 1, MOST + 1), dtype=np.int64)
    np.add.at(confusions, (number[presses:], found), 1)
    return {"confusions": confusions}


def _drawn(pad: Morphology, count: int, contacts: int, rng: np.random.Generator) -> Array:
    """(count, contacts, 2) places."""
    return fresh_presses(between_fibres(pad.layout), count * contacts, int(rng.integers(2**32))).reshape(
        count, contacts, 2
    )


def _conclude(pads: Mapping[str, Morphology], settings: Mapping[str, Any], states: list[State]) -> Findings:
    rows, curves, confusions = [], [], []
    results = iter(states)
    for label, pad in pads.items():
        found = {way: next(results) for way in WAYS}
        labelled = unordered_distances(**found[LABELLED]).mean()
        for way, pair in found.items():
            off = unordered_distances(**pair)
            half = np.linalg.norm(pair["pressed"][:, 0] - pair["pressed"][:, 1], axis=1) / 2
            as_drawn = np.linalg.norm(pair["found"] - pair["pressed"], axis=2).mean()
            curve = _by_distance(off * pad.unit_mm, 2 * half * pad.unit_mm)
            rows.append(
                {
                    "pad": label,
                    "way": way,
                    "error_grid": float(off.mean()),
                    "error_mm": float(off.mean() * pad.unit_mm),
                    "of_fixed_labels": float(off.mean() / labelled),
                    "error_by_labels_mm": float(as_drawn * pad.unit_mm) if way == LABELLED else None,
                    "midpoint_named_mm": float(half.mean() * pad.unit_mm),
                    "told_apart_from_mm": _told_apart_from(curve),
                    "accuracy_percent": None,
                    "guessed_percent": None,
                }
            )
            curves.append({"pad": label, "way": way, **curve})
        counts = next(results)["confusions"]
        rightly, most_frequent = np.trace(counts), counts.sum(axis=1).max()
        rows.append(
            {
                **dict.fromkeys(rows[-1]),
                "pad": label,
                "way": COUNTED,
                "accuracy_percent": float(100 * rightly / counts.sum()),
                "guessed_percent": float(100 * most_frequent / counts.sum()),
            }
        )
        confusions.append({"pad": label, "counts": counts.tolist()})
    return Findings(rows, _told(settings, rows), {"curves": curves, "confusions": confusions})


def _by_distance(off_mm: Array, apart_mm: Array) -> dict[str, list[float]]:
    """Means of pairs' errors (T,), and of how far apart they are, in BINS by the latter."""
    bins = np.array_split(np.argsort(apart_mm), min(BINS, len(apart_mm)))
    return {
        "apart_mm": [float(apart_mm[own].mean()) for own in bins],
        "error_mm": [float(off_mm[own].mean()) for own in bins],
    }


def _told_apart_from(curve: Mapping[str, list[float]]) -> float | None:
    """Distance, mm, from which on the mean error is less than a quarter of it."""
    told = None
    for apart, error in zip(reversed(curve["apart_mm"]), reversed(curve["error_mm"]), strict=True):
        if error >= apart / 4:
            break
        told = apart
    return told


def _told(settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    text = [
        "Two contacts press at once, each anywhere between the outermost fibres, and their signals add, without noise. "
        f"Networks of {settings['hidden']} neurons, of which the mean of {settings['members']} is taken, learnt from "
        f"{settings['presses']} pairs in at most {settings['epochs']} steps and were tested on {settings['test']} "
        "others. An error is the mean distance of both contacts, taken in the order of the two that makes it less. "
        "Fixed labels are the published way: contacts are learnt in the order they were drawn in. Sorted: by x. Free: "
        "a pair counts by the order its network comes nearest to. Moments: what has no order is learnt, the midpoint "
        "and the products of half the difference."
    ]
    for label in settings["pads"]:
        *ways, counted = (row for row in rows if row["pad"] == label)
        by_way = {row["way"]: row for row in ways}
        labelled, least = by_way[LABELLED], min(ways, key=lambda row: row["error_mm"])
        errors = ", ".join(f"{way} {row['error_mm']:.2f} mm" for way, row in by_way.items())
        text.append(
            f"{label}: {errors}. By its own labels the published way is {labelled['error_by_labels_mm']:.2f} mm off; "
            f"naming the midpoint of the two for both would be {labelled['midpoint_named_mm']:.2f} mm off. Free has "
            f"{by_way['free']['of_fixed_labels']:.2f} of the error of fixed labels; least is that of {least['way']}, "
            f"{least['of_fixed_labels']:.2f} of it, which is "
            + (
                "a quarter of the distance of the two or more even for the farthest pairs. "
                if least["told_apart_from_mm"] is None
                else "less than a quarter of the distance of the two, half of what naming the midpoint costs, from "
                f"about {least['told_apart_from_mm']:.1f} mm on. "
            )
            + f"Of up to {settings['most']} contacts, read with noise of {settings['noise_counts']:g} of "
            f"{COUNTS} counts, {counted['accuracy_percent']:.1f} % are counted rightly (always naming the most "
            f"frequent number: {counted['guessed_percent']:.1f} %)."
        )
    return text


def _draw(document: Mapping[str, Any]) -> Figure:
    """The error by way and pad; under it, for every pad, the error by distance, and confusions of the number."""
    labels = list(document["settings"]["pads"])
    figure = Figure(figsize=(max(8.0, 1.2 + 2.9 * len(labels)), 9.6), layout="constrained")
    grid = figure.add_gridspec(3, len(labels), height_ratios=[1, 1, 1.1])
    colours = dict(zip(WAYS, CURVES, strict=False))
    _draw_bars(figure.add_subplot(grid[0, :]), document["rows"], labels, colours)
    most = max(max(curve["error_mm"]) for curve in document["curves"])
    for at, label in enumerate(labels):
        axes = figure.add_subplot(grid[1, at])
        own = [curve for curve in document["curves"] if curve["pad"] == label]
        for curve in own:
            axes.plot(curve["apart_mm"], curve["error_mm"], color=colours[curve["way"]], marker="o", markersize=2.5)
        ends = np.array([0, own[0]["apart_mm"][-1]])
        axes.plot(ends, ends / 2, "--", color=INK, linewidth=0.8, label="midpoint named for both")
        axes.plot(ends, ends / 4, ":", color=INK, linewidth=0.8, label="a quarter of the distance")
        axes.set_ylim(0, 1.05 * most)
        axes.set_title(label, loc="left", color=INK, fontsize=10)
        axes.set(xlabel="distance of the two contacts (mm)", ylabel="mean error (mm)" if at == 0 else "")
        axes.legend(frameon=False, fontsize=8, loc="upper left")
        style_axes(axes)
        _draw_confusions(figure.add_subplot(grid[2, at]), document["confusions"][at]["counts"], at == 0)
    add_title(
        figure,
        f"Contacts at once on {document['settings']['test']} presses never trained on: places of two, number of up to "
        f"{document['settings']['most']}",
    )
    return figure


def _draw_bars(axes: Any, rows: list[dict[str, Any]], labels: list[str], colours: Mapping[str, str]) -> None:
    width = 0.8 / len(colours)
    for at, (way, colour) in enumerate(colours.items()):
        errors = [row["error_mm"] for row in rows if row["way"] == way]
        places = np.arange(len(labels)) + (at - (len(colours) - 1) / 2) * width
        bars = axes.bar(places, errors, 0.92 * width, color=colour, label=way)
        axes.bar_label(bars, fmt="%.1f", fontsize=8, color=INK, padding=1)
    axes.set_xticks(range(len(labels)), labels)
    axes.set_ylabel("mean error, two contacts (mm)")
    axes.legend(frameon=False, fontsize=8, ncols=len(colours), loc="lower left", bbox_to_anchor=(0, 1))
    style_axes(axes)


def _draw_confusions(axes: Any, counts: list[list[int]], first: bool) -> None:
    draw_confusions(axes, counts)
    axes.set(xticks=range(len(counts)), yticks=range(len(counts)))
    axes.set_title(f"number: {100 * np.trace(counts) / np.sum(counts):.0f} % right", loc="left", color=INK, fontsize=10)
    axes.set_xlabel("contacts found", color=INK)
    axes.set_ylabel("contacts pressed" if first else "", color=INK)
