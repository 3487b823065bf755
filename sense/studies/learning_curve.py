"""Learning curve: error against the number of training presses, and the gain by recording more of them.

Localizers are trained on nested shares of the training presses and tested on the same presses. A power law with a
floor, e(n) = c + a n^-b, describes such curves (J. Hestness et al., Deep learning scaling is predictable, empirically,
2017) and is extrapolated to twice as many presses.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from padforge.common.files import provenance
from padforge.common.parallel import one_thread, run_tasks
from padforge.common.plotting import ALARM, FAINT, INK, add_caption, new_figure, save_figure
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import or_default
from padforge.common.validation import InputError
from padforge.sense import settings
from padforge.sense.arrays import Array
from padforge.sense.localizer.calibration import fit_recording, split_presses
from padforge.sense.localizer.evaluation import distances
from padforge.sense.recording.recording import Recording

FORMAT = "padforge-learning-curve/1"
SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)  # of the training presses
MIN_PRESSES = 10  # training presses of the smallest localizer
RESAMPLINGS = 400


@dataclass(frozen=True)
class LearningCurve:
    """Error against the number of training presses.

    Attributes:
        test_presses: their number, the same for all points.
        points: "presses", "mean_mm" and "standard_error_mm", by number of training presses.
        fit: "floor_mm", "factor_mm" and "exponent" of the power law.
        forecast: "presses", twice as many, "mean_mm", and the interval "low_mm" to "high_mm" of 80 % of resamplings of
            the test presses and the residuals.
        advice: in words.
        settings: of the training.
        provenance: of the study.
    """

    test_presses: int
    points: list[dict[str, Any]]
    fit: dict[str, float]
    forecast: dict[str, Any]
    advice: str
    settings: dict[str, Any]
    provenance: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the document of `learning_curve.json`."""
        return {"format": FORMAT} | vars(self)


def learning_curve(
    recording: Recording,
    options: settings.LocalizerSettings | None = None,
    *,
    on_progress: OnProgress = ignore_progress,
) -> LearningCurve:
    """Train localizers on growing numbers of presses, and extrapolate their error.

    Args:
        recording: with presses of known position.
        options: of the training; the defaults if None. A single member is trained, so that errors are somewhat above
            those of a calibration.
        on_progress: called with (steps done, total, name of work that is not counted in steps).

    Raises:
        InputError: too few presses for a curve.
    """
    from padforge.sense.localizer.training import joint_progress, training_steps

    options = or_default("options", options, settings.LocalizerSettings)
    rng = np.random.default_rng(options.seed)
    presses = np.flatnonzero(recording.has_position)
    training, test = split_presses(presses, options.split, options.test_share, rng)
    if len(training) * SHARES[0] < MIN_PRESSES:
        raise InputError(
            f"recording has {len(training)} presses to train on, "
            f"expected at least {round(MIN_PRESSES / SHARES[0])} for a curve"
        )
    order = rng.permutation(training)
    sizes = [round(share * len(order)) for share in SHARES]
    options = options.model_copy(update={"members": 1, "method": "ensemble"})
    # as many steps as in a calibration on so many presses; otherwise more presses would hardly lower the error
    steps = [training_steps(size, options) for size in sizes]

    def test_errors(number: int) -> Array:
        rows, rng = np.sort(order[: sizes[number]]), np.random.default_rng([options.seed, sizes[number]])
        localizer = fit_recording(recording, rows, options, rng, partial(update, number))
        prediction = localizer.predict_features(localizer.scaled_features(recording)[test])
        return distances(prediction.positions_mm, recording.presses_mm[test])

    longest_first = reversed(range(len(sizes)))
    with one_thread(), joint_progress(steps, on_progress) as update:
        by_number = dict(run_tasks((number, partial(test_errors, number)) for number in longest_first))
    errors = np.array([by_number[number] for number in range(len(sizes))])
    counts = np.array(sizes, dtype=float)
    fit = fit_power_law(counts, errors.mean(axis=1))
    forecast = _forecast(counts, errors, fit, rng)
    origin = provenance("padforge sense learning-curve", options.seed)
    origin["inputs"] = {"recording": recording.digest}
    return LearningCurve(
        test_presses=len(test),
        points=[
            {"presses": size, "mean_mm": row.mean(), "standard_error_mm": row.std(ddof=1) / np.sqrt(len(row))}
            for size, row in zip(sizes, errors, strict=True)
        ],
        fit=dict(zip(("floor_mm", "factor_mm", "exponent"), fit, strict=True)),
        forecast=forecast,
        advice=f"{forecast['presses'] - sizes[-1]} more training presses, twice as many, would bring the error from "
        f"{errors[-1].mean():.2f} mm to about {forecast['mean_mm']:.2f} mm "
        f"({forecast['low_mm']:.2f} to {forecast['high_mm']:.2f} mm)",
        settings=options.model_dump(),
        provenance=origin,
    )


