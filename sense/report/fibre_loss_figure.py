"""The figure of a study of lost fibres."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from padforge.design.common.plotting import FAINT, HORIZONTAL, INK, VERTICAL, add_caption, save_figure, style_axes

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
            means = [each["mean_mm"] for each in ways[way]["by_subset"] if len(each["lost"]) == row["lost"]]
            # Spread in order of the error, so that no two dots of a level hide each other.
            spread = np.linspace(-0.3, 0.3, len(means)) * _WIDTH if len(means) > 1 else np.zeros(1)
            axes.bar(at + sideways, row["mean_mm"], 0.9 * _WIDTH, color=colour, alpha=0.35, label=None if at else way)
            axes.scatter(at + sideways + spread, sorted(means), s=9, color=colour, linewidths=0, zorder=3)
            axes.text(at + sideways, 0.03, f"{row['mean_mm']:.2f}", color=INK, fontsize=9, ha="center", va="bottom")
    axes.legend(frameon=False, loc="upper left")
    label_losses(axes, next(iter(ways.values()))["errors"], f"Lost fibres, {document['test_presses']}")
    means = [cell["mean_mm"] for way in ways.values() for each in way["maps"] for cell in each["by_place"]]
    for row, (way, found) in enumerate(ways.items()):
        panels = [figure.add_subplot(grid[1 + row, column], aspect="equal") for column in range(len(found["maps"]))]
        pictures = [_draw_map(panel, each, max(means)) for panel, each in zip(panels, found["maps"], strict=True)]
        panels[0].set_ylabel(way, fontsize=8, color=INK)
        figure.colorbar(pictures[0], ax=panels[-1], label="mm", shrink=0.9)
    save_figure(figure, path)


def label_losses(axes: Any, rows: Sequence[Mapping[str, Any]], title: str) -> None:
    """Say along and over `axes` what stands for the `rows` of errors, one a number of lost fibres, and their sets."""
    names = ["all fibres" if row["lost"] == 0 else f"{row['lost']} lost" for row in rows]
    sets = [f"{row['subsets']} set{'s' if row['subsets'] > 1 else ''}" for row in rows]
    axes.set_xticks(range(len(rows)), [f"{name}\n{count}" for name, count in zip(names, sets, strict=True)])
    axes.set_ylabel("mean error (mm)")
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.set_title(f"{title} presses never trained on\n", loc="left", color=INK, fontsize=11)
    add_caption(axes, "bar: mean over the sets of lost fibres; dot: one set")


def _draw_map(axes: Any, found: Mapping[str, Any], highest_mm: float) -> Any:
    """Draw mean errors by cell of the pad, without the fibres that its title names."""
    cells = found["by_place"]
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
    lost = "+".join(str(fibre + 1) for fibre in found["lost"])
    axes.set_title(f"without {lost}" if lost else "all fibres", fontsize=8, color=INK)
    extent = (left, right, below, above)
    return axes.imshow(errors, origin="lower", extent=extent, cmap="magma_r", vmin=0, vmax=highest_mm)
