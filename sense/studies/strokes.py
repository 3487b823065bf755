"""Strokes: how well a localizer that was trained on presses follows a finger that slides over a simulated pad."""

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.common.parallel import State
from padforge.common.plotting import CURVES, add_title
from padforge.design.morphology import Morphology
from padforge.design.settings import Contact
from padforge.sense.arrays import Array, Indices
from padforge.sense.localizer.calibration import fit_recording
from padforge.sense.localizer.evaluation import distances
from padforge.sense.localizer.features import compute_features
from padforge.sense.localizer.model import Localization, LocalizerModel
from padforge.sense.settings import LocalizerSettings, RigSettings
from padforge.sense.signals.press_detection import TOUCH_DELAY_S
from padforge.sense.simulation.simulated_recording import simulate
from padforge.sense.simulation.strokes import simulate_strokes
from padforge.sense.studies.study import Study, StudyResult, Task, describe_pads, label_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPEEDS_MM_S = (0.0, 5.0, 10.0, 20.0, 50.0)


def strokes_study(
    pads: Mapping[str, Morphology],
    *,
    contact: Contact | None = None,
    presses: int = 1500,
    strokes: int = 200,
    options: LocalizerSettings | None = None,
    seed: int = 0,
) -> Study:
    """Follow `strokes` strokes of each speed by localizers trained on `presses` presses of the same simulated pads."""
    contact = contact or Contact()
    rig = RigSettings(presses=presses, seed=seed)
    options = (options or LocalizerSettings()).model_copy(update={"seed": seed})
    tasks = [Task(label, partial(_follow_strokes, pad, contact, rig, strokes, options)) for label, pad in pads.items()]
    settings = {
        "pads": describe_pads(pads),
        "contact": contact.model_dump(mode="json"),
        "presses": presses,
        "speeds_mm_s": list(SPEEDS_MM_S),
        "strokes": strokes,
        "localizer": options.model_dump(mode="json"),
        "seed": seed,
    }
    return Study("strokes", "A finger that slides", settings, tasks, partial(_conclude, list(pads), rig), _draw)


def _follow_strokes(
    pad: Morphology, contact: Contact, rig: RigSettings, n_strokes: int, options: LocalizerSettings
) -> State:
    """Follow strokes by a localizer; errors are in mm.

    Returns:
        "errors" (speeds, readings, strokes) at each reading; "within", whether they are within r90; and "lifted"
        (speeds, strokes), the errors of the last positions by all readings up to the release and after it.
    """
    recording = simulate(pad, rig, contact)
    model = fit_recording(recording, np.arange(rig.presses), options, np.random.default_rng(rig.seed))
    errors, within, final_errors = [], [], []
    for number, speed in enumerate(SPEEDS_MM_S):
        rng = np.random.default_rng([rig.seed, number])
        strokes = simulate_strokes(pad, rig, contact, speed, n_strokes, rng)
        recorded = strokes.recording
        # a command precedes the touch, with which a stroke begins
        down_command = recorded.down_command - round(TOUCH_DELAY_S * rig.rate_hz)
        predict = partial(_predict, model, recorded.readings, down_command, recorded.up_command)
        for reading in range(strokes.positions_mm.shape[1]):
            predicted = predict(recorded.down_command + reading + 1)
            error = distances(predicted.positions_mm, strokes.positions_mm[:, reading])
            errors.append(error)
            within.append(error <= predicted.r90_mm)
        final_errors.append(distances(predict(None).positions_mm, strokes.positions_mm[:, -1]))
    shape = len(SPEEDS_MM_S), -1, n_strokes
    return {
        "errors": np.array(errors).reshape(shape),
        "within": np.array(within).reshape(shape),
        "lifted": np.array(final_errors),
    }


def _predict(
    model: LocalizerModel, readings: Array, down_command: Indices, up_command: Indices, until: Indices | None
) -> Localization:
    features = compute_features(readings, down_command, up_command, until)
    return model.predict_features(model.scaler.transform(features))


def _conclude(labels: list[str], rig: RigSettings, states: list[State]) -> StudyResult:
    rows, curves = [], {}
    for label, state in zip(labels, states, strict=True):
        means = state["errors"].mean(axis=2)
        curves[label] = means.tolist()
        settled = slice(means.shape[1] // 5, None)  # the first readings of a touch have little information
        for number, speed in enumerate(SPEEDS_MM_S):
            rows.append(
                {
                    "pad": label,
                    "speed_mm_s": speed,
                    "mean_mm": float(means[number, settled].mean()),
                    "ratio": float(means[number, settled].mean() / means[0, settled].mean()),
                    "within_r90": float(state["within"][number, settled].mean()),
                    "lifted_mm": float(state["lifted"][number].mean()),
                }
            )
    text = [
        f"Strokes in straight lines, as long as a press of {rig.readings_per_press // 2} readings, followed at every "
        "reading by a localizer that was trained on single presses of the same simulated pad. Errors are means over "
        "readings after the first fifth of a stroke; ratio is to those of a finger at rest; lifted_mm is the error of "
        "its last position, once it has lifted.",
    ]
    return StudyResult(rows, text, {"curves": curves, "rate_hz": rig.rate_hz, "speeds_mm_s": list(SPEEDS_MM_S)})


def _draw(document: Mapping[str, Any]) -> "Figure":
    from matplotlib.figure import Figure

    curves = document["curves"]
    figure = Figure(figsize=(4.2 * len(curves), 3.8), layout="constrained")
    all_axes = np.ravel(figure.subplots(1, len(curves), squeeze=False))
    for axes, (label, means) in zip(all_axes, curves.items(), strict=True):
        for speed, line, colour in zip(document["speeds_mm_s"], means, CURVES, strict=False):
            times_s = (np.arange(len(line)) + 1) / document["rate_hz"]
            axes.plot(times_s, line, color=colour, lw=1.4, label=f"{speed:g} mm/s")
        axes.set_ylim(0, None)
        label_axes(axes, label, "y", xlabel="since the touch (s)", ylabel="mean error (mm)")
        axes.legend(frameon=False, fontsize=8)
    add_title(figure, document["title"])
    return figure
