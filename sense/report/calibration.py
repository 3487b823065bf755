"""Figures of a calibration.

All that a calibration leaves in a folder: the localizer, what health is told by, the document and its figures.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection

from padforge.design.common.files import atomic_files, check_replaceable, check_writable, write_json
from padforge.design.common.plotting import ALARM, INK, add_caption, new_figure, save_figure
from padforge.design.common.profiling import stage
from padforge.design.common.validation import InputError
from padforge.sense.health.fault_detector import HEALTH_FILES, FaultDetector
from padforge.sense.localizer.calibration import calibrate, unlearnt_lines
from padforge.sense.recording.recording import Recording
from padforge.sense.settings import LocalizerSettings
from padforge.sense.studies.fibre_loss import label_losses


def draw_error_map(document: Mapping[str, Any], path: Path) -> None:
    """Draw where on the pad presses were found, and how far off: `error_map.png` of a calibration document."""
    test = document["test"]
    pressed, found = np.array(test["pressed_mm"]), np.array(test["predicted_mm"])
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
        means = [s["mean_mm"] for s in document["by_subset"] if len(s["failed"]) == row["n_failed"]]
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


FILES = (
    *("localizer.json", "localizer.safetensors", "calibration.json", "error_map.png", "error_by_loss.png"),
    *sorted(HEALTH_FILES),
)
"""Names of all that a calibration writes; of health, what can be learnt."""


def calibrate_into(
    recording: Recording,
    out: Path,
    options: LocalizerSettings,
    *,
    time_budget: float | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    warn: Callable[[str], None] = lambda line: None,
    force: bool = False,
) -> dict[str, Any]:
    """Calibrate, write all results to `out`, and return `calibration.json`.

    Nothing in `out` changes before the last result is there.

    Args:
        time_budget: seconds to train for, see `calibrate`.
        progress: called with (steps of training done, in all), and (0, 0) when the health of the fibres is learnt.
        warn: told in a line what is not learnt, of depth, force or health, as the recording does not suffice.
        force: whether a localizer is replaced that others in `out` were made from.

    Raises:
        InputError: as `calibrate`, `out` cannot be written, or others were made from the localizer in it.
    """
    check_writable(out)
    path, known = out / FILES[0], {"seed": options.seed, "inputs": {"recording": recording.digest}}
    check_replaceable(path, known, FILES, force)
    localizer, document = calibrate(recording, options, time_budget=time_budget, progress=progress)
    for line in unlearnt_lines(recording, localizer):
        warn(line)
    progress(0, 0)
    with stage("health"):
        try:
            detector = FaultDetector(seed=options.seed).fit(recording, localizer.test, localizer.provenance)
        except InputError as error:
            detector = None
            warn(f"no watch is kept on the fibres' health: {error}")
    with atomic_files(out, without=HEALTH_FILES) as folder:  # those of another model must not stay
        localizer.save(folder)
        check_replaceable(path, folder / path.name, FILES, force)  # other settings may be told by the result alone
        if detector:
            detector.save(folder)
        write_json(folder / "calibration.json", document)
        with stage("figures"):
            draw_error_map(document, folder / "error_map.png")
            draw_error_by_loss(document, folder / "error_by_loss.png")
    return document
