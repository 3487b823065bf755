"""The figure of a learning curve: error against the number of presses learnt from."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from padforge.design.common.plotting import ALARM, FAINT, INK, add_caption, new_figure, save_figure
from padforge.sense.localizer.calibration.learning_curve import power_law


def draw_learning_curve(document: Mapping[str, Any], path: Path) -> None:
    """Draw the error against the number of presses learnt from, the fit, and what twice as many would bring."""
    figure, axes = new_figure(6.4, 4.4)
    presses = np.array([point["presses"] for point in document["points"]], dtype=float)
    means = [point["mean_mm"] for point in document["points"]]
    ahead, fit = document["forecast"], document["fit"]
    along = np.geomspace(presses[0], ahead["presses"], 200)
    axes.plot(along, power_law(along, (fit["floor_mm"], fit["factor_mm"], fit["exponent"])), color=FAINT, linewidth=1.6)
    errors = [2 * point["standard_error_mm"] for point in document["points"]]
    axes.errorbar(presses, means, errors, fmt="o", color=INK, markersize=5, linewidth=1.2, label="measured")
    reach = [[ahead["mean_mm"] - ahead["low_mm"]], [ahead["high_mm"] - ahead["mean_mm"]]]
    expected = {"fmt": "D", "color": ALARM, "markersize": 6, "linewidth": 1.2, "label": "expected"}
    axes.errorbar([ahead["presses"]], [ahead["mean_mm"]], reach, **expected)
    axes.set_xscale("log")
    ticks = [*presses.astype(int).tolist(), ahead["presses"]]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set(ylim=(0, None), xlabel="presses learnt from", ylabel="mean error (mm)")
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.legend(frameon=False)
    axes.set_title(
        f"Error by number of presses, on the same {document['test_presses']}\n", loc="left", color=INK, fontsize=11
    )
    add_caption(axes, "bars: two standard errors; expected: 80 % of resamplings")
    save_figure(figure, path)
