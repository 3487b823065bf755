"""The figure of the study of drift."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from padforge.design.common.plotting import ALARM, CURVES, FAINT, INK, add_title, style_axes

COLUMNS = 2
"""Recordings side by side whose errors are shown."""
PHASES = (("before", INK), ("pressed", ALARM), ("after", CURVES[2]))


def draw(document: Mapping[str, Any]) -> Figure:
    """Drift of a fibre, its readings and what is taken of them, and the errors of every way to deal with it.

    Readings are shown of the first simulated and of the first real recording.
    """
    stretches, rows = document["stretches"], document["rows"]
    shown = [next(s for s in stretches if s["kind"] == kind) for kind in dict.fromkeys(s["kind"] for s in stretches)]
    labels = list(dict.fromkeys(row["recording"] for row in rows))
    lines = -(-len(labels) // COLUMNS)
    schemes = len(document["settings"]["compensate"])
    each = 0.62 * schemes + 0.9
    figure = Figure(figsize=(11, 2.7 * len(shown) + each * lines + 0.9), layout="constrained")
    grid = figure.add_gridspec(len(shown) + lines, 6, height_ratios=[2.7] * len(shown) + [each] * lines)
    for at, stretch in enumerate(shown):
        _levels(figure.add_subplot(grid[at, :2]), stretch)
        axes = figure.add_subplot(grid[at, 2:])
        _readings(axes, stretch)
        if at == 0:
            axes.legend(frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1, 1), ncols=5, borderaxespad=0)
    width = 6 // min(len(labels), COLUMNS)
    for at, label in enumerate(labels):
        column = width * (at % COLUMNS)
        axes = figure.add_subplot(grid[len(shown) + at // COLUMNS, column : column + width])
        _errors(axes, label, [row for row in rows if row["recording"] == label])
        if at == 0:
            figure.legend(
                *axes.get_legend_handles_labels(), frameon=False, fontsize=8, loc="outside lower left", ncols=5
            )
    told = "errors on presses never trained on: filled for presses at random, hollow for the last"
    add_title(figure, f"Drift of a fibre, and {told}")
    return figure


def _levels(axes: Axes, stretch: Mapping[str, Any]) -> None:
    """The values before and in presses, over the whole recording."""
    times_s, *volts = np.array(stretch["levels"]).T
    for (name, colour), own in zip(PHASES[:2], volts, strict=True):
        axes.scatter(times_s / 60, own, s=2.5, color=colour, label=name, linewidths=0)
    axes.set(xlabel="time (min)", ylabel="filtered (V)")
    axes.set_title(f"{stretch['recording']}, fibre {stretch['fibre'] + 1}", loc="left", color=INK, fontsize=10)
    style_axes(axes)


def _readings(axes: Axes, stretch: Mapping[str, Any]) -> None:
    """Some presses, as read and filtered, and the three values that are taken of each."""
    times_s, raw, filtered = np.array(stretch["stretch"])
    start = times_s[0]
    axes.plot(times_s - start, raw, color=CURVES[-1], linewidth=0.7, alpha=0.7, label="readings")
    axes.plot(times_s - start, filtered, color=CURVES[1], linewidth=1.3, label="filtered")
    # The value after a press is the one before the next: the ring shows around the dot.
    by_phase = np.array(stretch["marks"]).swapaxes(0, 1)
    for (name, colour), marks, size in zip(PHASES, by_phase, (4, 5, 8), strict=True):
        face = "none" if name == "after" else colour
        axes.plot(
            marks[:, 0] - start, marks[:, 1], "o", color=colour, markerfacecolor=face, markersize=size, label=name
        )
    axes.set(xlabel=f"time since {start / 60:.1f} min (s)", ylabel="V")
    style_axes(axes)


def _errors(axes: Axes, label: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """A dot for every way: filled for presses at random, hollow for the last ones."""
    schemes = list(dict.fromkeys(row["compensate"] for row in rows))
    filters = list(dict.fromkeys(row["denoise"] for row in rows))
    for at, name in enumerate(filters):
        own = [row for row in rows if row["denoise"] == name]
        heights = np.arange(len(schemes)) + 0.6 * ((at + 0.5) / len(filters) - 0.5)
        for part, face in (("", CURVES[at]), ("_last", "none")):
            means, stds = ([row[f"{what}{part}_mm"] for row in own] for what in ("mean", "std"))
            dot: dict[str, Any] = {"fmt": "o", "color": CURVES[at], "markerfacecolor": face, "markersize": 4.5}
            axes.errorbar(means, heights, xerr=stds, elinewidth=1, label=None if part else f"denoised: {name}", **dot)
    axes.set_yticks(range(len(schemes)), schemes)
    axes.set(ylim=(len(schemes) - 0.5, -0.5), xlim=(0, None), xlabel="mean error (mm)")
    axes.set_title(f"{label}, {rows[0]['kind']}", loc="left", color=INK, fontsize=10)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    style_axes(axes)
