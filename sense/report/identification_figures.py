"""Pictures of an identified pad."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from padforge.design.common.plotting import FAINT, HORIZONTAL, INK, PAPER, VERTICAL, add_title, save_figure, style_axes
from padforge.design.paths.curves import flatten
from padforge.sense.twin.identified_pad import Identification

COLUMNS = ("measured", "predicted", "left over")


def draw_responses(found: Identification, path: Path) -> None:
    """Draw what each live channel answers by place: measured, predicted, and what is left over, on one scale each."""
    presses, pad = found.held_out, found.fit.pad
    predicted = pad.predict(presses.places_mm)
    channels = len(found.live)
    figure = Figure(figsize=(7.2, 0.5 + 1.9 * channels), layout="constrained")
    axes = figure.subplots(channels, 3, squeeze=False, sharex=True, sharey=True)
    for row in range(channels):
        there = presses.there[:, row]
        x, y = presses.places_mm[there].T
        measured, told = presses.volts[there, row] * 1e3, predicted[there, row] * 1e3
        most = float(np.abs(np.concatenate([measured, told])).max()) or 1.0
        dots = None
        for column, values in enumerate((measured, told, measured - told)):
            each = axes[row, column]
            dots = each.scatter(x, y, c=values, s=9, cmap="RdBu_r", vmin=-most, vmax=most, linewidths=0)
            style_axes(each)
            each.set_aspect("equal")
        figure.colorbar(dots, ax=list(axes[row]), label="mV", shrink=0.85).outline.set_visible(False)  # type: ignore[operator]
        axes[row, 0].set_ylabel(f"channel {found.live[row] + 1}, fibre {pad.fibres[row] + 1}\ny (mm)", color=INK)
        axes[row, 2].set_title(f"explained {found.explained[row]:.2f}", fontsize=9, color=INK, loc="left")
    for column, name in enumerate(COLUMNS):
        first = axes[0, column].get_title("left")
        axes[0, column].set_title(f"{name}, {first}" if first else name, fontsize=9, color=INK, loc="left")
        axes[-1, column].set_xlabel("x (mm)")
    add_title(figure, f"What {len(presses)} presses held out show, and what the twin says")
    save_figure(figure, path)


def draw_laid_plan(found: Identification, path: Path) -> None:
    """Draw the plan with the fibres as laid over it, their uncertainty as a band, and how far each is off, in mm."""
    pad = found.pad
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    plan, aside = figure.subplots(1, 2, width_ratios=(1.15, 1))
    right, top = (side / 2 for side in pad.layout.size_mm)
    plan.add_patch(Rectangle((-right, -top), 2 * right, 2 * top, facecolor=PAPER, edgecolor=FAINT))
    for points in flatten(pad, 1e-3):
        plan.plot(*pad.to_mm(points).T, color=FAINT, linewidth=1.4)
    pressed = found.fit.pad.frame.to_plan(found.learnt.places_mm)
    plan.scatter(*pressed.T, s=1, color=INK, alpha=0.25, linewidths=0)
    for row, (off, unsure, within) in enumerate(found.laid_mm()):
        fibre = found.fit.pad.fibres[row]
        colour = VERTICAL if pad.layout.family(fibre) else HORIZONTAL
        x, y = pad.to_mm(found.fit.pad.course(row)[0]).T
        plan.plot(x, y, color=colour, linewidth=1.6)
        beside = 0.03 * max(right, top)
        end = (x[-1], top + beside) if pad.layout.family(fibre) else (right + beside, y[-1])
        plan.text(*end, str(fibre + 1), color=colour, fontsize=9, ha="center", va="center")
        run, shown = np.linspace(0, 100, len(off)), np.where(within, off, np.nan)
        aside.plot(run, shown, color=colour, linewidth=1.2)
        aside.fill_between(run, shown - unsure, shown + unsure, color=colour, alpha=0.12, linewidth=0)
        last = int(np.flatnonzero(within)[-1]) if within.any() else 0
        aside.annotate(str(fibre + 1), (run[last], off[last]), color=colour, fontsize=9, va="center")
    plan.set_aspect("equal")
    room = 0.1 * max(right, top)
    plan.set(xlabel="x (mm)", ylabel="y (mm)", xlim=(-room - right, right + room), ylim=(-room - top, top + room))
    aside.set(xlabel="along the fibre (%)", ylabel="beside its plan, to the left (mm)", xlim=(0, 104))
    aside.axhline(0, color=FAINT, linewidth=0.8)
    for axes in (plan, aside):
        style_axes(axes)
    add_title(figure, "Grey: the plan; coloured: as laid; dots: presses, on the plan")
    save_figure(figure, path)
