"""Scaling: larger surfaces, localized from equally many presses by equally large networks (paper, figures 7 and 8).

The published method learns from a serpentine of presses and is evaluated on those presses themselves. "Spread" and
"shared" learn from presses spread over the whole surface and are evaluated on fresh ones. The inputs of "spread" are
each fibre's share of its family's signal, of which the position is an almost linear function at any size. In "shared"
the tile is that of the largest signals, and one network for all tiles estimates the position in it from the fibres of
the tile and its neighbours: neither the size of the network nor its error need grow with the surface.
"""

import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.common.parallel import State
from padforge.common.plotting import CURVES, INK
from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.published.networks import fit_batch, fresh_presses, training_presses
from padforge.design.settings import Rectangle, between_fibres
from padforge.sense.arrays import Array
from padforge.sense.studies.press_model import PUBLISHED_PRESSES, PressModel
from padforge.sense.studies.study import Study, StudyResult, Task, describe_pads, draw_error_map, label_axes

TILES = (1, 2, 4, 8, 16, 32)  # tiles along a side, which are 4 to 128 fibres of the published pads
MAX_GRID = 256  # maximum number of fibres of a family
PUBLISHED, SPREAD, SHARED = "published", "spread", "shared"
METHODS = (PUBLISHED, SPREAD, SHARED)
HIDDEN = 70
EPOCHS = 60
TEST = 4096
CELLS = 16  # along a side of an error map


def scaling_study(
    pads: Mapping[str, Morphology],
    *,
    grids: Sequence[int] = (),
    press_model: PressModel = PUBLISHED_PRESSES,
    side: int = 64,
    seed: int = 0,
) -> Study:
    """Evaluate surfaces of growing grids, over which each square pad is repeated as a tile.

    The `grids` are multiples of every pad's; if empty, TILES of the smallest surface that all pads tile, up to
    MAX_GRID. Networks are trained on `side`^2 presses.

    Raises:
        InputError: a pad that is no tile of a surface.
    """
    for label, pad in pads.items():
        if not pad.layout.is_square:
            raise InputError(f"{label} has {pad.layout}, expected tiles of M + M fibres of one pitch")
    smallest = math.lcm(*(pad.grid for pad in pads.values()))
    grids = grids or [grid for tiles in TILES if (grid := tiles * smallest) <= MAX_GRID]
    if not grids:
        raise InputError(f"the smallest surface that all pads tile has a grid of {smallest}, allowed is {MAX_GRID}")
    for label, pad in pads.items():
        for grid in grids:
            if grid % pad.grid:
                raise InputError(f"grids has {grid}, expected multiples of {pad.grid}, the grid of {label}")
    cases = list(product(grids[::-1], pads, METHODS))
    tasks = [
        Task(
            f"{label}, {grid} x {grid}, {method}",
            partial(_evaluate, pads[label], grid, method, press_model, side, seed),
        )
        for grid, label, method in cases
    ]
    settings = {
        "pads": describe_pads(pads),
        **press_model.to_dict(),
        "grids": list(grids),
        "presses": side**2,
        "hidden": HIDDEN,
        "epochs": EPOCHS,
        "test": TEST,
        "seed": seed,
    }
    conclude = partial(_conclude, cases, settings, press_model.describe())
    return Study("scaling", "Larger surfaces", settings, tasks, conclude, _draw)


def spread_presses(rectangle: Rectangle, side: int, seed: int) -> Array:
    """Draw one press in each of side x side cells of a rectangle; shape (side^2, 2), grid units."""
    low, high = np.array(rectangle)
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    positions = cells + np.random.default_rng([6, seed]).uniform(size=cells.shape)
    return low + (high - low) / side * positions


def family_shares(responses: Array) -> Array:
    """Return signals (Q, 2M) as shares of their family's sum, and the two sums; shape (Q, 2M + 2)."""
    families = np.split(responses, 2, axis=1)
    sums = [family.sum(axis=1, keepdims=True) for family in families]
    shares = [np.divide(f, s, out=np.zeros_like(f), where=s > 0) for f, s in zip(families, sums, strict=True)]
    return np.hstack([*shares, *sums])


