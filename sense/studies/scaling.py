"""Scaling: larger surfaces, located from as many presses by networks as large (paper, figures 7 and 8).

The paper's way learns from a serpentine of presses, which on the larger grids all lie at the same phase to the fibres,
and is judged on those presses themselves. Beside it stands a way that is judged on fresh presses: it learns from
presses spread over the whole surface, and is given what share of its family's signal each fibre has, which makes the
place an almost linear function of the inputs whatever the size. The third way uses that tiles are alike: where fibres
signal most tells the tile, and one network, given the fibres of that tile and its neighbours, tells where in the tile.
All presses teach it whatever tile they are in, so that neither its size nor its error need grow with the surface."""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.parallel import State
from padforge.design.common.plotting import CURVES, FAINT, INK, style_axes
from padforge.design.common.validation import InputError
from padforge.design.contact import signals
from padforge.design.morphology import Morphology
from padforge.design.networks import fit_batch, fresh_presses, training_presses
from padforge.design.settings import PUBLISHED_CONTACT, Rectangle, between_fibres
from padforge.sense.arrays import Array
from padforge.sense.studies.study import Findings, Study, Task, described

GRIDS = (4, 8, 16, 32, 64, 128)
PUBLISHED, SPREAD, SHARED = "published", "spread", "shared"
WAYS = (PUBLISHED, SPREAD, SHARED)
HIDDEN = 70
EPOCHS = 60
TEST = 4096
CELLS = 16
"""Cells along a side of a map of errors."""


def scaling_study(
    pads: Mapping[str, Morphology], *, grids: Sequence[int] = GRIDS, side: int = 64, seed: int = 0
) -> Study:
    """Errors on surfaces of growing grids, each pad repeated over them as a tile.

    Args:
        pads: tiles by label. grids: sizes of the surfaces, multiples of every tile's.
        side: of the square of presses, side^2 to learn from. seed: of presses and networks.

    Raises:
        InputError: a tile that is no square of one pitch, or a grid that is no multiple of a tile's.
    """
    for label, pad in pads.items():
        if not pad.layout.is_square:
            raise InputError(f"{label} has {pad.layout}, expected tiles of M + M fibres of one pitch")
        for grid in grids:
            if grid % pad.grid:
                raise InputError(f"grids has {grid}, expected multiples of {pad.grid}, the grid of {label}")
    cases = [(label, grid, way) for grid in grids[::-1] for label in pads for way in WAYS]
    tasks = [
        Task(f"{label}, {grid} x {grid}, {way}", partial(_found, pads[label], grid, way, side, seed))
        for label, grid, way in cases
    ]
    settings = {
        "pads": described(pads),
        "grids": list(grids),
        "presses": side**2,
        "hidden": HIDDEN,
        "epochs": EPOCHS,
        "test": TEST,
        "seed": seed,
    }
    return Study("scaling", "Larger surfaces", settings, tasks, partial(_conclude, dict(pads), cases, settings), _draw)


def spread_presses(rectangle: Rectangle, side: int, seed: int) -> Array:
    """(side^2, 2) presses, one at random in each of side x side cells of a rectangle, grid units."""
    low, high = np.array(rectangle)
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    places = cells + np.random.default_rng([6, seed]).uniform(size=cells.shape)
    return low + (high - low) / side * places


def shares(given: Array) -> Array:
    """(Q, 2M) signals as shares of their family's sum, and the two sums: (Q, 2M + 2); shares of no signal are 0."""
    families = np.split(given, 2, axis=1)
    sums = [family.sum(axis=1, keepdims=True) for family in families]
    parts = [np.divide(f, s, out=np.zeros_like(f), where=s > 0) for f, s in zip(families, sums, strict=True)]
    return np.hstack([*parts, *sums])


