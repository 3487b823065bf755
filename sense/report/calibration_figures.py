"""Figures of a calibration."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection

from padforge.design.common.plotting import ALARM, INK, add_caption, new_figure, save_figure

from padforge.sense.report.fibre_loss_figure import label_losses


def draw_error_map(document: Mapping[str, Any], path: Path) -> None:
    """Draw where on the pad presses were found, and how far off: `error_map.png` of a calibration document."""
    test = document["test"]
    pressed, found = np.array(test["pressed_mm"]), np.array(test["found_mm"])
    errors = np.hypot(*(found - pressed).T)
    figure, axes = new_figure(6.4, 5.6)
    lines = list(np.stack([pressed, found], axis=1))
    axes.add_collection(LineCollection(lines, colors=INK, linewidths=0.6, alpha=0.55))
    dots = axes.scatter(
        *pressed.T, c=errors, s=20, cmap="viridis_r", vmin=0, vmax=np.percentile(errors, 98) or 1, linewidths=0
    )
    colours = figure.colorbar(dots, ax=axes, label="error (mm)", extend="max", shrink=0.9)
    colours.outline.set_visible(False)  # type: ignore[operator]
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set(xlabel="x from the pad's centre (mm)", ylabel="y from the pad's centre (mm)")
    axes.set_title(
        f"{len(errors)} presses never trained on: {errors.mean():.2f} mm off on average\n",
        loc="left",
        color=INK,
        fontsize=11,
    )
    add_caption(axes, "dot: place pressed; line: to the place found")
    save_figure(figure, path)


def draw_error_by_loss(document: Mapping[str, Any], path: Path) -> None:
    """Draw the error against the number of lost fibres: `error_by_loss.png` of a calibration document."""
    rows = document["errors"]
    figure, axes = new_figure(6.0, 4.4)
    for at, row in enumerate(rows):
        means = [s["mean_mm"] for s in document["by_subset"] if len(s["lost"]) == row["lost"]]
        # Spread sideways in order of the error, so that no two dots of a level hide each other.
        sideways = np.linspace(-0.17, 0.17, len(means)) if len(means) > 1 else [0.0]
        axes.scatter(at + np.array(sideways), sorted(means), s=14, color=ALARM, alpha=0.45, linewidths=0)
        axes.hlines(row["mean_mm"], at - 0.28, at + 0.28, color=INK, linewidth=2)
        axes.annotate(
            f"{row['mean_mm']:.2f}", (at + 0.3, row["mean_mm"]), color=INK, va="center", fontsize=10, weight="bold"
        )
    label_losses(axes, rows, f"One network, {document['test_presses']}")
    axes.set(xlim=(-0.5, len(rows) - 0.3), ylim=(0, 1.08 * max(row["max_mm"] for row in rows)))
    save_figure(figure, path)