def tile_inputs(responses: Array, tile: int) -> tuple[Array, Array]:
    """Select the signals (Q, 6 tile) of the tile of each press and its neighbours, and its origin (Q, 2), grid units.

    In each family, of `tile` fibres a tile, it is the tile with the largest sum, the middle one if all signals are 0.
    """
    windows, origins = [], []
    for family in np.split(responses, 2, axis=1)[::-1]:  # x depends on vertical fibres, y on horizontal ones
        sums = family.reshape(len(family), -1, tile).sum(axis=2)
        number = np.where(sums.any(axis=1), sums.argmax(axis=1), sums.shape[1] // 2)
        padded = np.pad(family, ((0, 0), (tile, tile)))
        columns = number[:, None] * tile + np.arange(3 * tile)
        windows.append(np.take_along_axis(padded, columns, axis=1))
        origins.append(number * tile)
    return np.hstack(windows), np.column_stack(origins).astype(float)


def _evaluate(tile: Morphology, grid: int, method: str, press_model: PressModel, side: int, seed: int) -> State:
    """Compute errors (Q,) at "positions" (Q, 2), grid units, and the seconds and epochs of the training."""
    pad = tile.tiled(grid // tile.grid) if grid > tile.grid else tile
    rectangle, begin = between_fibres(pad.layout), time.perf_counter()
    scatter_rng = np.random.default_rng([8, seed, 0])
    if method == PUBLISHED:
        training = test = training_presses(rectangle, side, seed)
    else:
        training, test = spread_presses(rectangle, side, seed), fresh_presses(rectangle, TEST, seed)

    def network_inputs(positions: Array) -> tuple[Array, Array]:
        """Return inputs, and the origins (Q, 2) that the outputs count from."""
        responses = press_model.respond(pad, positions, scatter_rng)
        if method == SHARED:
            return tile_inputs(responses, tile.grid)
        return responses if method == PUBLISHED else family_shares(responses), np.zeros((len(positions), 2))

    inputs, origins = network_inputs(training)
    valid = np.ones(len(training), dtype=bool)
    if method == SHARED and grid > tile.grid:
        # the tile is unknown where a family does not respond, and positions in a wrong tile teach nothing
        valid = np.all([part.any(axis=1) for part in np.split(inputs, 2, axis=1)], axis=0)
    rng = np.random.default_rng([8, seed])
    network = fit_batch(inputs[valid], (training - origins)[valid], [rng], HIDDEN, EPOCHS)[0]
    seconds = time.perf_counter() - begin
    inputs, origins = network_inputs(test)
    errors = np.linalg.norm(origins + network(inputs) - test, axis=1)
    return {"errors": errors, "positions": test, "seconds": np.array(seconds), "epochs": np.array(network.epochs)}


def _conclude(
    cases: Sequence[tuple[int, str, str]], settings: Mapping[str, Any], responses: str, states: list[State]
) -> StudyResult:
    rows, maps = [], []
    by_case = dict(zip(cases, states, strict=True))
    for label, method, grid in product(settings["pads"], METHODS, settings["grids"]):
        state = by_case[grid, label, method]
        errors = state["errors"]
        row = {
            "pad": label,
            "method": method,
            "grid": grid,
            "mean": float(errors.mean()),
            "median": float(np.median(errors)),
            "p95": float(np.quantile(errors, 0.95)),
            "percent_of_side": float(100 * errors.mean() / grid),
            "epochs": int(state["epochs"]),
            "seconds": round(float(state["seconds"]), 2),
        }
        rows.append(row)
        if method == SPREAD:
            maps.append({"pad": label, "grid": grid, "errors": _error_map(grid, state).tolist()})
    return StudyResult(rows, [_describe(settings, responses)], {"maps": maps})


def _error_map(grid: int, state: State) -> Array:
    """Return mean errors by cell; shape (CELLS, CELLS)."""
    cells = np.clip(((state["positions"] - 1) / (grid - 1) * CELLS).astype(int), 0, CELLS - 1)
    number = cells[:, 1] * CELLS + cells[:, 0]
    total, count = (np.bincount(number, weights, CELLS**2) for weights in (state["errors"], None))
    return np.round(total / np.maximum(count, 1), 4).reshape(CELLS, CELLS)


def _describe(settings: Mapping[str, Any], responses: str) -> str:
    return (
        f"Networks of {settings['hidden']} neurons were trained on {settings['presses']} presses, for every size of "
        f"the surface alike, in at most {settings['epochs']} steps. The published method learns the signals of a "
        "serpentine and is evaluated on it, most of which was trained on; the spread method learns each fibre's share "
        f"of its family's signal from presses spread evenly, and is evaluated on {settings['test']} fresh ones. The "
        "shared method learns from the same presses the position in the tile, by one network for all tiles. Errors are "
        f"in grid units. {responses}"
    )


def _draw(document: Mapping[str, Any]) -> Figure:
    """Draw errors, their share of the side and time by grid, and error maps on fresh presses."""
    grids, labels = document["settings"]["grids"], list(document["settings"]["pads"])
    figure = Figure(figsize=(max(7.2, 1.45 * len(grids)), 3.4 + 1.6 * len(labels)), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=[3.2, 1.6 * len(labels)])
    upper, lower = halves
    names = {"mean": "mean error (grid units)", "percent_of_side": "mean error (% of the side)", "seconds": "time (s)"}
    for index, (key, name) in enumerate(names.items()):
        axes = upper.add_subplot(1, 3, 1 + index)
        for number, label in enumerate(labels):
            for method, style in zip(METHODS, (":", "--", "-"), strict=True):
                cases = [row for row in document["rows"] if (row["pad"], row["method"]) == (label, method)]
                values, name_of = [row[key] for row in cases], f"{label}, {method}"
                colour = CURVES[number % len(CURVES)]
                axes.loglog(grids, values, style, color=colour, marker="o", markersize=3.5, label=name_of)
        if key == "mean":
            axes.axhline(0.5, color=INK, linewidth=0.8, linestyle="--")
            legend = {"fontsize": 7, "handlelength": 3.5, "loc": "outside upper left", "ncols": len(METHODS)}
            upper.legend(*axes.get_legend_handles_labels(), frameon=False, **legend)
        axes.set_xticks(grids, [str(grid) for grid in grids])
        axes.xaxis.minorticks_off()
        label_axes(axes, grid="y", xlabel="grid", ylabel=name)
    panels = lower.subplots(len(labels), len(grids), squeeze=False)
    highest = float(np.quantile([panel["errors"] for panel in document["maps"]], 0.98))
    for panel in document["maps"]:
        row, column = labels.index(panel["pad"]), grids.index(panel["grid"])
        title, row_label = f"{panel['grid']} x {panel['grid']}", "" if column else panel["pad"]
        draw_error_map(panels[row, column], panel["errors"], title, highest, row_label=row_label)
    return figure
