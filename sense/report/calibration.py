"""Files of a calibration: localizer, health models, document and figures."""

import logging
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, NullFormatter

from padforge.common.background import BackgroundProcess
from padforge.common.files import atomic_files, check_replaceable, check_writable, write_json
from padforge.common.plotting import ALARM, CURVES, FAINT, INK, add_caption, new_figure, save_figure, style_axes
from padforge.common.profiling import stage
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.validation import Fault, InputError
from padforge.design import Morphology
from padforge.sense.health.fault_detector import HEALTH_FILES, FaultDetector
from padforge.sense.localizer.calibration import calibrate, calibration_provenance, missing_target_lines, split_unseen
from padforge.sense.localizer.evaluation import Evaluation
from padforge.sense.recording.recording import Recording
from padforge.sense.report.sections import BY_LOSS, BY_MOMENT, MAP
from padforge.sense.settings import LocalizerSettings
from padforge.sense.studies.fibre_loss import draw_errors_by_loss

_log = logging.getLogger(__name__)

FILES = ("localizer.json", "localizer.safetensors", "calibration.json", MAP, BY_LOSS, BY_MOMENT, *sorted(HEALTH_FILES))
"""Names of all files of a calibration. A recording may not suffice for those of health and of moments."""


def calibrate_into(
    recording: Recording,
    out: Path,
    options: LocalizerSettings,
    *,
    pad: Morphology | None = None,
    time_budget: float | None = None,
    without: Collection[str] = (),
    on_progress: OnProgress = ignore_progress,
    force: bool = False,
) -> dict[str, Any]:
    """Calibrate as `calibrate`, write FILES into `out`, and return the content of `calibration.json`.

    No file changes before all are done. A warning is logged for each of depth, force and health that the recording does
    not suffice for. Parts in `without` are left out: "health", "figures" or "moments". `on_progress` is also called
    with (0, 0, "health"), and `force` replaces a localizer that other files in `out` were made from.

    Raises:
        InputError: as `calibrate`, `out` cannot be written, or other files were made from the localizer in it.
    """
    check_writable(out)
    path, origin = out / FILES[0], {"seed": options.seed, "inputs": {"recording": recording.digest}}
    check_replaceable(path, origin, FILES, force)
    by_moment = "moments" not in without
    with ExitStack() as stack:
        health = None
        if "health" not in without:  # learnt from the same presses as the localizer, and meanwhile
            _, test = split_unseen(recording, None, options)
            health = stack.enter_context(BackgroundProcess())
            made_by = calibration_provenance(recording, options)
            health.submit(FaultDetector(seed=options.seed).fit, recording, test, made_by)
        model, evaluation = calibrate(
            recording, options, pad=pad, time_budget=time_budget, by_moment=by_moment, on_progress=on_progress
        )
        for line in missing_target_lines(recording, model):
            _log.warning(line)
        # optional files of an earlier calibration must not stay
        optional = {*HEALTH_FILES, MAP, BY_LOSS, BY_MOMENT}
        folder = stack.enter_context(atomic_files(out, without=optional))
        model.save(folder)
        check_replaceable(path, folder / path.name, FILES, force)  # by content, since provenance does not show settings
        write_json(folder / "calibration.json", evaluation.to_dict())
        if "figures" not in without:
            with stage("figures"):
                draw_test_errors(evaluation, folder / MAP)
                figure, axes = new_figure(6.0, 4.4)
                draw_errors_by_loss(axes, {"": evaluation}, f"One network, {evaluation.test_presses}")
                save_figure(figure, folder / BY_LOSS)
                if evaluation.by_moment:
                    draw_errors_by_moment(evaluation, folder / BY_MOMENT)
        if health:
            on_progress(0, 0, "health")
            with stage("health"):
                try:
                    health.result().save(folder)
                except (InputError, Fault) as error:  # the localizer, minutes of training, is kept
                    held_out = f"{len(model.test)} presses are held out"
                    _log.warning("the health of the fibres is not monitored: %s; %s", error, held_out)
    return evaluation.to_dict()


def draw_test_errors(evaluation: Evaluation, path: Path) -> None:
    """Draw the true and the predicted positions of the test presses of a calibration."""
    pressed, predicted = (np.array(evaluation.test[name]) for name in ("pressed_mm", "predicted_mm"))
    errors = np.hypot(*(predicted - pressed).T)
    figure, axes = new_figure(6.4, 5.6)
    lines = list(np.stack([pressed, predicted], axis=1))
    axes.add_collection(LineCollection(lines, colors=INK, linewidths=0.6, alpha=0.55))
    limit = np.percentile(errors, 98) or 1
    dots = axes.scatter(*pressed.T, c=errors, s=20, cmap="viridis_r", vmin=0, vmax=limit, linewidths=0)
    colours = figure.colorbar(dots, ax=axes, label="error (mm)", extend="max", shrink=0.9)
    colours.outline.set_visible(False)  # type: ignore[operator]
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set(xlabel="x from the pad's centre (mm)", ylabel="y from the pad's centre (mm)")
    title = f"{len(errors)} presses never trained on: mean error {errors.mean():.2f} mm\n"
    axes.set_title(title, loc="left", color=INK, fontsize=11)
    add_caption(axes, "dot: true position; line: to the prediction")
    save_figure(figure, path)


def draw_errors_by_moment(evaluation: Evaluation, path: Path) -> None:
    """Draw errors by time since the touch and since the lift, and the shrinking radius of a single press."""
    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    touch, lift, focus = figure.subplots(1, 3)
    for axes in (touch, lift, focus):
        style_axes(axes)
    for axes, since in ((touch, "touch"), (lift, "lift")):
        for n_failed in sorted({row["n_failed"] for row in evaluation.by_moment}):
            rows = [row for row in evaluation.by_moment if (row["since"], row["n_failed"]) == (since, n_failed)]
            times_s, means = [row["time_s"] for row in rows], [row["mean_mm"] for row in rows]
            colour, label = CURVES[n_failed % len(CURVES)], f"{n_failed} failed"
            axes.plot(times_s, means, "o-", color=colour, ms=3.5, lw=1.4, label=label)
        axes.set_yscale("log")
        axes.set(xlabel=f"since the {since} (s)", ylabel="mean error (mm)")
    means = [row["mean_mm"] for row in evaluation.by_moment]
    for axes in (touch, lift):
        axes.set_ylim(0.9 * min(means), 1.1 * max(means))
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
    touch.legend(frameon=False, fontsize=8)
    touch.set_title("Error while a press is read\n", loc="left", color=INK, fontsize=11)
    x, y = evaluation.focus["pressed_mm"]
    moments = evaluation.focus["moments"]
    for number, moment in enumerate(moments):
        share = (number + 1) / len(moments)
        style = {"fill": False, "ec": INK, "lw": 0.6 + share, "alpha": 0.15 + 0.85 * share}
        focus.add_patch(Circle(moment["predicted_mm"], moment["r90_mm"], **style))
    focus.plot(*np.array([moment["predicted_mm"] for moment in moments]).T, "-", color=FAINT, lw=0.8)
    focus.plot(x, y, "+", color=ALARM, ms=9, mew=1.6)
    focus.set_aspect("equal")
    focus.autoscale_view()
    focus.set(xlabel="x (mm)", ylabel="y (mm)")
    focus.set_title("A touch comes into focus\n", loc="left", color=INK, fontsize=11)
    add_caption(focus, "circles of 90 %, later ones darker; cross: true position")
    save_figure(figure, path)