def fit_power_law(presses: Array, errors: Array) -> tuple[float, float, float]:
    """Fit c + a n^-b to errors (P,) by numbers of presses (P,): least squares of relative errors, c and a >= 0."""

    def solve(exponent: float) -> tuple[Array, float]:
        terms = np.column_stack([np.ones_like(presses), (presses / presses[-1]) ** -exponent])
        return nnls(terms / errors[:, None], np.ones_like(errors))

    exponent = min(np.linspace(0.1, 1.5, 57).tolist(), key=lambda b: solve(b)[1])
    (floor, last), _ = solve(exponent)
    return float(floor), float(last * presses[-1] ** exponent), float(exponent)


def power_law(presses: Array, fit: tuple[float, float, float]) -> Array:
    """Evaluate a fitted power law at numbers of presses."""
    floor, factor, exponent = fit
    return floor + factor * presses**-exponent


def _forecast(
    presses: Array, errors: Array, fit: tuple[float, float, float], rng: np.random.Generator
) -> dict[str, Any]:
    """Extrapolate errors (P, Q) of the test presses to twice as many training presses."""
    residual = np.log(errors.mean(axis=1) / power_law(presses, fit))
    scatter = np.sqrt((residual**2).sum() / max(1, len(residual) - 3))
    target = 2 * presses[-1:]

    def ratio(fit: tuple[float, float, float]) -> float:
        return (power_law(target, fit) / power_law(presses[-1:], fit))[0]

    ratios = []
    for _ in range(RESAMPLINGS):
        means = errors[:, rng.integers(errors.shape[1], size=errors.shape[1])].mean(axis=1)
        ratios.append(ratio(fit_power_law(presses, means * np.exp(scatter * rng.standard_normal(len(means))))))
    low, high = np.quantile(ratios, [0.1, 0.9])
    expected, error = ratio(fit), errors[-1].mean()
    return {
        "presses": int(target[0]),
        "mean_mm": float(error * expected),
        "low_mm": float(error * min(low, expected)),
        "high_mm": float(error * max(high, expected)),
    }


def draw_learning_curve(curve: LearningCurve, path: Path) -> None:
    """Draw the errors, the fit, and the forecast for twice as many presses."""
    figure, axes = new_figure(6.4, 4.4)
    presses = np.array([point["presses"] for point in curve.points], dtype=float)
    means = [point["mean_mm"] for point in curve.points]
    forecast, fit = curve.forecast, curve.fit
    x = np.geomspace(presses[0], forecast["presses"], 200)
    axes.plot(x, power_law(x, (fit["floor_mm"], fit["factor_mm"], fit["exponent"])), color=FAINT, linewidth=1.6)
    bars = [2 * point["standard_error_mm"] for point in curve.points]
    axes.errorbar(presses, means, bars, fmt="o", color=INK, markersize=5, linewidth=1.2, label="measured")
    interval = [[forecast["mean_mm"] - forecast["low_mm"]], [forecast["high_mm"] - forecast["mean_mm"]]]
    style = {"fmt": "D", "color": ALARM, "markersize": 6, "linewidth": 1.2, "label": "expected"}
    axes.errorbar([forecast["presses"]], [forecast["mean_mm"]], interval, **style)
    axes.set_xscale("log")
    ticks = [*presses.astype(int).tolist(), forecast["presses"]]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set(ylim=(0, None), xlabel="training presses", ylabel="mean error (mm)")
    axes.grid(axis="y", color=FAINT, linewidth=0.6)
    axes.legend(frameon=False)
    title = f"Error by number of presses, on the same {curve.test_presses}\n"
    axes.set_title(title, loc="left", color=INK, fontsize=11)
    add_caption(axes, "bars: two standard errors; expected: 80 % of resamplings")
    save_figure(figure, path)


def learning_curve_lines(curve: LearningCurve) -> list[str]:
    """Format a learning curve as a table, the fit and the advice."""
    fit = curve.fit
    return [
        f"error in mm on {curve.test_presses} presses never trained on",
        "presses   mean  standard error",
        *(f"{row['presses']:7d} {row['mean_mm']:6.2f}  {row['standard_error_mm']:14.2f}" for row in curve.points),
        f"fit: {fit['floor_mm']:.2f} mm + {fit['factor_mm']:.3g} mm / presses^{fit['exponent']:.2f}",
        curve.advice,
    ]
