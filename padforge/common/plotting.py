"""The common style of figures, with a colour for each family of fibres, and functions to save them."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from padforge.common.files import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FAMILY_COLOURS = HORIZONTAL, VERTICAL = "#0b6e99", "#d9730d"
ALARM, INK, FAINT, PAPER = "#c4161c", "#37352f", "#d3d1cb", "#f7f6f3"  # faults, text, lines of axes, fill of a pad
CURVES = (INK, VERTICAL, HORIZONTAL, ALARM, "#3f8f5b", "#8a63b0", "#b58900", "#7d7a75")  # colours of curves, in order

DPI = 150  # default resolution of pictures


def save_figure(figure: "Figure", path: Path, dpi: float | None = None) -> None:
    """Save a figure as .svg or .png, atomically and reproducibly to the byte (no dates, stable ids).

    A PNG has a palette of 256 colours, which reduces it to a third of the size without a visible difference.
    """
    import matplotlib as mpl
    import numpy as np
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    with atomic_file(path) as temporary:
        if path.suffix.lower() == ".svg":
            with mpl.rc_context({"svg.hashsalt": "padforge"}):
                figure.savefig(temporary, metadata={"Date": None})
            return
        canvas = FigureCanvasAgg(figure)
        figure.set_dpi(dpi or DPI)
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        reduced = picture.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        reduced.save(temporary, format="PNG", optimize=True)


def new_figure(width_in: float, height_in: float) -> "tuple[Figure, Any]":
    """Create a figure of a size in inches with one pair of axes in the common style."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    axes = figure.subplots()
    style_axes(axes)
    return figure, axes


def style_axes(axes: Any) -> None:
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(color=FAINT, labelcolor=INK)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)


def add_title(figure: "Figure", text: str) -> None:
    figure.suptitle(text, x=0.01, ha="left", color=INK, fontsize=11)


def add_caption(axes: Any, text: str) -> None:
    """Add an explanation of the markers below the title of axes."""
    axes.text(0, 1.015, text, transform=axes.transAxes, color=INK, fontsize=8.5)