def around(given: Array, tile: int) -> tuple[Array, Array]:
    """(Q, 6 tile) signals of the fibres of the tile a press is in and of those beside it, and (Q, 2) where that tile
    begins, grid units.

    In each family it is the tile whose fibres signal most, and one in the middle where none does; beyond the edge there
    are no fibres, and no signal.

    Args:
        given: (Q, 2M) signals. tile: fibres a family of a tile.
    """
    windows, origins = [], []
    # The vertical fibres tell x, the horizontal ones y.
    for family in np.split(given, 2, axis=1)[::-1]:
        sums = family.reshape(len(family), -1, tile).sum(axis=2)
        number = np.where(sums.any(axis=1), sums.argmax(axis=1), sums.shape[1] // 2)
        padded = np.pad(family, ((0, 0), (tile, tile)))
        columns = number[:, None] * tile + np.arange(3 * tile)
        windows.append(np.take_along_axis(padded, columns, axis=1))
        origins.append(number * tile)
    return np.hstack(windows), np.column_stack(origins).astype(float)


def _found(tile: Morphology, grid: int, way: str, side: int, seed: int) -> State:
    """Errors (Q,) and places (Q, 2) of the presses that a way is judged on, and how long it learnt."""
    pad = tile.tiled(grid // tile.grid) if grid > tile.grid else tile
    pressed, begin = between_fibres(pad.layout), time.perf_counter()
    if way == PUBLISHED:
        learned = judged = training_presses(pressed, side, seed)
    else:
        learned, judged = spread_presses(pressed, side, seed), fresh_presses(pressed, TEST, seed)

    def given(places: Array) -> tuple[Array, Array]:
        """Inputs of the network, and the places (Q, 2) its outputs count from."""
        found = signals(pad, places, PUBLISHED_CONTACT)
        if way == SHARED:
            return around(found, tile.grid)
        return found if way == PUBLISHED else shares(found), np.zeros((len(places), 2))

    inputs, origins = given(learned)
    told = np.ones(len(learned), dtype=bool)
    if way == SHARED and grid > tile.grid:
        # Where a family is silent the tile is unknown; there is nothing to learn from where in a wrong one a press is.
        told = np.all([part.any(axis=1) for part in np.split(inputs, 2, axis=1)], axis=0)
    rng = np.random.default_rng([8, seed])
    network = fit_batch(inputs[told], (learned - origins)[told], [rng], HIDDEN, EPOCHS)[0]
    seconds = time.perf_counter() - begin
    inputs, origins = given(judged)
    errors = np.linalg.norm(origins + network(inputs) - judged, axis=1)
    return {"errors": errors, "places": judged, "seconds": np.array(seconds), "epochs": np.array(network.epochs)}


def _conclude(
    pads: Mapping[str, Morphology], cases: list[tuple[str, int, str]], settings: Mapping[str, Any], states: list[State]
) -> Findings:
    rows, maps = [], []
    by_case = dict(zip(cases, states, strict=True))
    for label in pads:
        for way in WAYS:
            for grid in settings["grids"]:
                state = by_case[label, grid, way]
                errors = state["errors"]
                rows.append(
                    {
                        "pad": label,
                        "way": way,
                        "grid": grid,
                        "mean": float(errors.mean()),
                        "median": float(np.median(errors)),
                        "p95": float(np.quantile(errors, 0.95)),
                        "percent_of_side": float(100 * errors.mean() / grid),
                        "epochs": int(state["epochs"]),
                        "seconds": round(float(state["seconds"]), 2),
                    }
                )
                if way == SPREAD:
                    maps.append({"pad": label, "grid": grid, "errors": _map(grid, state).tolist()})
    return Findings(rows, _told(settings, rows), {"maps": maps})


def _map(grid: int, state: State) -> Array:
    """(CELLS, CELLS) mean errors by place."""
    low = 1 if grid > 1 else 0.5
    cells = np.clip(((state["places"] - low) / max(grid - 1, 1) * CELLS).astype(int), 0, CELLS - 1)
    total, count = np.zeros((2, CELLS, CELLS))
    np.add.at(total, (cells[:, 1], cells[:, 0]), state["errors"])
    np.add.at(count, (cells[:, 1], cells[:, 0]), 1)
    return np.round(total / np.maximum(count, 1), 4)


def _told(settings: Mapping[str, Any], rows: list[dict[str, Any]]) -> list[str]:
    text = [
        f"Networks of {settings['hidden']} neurons learnt from {settings['presses']} presses, for every size of the "
        f"surface alike, in at most {settings['epochs']} steps. The published way learns the signals of a serpentine "
        "and is judged on it, most of which was trained on; the other one learns each fibre's share of its family's "
        f"signal from presses spread evenly, and is judged on {settings['test']} fresh ones. The third, shared way "
        "learns from the same presses where in its tile each is, one network for all tiles. Errors are in grid units."
    ]
    for label in settings["pads"]:
        for way in WAYS:
            own = [row for row in rows if (row["pad"], row["way"]) == (label, way)]
            below = [row["grid"] for row in own if row["mean"] < 0.5]
            reach = (
                f"below half a grid unit on grids {', '.join(map(str, below))}" if below else "above half throughout"
            )
            first, last = own[0], own[-1]
            text.append(
                f"{label}, {way}: {first['mean']:.3f} at {first['grid']} x {first['grid']} to {last['mean']:.3f} at "
                f"{last['grid']} x {last['grid']}, {first['percent_of_side']:.2f} % to {last['percent_of_side']:.2f} % "
                f"of the side; {reach}. The largest took {last['seconds']:.0f} s."
            )
    grid = max(settings["grids"])
    judged_alike = (row for row in rows if row["grid"] == grid and row["way"] != PUBLISHED)
    largest = sorted(judged_alike, key=lambda row: row["mean"])
    best, worst = largest[0], largest[-1]
    text.append(
        f"On fresh presses at {grid} x {grid} the best is {best['pad']}, {best['way']}, {best['mean']:.3f} grid units "
        f"or {best['percent_of_side']:.3f} % of the side off; {worst['pad']}, {worst['way']} is "
        f"{worst['mean'] / best['mean']:.1f} times as far off."
    )
    return text


def _draw(document: Mapping[str, Any]) -> Figure:
    """Errors and their share of the side by the grid, and maps of errors on fresh presses."""
    grids, labels = document["settings"]["grids"], list(document["settings"]["pads"])
    figure = Figure(figsize=(max(7.2, 1.45 * len(grids)), 3.4 + 1.6 * len(labels)), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=[3.2, 1.6 * len(labels)])
    upper, lower = halves
    names = {"mean": "mean error (grid units)", "percent_of_side": "mean error (% of the side)", "seconds": "time (s)"}
    for place, (key, name) in enumerate(names.items()):
        axes = upper.add_subplot(1, 3, 1 + place)
        for number, label in enumerate(labels):
            for way, style in zip(WAYS, (":", "--", "-"), strict=True):
                own = [row for row in document["rows"] if (row["pad"], row["way"]) == (label, way)]
                colour = CURVES[number % len(CURVES)]
                values = [row[key] for row in own]
                axes.loglog(grids, values, style, color=colour, marker="o", markersize=3.5, label=f"{label}, {way}")
        if key == "mean":
            axes.axhline(0.5, color=INK, linewidth=0.8, linestyle="--")
            curves = axes.get_legend_handles_labels()
            upper.legend(
                *curves, frameon=False, fontsize=7, handlelength=3.5, loc="outside upper left", ncols=len(WAYS)
            )
        axes.set_xticks(grids, [str(grid) for grid in grids])
        axes.xaxis.minorticks_off()
        axes.set(xlabel="grid", ylabel=name)
        axes.grid(axis="y", color=FAINT, linewidth=0.6)
        style_axes(axes)
    panels = lower.subplots(len(labels), len(grids), squeeze=False)
    highest = float(np.quantile([each["errors"] for each in document["maps"]], 0.98))
    for each in document["maps"]:
        row, column = labels.index(each["pad"]), grids.index(each["grid"])
        axes = panels[row, column]
        picture = axes.imshow(each["errors"], origin="lower", cmap="magma_r", vmin=0, vmax=highest)
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"{each['grid']} x {each['grid']}", fontsize=8, color=INK)
        if column == 0:
            axes.set_ylabel(each["pad"], fontsize=8, color=INK)
            lower.colorbar(picture, ax=axes, location="left", shrink=0.8).ax.tick_params(labelsize=7)
    return figure
